"""Maps of layouts: what is drawn, where obstacles are cut, where contact is marked, and how large the view is."""

from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from tests.plotting.straight import contacts, layout_grid
from tests.trials import flights, trials
from torchgco.base.errors import InputError
from torchgco.judging.contact import BETWEEN
from torchgco.plotting.bodies import Ball, Box, bodies
from torchgco.plotting.scene import scene_of
from torchgco.plotting.style import DASHES, solver_colours
from torchgco.scenarios import Mazes

MARKS = {"X": "contact", "o": "short", "D": "infeasible"}


def plane(count: int = 3, **more: Any) -> dict[str, np.ndarray]:
    centers = np.tile([[0.5, 0.2], [0.2, 0.8]], (count, 1, 1))
    radii = np.tile([0.1, np.nan], (count, 1))
    start, goal = np.zeros(6), np.array([1.0, 1.0, 0, 0, 0, 0])
    scalars = {"vehicle_radius": np.array(0.05), "goal_radius": np.array(0.3), "dt": np.array(0.5)}
    return {"centers": centers, "radii": radii, "start": start, "goal": goal, **scalars, **more}


def space(sphere: list[float], radius: float = 0.5) -> dict[str, np.ndarray]:
    """One sphere between (0, 0, 0) and (10, 0, 0)."""
    ends = {"start": np.zeros(14), "goal": np.array([10.0, *np.zeros(13)])}
    return {"centers": np.array([[sphere]]), "radii": np.array([[radius]]), "vehicle_radius": np.array(0.3), **ends}


def straight(count: int = 3, knots: int = 5, n: int = 6, goal: Any = (1.0, 1.0)) -> np.ndarray:
    states = np.zeros((count, knots, n))
    states[..., : len(goal)] = np.linspace(0, 1, knots)[:, None] * np.array(goal)
    return states


def shapes(ax: Axes, dotted: bool = False, filled: bool | None = None) -> list[np.ndarray]:
    """Outlines of the obstacles of a panel: the filled ones, those around them, or the dotted and dashed ones."""
    found = []
    for held in ax.collections:
        if isinstance(held, PolyCollection) and (held.get_linestyle()[0][1] is not None) == dotted:
            fill = len(held.get_facecolor()) > 0
            if filled is None or fill == filled:
                found += [path.vertices for path in held.get_paths()]
    return found


def widths(found: list[np.ndarray]) -> list[float]:
    return sorted(round(float(np.ptp(shape[:, 0])), 6) for shape in found)


def marks(ax: Axes) -> dict[str, list[tuple[float, ...]]]:
    lines = [line for line in ax.lines if line.get_marker() in MARKS]
    return {MARKS[line.get_marker()]: [tuple(p) for p in line.get_xydata().round(9)] for line in lines}


def courses(ax: Axes, knots: int = 5) -> list[Line2D]:
    return [line for line in ax.lines if len(line.get_xdata()) == knots]


def words(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


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
    assert widths(shapes(ax)) == [0.2, 0.3], "one obstacle, as it is and with the vehicle; the absent one is not drawn"
    rings = [patch.get_radius() for patch in ax.patches if isinstance(patch, Circle)]
    assert rings == [0.3]
    points = [tuple(line.get_xydata()[0]) for line in ax.lines if line.get_marker() in ("s", "*")]
    assert points == [(0, 0), (1, 1)]
    assert [text.get_text() for text in figure.texts] == ["forest (quadrotor), seed 0"]
    figure.draw_without_rendering()
    top = max(ax.get_tightbbox().y1 for ax in figure.axes)
    assert top <= figure.legends[0].get_window_extent().y0, "the legend covers no panel"


def test_the_studied_solver_is_drawn_over_the_others_each_with_its_look() -> None:
    ax = layout_grid(plane(), {"gco": straight(), "mine": straight()}, ENDS).axes[0]
    below, above = sorted(courses(ax), key=lambda line: line.get_zorder())
    colours = solver_colours(["gco", "mine"])
    assert (above.get_color(), below.get_color()) == (colours["gco"], colours["mine"])
    assert above.get_linewidth() < below.get_linewidth(), "one of the same course shows at its sides"
    expected = Line2D([], [], linestyle=DASHES[colours["mine"]], linewidth=below.get_linewidth())
    assert below._dash_pattern == expected._dash_pattern


def test_marks_tell_how_flights_end() -> None:
    figure = layout_grid(plane(), {"mine": straight()}, ENDS)
    assert [marks(ax) for ax in figure.axes] == [{}, {"short": [(1, 1)]}, {"infeasible": [(1, 1)]}]
    assert {"feasible, short of the goal", "infeasible without contact"} < set(words(figure))
    assert "contact" not in words(figure) and not any("cut" in word for word in words(figure))


def test_contact_is_marked_where_it_is_deepest_and_the_goal_stays_on_top() -> None:
    layouts = plane(centers=np.array([[[0.52, 0.5], [0.9, 1.02]]] * 3), radii=np.full((3, 2), 0.1))
    figure = layout_grid(layouts, {"mine": straight()}, trials(*flights("mine", [False] * 3)))
    for ax in figure.axes[::2]:
        (first, second) = marks(ax)["contact"]
        half = 0.5 / (4 * BETWEEN)  # of a piece: four stages from 0 to 1
        assert np.allclose(first, 0.51, atol=half) and 0.9 < second[0] < 1 and "infeasible" not in marks(ax)
        crosses = next(line for line in ax.lines if line.get_marker() == "X")
        assert crosses.get_color() == solver_colours(["mine"])["mine"]
        star = next(line for line in ax.lines if line.get_marker() == "*")
        assert star.get_zorder() > max(line.get_zorder() for line in ax.lines if line is not star)
    assert "contact" in words(figure)


def test_contact_between_knots_counts_and_follows_moving_obstacles() -> None:
    leap = np.array([[0.0, 0.0], [1.0, 0.0]])
    still = scene_of(plane(1, centers=np.array([[[0.5, 0.05]]]), radii=np.array([[0.1]])))
    assert contacts(still, 0, leap).tolist() == [[0.5, 0.0]]
    grazed = scene_of(plane(1, centers=np.array([[[0.5, 0.1426]]]), radii=np.array([[0.1]])))
    assert len(contacts(grazed, 0, leap)) == 0, "bodies touch at 0.95 of their radii"
    layouts = plane(1, centers=np.array([[[0.5, 1.0]]]), radii=np.array([[0.1]]))
    meets, late = ({**layouts, "velocities": np.array([[[0.0, v]]])} for v in (-4.0, -1.0))
    assert len(contacts(scene_of(meets), 0, leap)) == 1 and len(contacts(scene_of(late), 0, leap)) == 0


def test_a_solver_without_a_trajectory_is_marked_at_the_start() -> None:
    states = straight()
    states[2] = np.nan
    ax = layout_grid(plane(), {"mine": states}, ENDS).axes[2]
    assert marks(ax) == {"infeasible": [(0, 0)]}


def test_a_solver_that_stays_at_the_start_hides_nothing_and_is_named() -> None:
    rows = trials(*flights("gco", [True] * 3), *({"solver": "hold", "layout": i, "reached": False} for i in range(3)))
    figure = layout_grid(plane(), {"gco": straight(), "hold": np.zeros((3, 5, 6))}, rows)
    assert all(len(courses(ax)) == 1 and not marks(ax) for ax in figure.axes)
    assert "hold: stays at the start" in words(figure)


def test_at_most_rows_times_columns_layouts_are_shown() -> None:
    table = trials(*flights("gco", [True] * 9))
    assert len(layout_grid(plane(9), {"gco": straight(9)}, table, columns=2, rows=2).axes) == 4


def test_ids_assign_trials_to_layouts() -> None:
    layouts = plane(2, layout=np.array([2, 0]))
    axes = layout_grid(layouts, {"mine": straight(2)}, ENDS).axes
    assert [ax.get_title(loc="left") for ax in axes] == ["layout 2", "layout 0"]
    assert [list(marks(ax)) for ax in axes] == [["infeasible"], []]


def test_ends_may_differ_by_layout() -> None:
    goals = np.array([[1.0, 1.0], [2.0, 0.0], [0.0, 2.0]])
    axes = layout_grid(plane(goal=goals), {"gco": straight()}, ENDS).axes
    stars = [tuple(line.get_xydata()[0]) for ax in axes for line in ax.lines if line.get_marker() == "*"]
    assert stars == [(1, 1), (2, 0), (0, 2)]


def test_neither_a_diverging_trajectory_nor_a_long_wall_shrinks_the_map() -> None:
    states = straight()
    states[2, -1] = 1e6
    wall = {"box_centers": np.array([[[0.5, 0.0]]] * 3), "box_half_sizes": np.array([[[0.01, 26.0]]] * 3)}
    ax = layout_grid(plane(**wall), {"mine": states}, ENDS).axes[0]
    assert ax.get_xlim()[1] < 1.6 and -0.4 < ax.get_ylim()[0] < 0 and 1.3 < ax.get_ylim()[1] < 1.6


def test_a_detour_that_reaches_the_goal_is_shown_whole() -> None:
    states = straight()
    states[0, 2, 1] = -9.0
    rows = layout_grid(plane(), {"gco": states}, ENDS, columns=1).axes
    assert rows[0].get_ylim()[0] < -9 and rows[1].get_ylim()[0] > -1, "only its own row of panels grows"


def test_moving_obstacles_are_drawn_when_they_are_passed() -> None:
    layouts = plane(1, centers=np.array([[[0.5, 1.2]]]), radii=np.array([[0.1]]), velocities=np.array([[[0.0, -0.4]]]))
    figure = layout_grid(layouts, {"gco": straight(1, knots=9)}, ENDS)
    (ax,) = figure.axes
    t = 0.5 * np.arange(9)
    path, ball = straight(1, knots=9)[0, :, :2], np.stack([np.full(9, 0.5), 1.2 - 0.4 * t], axis=-1)
    k = int(np.linalg.norm(path - ball, axis=1).argmin())
    assert 0 < k < 8 and ax.texts[0].get_text() == f"{t[k]:.1f} s"
    found = [(shape[:-1].mean(axis=0), np.ptp(shape[:, 0])) for shape in shapes(ax, dotted=True) + shapes(ax)]
    margin = float(layouts["vehicle_radius"])
    for (at, wide), (wanted, radius) in zip(found, ((ball[k], 0.1), (path[k], margin)), strict=True):
        assert at == pytest.approx(wanted) and wide == pytest.approx(2 * radius), "the obstacle, and the vehicle then"
    trail = next(line for line in ax.lines if len(line.get_xdata()) == 2)
    assert trail.get_xydata() == pytest.approx(np.array([ball[k - 2], ball[k]])), "its last second"
    assert any("last second" in word for word in words(figure))


def test_in_space_spheres_are_cut_at_the_height_of_the_studied_solver() -> None:
    states = straight(1, knots=21, n=14, goal=(10.0, 0.0, 0.0))
    other = straight(1, knots=21, n=14, goal=(10.0, 0.0, 0.7))
    rows = trials(*flights("gco", [True]), *flights("mine", [True]))
    figure = layout_grid(space([5.0, 1.0, 0.3]), {"gco": states, "mine": other}, rows)
    top, side = figure.axes
    assert widths(shapes(top, filled=True)) == pytest.approx([2 * np.sqrt(0.5**2 - 0.3**2)], abs=2e-3)
    assert widths(shapes(top, filled=False)) == pytest.approx([2 * np.sqrt(0.8**2 - 0.3**2)], abs=2e-3)
    assert shapes(side, filled=True) == [] and shapes(side) == [], "at this y there is no obstacle"
    assert widths(shapes(side, dotted=True)) == [1.0] and shapes(top, dotted=True) == []
    assert (top.get_ylabel(), side.get_ylabel(), side.get_xlabel()) == ("y [m]", "z [m]", "x [m]")
    assert {"obstacle, cut at the height (below: at the y) of gco", "near gco, missed by this cut"} < set(words(figure))


def test_a_trunk_that_the_flight_turns_away_from_is_not_cut_in_the_side_view() -> None:
    sizes = {"box_half_sizes": np.array([[[0.0, 0.0, 8.0]]]), "box_radii": np.array([[0.3]])}
    layouts = space([np.nan] * 3, np.nan) | {"box_centers": np.array([[[5.0, 0.0, 0.0]]])} | sizes
    states = straight(1, knots=41, n=14, goal=(10.0, 0.0, 0.0))
    states[0, :, 1] = np.interp(states[0, :, 0], [4.0, 4.75, 6.0, 10.0], [0.0, 2.0, 2.0, 0.0])
    top, side = layout_grid(layouts, {"gco": states}, trials(*flights("gco", [True]))).axes
    assert len(shapes(top)) == 2 and shapes(side) == [] and len(shapes(side, dotted=True)) == 1
    assert shapes(top, dotted=True) == []


def test_a_moving_obstacle_that_stays_far_is_left_out() -> None:
    near, far = (
        plane(1, centers=np.array([[[0.5, y]]]), radii=np.array([[0.1]]), velocities=np.array([[[0.01, 0.0]]]))
        for y in (0.6, 1.3)
    )
    for layouts, count in ((near, 1), (far, 0)):
        (ax,) = layout_grid(layouts, {"gco": straight(1)}, ENDS).axes
        assert len(shapes(ax)) == len(shapes(ax, dotted=True)) == len(ax.texts) == count


def test_in_space_what_is_far_from_the_flight_is_left_out() -> None:
    states = straight(1, knots=21, n=14, goal=(10.0, 0.0, 0.0))
    figure = layout_grid(space([5.0, 0.4, 3.0]), {"gco": states}, trials(*flights("gco", [True])))
    top, side = figure.axes
    assert shapes(top) == shapes(top, dotted=True) == [] and len(shapes(side)) == 2
    assert not any("near" in word for word in words(figure))


def test_the_openings_of_a_maze_are_seen_from_above_and_from_the_side() -> None:
    layouts = Mazes(walls=1, loose=0).draw([0], seed=3)
    pieces = [body for body in bodies(layouts.arrays(), 0) if isinstance(body, Box)]
    left, _, under, over = (body.center for body in pieces)
    gap = np.array([pieces[0].center[1] + pieces[0].half[1], pieces[1].center[1] - pieces[1].half[1]])
    opening = np.array([left[0], gap.mean(), 0.5 * (under[2] + over[2] + pieces[2].half[2] - pieces[3].half[2])])
    states = np.zeros((1, 41, 14))
    for axis, (a, b, c) in enumerate(zip(layouts.start[0, :3], opening, layouts.goal[0, :3], strict=True)):
        states[0, :, axis] = np.interp(np.arange(41), [0, 20, 40], [a, b, c])
    figure = layout_grid(layouts.arrays(), {"gco": states}, trials(*flights("gco", [True])))
    top, side = figure.axes
    for ax, axis in ((top, 1), (side, 2)):
        solid = sorted((shape[:, 1].min(), shape[:, 1].max()) for shape in shapes(ax, filled=True))
        assert len(solid) == 2 and solid[0][1] < opening[axis] < solid[1][0]
        assert solid[1][0] - solid[0][1] == pytest.approx(1.8)
        assert marks(ax) == {}


@pytest.mark.parametrize("plane", [(0, 1), (0, 2), (1, 2)])
@pytest.mark.parametrize(("radius", "margin"), [(0.0, 0.0), (0.0, 0.3), (0.2, 0.0), (0.2, 0.3)])
def test_sections_against_distances(plane: tuple[int, int], radius: float, margin: float) -> None:
    rng = np.random.default_rng(0)
    (hidden,) = {0, 1, 2} - set(plane)
    sides = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    for body in (
        Box(np.array([0.1, -0.2, 0.3]), np.array([0.7, 0.5, 0.3]), sides, radius),
        Box(np.array([0.1, -0.2, 0.3]), np.array([0.6, 0.0, 0.0]), np.eye(3), radius + 0.2),
        Ball(np.array([0.1, -0.2, 0.3]), 0.5 + radius, np.zeros(3)),
    ):
        for at in (body.center[hidden], body.center[hidden] + 0.25, body.center[hidden] + 9.0):
            shape = body.section(plane, at, margin)
            places = rng.uniform(-1.6, 1.6, (4000, 3))
            places[:, hidden] = at
            reach = body.radius + margin
            inside = body.distance(places, np.zeros(4000)) < reach
            if shape is None:
                assert not inside.any()
                continue
            ahead = np.roll(shape, -1, axis=0) - shape
            away = places[:, None, list(plane)] - shape
            drawn = (ahead[:, 0] * away[..., 1] - ahead[:, 1] * away[..., 0] >= -1e-9).all(axis=1)
            # Outlines are polygons of 72 corners, so a thin rim may differ.
            assert (inside != drawn).mean() < 0.006
            rim = np.insert(shape, hidden, at, axis=1)
            assert body.distance(rim, np.zeros(len(rim))) == pytest.approx(np.full(len(rim), reach), abs=0.01)


def test_trajectories_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match=r"trajectories\.gco: expected 3 trajectories"):
        layout_grid(plane(), {"gco": straight(2)}, ENDS)
    with pytest.raises(InputError, match="a row of other for layout 0"):
        layout_grid(plane(), {"other": straight()}, ENDS)


def test_several_tasks_have_no_title_and_colours_are_those_of_all_figures() -> None:
    rows = pd.concat([ENDS, ENDS.assign(scenario="trap", layout=lambda held: held.layout + 9)])
    figure = layout_grid(plane(), {"gco": straight()}, rows)
    assert [text.get_text() for text in figure.texts] == [""]
    assert {to_hex(line.get_color()).upper() for line in courses(figure.axes[0])} == {solver_colours(["gco"])["gco"]}
