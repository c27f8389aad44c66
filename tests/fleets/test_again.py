"""Vehicles that plan again among the motions of all others."""

from __future__ import annotations

import torch

import torchgco
from tests.fleets.scenes import disc, swaps
from torchgco import Fleet, InteriorPoint, Spheres
from torchgco.fleets.among import Among
from torchgco.fleets.plans import Plans
from torchgco.fleets.replanned import Replanned
from torchgco.fleets.solve import _Best, _relieve, alone
from torchgco.fleets.verdict import judge_fleet
from torchgco.problem.known import Known


def test_one_of_two_that_collide_plans_again_and_the_other_stays() -> None:
    fleet, one = Fleet([disc([0, 0], [4, 0]), disc([4, 0.1], [0, 0.1])], 0.4), torch.tensor([0])
    first = alone(fleet, torchgco.solve, 0, one, "gco")
    assert not bool(judge_fleet(fleet, first.U).feasible[0])
    forms = [Among(problem, Known()) for problem, _ in fleet.forms]
    plans = Replanned(fleet, forms, one, first, [[1]], torch.ones(1, 2, dtype=torch.bool)).run()
    assert bool(judge_fleet(fleet, plans.U).reached[0])
    assert torch.equal(plans.U[0], first.U[0]) and not torch.equal(plans.U[1], first.U[1])


def test_who_pays_more_than_all_others_plans_again() -> None:
    """A vehicle that goes far out of its way, in the second fleet alone, is found, and the first keeps its bits."""
    members, both = swaps(3, 2), torch.arange(2)
    fleet = Fleet(members, 0.4)
    found = torchgco.solve(fleet)
    start = members[2].x0[:, :2].numpy()
    wide = disc(start, -start, Spheres([[0.0, 0.0]], [1.2], 0.2))
    detour = InteriorPoint().solve(wide, torch.zeros(2, 50, 2, dtype=torch.float64))
    status = torch.zeros(2, 3, dtype=torch.int64)
    plans = Plans([s.X for s in found], [s.U for s in found], [s.K for s in found], status, status.clone())
    plans.set(2, torch.tensor([1]), detour, torch.tensor([1]))
    best = _Best(fleet, alone(fleet, torchgco.solve, 0, both, "gco"), 0, both)
    best.offer(both, plans)
    assert bool(best.verdict.reached.all())
    before = best.verdict.cost.clone()
    _relieve(best, [Among(problem, Known()) for problem, _ in fleet.forms], lambda: False)
    assert float(best.verdict.cost[1]) < float(before[1]) - 1.0 and bool(best.verdict.reached.all())
    assert float(best.verdict.cost[0]) <= float(before[0])
