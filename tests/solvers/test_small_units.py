"""The same problem in larger units has smaller numbers, and the same answer."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import torchgco
from torchgco import ControlBounds, FunctionCost, FunctionDynamics, Problem, StateBounds, Status
from torchgco.native.compiler import find_compiler

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
D, B = torch.float64, 64


def cart(size: Tensor, weighted: bool = True) -> Problem:
    """Carts whose positions, speeds and accelerations are `size` (B,) times as large; weighted, their costs are not."""
    goal = size * (0.5 + 3.5 * torch.rand(B, dtype=D, generator=torch.Generator().manual_seed(0)))
    cost = FunctionCost(
        lambda x, u, goal, weight: weight * ((x[..., 0] - goal).square() + 0.1 * u[..., 0].square()),
        lambda x, goal, weight: weight * (10 * (x[..., 0] - goal).square() + x[..., 1].square()),
        values={"goal": goal, "weight": size**-2 if weighted else torch.ones_like(size)},
    )
    model = FunctionDynamics(lambda x, u: torch.stack((x[..., 1], u[..., 0]), -1), 2, 1, 0.1, "rk4")
    size = size.view(-1, 1, 1)
    fastest = torch.cat((torch.full_like(size, torch.inf), 0.5 * size), -1)
    limits = [ControlBounds(-0.3 * size, 0.3 * size), StateBounds(-torch.inf * fastest, fastest)]
    return Problem(model, cost, limits, torch.zeros(B, 2, dtype=D), 40)


@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize("size", [1e-2, 1e-3])
def test_a_cart_in_larger_units_costs_as_much(size: float, weighted: bool) -> None:
    expected = torchgco.solve(cart(torch.ones(B, dtype=D)), solver="gco_exact").cost
    found = torchgco.solve(cart(torch.full((B,), size, dtype=D), weighted))
    assert found.statuses == [Status.CONVERGED] * B
    torch.testing.assert_close(found.cost / (1.0 if weighted else size**2), expected, rtol=1e-4, atol=0.0)


def test_problems_beside_one_in_larger_units_keep_their_bits() -> None:
    """Its barrier goes on falling when theirs are low enough."""
    problem = cart(torch.where(torch.arange(B) % 4 == 1, 1e-3, 1.0).to(D))
    whole = torchgco.solve(problem)
    for b in (0, 1, 2, 3, 30, 63):
        alone = torchgco.solve(problem.take(slice(b, b + 1)))
        assert torch.equal(alone.U[0], whole.U[b]) and int(alone.iterations[0]) == int(whole.iterations[b])
