"""Rows in which a barrier has no room: those that nothing moves, bounds that coincide, and rows that leave one point.

None of them may change an answer. 64 problems are drawn of a kind; the answer without such rows is IPOPT's in
`test_the_plain_problems_have_the_costs_of_ipopt`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import pytest
import torch
from torch import Tensor

import torchgco
from tests.slow import mostly
from torchgco import (
    ControlBounds,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Problem,
    QuadraticCost,
    Solution,
    StateBounds,
    Status,
)
from torchgco.constraints.base import Constraint
from torchgco.native.compiler import find_compiler

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
D, INF, B = torch.float64, torch.inf, 64
SOLVERS = "gco", "interior_point"
MOSTLY = ("interior_point", pytest.param("gco", marks=pytest.mark.slow))  # where the passes of `gco` add nothing
Plain = tuple[Callable[[Sequence[Constraint]], Problem], list[Constraint]]  # a problem of constraints, and its own


def drawn(seed: int, low: float, high: float, *shape: int) -> Tensor:
    return low + (high - low) * torch.rand(B, *shape, dtype=D, generator=torch.Generator().manual_seed(seed))


def battery(charge: float = 1.0) -> Plain:
    """Full at the start, it follows a load."""
    N = 48
    t = torch.arange(N + 1, dtype=D) / N
    load = drawn(1, 0.3, 1.2, 1) * (4 * math.pi * t + drawn(2, 0, 6.3, 1)).sin() + drawn(3, -0.3, 0.3, 1)
    cost = FunctionCost(
        lambda x, u, load: (load - u[..., 0]).square() + 0.01 * u[..., 0].square(),
        lambda x: 0.1 * (x[..., 0] - 0.5).square(),
        knot_values={"load": load},
    )
    model, x0 = FunctionDynamics(lambda x, u: -0.05 * u, 1, 1, 1.0), torch.full((B, 1), charge, dtype=D)
    return (lambda parts: Problem(model, cost, parts, x0, N)), [ControlBounds(-1.0, 1.0), StateBounds(0.0, 1.0)]


def cart(speed: float | Tensor = 0.0) -> Plain:
    """At rest, it drives to a goal, never backwards."""
    goal, x0 = torch.zeros(B, 1, 2, dtype=D), torch.zeros(B, 2, dtype=D)
    goal[:, 0, 0], x0[:, 1] = drawn(4, 0.5, 4.0), speed
    model = FunctionDynamics(lambda x, u: torch.stack((x[..., 1], u[..., 0]), -1), 2, 1, 0.1, "rk4")
    cost = QuadraticCost([1.0, 0.0], [0.1], [10.0, 1.0], goal)
    own = [ControlBounds(-1.0, 1.0), StateBounds([-INF, 0.0], [INF, 1.5])]
    return (lambda parts: Problem(model, cost, parts, x0, 40)), own


def rocket(height: float = 0.0) -> Plain:
    """On the ground, it flies to a height."""
    goal, x0 = drawn(5, 1.0, 6.0), torch.tensor([[height, 0.0]], dtype=D).repeat(B, 1)
    model = FunctionDynamics(lambda x, u: torch.stack((x[..., 1], u[..., 0] - 9.81), -1), 2, 1, 0.05, "rk4")
    cost = FunctionCost(
        lambda x, u, goal: (x[..., 0] - goal).square() + 0.01 * (u[..., 0] - 9.81).square(),
        lambda x, goal: 10 * (x[..., 0] - goal).square() + x[..., 1].square(),
        values={"goal": goal},
    )
    own = [ControlBounds(0.0, 20.0), StateBounds([0.0, -INF], [INF, INF])]
    return (lambda parts: Problem(model, cost, parts, x0, 40)), own


def assert_same_answer(found: Solution, expected: Solution, tolerance: float = 1e-6) -> None:
    assert found.statuses == expected.statuses == [Status.CONVERGED] * B
    torch.testing.assert_close(found.cost, expected.cost, rtol=tolerance, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, pytest.param(B, marks=pytest.mark.slow)])
def test_the_plain_problems_have_the_costs_of_ipopt(count: int) -> None:
    for plain in (battery(), cart(), rocket()):
        problem = plain[0](plain[1]).take(slice(0, count))
        ours, theirs = (torchgco.solve(problem, solver=name).cost for name in ("gco", "ipopt"))
        torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-8)


@pytest.mark.sampled(6)
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("off", [0.0, 1e-12, 1e-9])
@pytest.mark.parametrize("make", [battery, cart, rocket])
def test_bounds_that_a_given_start_meets(make: Callable[[float], Plain], off: float, solver: str) -> None:
    """At knot 0, where no control can change a thing; the start may break them by rounding."""
    of, own = make({battery: 1.0 + off}.get(make, -off))
    bounds = own[1]
    assert isinstance(bounds, StateBounds)
    also = StateBounds(bounds.lower, bounds.upper, knots=slice(0, of([]).N + 1))
    assert_same_answer(torchgco.solve(of([own[0], also]), solver=solver), torchgco.solve(of(own), solver=solver))


@pytest.mark.slow
@pytest.mark.parametrize("solver", MOSTLY)
def test_rows_that_are_constant(solver: str) -> None:
    """By a mask, at all knots, at the start of a state that nothing changes, and of states and controls together."""
    of, own = battery()
    expected, mask = torchgco.solve(of(own), solver=solver), (torch.arange(49) % 4 > 0).to(D).unsqueeze(-1)
    full = lambda x, u: torch.cat((x - 1.0, -x), dim=-1)
    for more in (
        FunctionConstraint(lambda x, k: mask[k] * (x - 1.0)),
        FunctionConstraint(lambda x: 0.0 * x),
        FunctionConstraint(full, of="xu"),
        FunctionConstraint(lambda x, k: x - 1.0, knots=[0]),
    ):
        assert_same_answer(torchgco.solve(of([*own, more]), solver=solver), expected)


@pytest.mark.parametrize("solver", MOSTLY)
def test_rows_of_a_state_that_nothing_moves(solver: str) -> None:
    """A mass, bounded from above by itself; guesses are moved inside of their bounds."""
    mass, of_all = 1.0 + drawn(10, 0.0, 9.0), torch.zeros(B, 3, dtype=D)
    goal = torch.stack((drawn(4, 0.5, 4.0), 0 * mass, 0 * mass), -1).unsqueeze(1)
    of_all[:, 2] = mass
    model = FunctionDynamics(
        lambda x, u: torch.stack((x[..., 1], u[..., 0] / x[..., 2], 0 * x[..., 2]), -1), 3, 1, 0.1, "rk4"
    )
    own = [ControlBounds(-1.0, 1.0), StateBounds([-INF, 0.0, -INF], [INF, 1.5, INF])]
    of = lambda parts: Problem(model, QuadraticCost([1.0, 0, 0], [0.1], [10.0, 1.0, 0.0], goal), parts, of_all, 40)
    heaviest = torch.full((B, 1, 3), INF, dtype=D)
    heaviest[:, 0, 2] = mass
    expected = torchgco.solve(of(own), solver=solver)
    for knots in (slice(0, 41), slice(1, 41)):
        more = StateBounds([-INF] * 3, heaviest, knots=knots)
        assert_same_answer(torchgco.solve(of([*own, more]), solver=solver), expected)


@pytest.mark.slow
@pytest.mark.parametrize("solver", MOSTLY)
def test_rows_that_move_by_rounding_alone(solver: str) -> None:
    """The length of what is turned."""
    angle = drawn(11, 0.3, 3.0)

    def turned(x: Tensor, u: Tensor) -> Tensor:
        cos, sin = (0.1 * u[..., 0]).cos(), (0.1 * u[..., 0]).sin()
        return torch.stack((cos * x[..., 0] - sin * x[..., 1], sin * x[..., 0] + cos * x[..., 1]), -1)

    cost = FunctionCost(lambda x, u: (x[..., 0] - 1).square() + x[..., 1].square() + 0.1 * u[..., 0].square())
    model, x0 = FunctionDynamics(turned, 2, 1, 0.1, "none"), torch.stack((angle.cos(), angle.sin()), -1)
    expected = torchgco.solve(Problem(model, cost, [ControlBounds(-2.0, 2.0)], x0, 40), solver=solver)
    parts = [ControlBounds(-2.0, 2.0), FunctionConstraint(lambda x: x.square().sum(-1, keepdim=True) - 1)]
    assert_same_answer(torchgco.solve(Problem(model, cost, parts, x0, 40), solver=solver), expected, 1e-5)


@pytest.mark.slow
def test_a_row_that_is_flat_only_where_the_guess_is() -> None:
    """It is left out at first, and comes in where it turns out to be broken."""
    of, own = battery(0.5)
    plain = torchgco.solve(of([*own, FunctionConstraint(lambda x, u: u.abs() - 0.05, of="xu")]))
    bent = FunctionConstraint(lambda x, u: u.square() - 0.0025, of="xu")
    found = torchgco.solve(of([*own, bent]))
    assert_same_answer(found, plain, 1e-4)
    assert float(torchgco.solve(of(own)).cost.sum()) < 0.99 * float(found.cost.sum())


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_start_outside_a_row(solver: str) -> None:
    """INFEASIBLE, whatever a later pass says; the controls are the best ones of all other rows."""
    of, own = cart(drawn(6, -0.09, -0.002))
    expected = torchgco.solve(of(own), solver=solver)
    rows = lambda x, u: torch.stack((-x[..., 1], x[..., 1] - 1.5), dim=-1)
    for broken in (
        [StateBounds([-INF, 0.0], [INF, 1.5], knots=slice(0, 41))],
        [FunctionConstraint(rows, of="xu"), StateBounds([-INF, 0.0], [INF, 1.5], knots=[40])],
    ):
        problem = of([own[0], *broken])
        found = torchgco.solve(problem, solver=solver)
        assert found.statuses == [Status.INFEASIBLE] * B
        torch.testing.assert_close(found.cost, expected.cost, rtol=1e-6, atol=0)
        torch.testing.assert_close(found.violation, -problem.x0[:, 1], rtol=0, atol=1e-12)
        assert set(found.worst_rows(problem)["knot"]) == {0}


@pytest.mark.parametrize("solver", mostly(SOLVERS, "gco"))
def test_no_later_pass_hides_that_problems_are_infeasible(solver: str) -> None:
    """Starts so far outside that the next knots are, too; and two rows that contradict each other."""
    of, own = cart(drawn(10, -3.0, -0.3))
    also = StateBounds([-INF, 0.0], [INF, 1.5], knots=slice(0, 41))
    place = drawn(11, 0.0, 1.0)
    apart = lambda x, a: torch.stack((x[..., 0] - a, a + 0.2 - x[..., 0]), dim=-1)
    both = FunctionConstraint(apart, knots=[10, 20], values={"a": place})
    for problem in (of([own[0], also]), cart()[0]([own[0], both])):
        assert torchgco.solve(problem, solver=solver).statuses == [Status.INFEASIBLE] * B


def test_a_row_that_is_flat_where_it_is_broken_is_not_called_the_starts() -> None:
    """At the guess it has no slope and is broken; farther away it is kept."""
    of, own = cart()
    far = FunctionConstraint(lambda x: 0.2 - (x[..., :1].abs() - 0.3).relu(), knots=[20])
    found = torchgco.solve(of([own[0], far]).take(slice(0, 8)))
    for b, status in enumerate(found.statuses):
        assert status is not Status.INFEASIBLE or "No control moves" not in str(found.explain(b))
    assert Status.CONVERGED in found.statuses


def test_rows_in_small_units_are_not_relaxed_away() -> None:
    """Their multipliers are as large as those that explode."""
    of, own = cart()
    expected = torchgco.solve(of([own[0], StateBounds([-INF, -INF], [INF, 0.5])]))
    small = FunctionConstraint(lambda x: 1e-7 * (x[..., 1:] - 0.5))
    assert_same_answer(torchgco.solve(of([own[0], small])), expected, 1e-4)


def test_a_row_without_which_there_is_no_optimum_comes_in() -> None:
    """It is flat at the guess, and nothing else bounds a linear cost."""
    model = FunctionDynamics(lambda x, u: u, 1, 1, 0.1)
    cost = FunctionCost(lambda x, u: -u[..., 0], lambda x: 0 * x[..., 0])
    row = FunctionConstraint(lambda x, u: (u - 0.02).relu().square() - 1e-4, of="xu")
    found = torchgco.solve(Problem(model, cost, [row], torch.zeros(1, 1, dtype=D), 40))
    assert found.statuses == [Status.CONVERGED]
    torch.testing.assert_close(found.U, torch.full_like(found.U, 0.03), rtol=1e-4, atol=0)


@pytest.mark.parametrize("solver", SOLVERS)
def test_rows_that_leave_one_point(solver: str) -> None:
    """From -0.1 m/s with 1 m/s^2 the first speed can only be 0: relaxed rows have room there."""
    of, own = cart(-0.1)
    found, theirs = torchgco.solve(of(own), solver=solver), torchgco.solve(of(own).take(slice(0, 4)), solver="ipopt")
    assert found.statuses == [Status.CONVERGED] * B and float(found.violation.max()) <= 1e-6
    torch.testing.assert_close(found.cost[:4], theirs.cost, rtol=1e-5, atol=0)


@pytest.mark.slow
@pytest.mark.parametrize("solver", MOSTLY)
def test_bounds_that_coincide_are_equalities(solver: str) -> None:
    """Of the last state and of the controls of four stages; multipliers have the signs of an inequality's."""
    of, own = cart()
    goal = torch.stack((drawn(7, 0.5, 1.8), torch.zeros(B, dtype=D)), dim=-1)
    last = FunctionConstraint(lambda x, goal: x - goal, "equality", knots=[40], values={"goal": goal})
    before = StateBounds([-INF, 0.0], [INF, 1.5], knots=slice(1, 40))
    expected = torchgco.solve(of([own[0], before, last]), solver=solver)
    same = StateBounds(goal.unsqueeze(1), goal.unsqueeze(1), knots=[40])
    found = torchgco.solve(of([own[0], before, same]), solver=solver)
    assert_same_answer(found, expected)
    assert float(found.violation.max()) <= 1e-9
    upper, lower = found.multipliers.lam[2].split(2, dim=-1)
    assert min(float(upper.min()), float(lower.min())) >= 0 and float((upper * lower).abs().max()) == 0
    torch.testing.assert_close(upper - lower, expected.multipliers.lam[2], rtol=1e-4, atol=1e-4)

    value, low = drawn(8, -0.3, 0.8, 1, 1), torch.full((B, 40, 1), -1.0, dtype=D)
    high = -low
    low[:, 10:14], high[:, 10:14] = value, value
    held = FunctionConstraint(
        lambda x, u, v: u - v, "equality", of="xu", knots=slice(10, 14), values={"v": value[:, 0]}
    )
    expected = torchgco.solve(of([*own, held]), solver=solver)
    tight = FunctionConstraint(lambda x, u, v: u - v, of="xu", knots=slice(10, 14), values={"v": value[:, 0]})
    for more in ([], [tight]):
        assert_same_answer(torchgco.solve(of([ControlBounds(low, high), own[1], *more]), solver=solver), expected)


def test_a_warm_start_keeps_the_multipliers_of_bounds_that_coincide() -> None:
    of, own = cart()
    goal = torch.stack((drawn(7, 0.5, 1.8), torch.zeros(B, dtype=D)), dim=-1).unsqueeze(1)
    before = StateBounds([-INF, 0.0], [INF, 1.5], knots=slice(1, 40))
    problem = of([own[0], before, StateBounds(goal, goal, knots=[40])])
    cold = torchgco.solve(problem, solver="interior_point")
    again = torchgco.solve(problem, solver="interior_point", warm=cold)
    assert_same_answer(again, cold)
    assert float(again.iterations.double().mean()) < 0.6 * float(cold.iterations.double().mean())


def test_batches_with_some_such_rows_keep_the_bits_of_all_problems() -> None:
    charge = torch.where(torch.arange(B) % 3 == 0, 1.0, 0.4 + 0.5 * drawn(9, 0, 1)).unsqueeze(-1)
    of, own = battery()
    plain = of([own[0], StateBounds(0.0, 1.0, knots=slice(0, 49))])
    problem = Problem(plain.dynamics, plain.cost, plain.constraints, charge, plain.N)
    whole = torchgco.solve(problem)
    for rows in (range(0, B, 3), [5], range(B - 1, -1, -1), range(7)):
        index = torch.tensor(list(rows))
        part = torchgco.solve(problem.take(index))
        assert torch.equal(part.U, whole.U[index]) and torch.equal(part.cost, whole.cost[index])


def test_problems_beside_one_that_its_start_spoils_keep_their_bits() -> None:
    """That one ends in the middle of the others' iterations."""
    speed = torch.where(torch.arange(B) % 4 == 1, -0.05, 0.2)
    of, own = cart(speed)
    problem = of([own[0], StateBounds([-INF, 0.0], [INF, 1.5], knots=slice(0, 41))])
    whole = torchgco.solve(problem, solver="interior_point")
    assert whole.statuses.count(Status.INFEASIBLE) == 16 and whole.statuses.count(Status.CONVERGED) == 48
    for b in (0, 1, 2, 3, 30, 63):
        alone = torchgco.solve(problem.take(slice(b, b + 1)), solver="interior_point")
        assert torch.equal(alone.U[0], whole.U[b]) and int(alone.iterations[0]) == int(whole.iterations[b])
