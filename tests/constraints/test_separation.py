"""Positions within one state that keep a distance: rows, derivatives, solves, judge and errors."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from tests.problems import at_knots
from tests.slow import mostly
from torchgco import (
    ContactWarning,
    ControlBounds,
    FunctionDynamics,
    Goal,
    InputError,
    InteriorPoint,
    Problem,
    QuadraticCost,
    RateBounds,
    Separation,
    Status,
    certify,
    judge,
    presets,
)
from torchgco.baselines import CasADiSolver
from torchgco.dynamics.rollout import open_loop
from torchgco.kernels import EagerWarning, chord_clearance

pytestmark = pytest.mark.filterwarnings("ignore::torchgco.ContactWarning")  # unless a test asks for it

D = torch.float64
B, N = 3, 30
STATES = [[0, 1], [4, 5], [8, 9]]  # of three carts in the plane, (position, velocity) each
PAIRS = [[0, 1], [0, 2], [1, 2]]
KEPT = torch.tensor([0.6, 0.8, 1.0], dtype=D)


def carts(*constraints: Any, x0: Tensor | None = None, rows: slice = slice(None), **kind: Any) -> Problem:
    """Three carts in one state that change places in 3 s."""
    ends = [[-2.0, 0, 0, 0, 1, 1.7, 0, 0, 1, -1.7, 0, 0], [1.9, 0.2, 0, 0, -1.1, -1.6, 0, 0, -0.9, 1.8, 0, 0]]
    start, goal = torch.tensor(ends, dtype=D).unsqueeze(1)
    start = start + 0.05 * torch.arange(B, dtype=D).unsqueeze(1) * torch.arange(12).cos() if x0 is None else x0

    def field(x: Tensor, u: Tensor) -> Tensor:
        parts = [torch.cat((x[..., i + 2 : i + 4], u[..., i // 2 : i // 2 + 2]), -1) for i in (0, 4, 8)]
        return torch.cat(parts, dim=-1)

    model = FunctionDynamics(field, 12, 6, 0.1, kind.get("integrator", "euler"), slice(0, 2))
    cost = QuadraticCost([1.0, 1, 0.1, 0.1] * 3, [0.1] * 6, [20.0, 20, 2, 2] * 3, goal)
    return Problem(model, cost, constraints, start[rows].contiguous(), N)


def points(seed: int) -> tuple[Tensor, Tensor]:
    random = torch.Generator().manual_seed(seed)
    return tuple(torch.randn(B, N + k, size, generator=random, dtype=D) for k, size in ((1, 12), (0, 6)))  # type: ignore


@pytest.mark.parametrize("knots", [None, [3, 30, 7]])
def test_rows_and_violations_are_those_of_numpy(knots: list[int] | None) -> None:
    pairs = [[2, 0], [1, 2]]
    (part,) = carts(Separation(STATES, KEPT, pairs, knots)).constraints
    X, U = points(0)
    value, violation = part.value(X, U).numpy(), part.violation(X, U).numpy()
    at = range(1, N + 1) if knots is None else knots
    assert value.shape == (B, len(at), 2) and 0 < (violation > 0).sum() < violation.size
    for b in range(B):
        for row, k in enumerate(at):
            for q, (i, j) in enumerate(pairs):
                apart = np.hypot(*(X[b, k, STATES[i]] - X[b, k, STATES[j]]).numpy())
                assert value[b, row, q] == pytest.approx(float(KEPT[b]) ** 2 - apart**2)
                assert violation[b, row, q] == pytest.approx(max(0.0, float(KEPT[b]) - apart))


@pytest.mark.parametrize("knots", [None, [3, 30, 7]])
def test_derivatives_are_those_of_autodiff(knots: list[int] | None) -> None:
    (part,) = carts(Separation([range(2), [5, 4], [9, 8]], KEPT, knots=knots)).constraints
    X, U = points(1)
    shape = part.value(X, U).shape
    g, h = (torch.randn(shape, generator=torch.Generator().manual_seed(i), dtype=D) for i in (2, 3))
    H = X.new_zeros(B, N + 1, 19, 19)
    part.accumulate(X, U, g, h, H)
    expected = torch.zeros_like(H)
    at = list(range(1, N + 1) if knots is None else knots)
    for b in range(B):
        one = part.take(slice(b, b + 1))
        rows = torch.func.jacrev(lambda x, one=one: one.value(x[None], U[:1])[0])(X[b])  # (K, Q, N+1, 12)
        for row, k in enumerate(at):
            J = rows[row, :, k]
            expected[b, k, :12, 12] = expected[b, k, 12, :12] = g[b, row] @ J
            expected[b, k, :12, :12] = J.mT @ (h[b, row].unsqueeze(-1) * J)
    torch.testing.assert_close(H, expected)


def test_solves_natively_and_in_pytorch_as_ipopt_does(native: bool) -> None:
    problem = carts(Separation(STATES, KEPT), ControlBounds(-6.0, 6.0))
    solver = InteriorPoint(tolerance=1e-9, violation_tolerance=1e-8) if native else presets.gco(problem).local
    with warnings.catch_warnings():
        warnings.simplefilter("error", EagerWarning)
        found = torchgco.solve(problem, solver=solver)
    assert at_knots(problem, found) == [Status.CONVERGED] * B
    assert float(found.violation.max()) < (1e-8 if native else 1e-3)
    near = problem.constraints[0].value(found.X, found.U).flatten(1).amax(-1)
    assert float(near.min()) > -1e-2  # the distance binds in every problem
    if native:
        there = CasADiSolver("ipopt").solve(problem, found.U, X0=found.X)
        torch.testing.assert_close(found.cost, there.cost, rtol=1e-6, atol=0)
        assert float(certify(problem, found.X, found.U).kkt_residual.max()) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("native", mostly(["native", "eager"], "eager"), indirect=True)
def test_the_rest_of_the_batch_changes_nothing(native: bool) -> None:
    whole = torchgco.solve(carts(Separation(STATES, KEPT), ControlBounds(-6.0, 6.0)))
    for b in range(B):
        rows = slice(b, b + 1)
        alone = torchgco.solve(carts(Separation(STATES, KEPT[rows]), ControlBounds(-6.0, 6.0), rows=rows))
        if native:  # a distance of one problem is a number that all share, and traced as such: the same bits here
            assert torch.equal(alone.U[0], whole.U[b]) and torch.equal(alone.X[0], whole.X[b])
        torch.testing.assert_close(alone.U[0], whole.U[b], rtol=1e-9, atol=1e-9)
        one = carts(Separation(STATES, KEPT), ControlBounds(-6.0, 6.0)).take(torch.tensor([b]))
        assert torch.equal(torchgco.solve(one).U[0], whole.U[b])


@pytest.mark.slow
def test_beside_controls_that_change_slowly() -> None:
    solver = InteriorPoint(tolerance=1e-9, violation_tolerance=1e-8)
    problems = [carts(Separation(STATES, 0.8), RateBounds(-most, most)) for most in (1e3, 0.5)]
    free, slow = (torchgco.solve(problem, solver=solver) for problem in problems)
    for problem, found in zip(problems, (free, slow), strict=True):
        assert at_knots(problem, found) == [Status.CONVERGED] * B
    assert bool((slow.cost > free.cost * 1.01).all())
    assert float(torch.cat((free.violation, slow.violation)).max()) < 1e-8


def meeting(speed: float, integrator: str = "euler") -> tuple[Problem, Tensor]:
    """Two carts that pass each other at 0.2 m, between two knots where fast; the third is far away."""
    x0 = torch.tensor([[-1.05, 0.1, speed, 0, 1.05, -0.1, -speed, 0, 50, 0, 0, 0]], dtype=D)
    return carts(Separation(STATES, 0.4), x0=x0, integrator=integrator), torch.zeros(1, N, 6, dtype=D)


def test_judge_and_certificate_measure_between_the_knots() -> None:
    problem, U = meeting(7.0)
    verdict = judge(problem, U, torch.zeros(2, dtype=D), 1e3)
    X = open_loop(problem.dynamics, problem.x0, U)
    away = X[0, :, :2] - X[0, :, 4:6]
    fine = torch.cat([away[:-1] + s * away.diff(dim=0) for s in torch.linspace(0, 1, 2001, dtype=D)])
    assert float(verdict.clearance_knots) == pytest.approx(float(away.norm(dim=-1).min()) - 0.38) and verdict.clear_95
    assert (
        float(verdict.clearance)
        == pytest.approx(float(fine.norm(dim=-1).min()) - 0.38, abs=1e-6)
        == pytest.approx(-0.18)
    )
    assert float(chord_clearance(problem, X)) == pytest.approx(float(verdict.clearance)) and not verdict.reached
    assert float(certify(problem, X, U).clearance) == pytest.approx(-0.2)


def test_the_certificate_counts_curved_paths_of_both() -> None:
    """Of controls up to 30 m/s^2 over 0.1 s, by which each path leaves its chord by up to 4 cm."""
    problem, _ = meeting(1.0, "rk4")
    within, generator = 0.1 * torch.linspace(0.0, 1.0, 2001, dtype=D).view(-1, 1), torch.Generator().manual_seed(0)
    for most in (0.0, 1.0, 30.0):
        U = most * (2.0 * torch.rand(1, N, 6, generator=generator, dtype=D) - 1.0)
        X = open_loop(problem.dynamics, problem.x0, U)
        places = [x[i : i + 2] + within * x[i + 2 : i + 4] + 0.5 * within**2 * u[i // 2 : i // 2 + 2]
                  for x, u in zip(X[0], U[0], strict=False) for i in (0, 4, 8)]  # fmt: skip
        pairs = [(places[i + a] - places[i + b]).norm(dim=-1).min() for i in range(0, 3 * N, 3) for a, b in PAIRS]
        true = float(torch.stack(pairs).min()) - 0.4
        assert true - 1e-3 <= float(certify(problem, X, U).clearance) <= true + 1e-9


def test_a_touch_between_knots_is_mended_or_warned_of() -> None:
    """Forced across each other, the carts keep their distance at the knots; the default solver mends the chords."""
    x0 = torch.tensor([[-2.1, 0.1, 7.0, 0, 2.1, -0.1, -7.0, 0, 50, 0, 0, 0]], dtype=D)
    problem = carts(Separation(STATES, 0.6), ControlBounds(-90.0, 90.0), x0=x0)
    with pytest.warns(ContactWarning):
        alone = torchgco.solve(problem, solver=InteriorPoint())
    assert alone.statuses == [Status.INFEASIBLE] and float(alone.violation) <= 1e-3
    assert float(chord_clearance(problem, alone.X)) < 0
    with warnings.catch_warnings():
        warnings.simplefilter("error", ContactWarning)
        mended = torchgco.solve(problem)
    assert mended.statuses == [Status.CONVERGED] and float(chord_clearance(problem, mended.X)) >= 0
    assert mended.to_frame(problem).clearance.min() >= 0


@pytest.mark.sampled(1)
@pytest.mark.parametrize("required", [False, True])
def test_two_that_change_places_head_on_pass_each_other(required: bool) -> None:
    """Exactly on one line, all that stays on it jumps over the other between two knots."""
    field = lambda x, u: torch.cat((x[..., 4:], u), dim=-1)
    model = FunctionDynamics(field, 8, 4, 0.4, "rk4", position=slice(0, 2))
    x0 = torch.tensor([[0.0, y, 4, 0, 0, 0, 0, 0] for y in (0.0, 0.2)], dtype=D)
    cost = QuadraticCost([0.1] * 4 + [0] * 4, [0.1] * 4, [50] * 4 + [5] * 4, [4, 0, 0, 0, 0, 0, 0, 0])
    goal = Goal([4.0, 0.0], 0.3, required=required)
    problem = Problem(model, cost, [ControlBounds(-4, 4), Separation([[0, 1], [2, 3]], 0.3)], x0, 13, goal=goal)
    found = torchgco.solve(problem)
    assert bool(judge(problem, found.U).reached.all()) and float(found.cost[0]) < 1.2 * float(found.cost[1])


def test_bodies_that_touch_at_the_start_are_no_valid_start() -> None:
    x0 = torch.tensor([[0.0, 0, 0, 0, d, 0, 0, 0, 50, 0, 0, 0] for d in (0.949, 0.951)], dtype=D)
    assert torchgco.solve(carts(Separation(STATES, 1.0), x0=x0)).statuses[0] == Status.INVALID_START
    assert carts(Separation(STATES, 1.0), x0=x0).start_is_clear.tolist() == [False, True]


def test_each_pair_keeps_a_distance_of_its_own() -> None:
    X, U = points(3)
    every = carts(Separation(STATES, [[0.6, 0.8, 1.0]])).constraints[0]
    single = [
        carts(Separation(STATES, d, [pair])).constraints[0] for d, pair in zip((0.6, 0.8, 1.0), PAIRS, strict=True)
    ]
    assert isinstance(every, Separation)
    for name in ("value", "violation"):
        rows = torch.cat([getattr(one, name)(X, U) for one in single], dim=-1)
        torch.testing.assert_close(getattr(every, name)(X, U), rows)
    by = torch.full((B,), 0.1, dtype=D)
    for part, alone in ((every, single), (every.grown(by), [one.grown(by) for one in single])):
        nearest = torch.stack([one.chord_clearance(X) for one in alone]).amin(0)  # type: ignore[attr-defined]
        torch.testing.assert_close(part.chord_clearance(X), nearest)
        judged = torch.stack([one.clearances(X)[1] for one in alone]).amin(0)  # type: ignore[attr-defined]
        torch.testing.assert_close(part.clearances(X)[1], judged)


WRONG: dict[str, list[Any]] = {
    "positions": [
        Separation(p, 1.0) for p in (None, 5, [], [[0, 1]], [[0, 1], [4]], [[0, 1], [1, 4]], [[0, 12], [4, 5]],
        [[-1, 0], [4, 5]], [[0.0, 1.0], [4.0, 5.0]], [[0, 0], [4, 5]], "ab", torch.eye(2), [[True, False], [4, 5]])
    ],
    "pairs": [
        Separation(STATES, 1.0, p)
        for p in (5, [], [[0, 3]], [[0, 0]], [[0, 1], [1, 0]], [[0, 1, 2]], [[-1, 0]], [0, 1], [[0.5, 1]])
    ],
    "min_distance": [
        Separation(STATES, d)
        for d in (None, "a", 0.0, -1.0, torch.nan, torch.inf, [1.0, 2.0], [[1.0] * 2], KEPT.float())
    ],
    "knots": [Separation(STATES, 1.0, knots=k) for k in ([], [31], [2, 2], "ab")],
}  # fmt: skip


@pytest.mark.parametrize("field", WRONG)
def test_wrong_input_is_named(field: str) -> None:
    for part in WRONG[field]:
        with pytest.raises(InputError, match=rf"^separation\.{field}: expected"):
            carts(part)
