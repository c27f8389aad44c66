"""Trajectories that cut an obstacle between two knots are solved again with grown obstacles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks.families.general_problems import FAMILIES
from tests.search.rows import without
from torchgco import (
    Boxes,
    ControlBounds,
    Goal,
    Planar,
    Problem,
    QuadraticCost,
    Solution,
    Spheres,
    compose,
    judge,
    presets,
    solve,
)
from torchgco.kernels import chord_clearance, open_loop, use_native
from torchgco.search import ClearChords, Converge, PathProposals

pytestmark = pytest.mark.filterwarnings("ignore::torchgco.ContactWarning")


def planar(parts: list, B: int, dt: float, N: int) -> Problem:
    """Start at x = -1, goal at (1, 0.4)."""
    x0 = torch.zeros(B, 6, dtype=torch.float64)
    x0[:, 0], x0[:, 1] = -1.0, torch.linspace(0.0, 0.3, B, dtype=torch.float64)
    cost = QuadraticCost(Q=[5, 5, 0, 1, 1, 0], R=[0.1, 0.1], Qf=[50, 50, 0, 1, 1, 0], x_ref=[1, 0.4, 0, 0, 0, 0])
    bounds = ControlBounds([-10, -10], [10, 10])
    return Problem(Planar(dt=dt), cost, [*parts, bounds], x0, N, Goal([1.0, 0.4], 0.3))


def coarse_disc(B: int = 4) -> Problem:
    """A disc whose edge is jumped over between two knots, 0.1 s apart."""
    return planar([Spheres([[0.2, 0.1]], [0.1], vehicle_radius=0.06)], B, dt=0.1, N=60)


def corners(B: int = 8) -> Problem:
    """Ten turned boxes per problem."""
    rng = np.random.default_rng(3)
    centers, half = rng.uniform([-0.7, -0.7], [0.7, 0.7], (B, 10, 2)), rng.uniform(0.03, 0.15, (B, 10, 2))
    return planar([Boxes(centers, half, 0.06, rng.uniform(0, 3.1, (B, 10)))], B, dt=0.05, N=160)


@cache
def cleared(make: Callable[[], Problem]) -> tuple[Problem, Solution]:
    problem = make()
    return problem, solve(problem)


def without_clearing(problem: Problem) -> Tensor:
    """By a table without the row, in whose end what was sound before isn't sought either."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torchgco.search.restarts.settle", lambda search, chords: None)
        return solve(problem, solver=without(presets.gco(problem), ClearChords)).U


@pytest.mark.slow
@pytest.mark.parametrize("make", [coarse_disc, pytest.param(corners, marks=pytest.mark.slow)])
def test_chords_are_cleared_and_nothing_else_changes(make) -> None:
    problem, solution = cleared(make)
    before = without_clearing(problem)
    old, new = judge(problem, before), judge(problem, solution.U)
    cut = old.clear_95 & (old.clearance < 0)
    assert bool(cut.any()) and int(new.reached.sum()) > int(old.reached.sum())
    assert bool((new.reached | ~old.reached).all())
    assert bool((new.clearance >= old.clearance).all())
    assert torch.equal(solution.U[~cut], before[~cut])


def test_a_coarse_disc_is_cleared_for_every_start() -> None:
    problem, solution = cleared(coarse_disc)
    assert bool(judge(problem, solution.U).reached.all())


@pytest.mark.slow
def test_growth_counts_from_the_clearance_that_the_last_solve_missed() -> None:
    """In this maze the first growth, by what the solve missed, leads to a deeper cut than before."""
    setup = compose(["scenario=mazes", "scenario.walls=4", "seed=99"])
    task = setup.task(setup.layouts(27))
    problem = task.problem.take(torch.tensor([26]))
    solver = without(presets.gco(problem), Converge)
    rows = (replace(row, follow=row.follow[:1]) if isinstance(row, PathProposals) else row for row in solver.passes)
    solver = replace(solver, passes=tuple(rows))
    old = judge(problem, solve(problem, solver=without(solver, ClearChords)).U)
    assert bool(old.clear_95) and bool(old.clearance < 0)
    assert bool(judge(problem, solve(problem, solver=solver).U).reached.all())


def test_a_way_along_thin_walls_is_cleared_by_the_interior_point() -> None:
    """Out of a spiral: at the speed of its way, AL-iLQR's relaxed solve steps over walls of 0.2 m."""
    problem = FAMILIES["spiral"].problem(0).take([0])
    solution = solve(problem, verbose=False)
    assert chord_clearance(problem, solution.X).item() >= 0.0
    assert solution.violation.item() <= 1e-6 and solution.cost.item() < 18.0, "26.3 where it gave up"


@pytest.mark.slow
def test_more_effort_loses_no_clear_trajectory() -> None:
    """In this maze `gco_max` finds a cheaper trajectory than `gco`, which touches a wall and can't be cleared."""
    setup = compose(["scenario=mazes", "scenario.walls=3", "seed=21"])
    task = setup.task(setup.layouts(4))
    problem = task.problem.take(torch.tensor([3]))
    less, more = solve(problem), solve(problem, solver="gco_max")
    assert bool(judge(problem, less.U).reached.all()) and bool(judge(problem, more.U).reached.all())
    assert bool((more.cost <= 1.001 * less.cost).all())


@pytest.mark.slow
def test_a_problem_is_cleared_alike_in_every_batch() -> None:
    problem, whole = cleared(corners)
    order = torch.tensor([5, 0, 3])
    part = presets.gco(problem).solve(problem.take(order), problem.x0.new_zeros(3, problem.N, 2), ids=order)
    assert torch.equal(part.U, whole.U[order]) and torch.equal(part.iterations, whole.iterations[order])


@pytest.mark.parametrize("native", [True, False])
def test_grown_obstacles_are_those_with_a_larger_radius(native: bool) -> None:
    by = torch.tensor([0.02, 0.0, 0.01], dtype=torch.float64)
    rng = np.random.default_rng(0)
    centers, velocities = rng.uniform(-1, 1, (3, 4, 2)), rng.uniform(-1, 1, (3, 4, 2))
    radii = rng.uniform(0.05, 0.2, (3, 4))
    centers[1, 2], radii[1, 2], velocities[1, 2] = np.nan, np.nan, np.nan
    half = np.where(np.isnan(centers), np.nan, rng.uniform(0.05, 0.2, (3, 4, 2)))
    turns = np.where(np.isnan(radii), np.nan, 0.3)

    def parts(more: Tensor | float) -> list:
        reach = 0.06 + more
        moving = Spheres(centers, radii, reach, velocities)
        return [Spheres(centers, radii, reach), moving, Boxes(centers, half, reach, turns)]

    small, large = planar(parts(0.0), 3, 0.1, 20), planar(parts(by), 3, 0.1, 20)
    grown = small.grown(by)
    U = torch.as_tensor(rng.normal(size=(3, 20, 2)))
    use_native(native)
    try:
        X = open_loop(small, U)
    finally:
        use_native(True)
    for ours, fresh in zip(grown.constraints, large.constraints, strict=True):
        torch.testing.assert_close(ours.value(X, U), fresh.value(X, U), rtol=0, atol=1e-12)
        torch.testing.assert_close(ours.violation(X, U), fresh.violation(X, U), rtol=0, atol=1e-12)
    torch.testing.assert_close(chord_clearance(grown, X), chord_clearance(large, X), rtol=0, atol=1e-12)
    assert torch.equal(grown.start_is_clear, large.start_is_clear)
