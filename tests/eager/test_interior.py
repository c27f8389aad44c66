"""The interior point in PyTorch's kernels: the same answers as in C, whatever else is in the batch."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor

import torchgco
from benchmarks.families.general_problems import FAMILIES
from tests.engines import compiled
from tests.slow import mostly
from torchgco import (
    Constraint,
    ControlBounds,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    InputError,
    InteriorPoint,
    Problem,
    QuadraticCost,
    RateBounds,
    Solution,
    StateBounds,
    Status,
)
from torchgco.base.shapes import Dimensions
from torchgco.eager.curvature import by_forward, by_reverse, expansion_of, flat
from torchgco.kernels import EagerWarning, use_native

D = torch.float64


@contextmanager
def by_pytorch() -> Iterator[None]:
    use_native(False)
    try:
        yield
    finally:
        use_native(True)


def cart(B: int = 3, N: int = 12, **more: Any) -> Problem:
    """A cart with drag between bounds, towards a place that differs between problems; its speed is bounded."""

    def field(x: Tensor, u: Tensor) -> Tensor:
        return torch.stack((x[..., 1], u[..., 0] - 0.3 * x[..., 1] * x[..., 1].abs()), dim=-1)

    aims = torch.linspace(1.0, 1.6, B, dtype=D)
    cost = FunctionCost(
        lambda x, u, aim: 0.1 * u.square().sum(-1) + (1.0 + (x[..., 0] - aim).square()).sqrt(),
        lambda x, aim: 50.0 * (x[..., 0] - aim).square() + x[..., 1].square(),
        values={"aim": aims},
    )
    rows = more.pop("rows", [ControlBounds(-2.0, 2.0), StateBounds([-9.0, -9.0], [9.0, 1.1])])
    x0 = more.pop("x0", torch.zeros(B, 2, dtype=D))
    return Problem(FunctionDynamics(field, 2, 1, 0.2, "rk4"), cost, rows, x0, N, **more)


def both(problem: Problem, **how: Any) -> tuple[Solution, Solution]:
    """Solutions in C and in PyTorch."""
    native = torchgco.solve(problem.renewed(), verbose=False, **how)
    with by_pytorch():
        return native, torchgco.solve(problem.renewed(), verbose=False, **how)


def assert_same(native: Solution, eager: Solution, rtol: float = 1e-6) -> None:
    assert eager.statuses == native.statuses
    torch.testing.assert_close(eager.cost, native.cost, rtol=rtol, atol=1e-9)
    torch.testing.assert_close(eager.iterations, native.iterations, rtol=0, atol=1)


@compiled
@pytest.mark.parametrize("solver", ["interior_point", "gco"])
def test_answers_are_those_of_native_kernels(solver: str) -> None:
    native, eager = both(cart(), solver=solver)
    assert set(native.statuses) == {Status.CONVERGED}
    assert_same(native, eager)
    torch.testing.assert_close(eager.X, native.X, rtol=0, atol=1e-6)
    torch.testing.assert_close(eager.K, native.K, rtol=1e-4, atol=1e-4)
    for mine, theirs in zip(eager.multipliers.lam, native.multipliers.lam, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-3, atol=1e-4)


@pytest.mark.slow
@compiled
def test_warm_starts_free_starts_and_guesses_of_states_are_taken() -> None:
    problem, rest = cart(), InteriorPoint()
    native, eager = both(problem, solver=rest)
    warm = {"U0": native.U, "warm": native}
    assert_same(*both(problem, solver=rest, **warm))
    free = cart(free_start=[True, False], rows=[ControlBounds(-2.0, 2.0), StateBounds(-0.5, 1.1, knots=[0, 5])])
    native, eager = both(free, solver=rest)
    assert_same(native, eager)
    assert bool((native.X[:, 0, 0] > 0.1).all())
    torch.testing.assert_close(eager.X[:, 0], native.X[:, 0], rtol=0, atol=1e-6)
    X0 = torch.linspace(0.0, 1.0, 13, dtype=D).view(1, -1, 1).repeat(3, 1, 2)
    native = rest.solve(problem.renewed(), torch.zeros(3, 12, 1, dtype=D), X0=X0)
    with by_pytorch():
        assert_same(native, rest.solve(problem.renewed(), torch.zeros(3, 12, 1, dtype=D), X0=X0))


@pytest.mark.slow
@compiled
def test_rows_without_room_stay_out() -> None:
    """A bound that the start meets, bounds that coincide, a row that is constantly 0; and one that is broken."""
    low, high = torch.full((1, 12, 1), -2.0, dtype=D), torch.full((1, 12, 1), 2.0, dtype=D)
    low[:, 4], high[:, 4] = 0.5, 0.5
    flat_row = FunctionConstraint(lambda x: 0.0 * x[..., :1])
    rows = [ControlBounds(low, high), StateBounds([0.0, -9.0], [9.0, 1.1], knots=range(13)), flat_row]
    assert_same(*both(cart(rows=rows), solver="interior_point"))
    broken = cart(rows=rows, x0=torch.tensor([[-0.02, 0.0]] * 3, dtype=D))  # rows from knot 1 on can be kept
    native, eager = both(broken, solver="interior_point")
    assert native.statuses == eager.statuses == [Status.INFEASIBLE] * 3
    torch.testing.assert_close(eager.cost, native.cost, rtol=1e-6, atol=0)


def test_no_problem_depends_on_the_others() -> None:
    """Bit by bit: alone, in parts, in another order, beside one that fails."""
    problem = cart(4, x0=torch.tensor([[0.0, 0.0], [0.3, 0.5], [0.0, 3.0], [-1.0, 0.2]], dtype=D))
    solver = InteriorPoint(max_iterations=15)
    with by_pytorch():
        whole = torchgco.solve(problem, solver=solver, verbose=False)
        assert len(set(whole.statuses)) > 1
        for index in ([0], [3, 1], [2, 3, 0, 1]):
            rows = torch.tensor(index)
            some = torchgco.solve(problem.take(rows), solver=solver, ids=rows, verbose=False)
            for name in ("X", "U", "cost", "status", "iterations"):
                assert torch.equal(getattr(some, name), getattr(whole, name)[rows]), name


@compiled
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchgco.StepWarning")
@pytest.mark.parametrize("name", FAMILIES)
def test_general_families_end_as_with_native_kernels(name: str) -> None:
    problem = FAMILIES[name].problem(0)
    native, eager = both(problem.take(torch.arange(min(problem.B, 2))), solver=InteriorPoint(max_iterations=60))
    assert eager.statuses == native.statuses
    torch.testing.assert_close(eager.cost, native.cost, rtol=1e-6, atol=1e-9)


def test_second_derivatives_agree_and_fall_back() -> None:
    w = torch.rand(2, 5, 3, dtype=D)
    weights = torch.rand(2, 5, 2, dtype=D)
    smooth = lambda w: torch.stack((w[..., 0].sin() * w[..., 1], w.square().sum(-1).exp()), dim=-1)
    for mine, theirs in zip(by_reverse(smooth, w, weights), by_forward(smooth, w, weights), strict=True):
        torch.testing.assert_close(mine, theirs)
    assert expansion_of(smooth, w) is by_reverse
    with torch.inference_mode():
        assert expansion_of(smooth, w) is by_forward

    def once(w: Tensor) -> Tensor:
        if w.requires_grad:  # as operations do that have no derivatives in reverse
            raise RuntimeError
        return w[..., :2].square()

    assert expansion_of(once, w) is flat
    J, H = flat(once, w, weights)
    assert not bool(H.any())
    torch.testing.assert_close(J[..., 0, :], torch.cat((2.0 * w[..., :1], 0.0 * w[..., 1:]), dim=-1))


class Branches(torch.nn.Module):
    """A model that can't be traced, as it branches on values; without a curvature of its own."""

    def forward(self, x: Tensor, u: Tensor) -> Tensor:
        gain = 0.5 if float(x.detach().abs().sum()) > 1e9 else 1.0
        return torch.stack((x[..., 0] + 0.2 * x[..., 1], x[..., 1] + gain * 0.2 * torch.tanh(u[..., 0])), dim=-1)


def test_code_that_cannot_be_traced_is_solved_by_the_interior_point() -> None:
    model = FunctionDynamics(Branches(), 2, 1, 0.2, "none")
    cost = QuadraticCost([0.1, 0.1], [0.01], [90.0, 9.0], [1.0, 0.0])
    end = FunctionConstraint(lambda x: x[..., :1] - 1.0, "equality", knots=[15])
    problem = Problem(model, cost, [ControlBounds(-1.0, 1.0), end], torch.zeros(2, 2, dtype=D), 15)
    with pytest.warns(EagerWarning, match="many times slower"):
        solution = torchgco.solve(problem, solver="interior_point", verbose=False)
    assert solution.statuses == [Status.CONVERGED] * 2 and float(solution.violation.max()) <= 1e-6
    plain = lambda x, u: torch.stack((x[..., 0] + 0.2 * x[..., 1], x[..., 1] + 0.2 * torch.tanh(u[..., 0])), dim=-1)
    traced = replace(problem, dynamics=replace(model, function=plain))
    same = torchgco.solve(traced, solver="interior_point", verbose=False)
    torch.testing.assert_close(solution.cost, same.cost, rtol=1e-6, atol=0)


@dataclass(frozen=True)
class Rate(Constraint):
    """|u_{k+1} - u_k| <= limit, written by hand: rows that join two knots."""

    limit: float
    knots: ClassVar[slice] = slice(0, 11)

    def bind(self, dims: Dimensions) -> Rate:
        return self

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        change = U[:, 1:] - U[:, :-1]
        return torch.cat((change, -change), dim=-1) - self.limit


@pytest.mark.parametrize(
    ("solver", "more"), [("interior_point", []), ("gco", []), ("interior_point", [RateBounds(-1.0, 1.0)])]
)
def test_rows_that_join_knots_are_refused_in_one_line(solver: str, more: list) -> None:
    problem = cart(rows=[ControlBounds(-2.0, 2.0), Rate(0.1), *more])
    began = time.monotonic()
    with warnings.catch_warnings(), pytest.raises(InputError, match=r"rows of one knot .*RateBounds") as caught:
        warnings.simplefilter("ignore", EagerWarning)
        torchgco.solve(problem, solver=solver, verbose=False)
    assert caught.value.field == "constraints[1].value" and "\n" not in str(caught.value)
    assert time.monotonic() - began < 60.0  # not after minutes of iterations


def test_every_solve_ends_at_its_limit() -> None:
    with by_pytorch():
        solution = torchgco.solve(cart(), solver=InteriorPoint(max_iterations=2), verbose=False)
    assert solution.iterations.tolist() == [2, 2, 2] and Status.CONVERGED not in solution.statuses


def test_the_time_is_looked_at_in_every_iteration() -> None:
    with by_pytorch():
        solution = InteriorPoint().solve(cart(), torch.zeros(3, 12, 1, dtype=D), max_seconds=1e-9)
        assert set(solution.statuses) <= {Status.TIME_LIMIT, Status.FEASIBLE} and int(solution.iterations.max()) <= 1


# Branches that aren't taken -------------------------------------------------------------------------------------------

BRANCHES = {  # with places where the other branch has no slopes, or infinite ones
    "sqrt": lambda z: torch.where(z > 0, 0.1 * z.sqrt() + z, 0.2 * z),
    "log": lambda z: torch.where(z > 0.1, z.log(), z),
    "quotient": lambda z: torch.where(z != 0, z.sin() / z, 1.0),
    "asin": lambda z: torch.where(z.abs() < 0.5, z.asin(), z),
    "net": lambda z: torch.where(z > 0, torch.tanh(torch.stack((z.sqrt(), 1.0 - z), dim=-1)).sum(-1), 0.2 * z),
}


@pytest.mark.parametrize("way", [by_reverse, by_forward])
@pytest.mark.parametrize("name", BRANCHES)
def test_derivatives_of_a_branch_not_taken_do_not_count(name: str, way) -> None:
    z = torch.tensor([-1.0, 0.0, 0.05, 0.3, 0.8], dtype=D)
    branch = BRANCHES[name]
    flat_at = lambda z: branch(z) if name != "quotient" else torch.where(z == 0, 1.0, branch(z))
    w, weights = torch.stack((z, z.flip(0)), dim=-1).unsqueeze(0), torch.ones(1, 5, 1, dtype=D)
    J, H = way(lambda w: branch(w[..., :1]) * (1.0 + w[..., 1:]), w, weights)
    assert bool(torch.isfinite(J).all()) and bool(torch.isfinite(H).all())
    inner = (z.abs() > 1e-3) & ((z.abs() - 0.5).abs() > 1e-3)  # differences don't cross from branch to branch
    h, other = 1e-4, 1.0 + z.flip(0)
    slope, bend = (flat_at(z + h) - flat_at(z - h)) / (2 * h), (flat_at(z + h) - 2 * flat_at(z) + flat_at(z - h)) / h**2
    torch.testing.assert_close(J[0, inner, 0, 0], (slope * other)[inner], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(J[0, :, 0, 1], branch(z))
    torch.testing.assert_close(H[0, inner, 0, 0], (bend * other)[inner], rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(H[0, inner, 0, 1], slope[inner], rtol=1e-4, atol=1e-6)


@pytest.mark.slow
@compiled
@pytest.mark.parametrize("place", mostly(["dynamics", "cost", "row"], "cost", "row"))
def test_branches_not_taken_end_as_with_native_kernels(place: str) -> None:
    branch = BRANCHES["sqrt"]
    drag = branch if place == "dynamics" else torch.zeros_like
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u - 0.3 * drag(x[..., :1])), dim=-1), 2, 1, 0.1)
    off = (lambda x: branch(x[..., 0])) if place == "cost" else lambda x: x[..., 0] - 1.0
    cost = FunctionCost(lambda x, u: 0.01 * u[..., 0].square() + off(x).square(), lambda x: 50 * off(x).square())
    rows = [FunctionConstraint(lambda x: branch(x[..., :1]) - 0.6)] if place == "row" else []
    x0 = torch.tensor([[-1.0, 0.0], [0.0, 0.0], [0.3, 0.0]], dtype=D)
    problem = Problem(model, cost, [ControlBounds(-2.0, 2.0), *rows], x0, 10)
    for solver in (InteriorPoint(), torchgco.AugmentedLagrangian()):
        native, eager = both(problem, solver=solver)
        assert eager.statuses == native.statuses == [Status.CONVERGED] * 3
        torch.testing.assert_close(eager.cost, native.cost, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("count", [1, 2])
def test_affine_code_with_weights_that_ask_for_gradients(count: int) -> None:
    """Its slopes ask for gradients, by the weights, and depend on no state."""
    torch.manual_seed(0)
    net = torch.nn.Linear(6, 4).double()
    x0 = torch.tensor([[0.1, 0.3, -0.2, 0.15], [0.2, -0.4, 0.1, 0.6]], dtype=D)[:count]
    cost = QuadraticCost([1.0] * 4, [0.1] * 2, [20.0] * 4)
    model = FunctionDynamics(lambda x, u: net(torch.cat((x, u), -1)), 4, 2, 0.2)
    problem = Problem(model, cost, [ControlBounds(-1.0, 1.0)], x0, 8)
    native = torchgco.solve(problem, solver="interior_point").detach()
    with by_pytorch():
        eager = torchgco.solve(problem, solver="interior_point").detach()
    assert_same(native, eager)
