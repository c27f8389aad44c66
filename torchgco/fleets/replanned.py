"""Vehicles that plan again one after the other, from where they are, each among the present motions of the others.

M. Erdmann and T. Lozano-Perez, On multiple moving objects, Algorithmica 2 (1987).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.constraints.base import ADMITTED
from torchgco.fleets.among import SOLVER, Teams
from torchgco.fleets.negotiated import DEAREST
from torchgco.fleets.plans import Plans
from torchgco.fleets.verdict import leaves_chords, states_goal
from torchgco.kernels import path_clearance
from torchgco.problem.problem import Problem
from torchgco.roadmap.timed import TimedScene, timed_ways
from torchgco.search.timed import guesses_along
from torchgco.solution import Solution

REPAIRS = 3  # solves among larger others of what touches them between the knots
BEYOND, MORE = 1.5, 2e-3  # by how much more than it touches they are larger: times, and m


@dataclass(eq=False)
class Replanned(Teams):
    """Planning of C teams side by side; their vehicles have turns of their own.

    Args:
        orders: in which some of its vehicles plan, of each team.
        known: which vehicles others plan among from the beginning, (C, V) bool; others they do once these have planned.

    Attributes:
        lost: vehicles of each team that have found no plan.
    """

    orders: Sequence[Sequence[int]]
    known: Tensor

    def __post_init__(self) -> None:
        super().__post_init__()
        self.left, self.lost = [list(order) for order in self.orders], [list[int]() for _ in self.orders]
        self.known = self.known.clone()
        each = zip(self.fleet.members, self.plans.X, self.plans.U, strict=True)
        self.off = torch.stack([leaves_chords(one.take(self.of), x, u) for one, x, u in each], dim=1)

    def run(self) -> Plans:
        """Plans of all teams; vehicles that find none are where they were."""
        while (rows := [c for c in range(len(self.of)) if self.left[c]]) and not self.late():
            turn = {c: self.left[c].pop(0) for c in rows}
            for i in range(len(self.forms)):
                mine = [c for c in rows if self.fleet.form_of[turn[c]][0] == i]
                if mine:
                    self._plan(i, torch.tensor(mine), torch.tensor([turn[c] for c in mine]))
        return self.plans

    def _plan(self, form: int, teams: Tensor, vehicles: Tensor) -> None:
        """Plan a vehicle of each of some teams, all of one form: from where it is, else along a way on its lattice."""
        turn = _Turn(self, form, teams, vehicles)
        turn.solve(torch.arange(len(teams)))
        left = (~turn.found).nonzero().flatten()
        if len(left) and not self.late():
            turn.solve(turn.along_ways(left))
        for (c, v), found in zip(turn.pairs, turn.found.tolist(), strict=True):
            if not found:
                self.lost[c].append(v)


class _Turn:
    """Vehicles (b,) of as many teams, all of one form."""

    def __init__(self, run: Replanned, form: int, teams: Tensor, vehicles: Tensor) -> None:
        self.run, self.among = run, run.forms[form]
        self.pairs = list(zip(teams.tolist(), vehicles.tolist(), strict=True))
        self.rows = torch.tensor([run.fleet.row_of(v, int(run.of[c])) for c, v in self.pairs])
        keep, at = run.fleet.distances[vehicles], torch.arange(run.fleet.V)
        there = (keep > 0) & run.known[teams] & (at != vehicles.unsqueeze(1))
        p = run.fleet.places(run.plans.X)[teams].transpose(1, 2)  # (b, N+1, V, d)
        self.p = torch.where(there[:, None, :, None], p, torch.nan)
        self.radii = torch.where(there, keep + run.off[teams], torch.nan)
        self.X, self.U = (torch.stack([part[v][c] for c, v in self.pairs]) for part in (run.plans.X, run.plans.U))
        self.found = torch.zeros(len(self.pairs), dtype=torch.bool)

    def along_ways(self, rows: Tensor) -> Tensor:
        """Guess some vehicles to go along the cheapest ways on their lattices; those for which there is one."""
        run, scenes = self.run, dict[int, TimedScene]()
        for i in rows.tolist():
            (c, v), there = self.pairs[i], ~self.radii[i].isnan()
            ground = run.ground(c, v)
            if ground is not None:
                p, radii = self.p[i][:, there].transpose(0, 1), self.radii[i][there]
                price = torch.full_like(radii, DEAREST * ground.wait)
                scenes[i] = ground.among(p, radii, price, run.fleet.dt)
        searched = zip(scenes, timed_ways(list(scenes.values()), 1, 0.0), strict=True)
        found = {i: ways for i, ways in searched if ways.points}
        chosen = torch.tensor(list(found), dtype=torch.int64)
        if found:
            problem = self.among.problem.take(self.rows[chosen])
            guesses = guesses_along(problem, torch.arange(len(found)), list(found.values()))
            self.X[chosen], self.U[chosen] = guesses
        return chosen

    def solve(self, left: Tensor) -> None:
        """Solve from the guesses of some vehicles, and keep what is sound."""
        X, U, grown = self.X.clone(), self.U.clone(), torch.zeros(len(self.rows), dtype=self.X.dtype)
        for _ in range(1 + REPAIRS if len(left) else 0):
            larger = self.among.at(self.rows[left], self.p[left], self.radii[left] + grown[left].unsqueeze(-1))
            solution = SOLVER.solve(larger, U[left], X0=X[left])
            fine, touch = arrives(self.among.at(self.rows[left], self.p[left], self.radii[left]), solution)
            for place, i in enumerate(left.tolist()):
                self._take(i, solution, place, bool(fine[place]))
            self.found[left] = fine
            again = ~fine & (touch < 0) & (solution.violation <= ADMITTED)
            X[left], U[left] = solution.X, solution.U
            grown[left[again]] += BEYOND * -touch[again] + MORE
            left = left[again]
            if not len(left):
                break

    def _take(self, i: int, solution: Solution, place: int, fine: bool) -> None:
        (c, v), run = self.pairs[i], self.run
        run.plans.iterations[c, v] += solution.iterations[place]
        if fine:
            row = torch.tensor([c])
            run.plans.set(v, row, solution, torch.tensor([place]))
            run.known[c, v] = True
            one, x, u = run.fleet.members[v].take(run.of[row]), run.plans.X[v][row], run.plans.U[v][row]
            run.off[c, v] = leaves_chords(one, x, u)[0]


def arrives(problem: Problem, found: Solution) -> tuple[Tensor, Tensor]:
    """Whether solutions are sound, and by how much they keep from contact, m, (b,) each: as solvers see it, as what
    becomes of the fleet is judged."""
    clear = path_clearance(problem, found.X, found.U)
    fine, goal = (found.violation <= ADMITTED) & (clear >= 0), problem.goal
    if goal is not None and states_goal(problem):
        away = (found.X[:, -1, problem.position] - goal.position).norm(dim=-1)
        fine &= away < goal.radius + (ADMITTED if goal.required else 0.0)
    return fine, clear
