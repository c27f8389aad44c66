"""From a fleet to its trajectories: each alone, all together, and one after the other where that doesn't do."""

from __future__ import annotations

import warnings
from typing import Any

import torch
from torch import Tensor

from torchgco.base import clock
from torchgco.base.tree import put, take
from torchgco.fleets.fleet import Fleet
from torchgco.fleets.guesses import SIDES
from torchgco.fleets.plans import Plans, Solve
from torchgco.fleets.prioritised import Prioritised
from torchgco.fleets.solution import FleetSolution
from torchgco.fleets.together import MOST_STATES, around, together
from torchgco.fleets.verdict import FleetVerdict, judge_fleet


class _Best:
    """The best plans of every fleet so far."""

    def __init__(self, fleet: Fleet, plans: Plans) -> None:
        self.fleet, self.plans = fleet, plans
        self.verdict = judge_fleet(fleet, plans.U)

    @property
    def open(self) -> Tensor:
        """Fleets that aren't sound yet, (b,)."""
        return (~self.verdict.reached).nonzero().flatten()

    def offer(self, rows: Tensor, plans: Plans) -> None:
        """Keep plans of some fleets where they are better: sound, else closer to that, else cheaper."""
        verdict = judge_fleet(self.fleet.take(rows.tolist()), plans.U)
        new, old = _rank(verdict), _rank(self.verdict, rows)
        better = torch.zeros_like(rows, dtype=torch.bool)
        equal = torch.ones_like(better)
        for mine, theirs in zip(new, old, strict=True):
            better |= equal & (mine < theirs)
            equal &= mine == theirs
        places = better.nonzero().flatten()
        self.plans.put(rows[places], plans.take(places))
        put(self.verdict, rows[places], take(verdict, places))


def _rank(verdict: FleetVerdict, rows: Tensor | None = None) -> list[Tensor]:
    """What plans are compared by, first the first; smaller is better."""
    at = slice(None) if rows is None else rows
    miss = torch.where(verdict.feasible, 0.0, verdict.violation.clamp(min=0.0) - verdict.clearance.clamp(max=0.0))
    cost = verdict.cost.nan_to_num(torch.inf)
    return [(~verdict.reached[at]).to(cost.dtype), miss.nan_to_num(torch.inf)[at], cost[at]]


def solve_fleet(
    fleet: Fleet, solve: Solve, seed: int, ids: Tensor | None, solver: Any, ends: float | None = None
) -> FleetSolution:
    """The best plans found for every fleet of the batch.

    Args:
        solve: `torchgco.solve`.
        ids: (B,), of the random draws; None: 0..B-1.
        solver: of vehicles alone, and among others where guesses don't do.
        ends: the time of the clock after which nothing more is begun, s.
    """
    ids = torch.arange(fleet.B) if ids is None else ids
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        first = alone(fleet, solve, seed, ids, solver)
        best = _Best(fleet, first.take(torch.arange(fleet.B)))
        is_small = fleet.states <= MOST_STATES
        for side in SIDES if is_small else ():
            rows = best.open
            if len(rows) and not _late(ends):
                some, plans = fleet.take(rows.tolist()), first.take(rows)
                for found in around(some, plans, side, solve):
                    best.offer(rows, found)
        rows = best.open
        if len(rows) and not _late(ends):
            some = fleet.take(rows.tolist())
            found = Prioritised(some, first.take(rows), solve, seed, ids[rows], solver).run()
            best.offer(rows, found)
            if is_small and not _late(ends):
                for polished in together(some, found.X, found.U, found, solve):
                    best.offer(rows, polished)
    return FleetSolution(fleet, best.plans.solutions(fleet), best.verdict)


def _late(ends: float | None) -> bool:
    return ends is not None and clock.seconds() >= ends


def alone(fleet: Fleet, solve: Solve, seed: int, ids: Tensor, solver: Any) -> Plans:
    """Each vehicle as if there were no other."""
    plans = Plans.at_rest(fleet)
    for problem, whose in fleet.forms:
        own = torch.cat([ids * fleet.V + v for v in whose])
        found = solve(problem, seed=seed, ids=own, solver=solver)
        for place, v in enumerate(whose):
            rows = torch.arange(fleet.B)
            plans.set(v, rows, found, place * fleet.B + rows)
            plans.iterations[:, v] = found.iterations[place * fleet.B + rows]
    return plans
