"""What a receding horizon relies on: problems started elsewhere, bounds bound twice, own numbers of a traced model."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.engines import engine_of
from tests.missions.missions import DOUBLE
from tests.problems import assert_same_bits, planar_batch, quadrotor_batch
from torchgco import (
    ILQR,
    AugmentedLagrangian,
    FirstStepRates,
    InputError,
    Planar,
    Problem,
    QuadrotorPlanning,
    Spheres,
    StateBounds,
    kernels,
)
from torchgco.constraints import Constraint, ControlBounds
from torchgco.dynamics.rollout import open_loop as eager_rollout
from torchgco.kernels import cost_scale, open_loop
from torchgco.missions.planning_problem import BiasedPlanning
from torchgco.native.compiler import find_compiler

SOLVER = AugmentedLagrangian(ILQR(max_iterations=6), initial_penalty=0.1, max_outer_iterations=4)
INF = torch.inf
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


def bounds(B: int) -> StateBounds:
    """One component with an upper bound alone; another that is bounded below in the first problem only."""
    lower, upper = torch.full((B, 14), -INF, **DOUBLE), torch.full((B, 14), INF, **DOUBLE)
    lower[:, 2], upper[:, 2] = -0.4, 0.5
    upper[:, 3], lower[0, 4] = 3.0, -2.0
    return StateBounds(lower, upper)


def constraints(B: int, seed: int) -> list[Constraint]:
    """Moving spheres, bounds with an infinite side, and rates at the first knot, none of them bound."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, **DOUBLE)

    centers = torch.tensor([2.0, 0.5, 0.0], **DOUBLE) + 0.5 * normal(B, 3, 3)
    return [
        Spheres(centers, torch.full((B, 3), 0.3, **DOUBLE), 0.2, 0.3 * normal(B, 3, 3), knots=slice(1, 9)),
        ControlBounds([-5, -5, -5, 0.26], [5, 5, INF, 14.9]),
        bounds(B),
        FirstStepRates(3.94 + 0.05 * normal(B, 4), 0.1),
    ]


def horizon(B: int, seed: int, bias: float | None = None) -> Problem:
    """A quadrotor's planning problem, its state and constraints by seed."""
    plain, _ = quadrotor_batch(B, N=12)
    generator = torch.Generator().manual_seed(seed)
    x0 = plain.x0 + 0.05 * torch.randn(B, 14, generator=generator, **DOUBLE)
    model: QuadrotorPlanning = QuadrotorPlanning(dt=0.1)
    if bias is not None:
        model = BiasedPlanning(dt=0.1, bias=bias * torch.randn(B, 3, generator=generator, **DOUBLE))
    return Problem(model, plain.cost, constraints(B, seed), x0, 12)


def controls(problem: Problem) -> Tensor:
    return torch.tensor([0.0, 0, 0, 9.81], **DOUBLE).repeat(problem.B, problem.N, 1)


@pytest.mark.sampled(2)
@needs_compiler
@pytest.mark.parametrize("bias", [None, 0.5])
@pytest.mark.parametrize("B", [1, 3])
def test_a_problem_started_elsewhere_is_a_fresh_one_with_its_kernels_kept(B: int, bias: float | None) -> None:
    first = horizon(B, 1, bias)
    engine = engine_of(first)
    assert engine is not None
    SOLVER.solve(first, controls(first))  # with kernels that know the first problem's numbers
    for seed in (2, 3):
        fresh = horizon(B, seed, bias)
        for parts in (constraints(B, seed), fresh.constraints):
            dynamics = None if bias is None else fresh.dynamics
            moved = first.started_at(fresh.x0, parts, dynamics=dynamics)
            kept = engine_of(moved)
            assert kept is not None and kept.library is engine.library
            assert torch.equal(cost_scale(moved).unit, cost_scale(horizon(B, seed, bias)).unit)
            assert_same_bits(SOLVER.solve(moved, controls(moved), seed=4), SOLVER.solve(fresh, controls(fresh), seed=4))
    again = first.started_at(first.x0, first.constraints)
    assert_same_bits(SOLVER.solve(again, controls(again)), SOLVER.solve(first, controls(first)))


@needs_compiler
def test_a_problem_started_elsewhere_has_the_same_bits_in_any_batch() -> None:
    first, fresh = horizon(3, 1, 0.5), horizon(3, 2, 0.5)
    whole = first.started_at(fresh.x0, fresh.constraints, dynamics=fresh.dynamics)
    together = SOLVER.solve(whole, controls(whole))
    for rows in ([2], [1, 0], [0, 0, 0]):
        index = torch.tensor(rows)
        alone, part = first.take(index), fresh.take(index)
        for problem in (whole.take(index), alone.started_at(part.x0, part.constraints, dynamics=part.dynamics)):
            solution = SOLVER.solve(problem, controls(problem), ids=index)
            assert_same_bits(solution, together.take(index))


def test_spheres_a_while_later_are_shifted_ones() -> None:
    """Values, rows of the Hessian and distances of `later` are those of spheres given at the later centres."""
    now = horizon(2, 1)
    spheres = constraints(2, 1)[0]
    assert isinstance(spheres, Spheres)
    moved = replace(spheres, centers=spheres.centers + 0.7 * spheres.velocities)
    fresh = Problem(now.dynamics, now.cost, [moved], now.x0, now.N).constraints[0]
    later = now.constraints[0].later(0.7)
    X, U = open_loop(now, controls(now)), controls(now)
    assert torch.equal(later.value(X, U), fresh.value(X, U))
    assert torch.equal(later.start_is_clear(now.x0), fresh.start_is_clear(now.x0))
    assert now.constraints[2].later(0.7) is now.constraints[2]


def test_what_does_not_fit_is_named() -> None:
    first = horizon(2, 1)
    with pytest.raises(InputError) as caught:
        first.started_at(first.x0[:1], first.constraints)
    assert caught.value.field == "x0"
    with pytest.raises(InputError) as caught:
        first.started_at(first.x0, first.constraints[1:])
    assert caught.value.field == "constraints"


def test_bounds_that_are_bound_twice_keep_their_rows() -> None:
    once = horizon(3, 1)
    twice = Problem(once.dynamics, once.cost, once.constraints, once.x0, once.N)
    X, U = open_loop(once, controls(once)), controls(once)
    for i, count in ((1, 7), (2, 4)):  # of bounded sides: 8 less one of the controls, 2 + 1 + 1 of the states
        rows = once.constraints[i].value(X, U)
        assert rows.shape[-1] == count
        assert torch.equal(twice.constraints[i].value(X, U), rows)
        assert torch.equal(once.started_at(once.x0, once.constraints).constraints[i].value(X, U), rows)
    assert_same_bits(SOLVER.solve(once, U), SOLVER.solve(twice, U))


def dragged(drag: Any, B: int = 3) -> Problem:
    """Planar problems with a drag of their own."""
    plain, _ = planar_batch(B, N=20, obstacles=3)
    return Problem(Planar(dt=0.1, drag=drag), plain.cost, plain.constraints, plain.x0, plain.N)


DRAG = torch.tensor([4.0, 9.0, 13.0], **DOUBLE)


@pytest.mark.slow
@needs_compiler
def test_a_parameter_per_problem_has_the_same_bits_alone_and_repeated() -> None:
    whole = dragged(DRAG)
    U0 = torch.zeros(3, 20, 2, **DOUBLE)
    together = SOLVER.solve(whole, U0)
    assert len({float(cost) for cost in together.cost}) == 3
    for b in range(3):
        index = torch.tensor([b])
        part = whole.take(index)
        fresh = Problem(Planar(dt=0.1, drag=DRAG[b : b + 1]), part.cost, part.constraints, part.x0, 20)
        for alone in (part, fresh):
            assert_same_bits(SOLVER.solve(alone, U0[:1]), together.take(index))
            for repeated in (alone.take(torch.tensor([0, 0, 0])), alone.take(torch.tensor([0, 0]))):
                assert_same_bits(SOLVER.solve(repeated, U0[: repeated.B]), together.take(index.repeat(repeated.B)))
    mixed = torch.tensor([2, 0, 2, 1, 1])
    assert_same_bits(SOLVER.solve(whole.take(mixed), U0[mixed % 1]), together.take(mixed))


@needs_compiler
@pytest.mark.parametrize("first", ["whole", "alone", "repeated"])
def test_kernels_may_be_made_for_any_batch_first(first: str) -> None:
    """The library is compiled at the first use, whose batch it must not remember."""
    whole = dragged(DRAG)
    alone = whole.take(torch.tensor([1]))
    batches = {"whole": whole, "alone": alone, "repeated": alone.take(torch.tensor([0, 0, 0]))}
    U = 0.5 * torch.randn(1, 20, 2, generator=torch.Generator().manual_seed(0), **DOUBLE)
    assert engine_of(batches[first]) is not None
    for name in ("alone", "whole", "repeated", "alone"):
        problem = batches[name]
        X = open_loop(problem, U.expand(problem.B, -1, -1).contiguous())
        eager = eager_rollout(problem.dynamics, problem.x0, U.expand(problem.B, -1, -1))
        torch.testing.assert_close(X, eager, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("rows", [[1], [0, 0, 0], [2, 0, 1]])
def test_native_and_eager_kernels_agree_on_own_parameters(rows: list[int]) -> None:
    index = torch.tensor(rows)
    U0 = torch.zeros(len(rows), 20, 2, **DOUBLE)
    native = SOLVER.solve(dragged(DRAG).take(index), U0)
    kernels.use_native(False)
    try:
        eager = SOLVER.solve(dragged(DRAG).take(index), U0)
    finally:
        kernels.use_native(True)
    torch.testing.assert_close(native.X, eager.X, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(native.cost, eager.cost, rtol=1e-8, atol=1e-8)
