"""Functions that Python computes in the interior point: the answers of compiled ones, whatever else is in the batch."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor

import torchgco
from benchmarks.families.general_problems import FAMILIES
from tests.eager.test_curvature import BRANCHES
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
from torchgco.kernels import EagerWarning, cost_scale, interior_of, use_native
from torchgco.lagrangian.lagrangian import Multipliers

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


@pytest.mark.slow
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


# Where C itself ends elsewhere if the last bit of its guess changes: costs by 1e-5 and more after 60 iterations.
# Of cartpole_fine it decides whether the rollout of what is left after 60 iterations stays finite.
ROUNDED = "parking_lot", "brachistochrone_raw", "cartpole_fine"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchgco.StepWarning")
@pytest.mark.parametrize("name", [name for name in FAMILIES if name not in ROUNDED])
def test_general_families_end_as_with_native_kernels(name: str) -> None:
    problem = FAMILIES[name].problem(0)
    native, eager = both(problem.take(torch.arange(min(problem.B, 2))), solver=InteriorPoint(max_iterations=60))
    assert eager.statuses == native.statuses
    assert int((eager.iterations - native.iterations).abs().max()) <= 1  # where an error is just below the tolerance
    torch.testing.assert_close(eager.cost, native.cost, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ROUNDED)
def test_iterates_are_those_of_native_kernels_where_rounding_decides_on_the_end(name: str) -> None:
    problem, found = FAMILIES[name].problem(0), []
    for native in (True, False):
        use_native(native)
        try:
            part = problem.take(torch.arange(min(problem.B, 2))).renewed()
            X, U = (z.clone() for z in part.at_rest)
            lam, mu = Multipliers.zero(part, 1.0).lam, X.new_full((part.B,), 0.1)
            out = interior_of(part).solve(
                part, X, U, lam, mu, cost_scale(part), InteriorPoint(max_iterations=3).options(False)
            )
        finally:
            use_native(True)
        found.append((X, U, *lam, out["error"], out["theta"]))
    for mine, theirs in zip(*found, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-5, atol=1e-5)


class Branches(torch.nn.Module):
    """A model that can't be traced, as it branches on values; without a curvature of its own."""

    def forward(self, x: Tensor, u: Tensor) -> Tensor:
        gain = 0.5 if float(x.detach().abs().sum()) > 1e9 else 1.0
        return torch.stack((x[..., 0] + 0.2 * x[..., 1], x[..., 1] + gain * 0.2 * torch.tanh(u[..., 0])), dim=-1)


@pytest.mark.slow
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


@pytest.mark.parametrize("more", [[], [RateBounds(-1.0, 1.0)]])
def test_rows_that_join_knots_are_refused_in_one_line(more: list) -> None:
    with pytest.raises(InputError, match=r"rows of one knot .*RateBounds") as caught:
        cart(rows=[ControlBounds(-2.0, 2.0), Rate(0.1), *more])
    assert caught.value.field == "constraints[1].value" and "\n" not in str(caught.value)


def test_every_solve_ends_at_its_limit() -> None:
    with by_pytorch():
        solution = torchgco.solve(cart(), solver=InteriorPoint(max_iterations=2), verbose=False)
    assert solution.iterations.tolist() == [2, 2, 2] and Status.CONVERGED not in solution.statuses


def test_the_time_is_looked_at_in_every_iteration() -> None:
    with by_pytorch():
        solution = InteriorPoint().solve(cart(), torch.zeros(3, 12, 1, dtype=D), max_seconds=1e-9)
        assert set(solution.statuses) <= {Status.TIME_LIMIT, Status.FEASIBLE} and int(solution.iterations.max()) <= 1


@pytest.mark.slow
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


# What a user's code does while C waits --------------------------------------------------------------------------------


class Watched(torch.nn.Module):
    """A model that can't be traced, and that does something of the test's at each evaluation."""

    def __init__(self, look: Callable[[Tensor], None]) -> None:
        super().__init__()
        self.look = look

    def forward(self, x: Tensor, u: Tensor) -> Tensor:
        if float(x.detach().abs().sum()) < 1e9:
            self.look(x)
        return torch.stack((x[..., 0] + 0.2 * x[..., 1], x[..., 1] + 0.2 * torch.tanh(u[..., 0])), dim=-1)


def watched(look: Callable[[Tensor], None], B: int = 9) -> Problem:
    """Problems of two loops at least, each from a place of its own."""
    model = FunctionDynamics(Watched(look), 2, 1, 0.2, "none")
    starts = torch.stack((torch.linspace(-1.3, 1.1, B, dtype=D), torch.zeros(B, dtype=D)), dim=-1)
    cost = QuadraticCost([0.1, 0.1], [0.01], [90.0, 9.0], [1.0, 0.0])
    rows = FunctionConstraint(lambda x: x[..., :1].square() - 2.0)
    return Problem(model, cost, [ControlBounds(-1.0, 1.0), rows], starts, 15)


class Unlike(Exception):
    """An error that torchgco doesn't know."""


@pytest.mark.filterwarnings("ignore::torchgco.kernels.EagerWarning")
@pytest.mark.parametrize("how", ["error", "Ctrl-C"])
def test_what_a_users_code_raises_ends_the_solve(how: str) -> None:
    calls, threads, thrown = [0], threading.active_count(), Unlike("mine")

    def look(x: Tensor) -> None:
        calls[0] += x.dim() == 3 and x.shape[1] == 15
        if calls[0] == 40:
            calls[0] += 1
            if how == "error":
                raise thrown
            signal.raise_signal(signal.SIGINT)

    problem = watched(look)
    U0, solver = torch.zeros(9, 15, 1, dtype=D), InteriorPoint().prepare(problem)
    calls[0] = 0
    with pytest.raises(Unlike if how == "error" else KeyboardInterrupt) as caught:
        solver.solve(problem, U0)
    assert how != "error" or caught.value is thrown
    assert threading.active_count() == threads
    assert solver.solve(problem, U0).statuses == [Status.CONVERGED] * 9


@pytest.mark.filterwarnings("ignore::torchgco.kernels.EagerWarning")
def test_problems_that_have_ended_are_not_evaluated() -> None:
    """The largest batch of all stages is all problems; while the last ones are solved, it is these alone."""
    sizes = list[int]()
    problem = watched(lambda x: sizes.append(len(x)) if x.shape[1:] == (15, 2) else None)
    U0, solver = torch.zeros(9, 15, 1, dtype=D), InteriorPoint().prepare(problem)
    sizes.clear()
    found = solver.solve(problem, U0)
    last = int((found.iterations == found.iterations.max()).sum())
    assert found.statuses == [Status.CONVERGED] * 9 and last < 9
    assert max(sizes) == 9 and last in sizes


@pytest.mark.filterwarnings("ignore::torchgco.kernels.EagerWarning")
def test_slow_code_ends_at_the_limit_of_time() -> None:
    problem = watched(lambda x: time.sleep(0.02) if x.dim() == 3 else None)
    solver, began = InteriorPoint().prepare(problem), time.monotonic()
    found = solver.solve(problem, torch.zeros(9, 15, 1, dtype=D), max_seconds=0.3)
    assert set(found.statuses) <= {Status.TIME_LIMIT, Status.FEASIBLE} and time.monotonic() - began < 20.0
    assert int(found.iterations.max()) < 8


def test_single_precision_is_solved_to_what_it_can_meet() -> None:
    single = cart().cast(torch.float32)
    double, found = (torchgco.solve(problem, solver="interior_point", verbose=False) for problem in (cart(), single))
    assert found.X.dtype == found.cost.dtype == found.K.dtype == torch.float32
    assert found.statuses == double.statuses == [Status.CONVERGED] * 3
    torch.testing.assert_close(found.cost.double(), double.cost, rtol=1e-5, atol=0)
