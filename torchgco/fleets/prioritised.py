"""Prioritised planning: each vehicle among the planned motions of those before it, with priorities that are found.

M. Erdmann and T. Lozano-Perez, On multiple moving objects, Algorithmica 2 (1987). A vehicle that finds no plan gets
priority over all others, as in priority-based search (H. Ma et al., Searching with consistent prioritization for
multi-agent path finding, 2019), but without going back: it does what it would do alone, and only those that are then in
its way plan again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchgco.base.status import Status
from torchgco.constraints.base import ADMITTED, CONTACT_FACTOR
from torchgco.fleets.among import SOLVER, Among
from torchgco.fleets.fleet import Fleet
from torchgco.fleets.guesses import SIDES, bent
from torchgco.fleets.plans import Plans
from torchgco.fleets.verdict import leaves_chords, states_goal
from torchgco.kernels import path_clearance
from torchgco.obstacles.measured import segment_distance
from torchgco.problem.problem import Problem
from torchgco.roadmap.timed import library_for, timed_ways
from torchgco.search.timed import guesses_along
from torchgco.search.timed_scenes import can_search
from torchgco.solution import Solution

WAYS = 3  # through space and time
DEARER = 0.5  # share by which ways may cost more than the cheapest, on the lattice
REPAIRS = 3  # solves among larger others of what touches them between the knots
BEYOND, MORE = 1.5, 2e-3  # by how much more than it touches they are larger: times, and m


class Prioritised:
    """Planning of C teams side by side; their vehicles have turns of their own.

    Args:
        fleet: of which these are.
        forms: of its vehicles.
        of: which of the fleets each team is, (C,).
        alone: what its vehicles do without the others.
        orders: in which some of its vehicles plan, of each team.
        late: whether the time is over.
        now: what vehicles do that others plan among from the beginning; None: nothing is known of those that haven't
            planned. Where it is `alone` itself, that is nearly a plan.
        raised: how often vehicles of a team may get priority over all others, at most.
    """

    def __init__(
        self,
        fleet: Fleet,
        forms: Sequence[Among],
        of: Tensor,
        alone: Plans,
        orders: Sequence[Sequence[int]],
        late: Callable[[], bool] = lambda: False,
        now: Plans | None = None,
        raised: int = 0,
    ) -> None:
        C, V = len(of), fleet.V
        self.fleet, self.forms, self.of, self.alone, self.late = fleet, forms, of, alone, late
        self.form_of = {v: (i, at) for i, (_, whose) in enumerate(fleet.forms) for at, v in enumerate(whose)}
        self.left = [list(order) for order in orders]
        self.raised = [raised] * C
        self.level = torch.zeros(C, V, dtype=torch.int64)  # of each vehicle's priority
        self.plans = (alone if now is None else now).take(torch.arange(C))
        self.is_near, self.known = now is alone, torch.full((C, V), now is not None)
        each = zip(fleet.members, self.plans.X, self.plans.U, strict=True)
        self.off = torch.stack([leaves_chords(one.take(of), x, u) for one, x, u in each], dim=1)

    def run(self) -> Plans:
        """Plans of all teams; vehicles without one are where they were."""
        while rows := [c for c in range(len(self.of)) if self.left[c]]:
            if self.late():
                break
            turn = {c: self.left[c][0] for c in rows}
            for i in range(len(self.forms)):
                mine = [c for c in rows if self.form_of[turn[c]][0] == i]
                if mine:
                    self._step(i, torch.tensor(mine), torch.tensor([turn[c] for c in mine]))
        return self.plans

    def _step(self, form: int, teams: Tensor, vehicles: Tensor) -> None:
        """Plan a vehicle of each of some teams, all of one form."""
        turn = _Turn(self, form, teams, vehicles)
        turn.plan()
        may_rise = ~turn.found & ~turn.radii.isnan().all(-1)
        for c, v, rises in zip(teams.tolist(), vehicles.tolist(), may_rise.tolist(), strict=True):
            if rises and self.raised[c] > 0:
                self.raised[c] -= 1
                self.level[c, v] = 1 + self.level[c].amax()
                continue
            self.left[c].pop(0)
            self.known[c, v] = True
            row, one = torch.tensor([c]), self.fleet.members[v]
            self.off[c, v] = leaves_chords(one.take(self.of[row]), self.plans.X[v][row], self.plans.U[v][row])[0]
            self._send_away(c, v)

    def _send_away(self, c: int, v: int) -> None:
        """Those of lower priority that are in the way of what a vehicle has planned plan again."""
        others = self.known[c] & (self.level[c] < self.level[c, v])
        if bool(others.any()):
            p = self.fleet.places([x[[c]] for x in self.plans.X])[0]
            in_way = others & touches(p[v], p, self.fleet.distances[v], self.off[c])
            self.known[c] &= ~in_way
            self.left[c] += in_way.nonzero().flatten().tolist()


def touches(p: Tensor, others: Tensor, keep: Tensor, off: Tensor) -> Tensor:
    """Which of other paths (V, K, d) come too close to places p (K, d), (V,) bool.

    Args:
        keep: the distances that are kept, (V,), m; 0 of those that keep none.
        off: by how much the paths may leave their chords, (V,), m.
    """
    away = others - p
    at, between = away.norm(dim=-1)[:, 1:].amin(-1), segment_distance(away[:, :-1], away[:, 1:]).amin(-1)
    return (keep > 0) & ((at < keep - ADMITTED) | (between < CONTACT_FACTOR * keep + off))


class _Turn:
    """Vehicles (b,) of as many teams, all of one form, that plan among those that have planned."""

    def __init__(self, run: Prioritised, form: int, teams: Tensor, vehicles: Tensor) -> None:
        self.run, self.among, self.teams, self.vehicles = run, run.forms[form], teams, vehicles
        places = torch.tensor([run.form_of[v][1] for v in vehicles.tolist()])
        self.rows = places * run.fleet.B + run.of[teams]
        radii, level = run.fleet.distances[vehicles], run.level[teams]
        there = run.known[teams] & (radii > 0) & (level >= level.gather(1, vehicles.unsqueeze(1)))
        there[torch.arange(len(teams)), vehicles] = False
        p = run.fleet.places(run.plans.X)[teams].transpose(1, 2)  # (b, N+1, V, d)
        self.p = torch.where(there[:, None, :, None], p, torch.nan)
        self.radii = torch.where(there, radii + run.off[teams], torch.nan)
        self.own = 0.5 * torch.where(radii > 0, radii, torch.inf).amin(-1)
        pairs = list(zip(teams.tolist(), vehicles.tolist(), strict=True))
        self.X, self.U = (torch.stack([part[v][c] for c, v in pairs]) for part in (run.alone.X, run.alone.U))
        self.cost = torch.full((len(teams),), torch.inf, dtype=radii.dtype)

    @property
    def found(self) -> Tensor:
        """Which have a plan, (b,)."""
        return torch.isfinite(self.cost)

    def plan(self) -> None:
        """As alone where nobody is in the way; else along ways through space and time, and from there.

        What serves is the last; what is nearly a plan already is tried first.
        """
        self._stay()
        near = lambda rows: (rows, self.X[rows], self.U[rows])
        for guesses in (near, self._guesses) if self.run.is_near else (self._guesses, near):
            left = (~self.found).nonzero().flatten()
            if len(left) == 0 or self.run.late():
                return
            self._solve(*guesses(left))

    def _stay(self) -> None:
        """Take what vehicles do alone where they have a plan that keeps clear of all others."""
        run, sound = self.run, torch.tensor([Status.CONVERGED, Status.FEASIBLE])
        for i, (c, v) in enumerate(zip(self.teams.tolist(), self.vehicles.tolist(), strict=True)):
            own, row, at = run.fleet.members[v].take(run.of[[c]]), torch.tensor([c]), slice(i, i + 1)
            keep = torch.where(self.radii[i].isnan(), 0.0, run.fleet.distances[v])
            off = run.off[c] + leaves_chords(own, self.X[at], self.U[at])
            clear = ~touches(self.X[i][:, own.position], self.p[i].transpose(0, 1), keep, off).any()
            if bool(clear) and bool(torch.isin(run.alone.status[c, v], sound)):
                run.plans.put_one(v, row, run.alone.take(row))
                self.cost[i] = own.cost.total(self.X[at], self.U[at])[0]

    def _guesses(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Guesses (C, ...) for some of the vehicles, and whose they are, (C,): along ways, or to both sides where none
        can be looked for."""
        problem, X, U = self._problem(rows), self.X[rows], self.U[rows]
        if not can_search(problem) or library_for(problem.position.stop - problem.position.start) is None:
            wide = self.radii[rows].nan_to_num(0.0).amax(-1)
            guesses = [bent(X, problem.position, side, wide) for side in SIDES]
            return rows.repeat(len(guesses)), torch.cat(guesses), U.repeat(len(guesses), 1, 1)
        each = [(i, row, problem.take(torch.tensor([i]))) for i, row in enumerate(self.rows[rows].tolist())]
        ways = timed_ways([self.among.scene(row, one, X[i]) for i, row, one in each], WAYS, DEARER)
        whose = torch.tensor([b for b, some in enumerate(ways) for _ in some.points], dtype=torch.int64)
        return rows[whose], *guesses_along(problem, whose, ways)

    def _problem(self, rows: Tensor, grown: Tensor | float = 0.0) -> Problem:
        radii = self.radii[rows] + (grown.unsqueeze(-1) if isinstance(grown, Tensor) else grown)
        return self.among.at(self.rows[rows], self.p[rows], radii, own=self.own[rows])

    def _solve(self, whose: Tensor, X0: Tensor, U0: Tensor) -> None:
        """Keep the cheapest of what guesses (C, ...) of vehicles `whose` (C,) lead to."""
        grown, left = torch.zeros(len(whose), dtype=X0.dtype), torch.arange(len(whose))
        for _ in range(1 + REPAIRS if len(left) else 0):
            own = whose[left]
            solution = SOLVER.solve(self._problem(own, grown[left]), U0[left], X0=X0[left])
            fine, touch = arrives(self._problem(own), solution)
            for place, i in enumerate(own.tolist()):
                c, v = int(self.teams[i]), int(self.vehicles[i])
                self.run.plans.iterations[c, v] += solution.iterations[place]
                if fine[place] and solution.cost[place] < self.cost[i]:
                    self.cost[i] = solution.cost[place]
                    self.run.plans.set(v, torch.tensor([c]), solution, torch.tensor([place]))
            again = ~fine & (touch < 0) & (solution.violation <= ADMITTED)
            X0[left], U0[left] = solution.X, solution.U
            grown[left[again]] += BEYOND * -touch[again] + MORE
            left = left[again]
            if not len(left):
                break


def arrives(problem: Problem, found: Solution) -> tuple[Tensor, Tensor]:
    """Whether solutions are sound, and by how much they keep from contact, m, (b,) each: as solvers see it, as what
    becomes of the fleet is judged."""
    clear = path_clearance(problem, found.X, found.U)
    fine, goal = (found.violation <= ADMITTED) & (clear >= 0), problem.goal
    if goal is not None and states_goal(problem):
        away = (found.X[:, -1, problem.position] - goal.position).norm(dim=-1)
        fine &= away < goal.radius + (ADMITTED if goal.required else 0.0)
    return fine, clear
