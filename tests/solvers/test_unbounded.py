"""Costs that fall without end have a status of their own; rewards behind wide bounds don't."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

import torchgco
from tests.slow import mostly
from torchgco import ControlBounds, FunctionCost, FunctionDynamics, Problem, StateBounds, Status
from torchgco.base.tree import take
from torchgco.constraints.base import Constraint
from torchgco.native.compiler import find_compiler
from torchgco.solvers.unbounded import _falls_at_a_pole

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
D, INF = torch.float64, torch.inf
SOLVERS = "interior_point", "gco", "al_ilqr"


def cart(x: Tensor, u: Tensor) -> Tensor:
    return torch.stack((x[..., 1], u[..., 0]), dim=-1)


def problem(stage, terminal, *constraints: Constraint) -> Problem:
    x0 = torch.tensor([[-0.1, 0.0], [-0.2, 0.0]], dtype=D)
    return Problem(FunctionDynamics(cart, 2, 1, 0.1), FunctionCost(stage, terminal), constraints, x0, 20)


def linear(*constraints: Constraint) -> Problem:
    return problem(lambda x, u: x[..., 0] + 0.5 * u[..., 0], lambda x: x[..., 0], *constraints)


def away(*constraints: Constraint) -> Problem:
    return problem(lambda x, u: 0.01 * u[..., 0].square() - x[..., 0].square(), lambda x: 0 * x[..., 0], *constraints)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("form", [linear, away], ids=["linear", "negative definite"])
def test_costs_without_an_end(solver: str, form) -> None:
    for free in ((), (ControlBounds(-INF, 5.0), StateBounds([-INF, -INF], [INF, 1e3]))):
        given = form(*free)
        found = torchgco.solve(given, torch.full((2, 20, 1), -0.1, dtype=D), solver)
        assert found.statuses == [Status.UNBOUNDED] * 2, found
        assert float(found.cost.max()) < -1e6
    alone = torchgco.solve(given.take(torch.tensor([1])), torch.full((1, 20, 1), -0.1, dtype=D), solver)
    assert torch.equal(alone.U, take(found, torch.tensor([1])).U)


@pytest.mark.parametrize("solver", SOLVERS)
def test_costs_that_end_far_below(solver: str) -> None:
    """Linear and concave costs whose bounds are reached after a fall of many millions."""
    wide = ControlBounds(-1e9, 1e9)
    for form, guess in ((linear(wide), 0.0), (away(wide, StateBounds([-1e7, -INF], [1e7, INF])), -0.1)):
        found = torchgco.solve(form, torch.full((2, 20, 1), guess, dtype=D), solver)
        assert Status.UNBOUNDED not in found.statuses, found
        assert float(found.cost.max()) < -1e8, found


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_reward_far_away(solver: str) -> None:
    """The cost of the guess, and its slopes there, are tiny; the reward isn't, but it has an end."""

    def reward(x: Tensor) -> Tensor:
        return -(-0.5 * (x[..., 0] - 7.0).square()).exp()

    form = problem(lambda x, u: reward(x) + 1e-14 * u[..., 0].square(), reward)
    found = torchgco.solve(form, torch.full((2, 20, 1), 0.1, dtype=D), solver)
    assert Status.UNBOUNDED not in found.statuses, found


# Logarithms -----------------------------------------------------------------------------------------------------------


def cake(*constraints: Constraint) -> Problem:
    """Consumption of a capital that grows by 3 % a year, valued by its logarithm, from 64 capitals."""
    model = FunctionDynamics(lambda x, u: 0.03 * x - u, 1, 1, 1.0)
    cost = FunctionCost(lambda x, u, k: -(0.95**k) * u[..., 0].log(), lambda x: 0 * x[..., 0])
    return Problem(model, cost, constraints, torch.linspace(0.5, 100, 64, dtype=D).unsqueeze(-1), 30)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("guess", mostly([0.01, 1.0], 1.0))
def test_a_cost_that_falls_like_a_logarithm(solver: str, guess: float) -> None:
    """Its slopes vanish against those of the guess, and a fall is never deep; nothing keeps the capital above 0."""
    for constraints in ((), (ControlBounds(1e-3, INF),)):
        found = torchgco.solve(cake(*constraints), torch.full((64, 30, 1), guess, dtype=D), solver)
        assert found.statuses == [Status.UNBOUNDED] * 64, found


@pytest.mark.parametrize("solver", ["interior_point", "gco"])
def test_a_logarithm_with_an_end(solver: str) -> None:
    """The capital is spent at the end: c_k = c_0 (0.95 * 1.03)^k, all of it."""
    problem = cake(StateBounds(0.0, INF, knots=[30]), ControlBounds(1e-3, INF))
    found = torchgco.solve(problem, torch.full((64, 30, 1), 0.01, dtype=D), solver)
    assert found.statuses == [Status.CONVERGED] * 64, found
    k = torch.arange(30, dtype=D)
    prices = 1.03 ** (29 - k)
    first = 1.03**30 * problem.x0 / (prices * (0.95 * 1.03) ** k).sum()
    torch.testing.assert_close(found.U[..., 0], first * (0.95 * 1.03) ** k, rtol=2e-3, atol=1e-4)


@pytest.mark.parametrize("solver", ["interior_point", "gco"])
def test_a_logarithm_that_ends_far_away_is_not_called_solved_on_the_way(solver: str) -> None:
    """Its slope falls under every tolerance long before u = 1e10, where it is 0."""
    model = FunctionDynamics(lambda x, u: u, 1, 1, 0.1, "none")
    cost = FunctionCost(lambda x, u: -u[..., 0].log() + 1e-10 * u[..., 0])
    given = Problem(model, cost, [ControlBounds(1e-3, INF)], torch.zeros(64, 1, dtype=D), 8)
    found = torchgco.solve(given, drawn_guesses(), solver)
    optimum = 8 * (1 - torch.tensor(1e10, dtype=D).log())
    far = found.cost > optimum + 1e-2 * optimum.abs()
    assert bool(far.any()) and not any(found.statuses[b] == Status.CONVERGED for b in far.nonzero().flatten())


@pytest.mark.parametrize("solver", ["interior_point", "gco"])
def test_a_logarithm_below_a_large_constant(solver: str) -> None:
    model = FunctionDynamics(lambda x, u: u, 1, 1, 0.1, "none")
    cost = FunctionCost(lambda x, u: 1e5 - (1 + u[..., 0].square()).log())
    given = Problem(model, cost, [ControlBounds(-1e12, INF)], torch.zeros(64, 1, dtype=D), 8)
    assert torchgco.solve(given, drawn_guesses(), solver).statuses == [Status.UNBOUNDED] * 64


def drawn_guesses() -> Tensor:
    return 0.5 + 4.5 * torch.rand(64, 8, 1, dtype=D, generator=torch.Generator().manual_seed(3))


# Poles ----------------------------------------------------------------------------------------------------------------


def firm(*constraints: Constraint) -> Problem:
    """Investment that costs its square over the capital, which nothing keeps above 0, for drawn rates."""
    draws = torch.Generator().manual_seed(3)
    value = 0.15 + 0.1 * torch.rand(16, generator=draws, dtype=D)
    x0 = (0.5 + torch.rand(16, 1, generator=draws, dtype=D)).clone()

    def stage(x: Tensor, u: Tensor, k: Any, value: Tensor) -> Tensor:
        capital = x[..., 0]
        return -(0.86**k) * (value * capital - u[..., 0] - (u[..., 0] - 0.1 * capital).square() / capital)

    model = FunctionDynamics(lambda x, u: u - 0.1 * x, 1, 1, 1.0, "rk4")
    return Problem(model, FunctionCost(stage, values={"value": value}), constraints, x0, 60)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_cost_that_falls_at_a_pole(solver: str) -> None:
    found = torchgco.solve(firm(), solver=solver)
    assert found.statuses.count(Status.UNBOUNDED) >= 12, found  # others end elsewhere, or no slope leads there
    assert found.statuses.count(Status.NOT_POSITIVE_DEFINITE) <= 2, found


@pytest.mark.parametrize("solver", ["interior_point", "gco"])
def test_a_pole_that_bounds_keep_away(solver: str) -> None:
    found = torchgco.solve(firm(StateBounds(1e-3, INF)), solver=solver)
    assert found.statuses == [Status.CONVERGED] * 16, found


@pytest.mark.slow
def test_where_a_cost_ends_its_slope_leads_to_no_pole() -> None:
    """Minima, kinks and jumps down the slope: near them less and less is gained."""
    model = FunctionDynamics(lambda x, u: u, 1, 1, 0.1, "none")
    ends = {
        "minimum": lambda z: (z - 3.0).square(),
        "kink": lambda z: (z - 3.0).abs(),
        "jump": lambda z: torch.where(z > 3.0, -50.0, -z),
        "saddle": lambda z: (z.square() - 4.0).square(),
    }
    poles = {"pole": lambda z: 1.0 / (z - 3.0), "logarithm": lambda z: (z - 3.0).abs().log()}
    for name, of in (ends | poles).items():
        problem = Problem(model, FunctionCost(lambda x, u, of=of: of(u[..., 0])), [], torch.zeros(32, 1, dtype=D), 4)
        U = torch.rand(32, 4, 1, dtype=D, generator=torch.Generator().manual_seed(4))
        assert bool((_falls_at_a_pole(problem, U, torch.ones(32, dtype=D), 1e-3) == (name in poles)).all()), name
