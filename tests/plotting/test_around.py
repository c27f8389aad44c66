"""The line below a figure of layouts: which flights pass around all obstacles, by slow geometry on a fine path."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.spatial import Delaunay

from tests.plotting.straight import layout_grid
from tests.plotting.test_layouts import plane, space
from tests.trials import flights, trials
from torchgco.plotting.around import passes_around
from torchgco.plotting.scene import scene_of


def arc(d: int, height: float, knots: int = 41) -> np.ndarray:
    """A path (K, d) from the origin to (10, 0, ...) that is `height` aside at its middle."""
    path = np.zeros((knots, d))
    path[:, 0] = np.linspace(0, 10, knots)
    path[:, 1] = height * np.sin(np.pi * path[:, 0] / 10)
    return path


def spheres(d: int, count: int = 6) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(d)
    centers = rng.uniform([2, *[-1] * (d - 1)], [8, *[1] * (d - 1)], (1, count, d))
    ends = {"start": np.zeros(d), "goal": np.array([10.0, *np.zeros(d - 1)])}
    return {"centers": centers, "radii": np.full((1, count), 0.3), "vehicle_radius": np.array(0.1), **ends}


@pytest.mark.parametrize("d", [2, 3])
def test_a_path_is_around_where_no_point_of_it_is_in_the_hull(d: int) -> None:
    layouts, rng = spheres(d), np.random.default_rng(0)
    surface = rng.standard_normal((2000, d))
    surface *= 0.3 / np.linalg.norm(surface, axis=1, keepdims=True)
    hull = Delaunay((layouts["centers"][0][:, None] + surface).reshape(-1, d)[:: 1 if d == 2 else 4])
    seen = []
    for height in np.linspace(-2.5, 2.5, 41):
        inside = bool((hull.find_simplex(arc(d, height, 1000)) >= 0).any())
        seen.append(passes_around(scene_of(layouts), 0, arc(d, height)))
        if inside:
            assert not seen[-1], height
    assert seen[0] and seen[-1] and not seen[20]
    assert (np.abs(np.diff(np.array(seen, dtype=int))) > 0).sum() == 2


def test_a_piece_that_cuts_the_hull_between_two_knots_is_not_around() -> None:
    layouts = spheres(2)
    assert not passes_around(scene_of(layouts), 0, np.array([[0.0, 0.0], [10.0, 0.0]]))


def drawn(heights: list[float], reached: list[bool], **more: Any) -> Figure:
    layouts = {name: np.repeat(a, len(heights), 0) if a.ndim > 1 else a for name, a in spheres(2).items()} | more
    states = np.zeros((len(heights), 41, 6))
    states[..., :2] = [arc(2, height) for height in heights]
    rows = trials(*flights("gco", reached), *flights("mine", [False] * len(heights)))
    return layout_grid(layouts, {"gco": states, "mine": states}, rows)


def caption(figure: Figure) -> str:
    return " ".join(text.get_text() for text in figure.texts if "convex hull" in text.get_text())


def test_the_line_counts_flights_that_reach_around_all_obstacles() -> None:
    """Those of `mine` take the same ways and fail."""
    figure = drawn([2.5, 0.0, -2.5, 2.5], [True, True, True, False])
    way = np.linalg.norm(np.diff(arc(2, 2.5), axis=0), axis=1).sum()
    said = caption(figure).replace("\n", " ")
    assert "gco in 2 of 3 flights that reach the goal" in said and "mine" not in said
    assert f"on ways {100 * (way / 10 - 1):.0f} % longer than straight lines" in said
    lowest = min(ax.get_position().y0 for ax in figure.axes)
    text = next(text for text in figure.texts if "convex hull" in text.get_text())
    assert text.get_position()[1] < lowest, "below the maps"


def test_there_is_no_line_where_nothing_is_around_or_there_is_no_hull() -> None:
    assert caption(drawn([0.0], [True])) == "" and caption(drawn([2.5], [False])) == ""
    moving = {"velocities": np.full((1, 6, 2), 0.1), "dt": np.array(0.1)}
    assert caption(drawn([2.5], [True], **moving)) == "", "what moves has no hull"
    single = layout_grid(
        space([5.0, 0.0, 0.0]), {"gco": np.pad(arc(3, 3.0), ((0, 0), (0, 11)))[None]}, trials(*flights("gco", [True]))
    )
    assert caption(single) == "", "whoever passes a single one is around it"
    assert caption(layout_grid(plane(1), {"gco": np.zeros((1, 3, 6))}, trials(*flights("gco", [True])))) == ""
