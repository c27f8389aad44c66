"""Gates on the page: rings across the way, frames of squares, and both in its data."""

import numpy as np
import torch

from tests.constraints.test_gates import AHEAD, BALLS, PLACES, SQUARES, points
from torchgco.view.document import outlines_of


def test_rings_lie_on_their_balls_across_the_way() -> None:
    problem = points(BALLS)
    stops = np.array([[0.0, 0.5, 1.0], *PLACES, [6.0, 0, 1]])  # of the second problem
    for g, corners in enumerate(np.array(outlines_of(problem, 1))):
        away = corners - PLACES[g]
        np.testing.assert_allclose(np.linalg.norm(away, axis=1), [0.2, 0.3][g], atol=1e-5)
        np.testing.assert_allclose(away @ (stops[g + 2] - stops[g]), 0.0, atol=1e-4)
        np.testing.assert_allclose(corners.mean(0), PLACES[g], atol=1e-5)


def test_frames_are_squares_in_their_planes() -> None:
    for g, corners in enumerate(np.array(outlines_of(points(SQUARES), 0))):
        away, sides = corners - PLACES[g], np.diff(np.vstack((corners, corners[:1])), axis=0)
        np.testing.assert_allclose(away @ np.array(AHEAD[g]), 0.0, atol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(sides, axis=1), 0.5, atol=1e-5)
        np.testing.assert_allclose((sides[:-1] * sides[1:]).sum(1), 0.0, atol=1e-5)


def test_a_page_without_gates_has_none() -> None:
    assert outlines_of(points(x0=torch.zeros(1, 6).double()), 0) == []
