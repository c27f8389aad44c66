"""Motions along paths: their ends, their limits, and shortcuts between corners."""

from itertools import pairwise

import numpy as np
import pytest

from torchgco.exploration.reference import Pace, along, between, lengths, motion, swings, taut

PACE, DT = Pace(4.0, 5.0, 3.0), 0.05
STILL = np.zeros(3)


def test_points_along_a_polyline() -> None:
    corners = np.array([[0.0, 0, 0], [3, 0, 0], [3, 4, 0]])
    assert np.array_equal(lengths(corners), [0, 3, 7])
    points, directions = along(corners, np.array([1.0, 5.0, 9.0]))
    assert np.allclose(points, [[1, 0, 0], [3, 2, 0], [3, 4, 0]])
    assert np.allclose(directions, [[1, 0, 0], [0, 1, 0], [0, 1, 0]])
    assert np.allclose(along(corners[:1], np.array([0.0, 1.0]))[0], 0.0)
    assert np.linalg.norm(np.diff(between(corners[0], corners[1]), axis=0), axis=1).max() <= 0.1


@pytest.mark.parametrize("length", [0.5, 3.0, 30.0])
def test_a_motion_rests_at_the_end_of_its_path_or_of_its_time(length: float) -> None:
    corners = np.array([[0.0, 0, 0], [0.5 * length, 0, 0], [length, 0, 0]])
    p, v = motion(corners, STILL, PACE, 60, DT)
    speed = np.linalg.norm(v, axis=1)
    assert p.shape == v.shape == (61, 3) and np.array_equal(p[0], corners[0])
    assert speed[-1] == pytest.approx(0.0, abs=1e-6) and speed.max() <= 1.01 * PACE.speed
    assert p[:, 0].max() <= length + 1e-9
    assert p[-1, 0] == pytest.approx(length, abs=0.01) if length < 5 else p[-1, 0] > 5
    assert np.abs(np.diff(speed) / DT).max() < 1.1 * PACE.acceleration


def test_a_motion_goes_on_with_the_speed_that_there_is() -> None:
    corners = np.array([[0.0, 0, 0], [20, 0, 0]])
    p, _ = motion(corners, np.array([4.0, 0, 0]), PACE, 60, DT)
    assert p[1, 0] == pytest.approx(4.0 * DT, rel=0.05)


def test_corners_are_taken_slowly_and_rounded() -> None:
    straight = np.array([[0.0, 0, 0], [4, 0, 0], [8, 0, 0]])
    sharp = np.array([[0.0, 0, 0], [4, 0, 0], [4, 4, 0]])
    ends = [motion(corners, STILL, PACE, 60, DT)[0] for corners in (straight, sharp)]
    assert lengths(ends[1])[-1] < lengths(ends[0])[-1] - 0.3
    turns = np.diff(ends[1], n=2, axis=0) / DT**2
    assert np.linalg.norm(turns, axis=1).max() < 20.0  # m/s^2: no jump of the velocity


def test_turns_are_slower_where_there_is_no_room_and_where_they_go_up() -> None:
    """A turn by 90 degrees at v with a m/s^2 misses its corner by about v^2 / (4 a)."""
    aside, up = (np.array([[0.0, 0, 0], [3, 0, 0], end]) for end in ([3.0, 3, 0], [3.0, 0, 3]))
    closest = []
    for corners, beyond in ((aside, 0.0), (aside, 0.13), (aside, 1.0), (up, 1.0)):
        swing = swings(corners, lambda p, beyond=beyond: p[:, 0] <= 3.0 + beyond)
        assert swing == pytest.approx([{0.0: 0.02, 0.13: 0.125, 1.0: 0.25}[beyond]])
        p, v = motion(corners, STILL, PACE, 80, DT, swing)
        closest.append(float(np.linalg.norm(v, axis=1)[np.linalg.norm(p - corners[1], axis=1).argmin()]))
    assert closest[0] < closest[1] < closest[2] and closest[3] < closest[2]
    straight = np.array([[0.0, 0, 0], [3, 0, 0]])
    assert swings(straight, lambda p: np.zeros(0, bool)).shape == (0,)


def test_shortcuts_avoid_what_is_not_free() -> None:
    path = np.array([[0.0, 0, 0], [1, 1, 0], [2, 2, 0], [3, 3, 0], [4, 3, 0], [5, 3, 0], [6, 2, 0], [7, 0, 0]])

    def is_free(points: np.ndarray) -> bool:  # a disc between the ends of the path
        return bool((np.linalg.norm(points[:, :2] - [3.5, 0.0], axis=1) > 1.5).all())

    corners = taut(path, is_free)
    assert np.array_equal(corners[[0, -1]], path[[0, -1]]) and len(corners) < len(path)
    assert all(is_free(between(a, b)) for a, b in pairwise(corners))
    assert np.array_equal(taut(path, lambda p: True), path[[0, -1]])
    assert np.array_equal(taut(path[:1], is_free), path[:1])
