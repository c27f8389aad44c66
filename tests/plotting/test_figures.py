import pkgutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

import torchgco.plotting
from tests.trials import flights, trials
from torchgco.base.errors import InputError
from torchgco.experiments.statistics.statistics import summarise
from torchgco.plotting.convergence import convergence_figure
from torchgco.plotting.distributions import clearance_figure, is_spread, violation_figure
from torchgco.plotting.rates import rates_figure
from torchgco.plotting.style import DASHES, PALETTE, legend_columns, save, solver_colours
from torchgco.presets import PRESETS


def bars(ax: Axes) -> list[Rectangle]:
    return [patch for patch in ax.patches if isinstance(patch, Rectangle)]


def colour(patch: Rectangle) -> str:
    return to_hex(patch.get_facecolor()).upper()


@pytest.mark.slow
def test_figures_need_no_pyplot() -> None:
    modules = [module.name for module in pkgutil.iter_modules(torchgco.plotting.__path__)]
    assert {"rates", "animation"} <= {*modules}
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


def test_each_solver_of_the_library_has_a_look_of_its_own() -> None:
    names = sorted(PRESETS)
    assert len(set(solver_colours(names).values())) == len(names) == 15
    assert all(solver_colours([name])[name] == colour for name, colour in solver_colours(names).items())
    common = solver_colours(("gco", "al_ilqr", "gco_paper", "mppi")).values()
    assert len({DASHES[colour] for colour in common}) == len(common) and DASHES[PALETTE[0]] == "-"


def test_a_legend_takes_as_many_columns_as_fit() -> None:
    handles = [Line2D([], [], label=word) for word in ("a", "b", "a label of some length", "c", "d")]
    # Filled column by column: a, b | long, c | d are 0.72 + 2.19 + 0.72 inches wide.
    assert legend_columns(handles, 99.0) == 5
    assert legend_columns(handles, 3.7) == 3 and legend_columns(handles, 3.5) == 2 and legend_columns(handles, 1.0) == 1


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
