"""The judge of safe plans: what it accepts, and what it finds."""

import numpy as np
import pytest

from tests.reference.sensing import cubes, distances
from torchgco.exploration.safety import least_gap, safe_periods
from torchgco.exploration.sensing.grid import FREE, OCCUPIED
from torchgco.missions.log import SeenLog

SHAPE, SIZE, CORNER = (20, 10, 8), 0.25, np.array([-1.0, -1.0, -1.0])
CELLS = np.arange(np.prod(SHAPE))


def log_of(states: np.ndarray, plan: np.ndarray) -> SeenLog:
    return SeenLog(CORNER, SHAPE, SIZE, [(CELLS.astype(np.int32), states.ravel())], [plan])


def stopping(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    share = 1.0 - (1.0 - np.linspace(0, 1, 30)) ** 2
    return np.concatenate([start + share[:, None] * (end - start), end[None], end[None]])


FREE_ALL = np.full(SHAPE, FREE, np.uint8)
PLAN = stopping(np.array([0.0, 0.2, 0.0]), np.array([2.5, 0.2, 0.0]))


def test_a_plan_that_stops_in_free_space_is_safe() -> None:
    assert safe_periods(log_of(FREE_ALL, PLAN), 0.3, 0.05).tolist() == [True]


def test_a_plan_far_from_all_is_safe_whatever_rounding_does() -> None:
    for end, radius in zip(np.linspace(0.5, 2.5, 200), np.linspace(0.1, 0.4, 200), strict=True):
        plan = stopping(np.array([0.0, 0.2, 0.0]), np.array([end, 0.2, 0.0]))
        assert least_gap(log_of(FREE_ALL, plan), FREE_ALL, plan, radius) == radius


def test_a_plan_that_does_not_stop_is_not() -> None:
    assert safe_periods(log_of(FREE_ALL, PLAN[:20]), 0.3, 0.05).tolist() == [False]


@pytest.mark.parametrize("state", [0, OCCUPIED])
def test_a_plan_near_a_cell_that_is_not_free_is_not(state: int) -> None:
    states = FREE_ALL.copy()
    states[10, 6, 4] = state  # 0.3 m beside the plan
    for radius, safe in ((0.26, True), (0.31, False)):
        assert safe_periods(log_of(states, PLAN), radius, 0.05).tolist() == [safe]


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("side", [0, 1])
def test_a_plan_that_leaves_the_grid_is_not(axis: int, side: int) -> None:
    """Through any face, however far, and where it comes back, although all cells are free."""
    start, face = np.array([0.1, 0.2, 0.0]), (CORNER, CORNER + SIZE * np.array(SHAPE))[side][axis]
    for beyond in (-0.3, -0.05, 0.05, 3.0):
        end = start.copy()
        end[axis] = face + (beyond if side else -beyond)
        for plan in (stopping(start, end), np.concatenate([stopping(start, end), stopping(end, start)])):
            assert safe_periods(log_of(FREE_ALL, plan), 0.1, 0.05).tolist() == [beyond < -0.1]


def test_cells_are_those_of_the_period() -> None:
    """A cell that is seen to be occupied later doesn't count before."""
    log = log_of(FREE_ALL, PLAN)
    hit = np.ravel_multi_index((10, 5, 4), SHAPE)
    log.changes.append((np.array([hit], np.int32), np.array([OCCUPIED], np.uint8)))
    log.safe.append(PLAN)
    assert safe_periods(log, 0.3, 0.05).tolist() == [True, False]
    assert log.state(0)[10, 5, 4] == FREE and log.state(1)[10, 5, 4] == OCCUPIED


def test_gaps_are_lower_bounds_of_slow_ones() -> None:
    rng = np.random.default_rng(0)
    states = np.where(rng.uniform(size=SHAPE) < 0.02, OCCUPIED, FREE).astype(np.uint8)
    log, centers = log_of(states, PLAN), cubes(SHAPE, CORNER, SIZE)
    for _ in range(8):
        a, b = (CORNER + 0.6 + rng.uniform(size=3) * (np.array(SHAPE) * SIZE - 1.2) for _ in range(2))
        points = a + np.linspace(0, 1, 2000)[:, None] * (b - a)
        slow = min(0.5, distances(points, centers[states.ravel() == OCCUPIED], SIZE).min())
        fast = least_gap(log, states, np.stack([a, b]), 0.5)
        assert slow - 0.03 <= fast <= slow + 1e-9
