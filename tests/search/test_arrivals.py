"""Where the time is free and obstacles move: ways arrive at times of their own, each through a gap of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchgco import (
    ControlBounds,
    FreeTime,
    FunctionDynamics,
    Goal,
    Problem,
    QuadraticCost,
    Spheres,
    StateBounds,
    judge,
    presets,
    solve,
)  # fmt: skip
from torchgco.roadmap.timed import library_for

D, INF = torch.float64, float("inf")
LANES = 3
GCO = presets.gco(2)
WITHOUT = replace(GCO, passes=GCO.passes.changed(timed=None))


@pytest.fixture(autouse=True)
def searched() -> None:
    if library_for(2) is None:
        pytest.skip("no compiler")


def lanes(B: int, seed: int, weight: float, **time: float) -> Problem:
    """Points that have to be at rest beyond lanes of discs with a gap each now and then; a second costs `weight`."""
    rng, rows = np.random.default_rng(seed), []
    for _ in range(B):
        discs = []
        for x in 1.5 + 1.7 * np.arange(LANES):
            speed, side = rng.uniform(0.4, 0.9), rng.choice([-1.0, 1.0])
            y = -side * (1.3 * np.arange(16) - rng.uniform(3.0, 4.0))
            y[rng.permutation(16)[:5]] = np.nan
            discs += [(x if np.isfinite(row) else np.nan, row, 0.0, side * speed) for row in y]
        rows.append(discs)
    x, y, still, speed = np.moveaxis(np.array(rows), -1, 0)
    radius = np.where(np.isnan(x), np.nan, 0.4)
    moving = Spheres(np.stack((x, y), -1), radius, 0.2, np.stack((still, speed), -1))
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.1, "rk4", slice(0, 2))
    end = [1.5 + 1.7 * LANES, 0.0, 0.0, 0.0]
    cost = QuadraticCost([0.0] * 4, [0.02] * 2, [0.0] * 4, x_ref=end)
    bounds = [ControlBounds(-2.0, 2.0), StateBounds([-0.5, -2.5, -2.0, -2.0], [8.0, 2.5, 2.0, 2.0])]
    goal = Goal(state=end, required=True)
    free = FreeTime(**{"least": 0.4, "most": 2.5, "weight": weight, **time})
    return Problem(model, cost, [moving, *bounds], torch.zeros(B, 4, dtype=D), 50, goal, time=free)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 5])
def test_who_may_choose_the_time_takes_the_gap_that_is_cheapest(seed: int) -> None:
    problem = lanes(4, seed, 1.0)
    solution, before = solve(problem, verbose=False), solve(problem, solver=WITHOUT, verbose=False)
    verdict = judge(problem, solution.U, times=solution.t)
    assert bool(verdict.reached.all()) and bool((verdict.clearance >= 0).all())
    held = judge(problem, before.U, times=before.t)
    ratio = verdict.cost / torch.where(held.reached, held.cost, INF)
    assert bool((ratio <= 1.001).all()), "searches at held times find nothing better"
    assert bool((ratio < 0.99).any()), "or the test shows nothing"
    one = torch.tensor([2])
    alone = solve(problem.take(one), ids=one, verbose=False)
    assert torch.equal(alone.U[0], solution.U[2]) and torch.equal(alone.duration[0], solution.duration[2])


@pytest.mark.slow
def test_times_stay_within_their_bounds() -> None:
    problem = lanes(2, 3, 1.0, least=1.3, most=1.4)
    solution = solve(problem, verbose=False)
    assert bool(judge(problem, solution.U, times=solution.t).reached.all())
    assert bool(((solution.duration >= 6.5 - 1e-6) & (solution.duration <= 7.0 + 1e-6)).all())


@pytest.mark.sampled(2)
@pytest.mark.parametrize("broken", [(0, np.nan), (1, np.inf), (3, np.nan), (2, -np.inf)])
def test_a_start_that_is_no_place_is_its_own_problems_alone(broken: tuple[int, float]) -> None:
    """It ended the solve of the whole batch with an error of NumPy."""
    lane, end = lanes(1, 3, 1.0), [3.0, 0.0, 0.0, 0.0]
    cost = QuadraticCost([0.0] * 4, [0.1] * 2, [0.0] * 4, x_ref=end)
    parts = [Spheres([[1.5, -0.5]], 0.4, 0.1, [[0.0, 0.5]]), ControlBounds(-4.0, 4.0)]
    free, goal = FreeTime(0.5, 2.0, weight=0.1), Goal(end[:2], 0.2, required=True)
    starts = torch.zeros(2, 4, dtype=D)
    starts[0, broken[0]] = broken[1]
    both, sound = (Problem(lane.dynamics, cost, parts, x0, 15, goal, time=free) for x0 in (starts, starts[1:]))
    solution, alone = solve(both, verbose=False), solve(sound, ids=torch.tensor([1]), verbose=False)
    assert [status.name for status in solution.statuses] == ["NON_FINITE", "CONVERGED"]
    assert torch.equal(solution.U[1], alone.U[0]) and torch.equal(solution.duration[1], alone.duration[0])
