"""Prioritised planning: one vehicle after the other, each among the planned motions of those before it.

M. Erdmann and T. Lozano-Perez, On multiple moving objects, Algorithmica 2 (1987). Several orders are planned side by
side. Vehicles that find no plan move to the front, and their team begins again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchgco.constraints.base import ADMITTED
from torchgco.fleets.among import SOLVER, Among
from torchgco.fleets.fleet import Fleet
from torchgco.fleets.guesses import SIDES, bent, in_conflict, late, widths
from torchgco.fleets.plans import Plans
from torchgco.fleets.verdict import leaves_chords, states_goal
from torchgco.kernels import path_clearance
from torchgco.problem.problem import Problem
from torchgco.roadmap.timed import library_for
from torchgco.search.timed import guesses_along, ways_in_time
from torchgco.search.timed_scenes import can_search
from torchgco.solution import Solution

RESTARTS = 3  # of each team
DELAYS = 0.1, 0.2, 0.4  # of beginning, shares of all stages
WAYS = 4  # through space and time, of those that no guess serves
REPAIRS = 3  # solves among larger others of what touches them between the knots
BEYOND, MORE = 1.5, 2e-3  # by how much more than it touches they are larger: times, and m


class Prioritised:
    """Planning of C teams side by side; their vehicles have turns of their own.

    Args:
        fleet: of which these are.
        forms: of its vehicles.
        of: which of the fleets each team is, (C,).
        alone: what its vehicles do without the others; with `again` what they do now.
        orders: in which its vehicles plan, of each team.
        late: whether the time is over.
        again: the vehicles in `orders` plan again, among the motions of all others; there are no restarts.
    """

    def __init__(
        self,
        fleet: Fleet,
        forms: Sequence[Among],
        of: Tensor,
        alone: Plans,
        orders: Sequence[Sequence[int]],
        late: Callable[[], bool] = lambda: False,
        again: bool = False,
    ) -> None:
        C, V = len(of), fleet.V
        self.fleet, self.forms, self.of, self.alone, self.late = fleet, forms, of, alone, late
        self.form_of = {v: (i, at) for i, (_, whose) in enumerate(fleet.forms) for at, v in enumerate(whose)}
        self.order = [list(order) for order in orders]
        self.at, self.restarts = [0] * C, [RESTARTS if again else 0] * C
        self.plans = alone.take(torch.arange(C))
        self.known = torch.full((C, V), again)
        self.off = alone.X[0].new_zeros(C, V)  # by which paths leave the chords that others know, m
        if again:
            each = zip(fleet.members, alone.X, alone.U, strict=True)
            self.off = torch.stack([leaves_chords(one.take(of), x, u) for one, x, u in each], dim=1)
        self.wide = widths(fleet, in_conflict(fleet, alone))

    def run(self) -> Plans:
        """Plans of all teams; vehicles without one are where they would be alone."""
        while rows := [c for c in range(len(self.of)) if self.at[c] < len(self.order[c])]:
            if self.late():
                break
            turn = {c: self.order[c][self.at[c]] for c in rows}
            for i in range(len(self.forms)):
                mine = [c for c in rows if self.form_of[turn[c]][0] == i]
                if mine:
                    self._step(i, torch.tensor(mine), torch.tensor([turn[c] for c in mine]))
        return self.plans

    def _step(self, form: int, teams: Tensor, vehicles: Tensor) -> None:
        """Plan a vehicle of each of some teams, all of one form."""
        turn = _Turn(self, form, teams, vehicles)
        turn.plan()
        for c, v, found in zip(teams.tolist(), vehicles.tolist(), turn.found.tolist(), strict=True):
            if found or self.restarts[c] >= RESTARTS:
                self.known[c, v], self.at[c] = True, self.at[c] + 1
                row, one = torch.tensor([c]), self.fleet.members[v]
                self.off[c, v] = leaves_chords(one.take(self.of[row]), self.plans.X[v][row], self.plans.U[v][row])[0]
                continue
            self.restarts[c] += 1
            self.order[c].remove(v)
            self.order[c].insert(0, v)
            self.known[c], self.at[c] = False, 0


class _Turn:
    """Vehicles (b,) of as many teams, all of one form, that plan among those that have planned."""

    def __init__(self, run: Prioritised, form: int, teams: Tensor, vehicles: Tensor) -> None:
        self.run, self.among, self.teams, self.vehicles = run, run.forms[form], teams, vehicles
        places = torch.tensor([run.form_of[v][1] for v in vehicles.tolist()])
        self.rows = places * run.fleet.B + run.of[teams]
        radii = run.fleet.distances[vehicles]
        there = run.known[teams] & (radii > 0)
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
        """From guesses near those alone, and along ways through space and time where these don't do."""
        wide, position = self.run.wide[self.teams, self.vehicles], self.among.problem.position
        guesses = [(self.X, self.U)] + [(bent(self.X, position, side, wide), self.U) for side in SIDES]
        guesses += [late(self.X, self.U, round(share * self.U.shape[1])) for share in DELAYS]
        X0, U0 = (torch.cat(parts) for parts in zip(*guesses, strict=True))
        self._solve(torch.arange(len(self.rows)).repeat(len(guesses)), X0, U0)
        left = (~self.found).nonzero().flatten()
        if len(left) == 0 or self.run.late():
            return
        problem = self._problem(left)
        if not self._can_search(problem):
            return
        ways = ways_in_time(problem, self.X[left], WAYS)
        each = torch.tensor([b for b, some in enumerate(ways) for _ in some.points], dtype=torch.int64)
        if len(each):
            X0, U0 = guesses_along(problem, each, ways)
            self._solve(left[each], X0, U0)

    def _can_search(self, problem: Problem) -> bool:
        return can_search(problem) and library_for(problem.position.stop - problem.position.start) is not None

    def _problem(self, rows: Tensor, grown: Tensor | float = 0.0) -> Problem:
        radii = self.radii[rows] + (grown.unsqueeze(-1) if isinstance(grown, Tensor) else grown)
        return self.among.at(self.rows[rows], self.p[rows], radii, own=self.own[rows])

    def _solve(self, whose: Tensor, X0: Tensor, U0: Tensor) -> None:
        """Keep the cheapest of what guesses (C, ...) of vehicles `whose` (C,) lead to."""
        grown, left = torch.zeros(len(whose), dtype=X0.dtype), torch.arange(len(whose))
        for _ in range(1 + REPAIRS):
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
