"""Bounds that differ from knot to knot."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, inf

import torchgco
from tests.engines import compiled
from tests.native.users import N, with_bounds_by_knot
from torchgco import (
    ILQR,
    MPPI,
    AugmentedLagrangian,
    ControlBounds,
    FunctionCost,
    FunctionDynamics,
    InputError,
    NormBounds,
    Problem,
    RateBounds,
    StateBounds,
    Status,
    kernels,
)
from torchgco.base.draws import DrawKey
from torchgco.baselines import CasADiSolver
from torchgco.judging.certificate import certify
from torchgco.kernels import EagerWarning, current
from torchgco.scenarios import Layouts

D = torch.float64
STEPS = 20
BRIEF = AugmentedLagrangian(inner=ILQR(max_iterations=3), max_outer_iterations=3)


def point(*constraints: Any, B: int = 2, goal: float = 5.0, stages: int = STEPS) -> Problem:
    """Points in the plane that are to get far in 2 s."""
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), dim=-1), 4, 2, 0.1, position=slice(0, 2))
    cost = FunctionCost(lambda x, u: 1e-3 * u.square().sum(-1), lambda x: (x[..., :2] - goal).square().sum(-1))
    return Problem(model, cost, constraints, torch.zeros(B, 4, dtype=D), stages)


def fading(B: int = 2) -> Tensor:
    """Bounds (B, STEPS, 2) that fall with time, wider for the second control."""
    each = torch.linspace(3.0, 0.5, STEPS, dtype=D).view(1, STEPS, 1) * torch.tensor([1.0, 2.0], dtype=D)
    return each * torch.linspace(1.0, 1.5, B, dtype=D).view(B, 1, 1)


@compiled
def test_controls_follow_their_bounds_natively() -> None:
    problem = point(ControlBounds(-1.0, fading()), goal=50.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error", EagerWarning)
        solution = torchgco.solve(problem)
    assert set(solution.statuses) == {Status.CONVERGED}
    assert bool((fading() + 1e-3 >= solution.U).all())
    torch.testing.assert_close(solution.U[:, :12], fading()[:, :12], rtol=0, atol=2e-3)  # as much as there is
    assert float(certify(problem, solution.X, solution.U).bound_violation.max()) < 2e-3
    excess = certify(problem, solution.X, solution.U + 0.25).bound_violation
    torch.testing.assert_close(excess, solution.violation.new_full((2,), 0.25), rtol=0, atol=2e-3)


@pytest.mark.parametrize("native", [True, False])
def test_problems_and_bounds_shared_by_them_give_the_same(native: bool) -> None:
    kernels.use_native(native)
    try:
        whole = torchgco.solve(point(ControlBounds(-1.0, fading())), solver=BRIEF).U
        for b in (0, 1):
            alone = point(ControlBounds(-1.0, fading()[b : b + 1]), B=1)
            part = point(ControlBounds(-1.0, fading())).take(torch.tensor([b]))
            shared = point(ControlBounds(-1.0, fading()[b : b + 1]), B=2)
            for one in (alone, part, shared):
                assert torch.equal(torchgco.solve(one, solver=BRIEF).U[0], whole[b])
    finally:
        kernels.use_native(True)


def test_a_corridor_of_states_agrees_with_ipopt_and_fatrop() -> None:
    """Walls that close in, and gates at three knots given in another order."""
    k = torch.arange(1, STEPS + 1, dtype=D)
    walls = StateBounds(-inf, torch.stack((torch.full_like(k, inf), 0.2 + 0.1 * k, *[k + inf] * 2), -1)[None])
    gates = torch.tensor([[2.5, inf, inf, inf], [0.5, inf, inf, inf], [1.0, inf, 0.3, inf]], dtype=D)[None]
    problem = point(walls, StateBounds(-inf, gates, knots=[20, 5, 12]), ControlBounds(-9.0, 9.0))
    solution = torchgco.solve(problem)
    X = solution.X
    assert float(solution.violation.max()) < 1e-3
    assert bool((X[:, 1:, 1] <= 0.2 + 0.1 * k + 1e-3).all())
    assert bool((X[:, [20, 5, 12], 0] <= gates[..., 0] + 1e-3).all()) and bool((X[:, 12, 2] <= 0.301).all())
    for plugin in ("ipopt", "fatrop"):
        there = CasADiSolver(plugin).solve(problem, solution.U)
        assert there.statuses == [Status.CONVERGED] * 2
        torch.testing.assert_close(there.cost, solution.cost, rtol=1e-2, atol=1e-3)


def test_samples_stay_within_the_bounds_of_their_knots() -> None:
    some = slice(5, 12)
    everywhere, here = point(ControlBounds(-1.0, fading())), point(ControlBounds(-1.0, fading()[:, some], knots=some))
    key = DrawKey(0, torch.arange(2), torch.zeros(2, dtype=torch.int64))
    U = torch.zeros(2, STEPS, 2, dtype=D)
    V = MPPI(covariance=100.0).first_samples(everywhere, U, key, 50)
    assert bool((fading() >= V).all()) and bool((fading() == V).any(0).any(0).all()) and float(V.min()) == -1.0
    W = MPPI(covariance=100.0).first_samples(here, U, key, 50)
    assert torch.equal(W[:, :, some], V[:, :, some]) and bool((W[:, :, 12:].abs() > 9.0).any())
    # From the bounds: the widest of a control's ranges.
    assert MPPI(covariance=None, spread=1.0)._sigma(everywhere).sqrt().tolist() == [[[4.0, 7.0]], [[5.5, 10.0]]]


def test_ranges_and_the_middle() -> None:
    (bounds,) = point(ControlBounds(-1.0, fading())).constraints
    assert isinstance(bounds, ControlBounds)
    assert bounds.range.tolist() == [[4.0, 7.0], [5.5, 10.0]]
    z = torch.zeros(2, STEPS, 2, dtype=D)
    torch.testing.assert_close(bounds.middle(z), 0.5 * (fading() - 1.0))
    reach = bounds.range_from(z[:, :1], torch.tensor([[1.0, -1.0]], dtype=D))
    assert reach.tolist() == [[[3.0, 1.0]], [[4.5, 1.0]]]


def test_a_guess_outside_the_bounds_starts_in_the_middle_of_each_knot() -> None:
    off = fading() + 1.0
    problem = point(ControlBounds(off, off + 1.0, knots=slice(0, STEPS)))
    torch.testing.assert_close(torchgco.api._guess(problem, current(problem)), off + 0.5)
    some = point(ControlBounds(off[:, :3], off[:, :3] + 1.0, knots=[4, 9, 2]))
    guess = torchgco.api._guess(some, current(some))
    torch.testing.assert_close(guess[:, [4, 9, 2]], off[:, :3] + 0.5)
    assert float(guess.abs().sum() - guess[:, [4, 9, 2]].abs().sum()) == 0.0


def test_values_are_those_of_a_loop() -> None:
    problem = with_bounds_by_knot()
    generator = torch.Generator().manual_seed(2)
    X, U = (torch.randn(problem.B, K, size, dtype=D, generator=generator) for K, size in ((N + 1, 4), (N, 2)))
    gates, walls = problem.constraints[1:]
    rows = gates.violation(X, U).amax(-1)
    for i, k in enumerate((2, 5, N)):
        over = [X[:, k, 3] - 0.3] if i < 2 else [X[:, k, 0] - 0.1, X[:, k, 1] - 0.2]
        torch.testing.assert_close(rows[:, i], torch.stack(over).amax(0).clamp(min=0.0))
    high = torch.linspace(2, 1, N, dtype=D)
    for k in range(1, N + 1):
        expected = torch.cat((X[:, k] - high[k - 1], -5.0 - X[:, k]), -1)
        torch.testing.assert_close(walls.value(X, U)[:, k - 1], expected)


@pytest.mark.parametrize(
    ("make", "line"),
    [
        (lambda: ControlBounds(-1.0, fading()[0]), r"upper: expected shape \(3, 2\), or per knot"),
        (lambda: ControlBounds(fading()[:, :4], 9.0), r"lower: expected shape \(3, 20, 2\), got \(2, 4, 2\)"),
        (lambda: ControlBounds(-1.0, fading(3), knots=[1, 2]), r"control_bounds.upper: expected shape \(3, 2, 2\)"),
        (lambda: StateBounds(-1.0, fading(3)), r"state_bounds.upper: expected shape \(3, 20, 4\)"),
        (lambda: ControlBounds(4.0, fading(3)), "control_bounds.lower: expected at most the upper bound"),
        (lambda: ControlBounds(-1.0, -inf * fading(3)), "control_bounds.upper: expected numbers or inf"),
        (lambda: ControlBounds(-1.0, fading(3)[None]), r"control_bounds.upper: expected shape"),
    ],
)  # fmt: skip
def test_bounds_that_do_not_fit_are_named(make: Any, line: str) -> None:
    with pytest.raises(InputError, match=line):
        point(make(), B=3)


def test_bounds_by_knot_do_not_fit_a_problem_of_another_length() -> None:
    (bounds,) = point(ControlBounds(-1.0, fading())).constraints
    assert point(bounds).constraints[0].value is not None
    with pytest.raises(InputError, match=r"control_bounds.lower: expected shape|control_bounds.upper: expected shape"):
        point(bounds, stages=15)


KINDS = {StateBounds: 4, ControlBounds: 2, RateBounds: 2}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(6))
def test_none_is_no_bound(kind: Any, seed: int) -> None:
    """For one component or for all, of each problem, and at each knot; what is bound is what infinity gives."""
    draw, size = torch.Generator().manual_seed(seed), KINDS[kind]
    K = STEPS if kind is not RateBounds else STEPS - 1
    shape = [(size,), (2, size), (2, K, size)][seed % 3]
    numbers = [sign * (1.0 + torch.rand(shape, generator=draw, dtype=D)) for sign in (-1.0, 1.0)]
    free = [torch.rand(shape, generator=draw) < 0.5 for _ in numbers]
    for some in free:
        some.view(-1, size)[:, 0] = False
    infinite = [bound.masked_fill(none, sign * inf) for bound, none, sign in zip(numbers, free, (-1, 1), strict=True)]
    given = [with_none(bound.tolist()) for bound in infinite]
    for lower, upper in (given, map(as_objects, given), [tuple(given[0]), given[1]], [None, given[1]]):
        expected = [-inf if lower is None else infinite[0], infinite[1]]
        (bound,), (other,) = (point(kind(*both)).constraints for both in ((lower, upper), expected))
        assert torch.equal(bound.lower, other.lower) and torch.equal(bound.upper, other.upper)
        X, U = (torch.randn(2, k, n, generator=draw, dtype=D) for k, n in ((STEPS + 1, 4), (STEPS, 2)))
        assert torch.equal(bound.value(X, U), other.value(X, U))


def with_none(value: Any) -> Any:
    return [with_none(one) for one in value] if isinstance(value, list) else value if abs(value) < inf else None


def as_objects(value: Any) -> Any:
    return np.array(value, dtype=object)


def test_none_is_no_bound_of_norms_layouts_and_compiled_problems() -> None:
    (norms,) = point(NormBounds("u", lower=[None, 0.5], upper=[2.0, None])).constraints
    (same,) = point(NormBounds("u", lower=[0.0, 0.5], upper=[2.0, inf])).constraints
    assert torch.equal(norms.lower, same.lower) and torch.equal(norms.upper, same.upper)
    layouts = Layouts(np.zeros((1, 1, 2)), np.ones((1, 1)), control_lower=[None, -1], control_upper=[2, None])
    assert layouts.control_lower is not None and layouts.control_upper is not None
    assert layouts.control_lower.tolist() == [-inf, -1] and layouts.control_upper.tolist() == [2, inf]
    mpc = torchgco.compile(point(ControlBounds([None, -1.0], [1.0, None]), B=1))
    mpc.numbers["lower"], mpc.numbers["upper"] = [None, -2.0], [2.0, None]
    assert mpc.numbers["lower"].tolist() == [[-inf, -2.0]] and mpc.numbers["upper"].tolist() == [[2.0, inf]]
    with pytest.raises(InputError, match="infinity in components that were infinite"):
        mpc(upper=[2.0, 2.0])


@pytest.mark.parametrize("wrong", [[None, None], None])
def test_no_bound_at_all_is_refused_as_before(wrong: Any) -> None:
    with pytest.raises(InputError, match="control_bounds: expected at least one finite bound"):
        point(ControlBounds(wrong, wrong))
