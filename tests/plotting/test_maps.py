"""Maps in pictures: contact is marked, unknown cells are told from occupied ones, and paths stay in view."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

import torchgco
from tests.plotting.straight import contacts, layout_grid, study_figure
from tests.trials import flights, trials
from tests.view.scenes import solution
from tests.view.test_packing import part
from torchgco import DistanceField, Field, FunctionDynamics, Goal, OccupancyGrid, Problem, QuadraticCost
from torchgco.experiments.statistics.statistics import summarise
from torchgco.plotting import missions
from torchgco.plotting.animation import mission_animation
from torchgco.plotting.course import Course
from torchgco.plotting.maps import UNSEEN
from torchgco.plotting.scene import scene_of

N, DT, RADIUS = 60, 0.1, 0.2
WALLS = [2.15, 3.65, 5.15, 6.65, 8.15]  # m: the middles of five walls, 0.3 m thick


def cells() -> np.ndarray:
    """12 m by 6 m of cells of 0.1 m: a room with five walls and a patch that nobody knows."""
    held = np.zeros((120, 60), np.float32)
    for k, x in enumerate((20, 35, 50, 65, 80)):
        held[x : x + 3, slice(0, 45) if k % 2 else slice(15, 60)] = 1
    held[0] = held[-1] = held[:, 0] = held[:, -1] = 1
    held[95:112, 35:55] = np.nan
    return held


SHARE = np.linspace(0, 1, N + 1)[:, None]
THROUGH = np.array([0.5, 3.0]) + SHARE * [10.5, 0.0]
SHORT = np.array([0.5, 3.0]) + SHARE * [0.6, -2.4]  # it ends 2.4 m beside the line from start to goal
AWAY = np.array([0.5, 3.0]) + SHARE * [-30.0, 60.0]
PATHS = np.stack((THROUGH, SHORT, AWAY))


def layouts(unknown: str = "occupied", count: int = 3) -> dict[str, Any]:
    ends = {"start": np.array([0.5, 3.0, 0, 0]), "goal": np.array([11.0, 3.0, 0, 0])}
    scalars = {"vehicle_radius": np.array(RADIUS), "goal_radius": np.array(0.3), "dt": np.array(DT)}
    held = {"map_occupied": cells(), "map_origin": np.zeros(2), "map_resolution": np.array(0.1)}
    return {
        "centers": np.zeros((count, 0, 2)), "radii": np.zeros((count, 0)), "map_unknown": np.array(unknown),
        **ends, **scalars, **held,
    }  # fmt: skip


def table() -> pd.DataFrame:
    return trials(
        *({"solver": "gco", "layout": i, "reached": False, "feasible": i == 1, "cost": 1.0} for i in range(3))
    ).assign(best_cost=1.0)


def words(figure: Figure) -> list[str]:
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def crosses(ax: Axes) -> np.ndarray:
    held = [np.column_stack(line.get_data()) for line in ax.lines if line.get_marker() == "X"]
    return np.concatenate(held) if held else np.empty((0, 2))


def blue(figure: Figure) -> int:
    """How many points of the panels, without the legend, have the colour of unknown cells."""
    for legend in figure.legends:
        legend.set_visible(False)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = np.asarray(canvas.buffer_rgba())[..., :3]
    return int((np.abs(picture / 255.0 - to_rgb(UNSEEN)).max(-1) < 0.01).sum())


def check_layouts(first: Axes, short: Axes, away: Axes) -> None:
    np.testing.assert_allclose(crosses(first), [[x, 3.0] for x in WALLS], atol=0.05)
    assert len(crosses(short)) == 0
    (low, high), (left, _) = short.get_ylim(), short.get_xlim()
    assert low < SHORT[-1, 1] < high, "its end is in the picture"
    assert away.get_xlim()[0] > -3 and away.get_ylim()[1] < 9, "one that goes far doesn't shrink the rest"
    arrow = next(line for line in away.lines if isinstance(line.get_marker(), tuple))
    x, y = np.column_stack(arrow.get_data())[0]
    assert np.isclose(y, away.get_ylim()[1]) or np.isclose(x, left)


def test_layouts_mark_contact_with_a_map_and_keep_ends_in_view() -> None:
    figure = layout_grid(layouts(), {"gco": PATHS}, table())
    check_layouts(*figure.axes)
    assert {"contact", "feasible, short of the goal", "leaves the picture", "obstacle"} < set(words(figure))
    assert "unknown, counts as occupied" in words(figure) and "infeasible without contact" not in words(figure)
    assert len(contacts(scene_of(layouts()), 0, THROUGH)) == 5
    assert blue(figure) > 100


def test_unknown_cells_that_count_as_free_are_drawn_and_no_contact() -> None:
    inside = np.array([10.0, 4.2]) + SHARE * [0.3, 0.3]
    for unknown, count in (("occupied", 1), ("free", 0)):
        held = layouts(unknown, 1)
        assert len(contacts(scene_of(held), 0, inside)) == count
        figure = layout_grid(held, {"gco": inside[None]}, table())
        assert f"unknown, counts as {unknown}" in words(figure) and blue(figure) > 100


def test_the_figure_of_a_study_does_the_same() -> None:
    figure = study_figure(layouts(), {"gco": PATHS}, table(), summarise(table()))
    check_layouts(*figure.axes[:3])
    assert {"contact", "feasible, short of the goal", "unknown, counts as occupied"} < set(words(figure))
    assert blue(figure) > 100


def planned() -> Problem:
    dynamics = FunctionDynamics(lambda x, u: u, 2, 2, DT, "euler", slice(0, 2))
    cost = QuadraticCost([0.0] * 2, [1.0] * 2, [1.0] * 2, [11.0, 3.0])
    x0 = torch.tensor([[0.5, 3.0]]).double().repeat(3, 1)
    return Problem(dynamics, cost, [Field(OccupancyGrid(cells(), [0, 0], 0.1), RADIUS)], x0, N, Goal([11.0, 3.0], 0.3))


@pytest.mark.slow
def test_plots_and_pages_of_a_problem_do_the_same() -> None:
    problem, X = planned(), torch.from_numpy(PATHS)
    found = solution(problem, X)
    for b, count in ((0, 5), (1, 0)):
        figure = torchgco.plot(problem, found, b)
        assert len(crosses(figure.axes[0])) == count
    assert figure.axes[0].get_ylim()[0] < SHORT[-1, 1] and "unknown, counts as occupied" in words(figure)
    assert blue(figure) > 100
    text = found.show(problem).html
    one = part(text, "part-0")
    np.testing.assert_allclose(one["flights"][0]["contacts"], [[x, 3.0] for x in WALLS], atol=0.05)
    np.testing.assert_allclose(one["map"], [[0.0, 0.0], [12.0, 6.0]])
    held = [shape if "shared" not in shape else part(text, f"map-{shape['shared']}") for shape in one["obstacles"]]
    known, unknown = held
    assert known["unknown"] is None and unknown["unknown"] == "occupied"
    area = 4 * np.broadcast_to(unknown["half"], (unknown["count"], 2)).prod(-1).sum()
    assert abs(area - 0.01 * np.isnan(cells()).sum()) < 1e-2


def test_maps_of_their_own_share_a_legend() -> None:
    """The first problem's map is known, the second one's isn't."""
    known, problem = np.nan_to_num(cells()), planned()
    maps = Field(OccupancyGrid(np.stack([known, cells(), cells()]), [0, 0], 0.1), RADIUS)
    own = Problem(problem.dynamics, problem.cost, [maps], problem.x0, N, problem.goal)
    found = solution(own, torch.from_numpy(PATHS))
    figure = torchgco.plot(own, found, [0, 1])
    assert words(figure).count("unknown, counts as occupied") == 1 and blue(figure) > 100
    figure = torchgco.plot(own, found, 0)
    assert not any("unknown" in word for word in words(figure)) and blue(figure) == 0


@pytest.mark.slow
def test_pictures_of_missions_do_the_same(tmp_path: Path) -> None:
    room = np.repeat(cells()[:, :, None], 20, axis=2)
    field = DistanceField.of(OccupancyGrid(room, [0.0, 0.0, -1.0], 0.1))
    course = Course((), np.array([11.0, 3.0, 0.0]), 0.3, RADIUS, field)
    frame = pd.DataFrame({"t": DT * np.arange(N + 1), "x0": THROUGH[:, 0], "x1": THROUGH[:, 1], "x2": 0.0})
    plans = np.stack([np.column_stack((THROUGH, np.zeros(N + 1)))] * (N + 1))[:, :5]
    figure = missions.snapshots_figure(frame, plans, course, [20, N], DT)
    panels = [ax for ax in figure.axes if ax.get_label() != "<colorbar>"]
    assert [len(crosses(ax)) for ax in panels] == [2, 2, 5, 5]
    assert {"contact", "unknown, counts as occupied"} < set(words(figure)) and blue(figure) > 100
    assert mission_animation(frame.iloc[::20], plans[::20], course, 20 * DT, tmp_path / "flown.gif").stat().st_size > 0


def test_contact_of_flights_of_several_solvers_is_told_apart() -> None:
    table_ = trials(*flights("gco", [True]), {"solver": "al_ilqr", "layout": 0, "feasible": False, "reached": False})
    figure = layout_grid(layouts(count=1), {"gco": SHORT[None], "al_ilqr": THROUGH[None]}, table_)
    assert len(crosses(figure.axes[0])) == 5
