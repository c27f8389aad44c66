"""One plan for all loops: moved on by stages or part of one, given to other vehicles, sampled between its knots."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.missions.missions import DOUBLE, DT, far, mission
from tests.problems import planar_batch
from torchgco import InputError, Planar, QuadrotorPlanning, solve
from torchgco.missions import Flight, MissionPlan
from torchgco.receding.plan import Plan

B, N = 3, 6


def plan() -> Plan:
    generator = torch.Generator().manual_seed(2)
    X, U, K = (torch.randn(B, *shape, generator=generator, **DOUBLE) for shape in ((N + 1, 6), (N, 2), (N, 2, 6)))
    return Plan(X=X, U=U, K=K, start=torch.tensor([0.0, 0.1, 0.25], **DOUBLE), dt=0.1, dynamics=Planar(dt=0.1))


def test_plans_of_several_starts_move_on_to_one_time() -> None:
    """By 3, 2 and half a stage: knots beyond the last one are its own, and half a stage is the middle of two knots."""
    before = plan()
    later = before.moved_to(0.3)
    for old, new in ((before.X, later.X), (before.U, later.U), (before.K, later.K)):
        last = old.shape[1] - 1
        for b, stages in enumerate((3, 2)):
            for k in range(last + 1):
                assert torch.equal(new[b, k], old[b, min(k + stages, last)])
        for k in range(last + 1):
            torch.testing.assert_close(new[2, k], 0.5 * (old[2, k] + old[2, min(k + 1, last)]))
    assert torch.equal(later.start, torch.full_like(later.start, 0.3)) and torch.equal(before.X, plan().X)


def test_vehicles_get_the_plans_of_others_and_the_rest_keep_theirs() -> None:
    mine, rows = plan(), torch.tensor([2, 0])
    other = replace(mine.take(rows), X=torch.zeros(2, N + 1, 6, **DOUBLE), start=torch.tensor([7.0, 8.0], **DOUBLE))
    both = mine.with_rows(rows, other)
    assert not bool(both.X[rows].any()) and both.start.tolist() == [8.0, 0.1, 7.0]
    assert torch.equal(both.X[1], mine.X[1]) and torch.equal(both.K, mine.K) and torch.equal(mine.X, plan().X)


@pytest.mark.slow
def test_a_missions_plan_is_sampled_like_any_other() -> None:
    """At a knot its state; between two what the model's own step leads to; with feedback within the bounds."""
    flight = Flight(mission(duration=0.2), far(2))
    flight.step()
    flown = flight.step().plan
    assert isinstance(flown, MissionPlan) and isinstance(flown, Plan) and flown.start.tolist() == [DT, DT]
    assert torch.equal(flown.at(DT).x, flown.X[:, 0]) and torch.equal(flown.at(2 * DT).u, flown.U[:, 1])
    assert isinstance(flown.dynamics, QuadrotorPlanning)
    half = replace(flown.dynamics, dt=0.5 * DT).at(0).step(flown.X[:, 0], flown.U[:, 0])
    torch.testing.assert_close(flown.at(1.5 * DT).x, half)


def test_a_solution_moves_on_by_part_of_a_stage() -> None:

    problem, _ = planar_batch(B=2, N=12, obstacles=2)
    found = solve(problem, verbose=False)
    between = found.shifted(1.5)
    torch.testing.assert_close(between.X, 0.5 * (found.shifted(1).X + found.shifted(2).X))
    for mine, one, two in zip(*(s.multipliers.lam for s in (between, found.shifted(1), found.shifted(2))), strict=True):
        torch.testing.assert_close(mine, 0.5 * (one + two))
    with pytest.raises(InputError, match="steps: expected"):
        found.shifted(0)
