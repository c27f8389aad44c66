"""ALTRO's quadrotor maze: its form, and a few starts solved without waypoints."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchgco
from benchmarks.outside.maze import TOLERANCE, main, precise
from benchmarks.outside.maze_problem import (
    DT,
    GOAL,
    HOVER,
    START,
    THRUST,
    R,
    cylinders,
    drawn,
    maze,
    recount,
    waypoint_guess,
)
from torchgco import ControlBounds, StateBounds
from torchgco.dynamics.rollout import open_loop
from torchgco.lagrangian.quality import violation
from torchgco.obstacles.spheres import BoundSpheres


def test_the_form_of_the_maze() -> None:
    problem = maze(drawn(3, 0))
    assert (problem.n, problem.m, problem.N, problem.dynamics.dt) == (13, 4, 100, 0.05)
    discs, controls, states, goal = problem.constraints
    assert isinstance(discs, BoundSpheres) and discs.centers.shape == (3, 47, 2)
    assert bool((discs.inflated_radii == 2.2).all())
    assert isinstance(controls, ControlBounds) and isinstance(states, StateBounds)
    assert controls.lower.unique().tolist() == [0.0] and controls.upper.unique().tolist() == [50.0]
    assert states.upper[0, :3].tolist() == [25.0, np.inf, 20.0] and states.upper[0, 7:10].tolist() == [30.0] * 3
    assert goal.sense == "equality" and goal.knots == slice(100, 101)
    assert goal.value(problem.x0.new_zeros(3, 101, 13), problem.x0.new_zeros(3, 100, 4)).shape == (3, 1, 9)
    assert problem.x0[0, :3].tolist() == list(START) and len(problem.x0.unique(dim=0)) == 3


def test_the_walls_leave_doors_but_no_straight_way() -> None:
    """At y = -10 and 10 m the doors are 1.6 m wide for the vehicle's centre; at y = 0 the middle wall bars 10.4 m."""

    def clear(x: float, y: float) -> bool:
        return bool((np.linalg.norm(cylinders() - (x, y), axis=-1) >= 2.2).all())

    for side in (-1, 1):
        assert clear(side * 0.79, -10.0) and clear(side * 0.79, 10.0) and clear(side * 5.21, 0.0)
        assert clear(side * 7.9, 0.0)
        assert not any(clear(side * x, y) for y in (-10.0, 10.0) for x in np.arange(0.81, 10, 0.01))
        assert not any(clear(side * x, 0.0) for x in np.arange(0, 5.2, 0.01))
    assert clear(*START[:2]) and clear(*GOAL[:2])


def test_the_problem_is_the_one_that_is_judged() -> None:
    problem = maze(drawn(4, 1))
    U = HOVER + 0.02 * torch.randn(4, 100, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    U[1] += THRUST  # beyond the bounds, and fast
    X = open_loop(problem.dynamics, problem.x0, U)
    cost, worst, states = recount(problem.x0.numpy(), U.numpy())
    torch.testing.assert_close(torch.from_numpy(states), X, rtol=1e-9, atol=1e-9)
    constant = 0.5 * R * DT * 4 * HOVER**2 * problem.N
    torch.testing.assert_close(problem.cost.total(X, U) + constant, torch.from_numpy(cost), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(violation(problem.constraints, X, U), torch.from_numpy(worst), rtol=1e-9, atol=1e-9)
    assert worst.min() > 1.0


def test_the_guess_passes_the_waypoints() -> None:
    X0, U0 = waypoint_guess(drawn(2, 0))
    assert X0.shape == (2, 101, 13) and U0.unique().tolist() == [HOVER]
    assert X0[0, 50, :3].tolist() == [7.0, 0.0, 1.0]
    assert X0[:, 0].equal(drawn(2, 0)) and X0[1, -1, :3].tolist() == list(GOAL)


@pytest.mark.slow
def test_starts_are_solved_without_waypoints() -> None:
    """Also where a candidate takes 80 iterations from hovering to the other end of its path (3, 55, 60)."""
    problem = maze(drawn(64, 0)).take(torch.tensor([0, 1, 2, 3, 55, 60]))
    solution = torchgco.solve(problem, solver=precise(problem))
    cost, worst, _ = recount(problem.x0.numpy(), solution.U.numpy())
    assert worst.max() <= TOLERANCE
    assert cost[0] <= 0.6111  # IPOPT's from the waypoints
    assert cost.max() <= 0.66  # the longer way round costs more than twice as much


@pytest.mark.slow
def test_the_table(capsys) -> None:
    assert main(["--starts", "2", "--fatrop", "1"]) == 0
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines()[2:6]]
    assert [row[1] for row in rows] == ["hovering", "hovering", "waypoints", "waypoints"]
    assert rows[1][2].startswith("2 of 2") and rows[2][2].startswith("2 of 2") and " of 1 " in rows[3][2]
