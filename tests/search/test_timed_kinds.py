"""Lanes of traffic are crossed where the goal is required, through gates, beside a map, and by a body of two balls."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from torchgco import (
    Body,
    ControlBounds,
    Field,
    FunctionDynamics,
    Gates,
    Goal,
    OccupancyGrid,
    Problem,
    QuadraticCost,
    Spheres,
    StateBounds,
    judge,
    presets,
    solve,
)
from torchgco.dynamics.planar import Unicycle
from torchgco.roadmap.timed import library_for
from torchgco.search.timed_scenes import can_search

D, INF, B = torch.float64, float("inf"), 3
GCO = presets.gco(2)
WITHOUT = replace(GCO, passes=GCO.passes.changed(timed=None))
# A required goal is also sought from the plan of the problem without it, which may come the same way.
ALONE = replace(GCO, passes=GCO.passes.changed(timed=None, tighten=replace(GCO.passes["tighten"], starts=0)))
RADIUS, END = 0.2, 6.0


@pytest.fixture(autouse=True)
def searched() -> None:
    if library_for(2) is None:
        pytest.skip("no compiler")


def lanes(seed: int, vehicle: Any, room: float) -> Spheres:
    """Discs in three lanes across the way, `room` apart beyond what a vehicle of 0.2 m takes."""
    rows = []
    for b in range(B):
        rng, discs = np.random.default_rng((seed, b)), []
        for x in (1.5, 3.0, 4.5):
            speed, side, radius = rng.uniform(0.4, 1.0), rng.choice([-1.0, 1.0]), rng.uniform(0.3, 0.4)
            gap = 2 * (radius + RADIUS) + room * rng.uniform(1.0, 1.5)
            first = rng.uniform(0, gap)
            discs += [(x, side * (3 - first - j * gap), radius, side * speed) for j in range(14)]
        rows.append(discs)
    x, y, radius, speed = np.moveaxis(np.array(rows), -1, 0)
    return Spheres(np.stack((x, y), -1), radius, vehicle, np.stack((0 * speed, speed), -1))


def crossing(seed: int, *more: Any, required: bool = False) -> Problem:
    """A point that has 10 s to get to the other side of the lanes."""
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.2, "rk4", slice(0, 2))
    cost = QuadraticCost([0.2, 0.2, 0.02, 0.02], [0.02, 0.02], [50.0, 50, 5, 5], x_ref=[END, 0, 0, 0])
    parts = [lanes(seed, RADIUS, 0.6), ControlBounds(-2.0, 2.0), StateBounds([-1, -2, -2, -2], [7, 2, 2, 2]), *more]
    return Problem(model, cost, parts, torch.zeros(B, 4, dtype=D), 50, Goal([END, 0.0], 0.3, required=required))


def gated() -> Problem:
    """A ball between the last lanes, to the left or to the right, which is passed at 5 s."""
    return crossing(11, Gates([[[3.75, side]] for side in (1.0, -1.0, 0.8)], 0.3, knots=[25]))


def mapped() -> Problem:
    """A wall from a map behind the last lane, with a door."""
    cells = np.zeros((80, 60), bool)
    cells[64:65, :] = True
    cells[64:65, 32:46] = False  # y from 0.2 to 1.6 m
    return crossing(14, Field(OccupancyGrid(cells, [-1.0, -3.0], 0.1), RADIUS))


def carried() -> Problem:
    """A unicycle with a ball ahead of its own."""
    body = Body([[0.0, 0.0], [0.25, 0.0]], RADIUS)
    bounds = [ControlBounds([-1.5, -2.0], [1.5, 2.0]), StateBounds([-1, -2, -INF, -0.5], [7, 2, INF, 1.5])]
    cost = QuadraticCost([0.2, 0.2, 0, 0.02], [0.02, 0.02], [50.0, 50, 0, 5], x_ref=[END, 0, 0, 0])
    parts = [lanes(13, body, 1.0), *bounds]
    return Problem(Unicycle(dt=0.2), cost, parts, torch.zeros(B, 4, dtype=D), 60, Goal([END, 0.0], 0.3))


CASES = {"required": lambda: crossing(10, required=True), "gates": gated, "map": mapped, "body": carried}


@pytest.mark.sampled(1)
@pytest.mark.filterwarnings("ignore::torchgco.base.errors.ContactWarning")  # of the solver without the row
@pytest.mark.parametrize("case", list(CASES))
def test_lanes_are_crossed(case: str) -> None:
    problem = CASES[case]()
    assert can_search(problem)
    verdict = judge(problem, solve(problem, verbose=False).U)
    solver = ALONE if case == "required" else WITHOUT
    before = judge(problem, solve(problem, solver=solver, verbose=False).U)
    assert bool(verdict.reached.all()) and bool((verdict.clearance >= 0).all())
    both = before.reached
    assert bool((verdict.cost[both] <= 1.01 * before.cost[both]).all())
    better = ~before.reached | (verdict.cost < 0.95 * before.cost)
    assert bool(better.any()), "or the test shows nothing"
