import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.patches import Circle, Rectangle

from tests.trials import flights, trials
from torchgco.errors import InputError
from torchgco.experiments.statistics import summarise
from torchgco.plotting.convergence import convergence_figure
from torchgco.plotting.distributions import clearance_figure, is_spread, violation_figure
from torchgco.plotting.layouts import layout_grid
from torchgco.plotting.rates import rates_figure
from torchgco.plotting.style import PALETTE, save, solver_colours


def bars(ax: Axes) -> list[Rectangle]:
    return [patch for patch in ax.patches if isinstance(patch, Rectangle)]


def colour(patch: Rectangle) -> str:
    return to_hex(patch.get_facecolor()).upper()


def test_figures_need_no_pyplot() -> None:
    modules = ("rates", "sweeps", "layouts", "distributions", "convergence", "style", "trajectory", "missions")
    modules += ("animation",)
    code = "import sys\n" + "".join(f"import torchgco.plotting.{name}\n" for name in modules)
    code += "sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_solver_keeps_its_colour_among_any_others() -> None:
    names = ["gco", "al_ilqr", "mine", "fatrop"]
    together = solver_colours(names)
    assert together == solver_colours(names[::-1])
    assert len(set(together.values())) == 4
    assert solver_colours(["al_ilqr"]) == {"al_ilqr": together["al_ilqr"]}
    assert set(solver_colours([f"s{i}" for i in range(7)]).values()) == set(PALETTE)


def test_more_solvers_than_colours_still_have_one_each() -> None:
    assert len(solver_colours([f"s{i}" for i in range(20)])) == 20


def test_save_makes_the_folder_and_writes_a_picture(tmp_path: Path) -> None:
    figure = rates_figure(summarise(trials({})))
    path = save(figure, tmp_path / "new" / "rates.png")
    assert path.read_bytes().startswith(b"\x89PNG")


def test_bars_are_as_high_as_the_rates_and_carry_the_interval() -> None:
    table = trials(*flights("gco", [True] * 3 + [False]), *flights("mine", [True] + [False] * 3))
    summary = summarise(table)
    figure = rates_figure(summary)
    (ax,) = figure.axes
    heights = {name: [bar.get_height() for bar in bars(ax) if colour(bar) == c] for name, c in coloured(summary)}
    assert heights == {"gco": [0.75] * 3, "mine": [0.25] * 3}
    ends = sorted({round(y, 9) for c in ax.collections for path in c.get_paths() for y in path.vertices[:, 1]})
    expected = summary[["reached_low", "reached_high"]].to_numpy().ravel()
    assert ends == pytest.approx(sorted(expected))
    assert [text.get_text() for text in ax.texts] == ["3/4"] * 3 + ["1/4"] * 3


def coloured(summary: pd.DataFrame) -> list[tuple[str, str]]:
    return [(name, c.upper()) for name, c in solver_colours(summary["solver"]).items()]


def test_an_undefined_rate_has_no_bar() -> None:
    (ax,) = rates_figure(summarise(trials({"success": pd.NA}))).axes
    assert len(bars(ax)) == 2
    assert ax.texts[-1].get_text() == "not defined"


def test_solvers_with_different_numbers_of_trials_are_marked() -> None:
    same, other = (trials(*flights("gco", [True] * 3), *flights("mine", [True] * n)) for n in (3, 2))
    assert rates_figure(summarise(same)).axes[0].get_xlabel() == ""
    assert rates_figure(summarise(other)).axes[0].get_xlabel() == "different numbers of layouts: gco 3, mine 2"


def test_each_task_has_its_panel() -> None:
    table = trials(*flights("gco", [True] * 2), *flights("gco", [True] * 2, scenario="trap", model="planar"))
    for figure in (rates_figure(summarise(table)), clearance_figure(table), violation_figure(table)):
        assert [ax.get_title(loc="left") for ax in figure.axes] == ["forest (quadrotor)", "trap (planar)"]


def spread(figure: Any, column: str, values: list[float], solver: str = "gco") -> Axes:
    (ax,) = figure(trials(*({"layout": i, column: v, "solver": solver} for i, v in enumerate(values)))).axes
    return ax


def share(ax: Axes, x: float, line: int = 0) -> float:
    """The height of a step line at x."""
    at, height = (np.asarray(held) for held in ax.lines[line].get_data())
    return float(height[np.searchsorted(at, x, side="right") - 1])


def test_the_share_of_collisions_is_read_at_the_surface() -> None:
    ax = spread(clearance_figure, "clearance", [0.33, -0.01, 0.01, 0.02, -0.21, np.nan])
    assert [share(ax, x) for x in (-0.22, -0.2, 0.0, 0.015, 0.34)] == pytest.approx([0, 1 / 6, 2 / 6, 3 / 6, 5 / 6])
    assert ax.lines[0].get_drawstyle() == "steps-post" and "gco 1" in ax.get_xlabel()


def test_solvers_are_drawn_over_each_other_at_their_own_values() -> None:
    """Bars side by side would move a violation beyond the tolerance."""
    rows = [{"solver": name, "layout": i, "violation": v} for name in ("a", "b") for i, v in enumerate((9e-4, 2e-3))]
    (ax,) = violation_figure(trials(*rows)).axes
    for line in (0, 1):
        assert [share(ax, x, line) for x in (-3.05, -3.0, -2.6)] == [0, 0.5, 1]
    assert np.asarray(ax.lines[2].get_xdata()).tolist() == [-3, -3]


def test_violations_below_the_floor_are_drawn_there() -> None:
    ax = spread(violation_figure, "violation", [0.0, 1e-15, 3e-5, 2.0, np.inf])
    assert [share(ax, x) for x in (-12.1, -12, -4, 0.31)] == pytest.approx([0, 0.4, 0.6, 0.8])
    assert "gco 1" in ax.get_xlabel()


@pytest.mark.parametrize("column", ["clearance", "violation"])
def test_what_has_no_spread_is_not_drawn(column: str) -> None:
    figure = clearance_figure if column == "clearance" else violation_figure
    for values in ([0.05], [np.nan, np.nan], [0.05, np.inf]):
        assert not is_spread(trials(*({"layout": i, column: v} for i, v in enumerate(values))), column)
    rows = [{"layout": i, column: 0.05 + i} for i in range(2)] + [{"scenario": "empty", column: np.nan}]
    assert is_spread(trials(*rows), column)
    assert [ax.get_title(loc="left") for ax in figure(trials(*rows)).axes] == ["forest (quadrotor)"]


def plane(count: int = 3, **more: Any) -> dict[str, np.ndarray]:
    centers = np.tile([[0.5, 0.5], [0.2, 0.8]], (count, 1, 1))
    radii = np.tile([0.1, np.nan], (count, 1))
    start, goal = np.zeros(6), np.array([1.0, 1.0, 0, 0, 0, 0])
    scalars = {"vehicle_radius": np.array(0.05), "goal_radius": np.array(0.3), "dt": np.array(0.5)}
    return {"centers": centers, "radii": radii, "start": start, "goal": goal, **scalars, **more}


def straight(count: int = 3, knots: int = 5, n: int = 6) -> np.ndarray:
    return np.broadcast_to(np.linspace(0, 1, knots)[:, None], (count, knots, n)).copy()


def discs(ax: Axes) -> list[float]:
    """Radii of all obstacles drawn in a panel, the faded copies of moving ones included."""
    paths = [path for held in ax.collections for path in held.get_paths()]
    return sorted(round(float(np.ptp(path.vertices[:, 0])) / 2, 6) for path in paths)


ENDS = trials(
    *flights("gco", [True, True, True]),
    {"solver": "mine", "layout": 0},
    {"solver": "mine", "layout": 1, "reached": False},
    {"solver": "mine", "layout": 2, "reached": False, "feasible": False},
)


def test_a_panel_per_layout_with_obstacles_ends_and_a_trajectory_per_solver() -> None:
    figure = layout_grid(plane(), {"gco": straight(), "mine": straight()}, ENDS, columns=2, rows=2)
    assert [ax.get_title(loc="left") for ax in figure.axes] == ["layout 0", "layout 1", "layout 2"]
    ax = figure.axes[0]
    assert discs(ax) == [0.1, 0.15], "one obstacle, at its radius and with the vehicle's; the absent one is not drawn"
    rings = [patch.get_radius() for patch in ax.patches if isinstance(patch, Circle)]
    assert rings == [0.3]
    points = [tuple(line.get_xydata()[0]) for line in ax.lines if line.get_marker() in ("s", "*")]
    assert points == [(0, 0), (1, 1)]
    assert sum(len(line.get_xdata()) == 5 for line in ax.lines) == 2


def test_failed_trajectories_are_dashed_and_end_in_a_mark() -> None:
    figure = layout_grid(plane(), {"mine": straight()}, ENDS)
    looks = []
    for ax in figure.axes:
        path = next(line for line in ax.lines if len(line.get_xdata()) == 5)
        marks = [(line.get_marker(), *line.get_xydata()[0]) for line in ax.lines if line.get_marker() in ("o", "X")]
        looks.append((path.get_linestyle(), marks))
    assert looks == [("-", []), ("--", [("o", 1, 1)]), ("--", [("X", 1, 1)])]
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert any("infeasible" in label for label in labels) and any("short" in label for label in labels)


def test_a_solver_without_a_trajectory_is_marked_at_the_start() -> None:
    states = straight()
    states[2] = np.nan
    ax = layout_grid(plane(), {"mine": states}, ENDS).axes[2]
    assert [tuple(line.get_xydata()[0]) for line in ax.lines if line.get_marker() == "X"] == [(0, 0)]


def test_at_most_rows_times_columns_layouts_are_shown() -> None:
    table = trials(*flights("gco", [True] * 9))
    assert len(layout_grid(plane(9), {"gco": straight(9)}, table, columns=2, rows=2).axes) == 4


def test_ids_assign_trials_to_layouts() -> None:
    layouts = plane(2, layout=np.array([2, 0]))
    axes = layout_grid(layouts, {"mine": straight(2)}, ENDS).axes
    assert [ax.get_title(loc="left") for ax in axes] == ["layout 2", "layout 0"]
    assert any(line.get_marker() == "X" for line in axes[0].lines)
    assert not any(line.get_marker() == "X" for line in axes[1].lines)


def test_ends_may_differ_by_layout() -> None:
    goals = np.array([[1.0, 1.0], [2.0, 0.0], [0.0, 2.0]])
    axes = layout_grid(plane(goal=goals), {"gco": straight()}, ENDS).axes
    stars = [tuple(line.get_xydata()[0]) for ax in axes for line in ax.lines if line.get_marker() == "*"]
    assert stars == [(1, 1), (2, 0), (0, 2)]


def test_a_diverging_trajectory_does_not_shrink_the_map() -> None:
    states = straight()
    states[1, -1] = 1e6
    ax = layout_grid(plane(), {"gco": states}, ENDS).axes[0]
    assert ax.get_xlim()[1] < 3 and ax.get_xlim()[0] < 0 and ax.get_ylim()[1] > 1.3


def test_moving_obstacles_leave_a_fading_trail() -> None:
    velocities = np.zeros((3, 2, 2))
    velocities[1, 0] = [0.1, 0.0]
    axes = layout_grid(plane(velocities=velocities), {"gco": straight()}, ENDS).axes
    assert len(discs(axes[0])) == 2 and len(discs(axes[1])) > 3
    trail = next(line for line in axes[1].lines if line.get_linestyle() == ":")
    assert trail.get_xydata() == pytest.approx(np.array([[0.5, 0.5], [0.7, 0.5]])), "4 stages of 0.5 s at 0.1 m/s"
    alphas = [held.get_alpha() for held in axes[1].collections[:4]]
    assert alphas == sorted(alphas), "the farther in time, the fainter"


def test_in_space_obstacles_are_shaded_by_height_highest_on_top() -> None:
    layouts = plane(1)
    layouts["centers"] = np.array([[[0.5, 0.5, 2.0], [0.4, 0.5, -1.0]]])
    layouts["radii"] = np.array([[0.1, 0.2]])
    figure = layout_grid(layouts, {"gco": straight(1, n=14)}, ENDS)
    panel, bar = figure.axes
    assert bar.get_ylabel() == "height of obstacles [m]" and bar.get_ylim() == (-1, 2)
    fills = panel.collections[-2]
    radii = [round(float(np.ptp(path.vertices[:, 0])) / 2, 6) for path in fills.get_paths()]
    low, high = fills.get_facecolor()[:, :3].sum(axis=1)
    assert radii == [0.2, 0.1] and low > high, "the highest is drawn last and darkest"


def test_trajectories_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match=r"trajectories\.gco: expected shape \(3, N\+1, n\)"):
        layout_grid(plane(), {"gco": straight(2)}, ENDS)
    with pytest.raises(InputError, match="a row of other for layout 0"):
        layout_grid(plane(), {"other": straight()}, ENDS)


def trace(cost: list[float], outer: list[int], guided: list[int], problem: int = 0) -> pd.DataFrame:
    rows = {"element": problem, "iteration": range(len(cost)), "outer": outer, "cost": cost}
    return pd.DataFrame(rows).assign(guided=np.array(guided, bool), merit=cost, violation=0.0)


OUTER, GUIDED = [0, 0, 1, 1, 2, 3], [0, 0, 1, 1, 0, 1]


def test_cost_with_updates_as_lines_and_guidance_as_bands() -> None:
    cost = [5.0, 4.0, 6.0, 3.0, 2.0, 2.0]
    (ax,) = convergence_figure(trace(cost, OUTER, GUIDED)).axes
    bands = [(bar.get_x(), bar.get_x() + bar.get_width()) for bar in bars(ax)]
    assert bands == [(1.5, 3.5), (4.5, 5.5)]
    curve = next(line for line in ax.lines if len(line.get_xdata()) == 6)
    assert curve.get_ydata().tolist() == cost
    assert [line.get_xdata()[0] for line in ax.lines if line is not curve] == [1.5, 3.5, 4.5]
    assert ax.get_yscale() == "linear"


def test_rows_of_a_trace_may_come_in_any_order() -> None:
    cost = [5.0, 4.0, 6.0, 3.0, 2.0, 2.0]
    (ax,) = convergence_figure(trace(cost, OUTER, GUIDED).iloc[::-1]).axes
    assert cost in [line.get_ydata().tolist() for line in ax.lines if len(line.get_ydata()) == 6]
    assert len(ax.lines) == 4 and len(bars(ax)) == 2


def test_costs_of_many_magnitudes_are_drawn_logarithmically() -> None:
    (ax,) = convergence_figure(trace([1e6, 10.0], [0, 0], [0, 0])).axes
    assert ax.get_yscale() == "log"


def test_the_first_or_the_requested_problems_are_shown() -> None:
    rows = pd.concat([trace([2.0, 1.0], [0, 0], [0, 0], problem) for problem in (3, 5, 7, 9, 11)])
    titles = [ax.get_title(loc="left") for ax in convergence_figure(rows).axes]
    assert titles == ["problem 3", "problem 5", "problem 7", "problem 9"]
    (ax,) = convergence_figure(rows, [11]).axes
    assert ax.get_title(loc="left") == "problem 11"
    with pytest.raises(InputError, match="elements"):
        convergence_figure(rows, [4])


def test_a_trace_without_its_columns_is_refused() -> None:
    with pytest.raises(InputError, match="guided"):
        convergence_figure(trace([1.0], [0], [0]).drop(columns="guided"))
