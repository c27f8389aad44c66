"""Footprints on drawn floors: ways of the ball around a body, of its whole pose, and from where nothing pulls."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt

from tests.slow import mostly
from torchgco import (
    Body,
    ControlBounds,
    Field,
    Goal,
    OccupancyGrid,
    Problem,
    QuadraticCost,
    StateBounds,
    Unicycle,
    judge,
    solve,
)

CELL = 0.05
LIMITS = [ControlBounds([-2, -1.5], [2, 1.5]), StateBounds([-math.inf] * 3 + [-1.0], [math.inf] * 3 + [1.0])]


def filled(size: tuple[float, float], free: list[tuple[float, float, float, float]]) -> np.ndarray:
    """Cells of a solid block (2,), m, with free boxes (x0, y0, x1, y1) cut out of it."""
    cells = np.ones([round(s / CELL) for s in size], bool)
    for box in free:
        x0, y0, x1, y1 = (round(b / CELL) for b in box)
        cells[x0:x1, y0:y1] = False
    return cells


def problem(
    cells: np.ndarray, footprint: tuple[float, float, float], start: Any, goal: Any, N: int, **more: Any
) -> Problem:
    """A unicycle with a box from -back to front along its heading, and of half a width."""
    back, front, half = footprint
    body = Body.covering([-back, -half], [front, half], [3, 2])
    cost = QuadraticCost([0.1, 0.1, 0, 0.2], [0.5, 0.5], [200, 200, 0, 10], [*goal[:2], 0, 0])
    field = Field(OccupancyGrid(cells, [0.0, 0.0], CELL), body)
    x0 = torch.tensor([[*start, 0.0]], dtype=torch.float64)
    end = more.get("end") or Goal([*goal[:2]], 0.3)
    return Problem(Unicycle(dt=0.1, integrator="rk4"), cost, [field, *LIMITS], x0, N, end)


def clear_of_cells(cells: np.ndarray, X: torch.Tensor, footprint: tuple[float, float, float]) -> bool:
    """Whether the box keeps out of all cells at finely spaced poses, by its outline."""
    back, front, half = footprint
    share = torch.linspace(0, 1, 9, dtype=X.dtype)[:-1, None]
    poses = torch.cat([a + share * (b - a) for a, b in zip(X[:-1, :3], X[1:, :3], strict=True)]).numpy()
    along, across = np.linspace(-back, front, 41), np.linspace(-half, half, 31)
    sides = [np.stack((along, np.full(41, s * half)), 1) for s in (-1, 1)]
    ends = [np.stack((np.full(31, e), across), 1) for e in (-back, front)]
    rim = np.concatenate([*sides, *ends])
    c, s = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
    x, y = poses[:, :1] + c * rim[:, 0] - s * rim[:, 1], poses[:, 1:2] + s * rim[:, 0] + c * rim[:, 1]
    i, j = np.floor(x / CELL).astype(int), np.floor(y / CELL).astype(int)
    return not cells[i, j].any()


def around_a_bend(rng: np.random.Generator) -> tuple[np.ndarray, tuple[float, float, float], list[float], list[float]]:
    """Two halls, joined by a short passage that bends twice, too narrow to turn the body in, and by a far door."""
    tall, thick, wide = rng.uniform(6.0, 7.5), rng.uniform(1.4, 1.8), rng.uniform(0.54, 0.6)
    left, right, low = 2.5, 2.5 + thick, rng.uniform(0.9, 1.2)
    middle, high = left + 0.5 * thick - 0.5 * wide, low + rng.uniform(0.9, 1.3)
    free = [
        (0.2, 0.2, left, tall - 0.2), (right, 0.2, right + 2.3, tall - 0.2),
        (left, low, middle + wide, low + wide), (middle, low, middle + wide, high + wide),
        (middle, high, right, high + wide), (left, tall - 1.5, right, tall - 0.2),
    ]  # fmt: skip
    start = [1.5, low + 0.5 * wide, rng.uniform(-math.pi, math.pi)]
    return filled((right + 2.5, tall), free), (0.35, 0.35, 0.25), start, [right + 1.0, high + 0.5 * wide]


@pytest.mark.slow
@pytest.mark.parametrize("seed", mostly(range(6), 0, 1, 3, 4, 5))
def test_a_body_takes_the_way_of_the_ball_around_it(seed: int) -> None:
    """The ball inside of it fits through the passage, which leads straight to the goal."""
    cells, size, start, goal = around_a_bend(np.random.default_rng(seed))
    room = distance_transform_edt(~cells) * CELL
    assert room[tuple(int(v / CELL) for v in start[:2])] > 0.5
    task = problem(cells, size, start, goal, 260)
    solution = solve(task)
    verdict = judge(task, solution.U)
    assert bool(verdict.reached) and float(verdict.clearance) >= 0
    assert clear_of_cells(cells, solution.X[0], size)


@pytest.mark.slow
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_way_that_cannot_be_brought_clear_gives_way_to_another(mirrored: bool) -> None:
    """In the bend behind the near door the body touches between two knots, and there is no room; a door is far away."""
    cells = filled((6.0, 5.0), [(0.05, 0.05, 5.95, 4.95)])
    cells[48:52] = True
    cells[48:52, 20:33] = cells[48:52, 74:94] = False
    cells[65:71, :56] = True
    turn = (lambda y: 5.0 - y) if mirrored else (lambda y: y)
    cells, goal = np.ascontiguousarray(cells[:, ::-1] if mirrored else cells), [5.2, turn(1.2)]
    field = Field(OccupancyGrid(cells, [0.0, 0.0], CELL), Body.covering([-0.35, -0.25], [0.35, 0.25], [3, 2]))
    limits = [ControlBounds([-1, -1.5], [1, 1.5]), StateBounds([-math.inf] * 3 + [-0.3], [math.inf] * 3 + [1.0])]
    cost = QuadraticCost([0.1, 0.1, 0, 0.1], [0.5, 0.5], [200, 200, 0, 10], [*goal, 0, 0])
    start = torch.tensor([[0.8, turn(1.325), 0.0, 0.0]], dtype=torch.float64)
    task = Problem(Unicycle(dt=0.1), cost, [field, *limits], start, 160, Goal(goal, 0.3))
    verdict = judge(task, solve(task).U)
    assert bool(verdict.reached) and float(verdict.clearance) >= 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_a_body_backs_into_a_dock(seed: int) -> None:
    """Its axle is at the back, and the dock is hardly wider than it: it has to turn in front of it, tail first."""
    rng = np.random.default_rng(seed)
    size, wide, deep = (0.2, 0.6, 0.25), CELL * rng.integers(14, 16), CELL * rng.integers(18, 21)
    low = CELL * rng.integers(20, 48)
    cells = filled((4.6 + deep, 4.0), [(0.2, 0.2, 4.4, 3.8), (4.4, low, 4.4 + deep, low + wide)])
    start = [rng.uniform(1.2, 2.0), rng.uniform(1.2, 2.8), rng.uniform(-0.4, 0.4)]
    turned = math.pi if start[2] >= 0 else -math.pi
    dock = [4.4 + deep - 0.4, low + 0.5 * wide, turned, 0.0]
    task = problem(cells, size, start, dock, 160, end=Goal(state=dock, radius=0.1, required=True))
    solution = solve(task)
    verdict = judge(task, solution.U)
    assert bool(verdict.reached) and float(verdict.clearance) >= 0
    assert clear_of_cells(cells, solution.X[0], size)


@pytest.mark.slow
@pytest.mark.parametrize("heading", [0.5 * math.pi, -0.5 * math.pi])
def test_a_vehicle_that_nothing_pulls_is_no_answer(heading: float) -> None:
    """Square to the way to the goal no control lowers the cost: a wall is in between, and yet nothing is touched."""
    cells = filled((8.0, 6.0), [(0.2, 0.2, 7.8, 5.8)])
    cells[78:82, :80] = True
    for vehicle in ((0.35, 0.35, 0.25), None):
        task = problem(cells, vehicle or (0.1, 0.1, 0.1), [2.0, 3.0, heading], [6.0, 3.0], 160)
        if vehicle is None:
            disc = Field(OccupancyGrid(cells, [0.0, 0.0], CELL), 0.25)
            task = Problem(task.dynamics, task.cost, [disc, *LIMITS], task.x0, 160, task.goal)
        verdict = judge(task, solve(task).U)
        assert bool(verdict.reached) and float(verdict.clearance) >= 0
