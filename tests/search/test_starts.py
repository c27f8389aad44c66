"""Solves from random guesses: where they are made, that they help, and that the rest of a batch changes nothing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

import torchgco
from tests.search.rows import without
from tests.search.test_finish import bryson_denham, effort, ends_at, parking
from torchgco import (
    ControlBounds,
    FunctionDynamics,
    Problem,
    QuadraticCost,
    Restarts,
    Solution,
    StateBounds,
    Status,
    presets,
)
from torchgco.search import Converge, Solve, Starts
from torchgco.search.starts import ReleaseGoal, RequireGoal

D = torch.float64
ALL = Starts(when="all")


def swing_up(*reach: float, N: int = 80, torque: float = 6.0) -> Problem:
    """Pendulums that swing up with bounded torque, from starts at several angles: with local minima."""

    def field(x: Tensor, u: Tensor) -> Tensor:
        return torch.stack((x[..., 1], u[..., 0] - 9.81 * x[..., 0].sin()), dim=-1)

    x0 = torch.tensor([[angle, 0.0] for angle in reach], dtype=D)
    end = ends_at(torch.pi, 0.0)
    return Problem(
        FunctionDynamics(field, 2, 1, 0.05, "rk4"), effort(0.05, 1.0), [ControlBounds([-torque], [torque]), end], x0, N
    )


def solved(problem: Problem, *starts: Starts, seed: int = 0, **others: Any) -> Solution:
    """By `gco`, its starts replaced by others, or left out."""
    solver = without(presets.gco(problem), Starts)
    return torchgco.solve(problem, solver=replace(solver, passes=(*solver.passes, *starts)), seed=seed, **others)


def same(one: Solution, other: Solution) -> bool:
    return torch.equal(one.U, other.U) and torch.equal(one.X, other.X) and torch.equal(one.iterations, other.iterations)


SWINGS = swing_up(0.0, 0.3, -0.2, 1.0, -1.2)


@pytest.mark.slow
def test_they_are_never_worse_and_find_cheaper_swings() -> None:
    once, again = solved(SWINGS), solved(SWINGS, ALL)
    assert bool((once.status == Status.CONVERGED).all() and (again.status == Status.CONVERGED).all())
    assert bool((again.cost <= once.cost).all()) and bool((again.cost < 0.99 * once.cost).any())
    assert bool((again.violation <= 1e-6).all())
    assert bool((again.iterations > once.iterations).all())


def test_nothing_is_solved_where_nothing_is_left(monkeypatch) -> None:
    begun: list[int] = []
    monkeypatch.setattr(Starts, "_solve", lambda self, search, rows: begun.append(len(rows)))
    assert solved(SWINGS, Starts()).status.tolist() == [Status.CONVERGED] * 5 and not begun


@pytest.mark.slow
def test_more_starts_are_the_same_and_more() -> None:
    """Of n starts, the first are those of a pass with fewer."""
    problem = swing_up(0.0, -0.2, -1.2, N=60)
    found = [solved(problem, replace(ALL, count=count)) for count in (1, 2, 4, 8)]
    costs, iterations = (torch.stack([getattr(one, name) for one in found]) for name in ("cost", "iterations"))
    assert bool((costs.diff(dim=0) <= 0).all() and (iterations.diff(dim=0) > 0).all())
    assert bool((costs[-1] < 0.99 * costs[0]).any())


@pytest.mark.slow
def test_no_result_depends_on_the_batch_or_on_slots() -> None:
    ids = torch.tensor([7, 3, 11, 2, 5])
    whole = solved(SWINGS, ALL, seed=4, ids=ids)
    for b in range(SWINGS.B):
        alone = solved(SWINGS.take(slice(b, b + 1)), ALL, seed=4, ids=ids[b : b + 1])
        assert torch.equal(alone.U[0], whole.U[b]) and torch.equal(alone.cost[0], whole.cost[b])
        assert int(alone.iterations) == int(whole.iterations[b])
    solver = presets.gco_max(SWINGS)
    assert isinstance(solver, Restarts)
    few = torchgco.solve(SWINGS, solver=solver.in_slots(9), seed=4, ids=ids)
    assert same(few, torchgco.solve(SWINGS, solver=solver, seed=4, ids=ids))


def test_guesses_differ_by_seed_and_id() -> None:
    twins = swing_up(0.3, 0.3)
    drawn = solved(twins, ALL)
    assert not torch.equal(drawn.iterations[:1], drawn.iterations[1:])
    assert not torch.equal(drawn.iterations, solved(twins, ALL, seed=1).iterations)


def test_nothing_is_done_where_the_first_solve_succeeds() -> None:
    """`gco` has starts for the others alone."""
    problem = bryson_denham()
    assert presets.gco(problem).passes.steps[-3:] == (Starts(), RequireGoal(), ReleaseGoal())
    assert same(torchgco.solve(problem), solved(problem))
    assert not same(torchgco.solve(problem, solver="gco_max"), solved(problem))


def test_a_first_solve_that_fails_is_made_again() -> None:
    """The default reaches swings that all its other rows miss."""
    problem = swing_up(0.0, 1.0, torque=4.0)
    once, again = solved(problem), torchgco.solve(problem)
    assert once.status.tolist() == [Status.CONVERGED, Status.INFEASIBLE]
    assert again.status.tolist() == [Status.CONVERGED] * 2
    assert torch.equal(again.U[0], once.U[0]) and int(again.iterations[0]) == int(once.iterations[0])


def test_a_saddle_at_rest_is_left() -> None:
    """Cars beside their place: there the interior point alone fails, and random guesses find a manoeuvre."""
    problem = parking()
    assert not bool((torchgco.solve(problem, solver="interior_point").status == Status.CONVERGED).any())
    local = presets.gco(problem).local
    passes = (Converge("free"), Solve(), Starts())
    found = torchgco.solve(problem, solver=Restarts(replace(local, max_outer_iterations=1), passes))
    assert found.status.tolist() == [Status.CONVERGED] * problem.B


def test_what_cannot_be_solved_stays_infeasible() -> None:
    """The end lies outside the bounds of the states."""
    problem = swing_up(0.0, 0.3, N=20)
    bounds = StateBounds([-1.0, -1.0], [1.0, 1.0])
    never = replace(problem, constraints=[*problem.constraints, bounds])
    once, again = solved(never), torchgco.solve(never)
    assert not bool((again.status == Status.CONVERGED).any())
    assert bool((again.violation <= once.violation).all()) and bool(torch.isfinite(again.U).all())


def test_a_start_that_is_no_number_keeps_its_status() -> None:
    bad = replace(SWINGS, x0=torch.where(torch.arange(5).view(-1, 1) == 2, torch.nan, SWINGS.x0))
    got, usual = solved(bad, ALL), solved(SWINGS, ALL)
    assert int(got.status[2]) == Status.NON_FINITE
    others = torch.tensor([0, 1, 3, 4])
    assert torch.equal(got.U[others], usual.U[others])


def test_no_time_is_left_for_them() -> None:
    ended = solved(SWINGS, ALL, max_seconds=1e-6)
    assert bool(torch.isfinite(ended.U).all())


def test_a_start_that_is_best_held_is_held() -> None:
    """A pendulum near its upright rest: the guess falls, and the optimum from there swings around once more."""

    def field(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return torch.stack((x[..., 1], 9.81 * x[..., 0].sin() - 0.1 * x[..., 1] + u[..., 0]), dim=-1)

    cost = QuadraticCost(Q=[1, 0.1], R=[0.1], Qf=[100, 10], x_ref=[0.0, 0.0])
    x0 = torch.tensor([[0.0123, 0.0], [0.1, 0.0], [0.3, 0.0], [0.5, 0.0]], dtype=D)
    model = FunctionDynamics(field, 2, 1, 0.05, "rk4")
    problem = Problem(model, cost, [ControlBounds([-5.0], [5.0])], x0, 60)
    found = torchgco.solve(problem)
    best = torch.tensor([0.01022, 0.6745, 6.007, 24.57], dtype=D)
    torch.testing.assert_close(found.cost, best, rtol=1e-3, atol=0)
    assert bool((found.cost < 0.2 * torchgco.solve(problem, solver="interior_point").cost).all())
    warm = torchgco.solve(problem, warm=torchgco.solve(problem, solver="interior_point"))
    assert bool((warm.cost > 200).all())  # a guess that was given is kept
