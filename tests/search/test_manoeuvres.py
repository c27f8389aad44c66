"""Cars with a body: their manoeuvres, and openings that these lead into."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from torchgco import (
    Body,
    Boxes,
    ControlBounds,
    FunctionDynamics,
    Goal,
    Problem,
    QuadraticCost,
    Spheres,
    StateBounds,
    Unicycle,
    judge,
    solve,
)
from torchgco.search.manoeuvres import car, driven_in_time
from torchgco.search.poses import END_POSE_ARCS, Poses, clear_at

WHEELBASE, STEERING = 1.2, 0.6
BODY = Body([[0.0, 0.0], [0.6, 0.0], [1.2, 0.0]], 0.4)
TIGHT = math.tan(STEERING) / WHEELBASE


def field(x: Tensor, u: Tensor) -> Tensor:
    heading, speed = x[..., 2], x[..., 3]
    turn = speed * x[..., 4].tan() / WHEELBASE
    return torch.stack((speed * heading.cos(), speed * heading.sin(), turn, u[..., 0], u[..., 1]), dim=-1)


def corridor(starts: list[list[float]], vehicle: Any = BODY, dynamics: Any = None) -> Problem:
    """Walls beside the x-axis from x = 3 on, between which the body fits with 5 cm on either side."""
    names = ("x", "y", "heading", "speed", "steering")
    model = dynamics or FunctionDynamics(field, 5, 2, 0.1, "rk4", slice(0, 2), state_names=names)
    n, wide = model.n, [math.inf] * 3
    walls = Boxes([[6.0, 3.45], [6.0, -3.45]], [[3.0, 3.0], [3.0, 3.0]], vehicle)
    limits: list[Any] = [ControlBounds([-1.5, -1], [1.5, 1])]
    if n == 5:
        limits.append(StateBounds([-math.inf] * 3 + [-2.0, -STEERING], [*wide, 3.0, STEERING]))
    end = [7.0, 0.0, 0.0, 0.0, 0.0][:n]
    cost = QuadraticCost([0.01, 0.01, 0, 0.01, 0.01][:n], [0.1, 0.1], [10.0, 10, 1, 1, 1][:n], x_ref=end)
    x0 = torch.tensor([[*start, 0.0, 0.0][:n] for start in starts], dtype=torch.float64)
    return Problem(model, cost, [walls, *limits], x0, N=90, goal=Goal([7.0, 0.0], 0.3, required=True))


def test_a_car_is_known_by_its_equations_and_its_body() -> None:
    problem = corridor([[0.0, 1.2, 0.1]])
    found = car(problem)
    assert found is not None and (found.heading, found.speed, found.radius) == (2, 3, 0.4)
    assert found.curvature == pytest.approx(TIGHT, rel=1e-12)
    trailing = Body([[0.0, 0.0]], 0.4, parts=[Body([[-0.5, 0.0]], 0.3, "steering")])
    assert car(corridor([[0.0, 1.2, 0.1]], trailing)) is None  # a pose doesn't say where the part is
    assert car(corridor([[0.0, 1.2, 0.1]], vehicle=0.4)) is None
    turns = car(corridor([[0.0, 1.2, 0.1]], dynamics=Unicycle(0.1)))
    assert turns is not None and turns.on_the_spot and not found.on_the_spot


def test_poses_are_clear_ball_by_ball() -> None:
    rng, problem = np.random.default_rng(4), corridor([[0.0, 1.2, 0.1]])
    trees = Spheres([[[1.0, -2.0], [2.0, 2.5]]], [[0.5, 0.2]], BODY)
    problem = Problem(problem.dynamics, problem.cost, [problem.obstacles[0], trees], problem.x0, 90, problem.goal)
    poses = np.column_stack((rng.uniform(-1, 8, 3000), rng.uniform(-4, 4, 3000), rng.uniform(-3, 3, 3000)))
    room = np.full(len(poses), np.inf)
    for x in (0.0, 0.6, 1.2):
        at = poses[:, :2] + x * np.stack((np.cos(poses[:, 2]), np.sin(poses[:, 2])), axis=1)
        for y in (3.45, -3.45):
            out = np.abs(at - [6.0, y]) - 3.0
            away = np.hypot(*out.clip(0.0).T) + out.max(1).clip(max=0.0)
            room = np.minimum(room, away - 0.4)
        for center, radius in (([1.0, -2.0], 0.5), ([2.0, 2.5], 0.2)):
            room = np.minimum(room, np.hypot(*(at - center).T) - radius - 0.4)
    found = clear_at(problem, 2)(poses)
    assert found[room > 0].all() and 300 < found.sum() < 2700
    assert not found[room < -0.2].any()  # bodies touch a little beneath the full surface


@pytest.mark.slow
def test_a_path_of_poses_can_be_driven_and_is_clear() -> None:
    problem = corridor([[1.2, 1.0, 0.2]])
    clear, step = clear_at(problem, 2), 0.2
    start, goal = np.array([1.2, 1.0, 0.2]), np.array([7.0, 0.0, 0.0])
    path = Poses(clear, TIGHT, step).path(start, goal)
    assert path is not None and clear(path).all() and np.array_equal(path[0], start)
    assert np.hypot(*(path[-1] - goal)[:2]) <= END_POSE_ARCS * step and abs(path[-1, 2]) <= END_POSE_ARCS * TIGHT * step
    moved, turned = np.diff(path[:, :2], axis=0), np.diff(path[:, 2])
    mean = path[:-1, 2] + 0.5 * turned
    assert np.allclose(np.abs(moved[:, 0] * np.cos(mean) + moved[:, 1] * np.sin(mean)), step)
    assert np.allclose(moved[:, 0] * np.sin(mean), moved[:, 1] * np.cos(mean)) and (abs(turned) < TIGHT * step).all()
    assert Poses(lambda poses: np.hypot(*(poses[:, :2] - start[:2]).T) < 1.0, TIGHT, step).path(start, goal) is None


def test_a_path_is_driven_from_rest_to_rest_between_changes_of_direction() -> None:
    path = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0], [3, 0, 0]])
    poses, speed = driven_in_time(path, 120, 0.75, 12.0)
    assert np.allclose(poses[[0, 60, 90, 120], 0], [0, 4, 3, 3]) and np.allclose(speed[[0, 60, 90, 120]], 0.0)
    slopes = (poses[2:, 0] - poses[:-2, 0]) / 0.2
    inner = np.delete(np.arange(1, 120), [59, 89])  # there the acceleration jumps
    assert np.abs(slopes - speed[1:-1])[inner - 1].max() < 0.01


@pytest.mark.slow
def test_a_car_backs_up_into_a_corridor_hardly_wider_and_alone_as_in_a_batch() -> None:
    problem = corridor([[1.0, 0.9, 0.1], [0.6, -1.0, 0.0], [-1.0, 0.1, 0.0]])
    solution = solve(problem)
    verdict = judge(problem, solution.U)
    assert bool(verdict.reached.all())
    assert float(solution.X[:2, :, 3].amin()) < -0.1  # no way in without
    alone = solve(problem.take(torch.tensor([1])))
    assert torch.equal(alone.U[0], solution.U[1])
