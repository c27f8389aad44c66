"""Prioritised planning: one vehicle after the other, each among the planned motions of those before it.

M. Erdmann and T. Lozano-Perez, On multiple moving objects, Algorithmica 2 (1987). Vehicles that find no plan move to
the front, and their fleet begins again.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.constraints.base import ADMITTED
from torchgco.fleets.fleet import Fleet
from torchgco.fleets.guesses import SIDES, bent, in_conflict, late, widths
from torchgco.fleets.plans import Plans, Solve
from torchgco.fleets.verdict import leaves_chords, states_goal
from torchgco.judging.judge import judge
from torchgco.obstacles.moved import Moved
from torchgco.problem.known import Known
from torchgco.problem.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers.interior import InteriorPoint

RESTARTS = 3  # of each fleet
DELAYS = 0.1, 0.2, 0.4  # of beginning, shares of all stages
REPAIRS = 3  # solves among larger others of what touches them between the knots
BEYOND, MORE = 1.5, 2e-3  # by how much more than it touches they are larger: times, and m
# From near guesses: a large barrier would lose them.
SOLVER = InteriorPoint(tolerance=1e-6, initial_barrier=1e-2, max_iterations=100)


@dataclass(frozen=True)
class Among:
    """The vehicles of a form among others: problems that share what is known of them."""

    problem: Problem
    known: Known

    def at(self, rows: Tensor, places: Tensor, radii: Tensor) -> Problem:
        """The problems at some rows, among motions (b, N+1, M, d) that they keep radii (b, M) from."""
        one = self.problem.take(rows)
        others = Moved(places, radii).bind(one._dimensions(one.x0))
        own = [part for part in one.constraints if not part.is_goal]
        goals = [part for part in one.constraints if part.is_goal]
        return one._with({"constraints": (*own, others, *goals)}, known=self.known)


class Prioritised:
    """Planning of all fleets of a batch side by side; their vehicles have turns of their own."""

    def __init__(self, fleet: Fleet, alone: Plans, solve: Solve, seed: int, ids: Tensor, solver: Any) -> None:
        B, V = fleet.B, fleet.V
        self.fleet, self.alone, self.ids = fleet, alone, ids
        self.solve, self.search = solve, partial(solve, seed=seed, solver=solver)
        self.forms = [Among(problem, Known()) for problem, _ in fleet.forms]
        self.form_of = {v: (i, at) for i, (_, whose) in enumerate(fleet.forms) for at, v in enumerate(whose)}
        self.order = [np.random.default_rng((seed, int(i))).permutation(V).tolist() for i in ids]
        self.at, self.restarts = [0] * B, [0] * B
        self.plans = alone.take(torch.arange(B))
        self.known = torch.zeros(B, V, dtype=torch.bool)
        self.off = alone.X[0].new_zeros(B, V)  # by which paths leave the chords that others know, m
        self.wide = widths(fleet, in_conflict(fleet, alone))

    def run(self) -> Plans:
        """Plans of all fleets; vehicles without one are where they would be alone."""
        while rows := [b for b in range(self.fleet.B) if self.at[b] < self.fleet.V]:
            turn = {b: self.order[b][self.at[b]] for b in rows}
            for i in range(len(self.forms)):
                mine = [b for b in rows if self.form_of[turn[b]][0] == i]
                if mine:
                    self._step(i, torch.tensor(mine), torch.tensor([turn[b] for b in mine]))
        return self.plans

    def _step(self, form: int, fleets: Tensor, vehicles: Tensor) -> None:
        """Plan a vehicle of each of some fleets, all of one form."""
        found = self._planned(form, fleets, vehicles)
        for b, v, ok in zip(fleets.tolist(), vehicles.tolist(), found.tolist(), strict=True):
            if ok or self.restarts[b] >= RESTARTS:
                self.known[b, v], self.at[b] = True, self.at[b] + 1
                row, one = torch.tensor([b]), self.fleet.members[v]
                self.off[b, v] = leaves_chords(one.take(row), self.plans.X[v][row], self.plans.U[v][row])[0]
                continue
            self.restarts[b] += 1
            self.order[b].remove(v)
            self.order[b].insert(0, v)
            self.known[b], self.at[b] = False, 0

    def _planned(self, form: int, fleets: Tensor, vehicles: Tensor) -> Tensor:
        """Which found a plan; from guesses near those alone, and by a search where these don't do."""
        rows = torch.tensor([self.form_of[v][1] for v in vehicles.tolist()]) * self.fleet.B + fleets
        p = self.fleet.places(self.plans.X)[fleets].transpose(1, 2)  # (b, N+1, V, d)
        radii = self.fleet.distances[vehicles]
        there = self.known[fleets] & (radii > 0)
        there[torch.arange(len(fleets)), vehicles] = False
        radii = radii + self.off[fleets]
        p, radii = torch.where(there[:, None, :, None], p, torch.nan), torch.where(there, radii, torch.nan)
        among = self.forms[form]
        found = self._near(among, rows, p, radii, fleets, vehicles)
        left = (~found).nonzero().flatten()
        if len(left):
            problem = among.at(rows[left], p[left], radii[left])
            ids = self.ids[fleets[left]] * self.fleet.V + vehicles[left]
            solution = self.search(problem, ids=ids)
            fine = arrives(problem, solution.U)[0]
            for place, i in enumerate(left.tolist()):
                self._keep(fleets[i], vehicles[i], solution, place)
            found[left] = fine
        return found

    def _near(self, among: Among, rows: Tensor, p: Tensor, radii: Tensor, fleets: Tensor, vehicles: Tensor) -> Tensor:
        """The cheapest plans from guesses near those alone; which of the vehicles have one."""
        pairs = list(zip(fleets.tolist(), vehicles.tolist(), strict=True))
        X, U = (torch.stack([part[v][b] for b, v in pairs]) for part in (self.alone.X, self.alone.U))
        wide, position = self.wide[fleets, vehicles], among.problem.position
        guesses = [(X, U)] + [(bent(X, position, side, wide), U) for side in SIDES]
        guesses += [late(X, U, round(share * U.shape[1])) for share in DELAYS]
        count, b = len(guesses), len(rows)
        every = torch.arange(b).repeat(count)
        X0, U0 = (torch.cat(parts) for parts in zip(*guesses, strict=True))
        grown, best = torch.zeros(len(every), dtype=X.dtype), torch.full((b,), torch.inf, dtype=X.dtype)
        left = torch.arange(len(every))
        for _ in range(1 + REPAIRS):
            own = every[left]
            larger = among.at(rows[own], p[own], radii[own] + grown[left].unsqueeze(-1))
            solution = self.solve(larger, solver=SOLVER, X0=X0[left], U0=U0[left])
            fine, cost, touch = arrives(among.at(rows[own], p[own], radii[own]), solution.U)
            for place, i in enumerate(own.tolist()):
                self.plans.iterations[fleets[i], vehicles[i]] += solution.iterations[place]
                if fine[place] and cost[place] < best[i]:
                    best[i] = cost[place]
                    self._keep(fleets[i], vehicles[i], solution, place)
            again = ~fine & (touch < 0) & (solution.violation <= ADMITTED)
            X0[left], U0[left] = solution.X, solution.U
            grown[left[again]] += BEYOND * -touch[again] + MORE
            left = left[again]
            if not len(left):
                break
        return torch.isfinite(best)

    def _keep(self, b: Tensor, v: Tensor, solution: Solution, place: int) -> None:
        self.plans.set(int(v), b.view(1), solution, torch.tensor([place]))


def arrives(problem: Problem, U: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Whether controls are sound, (b,) each; their costs; and by how much they keep from contact, m."""
    verdict = judge(problem, U)
    return verdict.reached if states_goal(problem) else verdict.feasible, verdict.cost, verdict.clearance
