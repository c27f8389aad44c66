import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from torchgco.plotting import trajectory as draw


@pytest.fixture
def ax() -> Axes:
    return Figure().subplots()


PATH = np.array([[0.0, 0.0, 5.0], [1.0, 0.5, 6.0], [2.0, 1.0, 7.0], [3.0, 1.5, 8.0]])


def test_dots_run_from_cool_to_warm_and_crosses_mark_infeasible_knots(ax: Axes) -> None:
    draw.draw_trajectory(ax, PATH, np.array([False, True, True, False]), plane=draw.SIDE)
    (dots,) = [part for part in ax.collections if isinstance(part, PathCollection)]
    assert np.asarray(dots.get_offsets()).tolist() == PATH[:, [0, 2]].tolist()
    first, last = dots.to_rgba(np.array([0.0, 1.0]))
    assert first[2] > first[0] and last[0] > last[2]
    (crosses,) = [line for line in ax.lines if line.get_marker() == "x"]
    assert np.array(crosses.get_data()).T.tolist() == PATH[1:3, [0, 2]].tolist()


def test_dots_and_crosses_are_thinned_apart(ax: Axes) -> None:
    draw.draw_trajectory(ax, PATH, np.array([True, True, True, False]), every=2, cross_every=3)
    (dots,) = [part for part in ax.collections if isinstance(part, PathCollection)]
    assert len(np.asarray(dots.get_offsets())) == 2
    (crosses,) = [line for line in ax.lines if line.get_marker() == "x"]
    assert np.array(crosses.get_data()).T.tolist() == [[0.0, 0.0]]
