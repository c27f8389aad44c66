"""The interior point alone says INFEASIBLE where constraints contradict each other, and only there."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import linprog
from torch import Tensor

import torchgco
from tests.slow import mostly
from torchgco import (
    ControlBounds,
    FunctionConstraint,
    FunctionDynamics,
    Gates,
    Goal,
    Problem,
    QuadraticCost,
    StateBounds,
    Status,
)
from torchgco.constraints.base import Constraint
from torchgco.kernels import open_loop
from torchgco.native.compiler import find_compiler
from torchgco.solvers.interior import InteriorPoint, contradicts, left_to_close

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
D, INF, N = torch.float64, torch.inf, 20


def cart(x: Tensor, u: Tensor) -> Tensor:
    return torch.stack((x[..., 1], u[..., 0] - 0.1 * x[..., 1] * x[..., 1].abs()), dim=-1)


def problem(*constraints: Constraint) -> Problem:
    x0 = torch.tensor([[0.0, 0.0], [0.1, -0.1]], dtype=D)
    return Problem(FunctionDynamics(cart, 2, 1, 0.1), QuadraticCost([1.0, 0.1], [0.1], [0.0, 0.0]), constraints, x0, N)


def ends_at(place: float) -> Constraint:
    return FunctionConstraint(lambda x: x - torch.tensor([place, 0.0], dtype=D), "equality", knots=[N])


CONTRADICTIONS = {
    "bounds and an equality": (StateBounds([-1.0, -INF], [1.0, INF]), ends_at(2.0)),
    "an end beyond reach": (ControlBounds(-1.0, 1.0), ends_at(9.0)),
    "two rows": (FunctionConstraint(lambda x: torch.stack((x[..., 0] + 1.0, 1.0 - x[..., 0]), -1), knots=[9]),),
    "two equalities": (FunctionConstraint(lambda x: torch.stack((x[..., 0] - 1, x[..., 0] - 3), -1), "equality", [N]),),
}


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", CONTRADICTIONS)
def test_contradictions_are_infeasible(name: str) -> None:
    given = problem(*CONTRADICTIONS[name])
    found = InteriorPoint().solve(given, torch.zeros(2, N, 1, dtype=D))
    assert found.statuses == [Status.INFEASIBLE] * 2, found
    worst = torch.stack([part.worst(found.X, found.U) for part in given.constraints]).amax(0)
    torch.testing.assert_close(found.violation, worst, rtol=0, atol=1e-11)
    alone = InteriorPoint().solve(given.take(torch.tensor([1])), torch.zeros(1, N, 1, dtype=D))
    assert torch.equal(alone.U[0], found.U[1]) and alone.statuses == [Status.INFEASIBLE]


def test_what_the_least_violation_is() -> None:
    """Two rows that leave x_9 no place: halfway between them each is violated by 1."""
    found = InteriorPoint().solve(problem(*CONTRADICTIONS["two rows"]), torch.zeros(2, N, 1, dtype=D))
    torch.testing.assert_close(found.violation, torch.ones(2, dtype=D), rtol=0, atol=1e-3)


def test_feasible_problems_that_end_early_are_not_infeasible() -> None:
    given = problem(ControlBounds(-9.0, 9.0), ends_at(2.0), StateBounds([-3.0, -4.0], [3.0, 4.0]))
    for limit in (1, 2, 4, 500):
        found = InteriorPoint(max_iterations=limit).solve(given, torch.zeros(2, N, 1, dtype=D))
        assert Status.INFEASIBLE not in found.statuses, found
    X = InteriorPoint(max_iterations=1).solve(given, torch.zeros(2, N, 1, dtype=D))
    assert found.statuses == [Status.CONVERGED] * 2
    share = left_to_close(given, X.X, X.U)
    assert bool((share > 0.9).all() and (share < 1 + 1e-9).all())


def courses(seed: int, B: int = 12, G: int = 2, stages: int = 18) -> Problem:
    """Square gates at given knots, and a goal that is required, for points with bounds on their acceleration."""
    draws = torch.Generator().manual_seed(seed)
    x0 = torch.randn(B, 4, generator=draws, dtype=D) * torch.tensor([0.2, 0.2, 0.5, 0.5], dtype=D)
    steps = torch.rand(B, G, 2, generator=draws, dtype=D) * 1.4 - 0.5
    centers, normals = x0[:, None, :2] + steps.cumsum(1), torch.randn(B, G, 2, generator=draws, dtype=D)
    knots = [[1 + 2 * k for k in torch.randperm(7, generator=draws)[:G].sort().values.tolist()] for _ in range(B)]
    goal = centers[:, -1] + 0.3 * torch.randn(B, 2, generator=draws, dtype=D)
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.1, "rk4", position=slice(0, 2))
    gates = Gates(centers, normals=normals, half_widths=0.3, knots=knots)
    cost = QuadraticCost([0.0] * 4, [0.1] * 2, [100.0] * 4, x_ref=torch.cat((goal, 0 * goal), -1).unsqueeze(1))
    return Problem(model, cost, [gates, ControlBounds(-5.0, 5.0)], x0, stages, goal=Goal(goal, 0.2, required=True))


def least_excess(problem: Problem, b: int) -> float:
    """By how much some row of the gates, or of 64 lines around the goal, has to be violated: a linear programme."""
    gates: Any = problem.constraints[0]
    n, dt, count = problem.N, problem.dynamics.dt, 2 * problem.N
    late = (torch.arange(1, n + 1).unsqueeze(-1) - torch.arange(n) - 0.5).clamp(min=0.0).double() * dt**2  # (k, j)
    drift = problem.x0[b, :2] + dt * torch.arange(1, n + 1).double().unsqueeze(-1) * problem.x0[b, 2:]
    slopes, limits = gates.slopes[b], gates.limits[b]  # (N, p, 2), (N, p)
    angles = torch.arange(64).double() * torch.pi / 32
    around = torch.stack((angles.cos(), angles.sin()), -1)
    ends = around @ problem.goal.position[b] + problem.goal.radius[b]
    of_gates = (slopes.unsqueeze(-1) * late[:, None, None]).reshape(-1, count)
    A = torch.cat((of_gates, (around.unsqueeze(-1) * late[-1]).reshape(-1, count)))
    b_ub = torch.cat(((limits - (slopes @ drift.unsqueeze(-1))[..., 0]).flatten(), ends - around @ drift[-1]))
    A = torch.cat((A, -torch.ones(len(A), 1, dtype=D)), -1)
    cost = np.append(np.zeros(count), 1.0)
    found = linprog(cost, A.numpy(), b_ub.numpy(), bounds=[(-5.0, 5.0)] * count + [(None, None)])
    return float(found.x[-1])


@pytest.mark.slow
@pytest.mark.parametrize("seed", mostly(range(6), *range(1, 6)))
def test_gates_that_contradict_each_other_are_infeasible(seed: int) -> None:
    problem = courses(seed)
    excess = torch.tensor([least_excess(problem, b) for b in range(problem.B)])
    found = torchgco.solve(problem, verbose=False)
    said = found.status == Status.INFEASIBLE
    assert int((excess > 2e-3).sum()) >= 3 and int((excess < 0).sum()) >= 3
    assert bool(said[excess > 2e-3].all()), (found.status[~said & (excess > 2e-3)], excess)
    assert not bool(said[excess < 0].any())


def test_no_contradiction_is_proved_where_there_is_none() -> None:
    """At drawn trajectories, of problems that are feasible by linear programmes; at the least violated, it is."""
    problem = courses(7, B=24)
    excess = torch.tensor([least_excess(problem, b) for b in range(24)])
    draws = torch.Generator().manual_seed(7)
    for size in (0.0, 1.0, 5.0, 30.0):
        U = size * torch.randn(24, problem.N, 2, generator=draws, dtype=D)
        assert not bool(contradicts(problem, open_loop(problem, U), U, 1e-3)[excess < 0].any())
    U = torchgco.solve(problem, verbose=False).U
    proved = contradicts(problem, open_loop(problem, U), U, 1e-3)
    assert int((excess < 0).sum()) >= 6 and not bool(proved[excess < 0].any())
    assert int(proved.sum()) >= 0.5 * int((excess > 2e-3).sum())
