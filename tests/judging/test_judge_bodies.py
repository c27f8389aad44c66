"""Judge, certificate and contacts of bodies on scenes whose answer is known."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from torchgco import (
    Body,
    Field,
    FunctionDynamics,
    Goal,
    InputError,
    OccupancyGrid,
    Problem,
    QuadraticCost,
    Spheres,
    Unicycle,
    certify,
    judge,
)
from torchgco.baselines import PathPursuit
from torchgco.judging.contact import contacts

D = torch.float64
RADIUS = 0.1
ROD = Body([[0.2 * i, 0.0] for i in range(-4, 5)], RADIUS)  # 1.8 m long
QUARTER = math.pi / 2


def scene(centers: Any, radii: Any, controls: Any, vehicle: Any = ROD, integrator: Any = "euler", **more: Any) -> Any:
    """A unicycle that starts at the origin along x, by its controls (N, 2), with steps of a second."""
    U = torch.tensor([controls], dtype=D)
    cost = QuadraticCost([0.0] * 4, [1.0] * 2, [0.0] * 4)
    x0 = torch.tensor([[0.0, 0, 0, more.pop("speed", 0.0)]], dtype=D)
    obstacles = Spheres(centers, radii, vehicle, **more)
    problem = Problem(Unicycle(1.0, integrator), cost, [obstacles], x0, U.shape[1])
    X = [x0]
    for k in range(U.shape[1]):
        X.append(problem.dynamics.step(X[-1], U[:, k]))
    return problem, torch.stack(X, dim=1), U


TURN = [[0.0, QUARTER / 2], [0.0, QUARTER / 2]]  # on the spot, a quarter of a turn in two steps
POST = [0.8 * math.cos(QUARTER / 4), 0.8 * math.sin(QUARTER / 4)]  # halfway between the first two knots


def test_a_rod_turns_past_a_post() -> None:
    """The ball at its end passes over the post's centre between two knots: a disc at the position sees nothing."""
    problem, X, U = scene([POST], [0.05], TURN)
    verdict, full = judge(problem, U), certify(problem, X, U)
    reach = 0.95 * (RADIUS + 0.05)
    at_knots = 2 * 0.8 * math.sin(QUARTER / 8) - reach  # the chord from a knot's direction to the post's
    assert float(verdict.clearance_knots) == pytest.approx(at_knots, abs=1e-9) and at_knots > 0.1
    sagitta = 0.8 * (1 - math.cos(QUARTER / 16))  # of a quarter of the step
    assert -reach - sagitta - 1e-9 <= float(verdict.clearance) <= -reach + 1e-9
    assert -0.15 - 0.8 * (1 - math.cos(QUARTER / 4)) - 1e-9 <= float(full.clearance) <= -0.15 + 1e-9
    assert float(verdict.violation) == 0.0 and bool(verdict.clear_95) and not bool(verdict.feasible)
    disc = judge(*scene([POST], [0.05], TURN, RADIUS)[::2])
    assert float(disc.clearance) == pytest.approx(0.8 - reach, abs=1e-12)
    found = contacts(problem.obstacles, X[0, :, :2].numpy(), 1.0, X[0].numpy())
    assert found.shape == (1, 2) and not found.any()  # where the position is meanwhile
    with pytest.raises(InputError, match="states"):
        contacts(problem.obstacles, X[0, :, :2].numpy(), 1.0)


def test_a_rod_that_meets_a_post_at_a_knot() -> None:
    """Clear as a disc, in contact as a rod, 0.05 m deep."""
    problem, _, U = scene([[0.0, 0.9]], [0.05], TURN)
    verdict = judge(problem, U)
    assert float(verdict.violation) == pytest.approx(RADIUS + 0.05 - 0.1, abs=1e-9)
    assert float(verdict.clearance_knots) == pytest.approx(0.1 - 0.95 * 0.15, abs=1e-9)
    assert not bool(verdict.feasible) and float(judge(*scene([[0.0, 0.9]], [0.05], TURN, RADIUS)[::2]).violation) == 0


def test_a_rod_passes_between_posts_that_a_disc_around_it_meets() -> None:
    posts, ahead = [[1.0, 0.3], [1.0, -0.3]], [[0.0, 0.0]] * 4
    problem, X, U = scene(posts, [0.1, 0.1], ahead, speed=0.5)
    verdict = judge(problem, U)
    assert float(verdict.clearance) == pytest.approx(0.3 - 0.95 * 0.2, abs=1e-9)
    assert float(certify(problem, X, U).clearance) == pytest.approx(0.1, abs=1e-9)
    assert float(judge(*scene(posts, [0.1, 0.1], ahead, ROD.reach, speed=0.5)[::2]).clearance) < -0.5


def test_moving_obstacles_meet_the_rod_between_knots() -> None:
    """A ball flies through the tip of a rod at rest, which it touches at no knot: the distance is that of chords."""
    problem, _, U = scene([[0.8, -1.0]], [0.05], [[0.0, 0.0]] * 2, velocities=[[0.0, 2.0]])
    verdict = judge(problem, U)
    assert float(verdict.clearance_knots) == pytest.approx(1.0 - 0.95 * 0.15, abs=1e-9)
    assert float(verdict.clearance) == pytest.approx(-0.95 * 0.15, abs=1e-9)


def test_a_certificate_bounds_the_way_of_a_turning_rod() -> None:
    """With rk4 positions leave their chords too: the bound holds at thousands of points of the true way."""
    turn = [[0.3, 0.4], [0.2, -0.5], [-0.2, 0.6]]
    problem, X, U = scene([[2.0, 1.2], [1.5, -0.8]], [0.2, 0.3], turn, integrator="rk4", speed=0.6)
    fine: list[Tensor] = []
    for k in range(3):
        for share in np.linspace(0, 1, 400, endpoint=False):
            part = Unicycle(max(float(share), 1e-9), "rk4")
            fine.append(part.step(X[:, k], U[:, k]))
    part: Any = problem.constraints[0]
    dense = torch.stack(fine, dim=1)
    exact = torch.stack([ball.signed_distance(P, dense[0, :, 0]).amin() for ball, P in part.each(dense)]).amin()
    found = float(certify(problem, X, U).clearance)
    assert found <= float(exact) + 1e-9 and found >= float(exact) - 0.4


def test_maps_are_measured_by_the_balls() -> None:
    """One occupied cell beside the way: the distances are those of the cell's side from the rod's balls."""
    cells = np.zeros((20, 20), bool)
    cells[15, 13] = True  # [1.0, 1.2] x [0.6, 0.8]
    plain, X, U = scene([[9.0, 9]], [0.1], [[0.0, 0.0]] * 4, speed=0.5)
    field = Field(OccupancyGrid(cells, [-2.0, -2.0], 0.2), ROD)
    problem = Problem(plain.dynamics, plain.cost, [field], plain.x0, 4)
    assert float(judge(problem, U).clearance) == pytest.approx(0.6 - 0.099, abs=1e-8)
    assert float(certify(problem, X, U).clearance) == pytest.approx(0.5, abs=1e-8)


def test_a_frame_is_judged_in_space() -> None:
    """A drone's arm, turned by a quaternion of any length, and a ball beside its tip."""
    arm = Body([[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0]], 0.1, "quaternion")
    names = ("x", "y", "z", "qw", "qx", "qy", "qz")
    rest = FunctionDynamics(lambda x, u: u, 7, 7, 1.0, position=slice(0, 3), state_names=names)
    half = math.pi / 8  # a turn by 45 degrees about z
    x0 = torch.tensor([[0.0, 0, 0, 2 * math.cos(half), 0, 0, 2 * math.sin(half)]], dtype=D)
    above = [[0.5 * math.cos(2 * half), 0.5 * math.sin(2 * half), 1.0]]  # the tip
    problem = Problem(rest, QuadraticCost([0.0] * 7, [1.0] * 7, [0.0] * 7), [Spheres(above, [0.2], arm)], x0, 2)
    verdict = judge(problem, torch.zeros(1, 2, 7, dtype=D))
    assert float(verdict.clearance) == pytest.approx(1.0 - 0.95 * 0.3, abs=1e-9)


def test_pursuit_follows_a_ball_and_refuses_a_body() -> None:
    problem, _, U = scene([[3.0, 3.0]], [0.1], TURN)
    with pytest.raises(InputError, match="vehicle_radius: expected a number for path_pursuit"):
        goal = Goal([5.0, 0.0], 0.5)
        PathPursuit().solve(Problem(problem.dynamics, problem.cost, problem.constraints, problem.x0, 2, goal), U)
