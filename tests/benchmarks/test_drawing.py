from pathlib import Path

import numpy as np
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure

from benchmarks.paper import drawing as draw
from benchmarks.paper.planar_animation import Picture, planar_animation
from tests.plotting.test_animation import changed, pictures


def test_inside_leaves_out_absent_spheres_and_touching_knots() -> None:
    points = np.array([[0.0, 0.0], [0.4995, 0.0], [0.49, 0.0], [9.0, 9.0]])
    centers, radii = np.array([[0.0, 0.0], [np.nan, np.nan], [9.0, 9.0]]), np.array([0.5, np.nan, 0.0])
    assert draw.inside(points, centers, radii).tolist() == [True, False, True, False]


def test_only_guided_knots_and_present_obstacles_have_a_circle() -> None:
    path, ax = np.array([[0.0, 0.0], [1.0, 0.5], [2.0, 1.0], [3.0, 1.5]]), Figure().subplots()
    draw.draw_region(ax, path, np.array([np.inf, 0.1, 0.2, np.inf]))
    draw.draw_obstacles(ax, path[:2], np.array([0.3, np.nan]), margin=0.1)
    counts = [len(part.get_paths()) for part in ax.collections if isinstance(part, PatchCollection)]
    assert counts == [2, 1, 1]


def test_a_legend_takes_other_words() -> None:
    plan, goal = draw.handles("plan", "goal", plan="along a path")
    assert (plan.get_label(), goal.get_label()) == ("along a path", "goal")


def test_pictures_of_a_planar_solve_stay_as_long_as_asked(tmp_path: Path) -> None:
    path = np.stack((np.linspace(-1.0, 1.0, 20), np.zeros(20)), axis=-1)
    many = np.stack([path + np.array([0.0, 0.1 * i]) for i in range(4)])
    shown = [Picture("caught", path[None], seconds=0.3), Picture("candidates", many, path[None], 0.5)]
    ends = path[0], path[-1]
    target = planar_animation(shown, np.zeros((1, 2)), np.array([0.3]), ends, tmp_path / "a.gif", 0.1, 0.2)
    found, duration = pictures(target)
    assert duration == 800 and len(found) == 2 and changed(*found) > 100
    red = (np.abs(found[0].astype(int) - [0xD0, 0, 0]).sum(axis=-1) < 60).sum()
    assert red > 10  # crosses inside the circle
