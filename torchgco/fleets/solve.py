"""From a fleet to its trajectories: each alone, all together, and by negotiations where that doesn't do."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base import clock
from torchgco.base.status import Status
from torchgco.base.tree import put, take
from torchgco.fleets.among import Among
from torchgco.fleets.coming_apart import ComingApart
from torchgco.fleets.fleet import Fleet
from torchgco.fleets.guesses import SIDES, aside
from torchgco.fleets.negotiated import Negotiated
from torchgco.fleets.plans import Plans, Solve
from torchgco.fleets.replanned import Replanned
from torchgco.fleets.shared_room import SharedRoom
from torchgco.fleets.solution import FleetSolution
from torchgco.fleets.verdict import FleetVerdict, judge_fleet, served
from torchgco.problem.known import Known

DRAWN = 2  # orders of turns in which vehicles negotiate
ORDERS = 4  # in which vehicles plan again, at most
SAME = 0.02  # share by which the costs of two orders may differ: then others are no better


class _Best:
    """The best plans of every fleet so far."""

    def __init__(self, fleet: Fleet, plans: Plans, seed: int, ids: Tensor) -> None:
        self.rngs = [np.random.default_rng((seed, number)) for number in ids.tolist()]
        self.fleet, self.alone, self.plans = fleet, plans, plans.take(torch.arange(fleet.B))
        self.verdict = judge_fleet(fleet, plans.U)
        self.least = self.costs  # (B, V), of vehicles alone
        self.lost = torch.isin(plans.status, torch.tensor([Status.INVALID_START, Status.NON_FINITE])).any(-1)

    @property
    def costs(self) -> Tensor:
        """Of all vehicles, (B, V)."""
        return torch.stack([one.cost for one in self.verdict.vehicles], dim=1)

    @property
    def open(self) -> Tensor:
        """Fleets that aren't sound yet, and can be: all of their vehicles have a start and a plan, (b,)."""
        return (~self.verdict.reached & ~self.lost).nonzero().flatten()

    def offer(self, rows: Tensor, plans: Plans) -> FleetVerdict:
        """Keep plans of some fleets where they are better: sound, else closer to that, else cheaper; what they are."""
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
        return verdict


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
        solver: of vehicles alone.
        ends: the time of the clock after which nothing more is begun, s.
    """
    ids = torch.arange(fleet.B) if ids is None else ids
    late = partial(_late, ends)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        first = alone(fleet, solve, seed, ids, solver)
        best, forms = _Best(fleet, first, seed, ids), [Among(one, Known()) for one, _ in fleet.forms]
        for side in SIDES:
            _come_apart(best, forms, side, late)
            _negotiate(best, forms, late)
        _relieve(best, forms, late)
    return FleetSolution(fleet, best.plans.solutions(fleet, best.verdict, late()), best.verdict)


def _come_apart(best: _Best, forms: list[Among], side: float, late: Callable[[], bool]) -> None:
    """Offer what becomes of fleets that aren't sound where all vehicles pass each other on a side."""
    rows = best.open
    if len(rows) == 0 or late():
        return
    guesses = aside(best.fleet, forms, rows, best.alone.take(rows), side)
    apart = ComingApart(best.fleet, forms, rows, guesses, late=late)
    plans = apart.run()
    near = apart.near.nonzero().flatten()
    _improve(best, forms, rows[near], plans.take(near), late)


def _negotiate(best: _Best, forms: list[Among], late: Callable[[], bool]) -> None:
    """Offer what the vehicles of fleets that aren't sound negotiate: of drawn orders of turns the cheapest."""
    rows = best.open
    if len(rows) == 0 or late():
        return
    of = rows.repeat_interleave(DRAWN)
    orders = [best.rngs[b].permutation(best.fleet.V).tolist() for b in of.tolist()]
    teams = Negotiated(best.fleet, forms, of, best.alone.take(of), orders, late=late)
    plans, least = teams.run(), teams.cost.view(-1, DRAWN).argmin(-1)
    _improve(best, forms, rows, plans.take(DRAWN * torch.arange(len(rows)) + least), late)


def _improve(best: _Best, forms: list[Among], rows: Tensor, plans: Plans, late: Callable[[], bool]) -> None:
    """Offer what sharing the room makes of plans for some fleets, (b,).

    Where some vehicles are left a little too close, each of them plans again among all others.
    """
    for again in (True, False):
        if len(rows) == 0 or late():
            return
        plans = SharedRoom(best.fleet, forms, rows, plans, late=late).run()
        best.offer(rows, plans)
        left = (~best.verdict.reached[rows]).nonzero().flatten()
        if len(left) == 0 or not again:
            return
        rows, plans = rows[left], plans.take(left)
        _plan_again(best, forms, rows, plans, late)
        rows = rows[best.verdict.reached[rows]]
        plans = best.plans.take(rows)


def _plan_again(best: _Best, forms: list[Among], rows: Tensor, plans: Plans, late: Callable[[], bool]) -> None:
    """Offer what becomes of fleets, (b,), whose vehicles that aren't sound plan again one after the other.

    Both ends of what is in conflict begin; after that, whoever has found no plan. It ends where order doesn't matter.
    """
    verdict = judge_fleet(best.fleet.take(rows.tolist()), plans.U)
    known = served(best.fleet, verdict.vehicles)
    orders = [(~one).nonzero().flatten().tolist() for one in known & verdict.apart]
    before = torch.full_like(verdict.cost, torch.nan)
    for i in range(ORDERS):
        run = Replanned(best.fleet, forms, rows, plans, orders, known, late=late)
        now = best.offer(rows, run.run())
        cost = torch.where(now.reached, now.cost, torch.nan)
        left = (~((cost - before).abs() <= SAME * cost.abs())).nonzero().flatten()
        if len(left) == 0 or late():
            return
        rows, plans, known, before = rows[left], plans.take(left), known[left], cost[left]
        if i == 0:
            orders = [orders[c][::-1] for c in left.tolist()]
            continue
        drawn = [
            best.rngs[b].permutation(orders[c]).tolist() for b, c in zip(rows.tolist(), left.tolist(), strict=True)
        ]
        lost = [run.lost[c] for c in left.tolist()]
        orders = [some + [v for v in order if v not in some] for some, order in zip(lost, drawn, strict=True)]


def _relieve(best: _Best, forms: list[Among], late: Callable[[], bool]) -> None:
    """Where one vehicle pays more for the others than all of these together, it goes another way, and who meets it."""
    paid = best.costs - best.least
    rows = (best.verdict.reached & (2.0 * paid.amax(-1) > paid.sum(-1))).nonzero().flatten()
    if len(rows) == 0 or late():
        return
    due = [[v] for v in paid[rows].argmax(-1).tolist()]
    orders = [list(range(best.fleet.V))] * len(rows)
    plans = Negotiated(best.fleet, forms, rows, best.plans.take(rows), orders, due, late=late).run()
    _improve(best, forms, rows, plans, late)


def _late(ends: float | None) -> bool:
    return ends is not None and clock.seconds() >= ends


def alone(fleet: Fleet, solve: Solve, seed: int, ids: Tensor, solver: Any) -> Plans:
    """Each vehicle as if there were no other; those that touch another at the start have no valid one."""
    plans = Plans.at_rest(fleet)
    for problem, whose in fleet.forms:
        own = torch.cat([ids * fleet.V + v for v in whose])
        found = solve(problem, seed=seed, ids=own, solver=solver)
        for place, v in enumerate(whose):
            rows = torch.arange(fleet.B)
            plans.set(v, rows, found, place * fleet.B + rows)
            plans.iterations[:, v] = found.iterations[place * fleet.B + rows]
    touches = ~fleet.start_is_apart & (plans.status != Status.NON_FINITE)
    plans.status = torch.where(touches, int(Status.INVALID_START), plans.status)
    return plans
