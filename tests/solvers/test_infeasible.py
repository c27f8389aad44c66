"""The interior point alone says INFEASIBLE where constraints contradict each other, and only there."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchgco import ControlBounds, FunctionConstraint, FunctionDynamics, Problem, QuadraticCost, StateBounds, Status
from torchgco.constraints.base import Constraint
from torchgco.native.compiler import find_compiler
from torchgco.solvers.infeasible import left_to_close
from torchgco.solvers.interior import InteriorPoint

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
