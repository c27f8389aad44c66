"""Trajectories of all vehicles of a fleet improved together, without a problem that holds them all.

A plane between each two vehicles, at each knot, keeps them apart: each vehicle plans on its side, all of them in one
batch. Where the planes are decides how much of the room each has. At the least cost of the whole fleet both sides of a
plane would pay the same for a little more room, so planes move to where linear responses of the trajectories to forces
say that this is so: a quadratic programme in the forces between the vehicles, one for each fleet. What was apart stays
apart on the way, as the planes of a round lie between the trajectories of the one before; what was too close comes
apart by as much as the vehicles can do.

Compare the planes with those of J. Park et al., Online distributed trajectory planning for quadrotor swarm with
feasibility guarantee using linear safe corridor (2022); the exchange of room is a primal decomposition (S. Boyd et al.,
Notes on decomposition methods, 2007).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchgco.constraints.base import ADMITTED, CONTACT_FACTOR
from torchgco.fleets.among import SOLVER, Teams
from torchgco.fleets.forces import balancing_forces, between_two, responses, stiffness
from torchgco.fleets.plans import Plans
from torchgco.fleets.verdict import leaves_chords
from torchgco.kernels import path_clearance
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.obstacles.measured import segment_distance
from torchgco.problem.problem import Problem
from torchgco.solution import Solution

ROUNDS = 16  # of planes, at most
LEAST_GAIN = 1e-4  # share of the cost: rounds that gain less are the last
FLAT = 100.0  # radius of the balls whose surfaces stand for planes, as a multiple of the distance that two keep
NEAR = 1.0  # as such a multiple, how much farther apart two may be whose forces are looked for
MORE = 1e-4  # m, by which pairs stay farther apart between the knots than where they touch
BEYOND = 1.5  # times what touches an obstacle between the knots, by which it is larger in the next round
BACK, ON = 0.3, 2.0  # times the step of the planes after a round that fails, and after one that serves
SHORTEST = 0.05  # step
# Share of what two keep by which they may come closer on the way to it: planes with no room have no inside.
LOOSE = 0.03


@dataclass
class Room:
    """Where the planes are, of c fleets; [i, j] of what vehicle i keeps from vehicle j, at all knots.

    Attributes:
        normals: unit vectors from vehicle j to vehicle i, (c, V, V, K, d).
        offsets: of the planes along these, (c, V, V, K), m.
        needed: the distances kept at the knots along them, (c, V, V, K), m.
        wanted: those to be kept in the end; 0 of pairs that keep none.
    """

    normals: Tensor
    offsets: Tensor
    needed: Tensor
    wanted: Tensor

    def balls(self, p: Tensor, v: int) -> tuple[Tensor, Tensor]:
        """Balls (c, K, V, d), NaN where there is none, and radii (c, V), that keep vehicle v at p (c, K, d) on its
        side."""
        normal, keep = self.normals[:, v], self.needed[:, v]
        radius = FLAT * self.wanted[:, v].amax(-1)
        beyond = (normal * p.unsqueeze(1)).sum(-1) - self.offsets[:, v] - 0.5 * keep
        foot = p.unsqueeze(1) - beyond.unsqueeze(-1) * normal
        centers = (foot - radius[..., None, None] * normal).transpose(1, 2)
        there = (self.wanted[:, v] > 0).any(-1)
        return torch.where(there[:, None, :, None], centers, torch.nan), torch.where(there, radius, torch.nan)


@dataclass
class Sides:
    """Vehicles of a form on their sides of the planes: those of c fleets, vehicle after vehicle."""

    whose: tuple[int, ...]
    bare: Problem  # without planes, and without obstacles that have grown
    problem: Problem
    place: int  # which constraint are the planes
    centers: Tensor  # (W c, K, V, d) of their balls
    solution: Solution

    def forces(self, position: slice) -> Tensor:
        """By which others push, (W c, K, d): slopes of the costs at the solutions."""
        p, rows = self.solution.X[..., position], self.problem.constraints[self.place]
        away = (p.unsqueeze(2) - self.centers.nan_to_num(0.0))[:, rows.knots]
        push = torch.zeros_like(p)
        push[:, rows.knots] = (2.0 * self.solution.multipliers.lam[self.place].unsqueeze(-1) * away).sum(2)
        return push

    def responses(self, rows: Tensor, forces: Tensor, kept: Tensor) -> Tensor:
        """Of places at knots 1..N to more than the forces of others, (r, N d, N d), m per unit.

        Args:
            kept: the largest distance that each of these vehicles keeps, (r,), m.
        """
        solution = self.solution.take(rows)
        lam = list(solution.multipliers.lam)
        del lam[self.place]
        own = replace(solution, multipliers=Multipliers(tuple(lam), solution.multipliers.mu))
        return responses(self.bare.take(rows), own, forces[rows], stiffness(own.cost, kept, self.bare.N))[0]


@dataclass(eq=False)
class SharedRoom(Teams):
    """Rounds of C teams side by side."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.now, self.best = self.plans, self.plans.take(torch.arange(len(self.of)))
        C, V, K, like = len(self.of), self.fleet.V, self.fleet.N + 1, self.fleet.distances
        self.needed = like.view(1, V, V, 1).repeat(C, 1, 1, K)
        self.grown = like.new_zeros(C, V)
        self.step, self.shift = like.new_ones(C), torch.zeros_like(self.fleet.places(self.plans.X))
        self.cost, self.least = like.new_full((C,), torch.inf), like.new_full((C,), torch.inf)
        self.sound = torch.zeros(C, dtype=torch.bool)
        self.live = torch.ones(C, dtype=torch.bool)

    def run(self) -> Plans:
        """The best plans of each; those of the last round where none was sound."""
        for _ in range(ROUNDS):
            rows = self.live.nonzero().flatten()
            if len(rows) == 0 or self.late():
                break
            self._round(rows)
        lost = (~torch.isfinite(self.least)).nonzero().flatten()
        self.best.put(lost, self.now.take(lost))
        return self.best

    def _round(self, rows: Tensor) -> None:
        """Plan between new planes, and keep what is better."""
        room, p = self._room(rows)
        sides = [self._solved(i, rows, room, p) for i in range(len(self.forms))]
        new, cost, keeps, clear = self._gathered(rows, sides)
        fine = keeps & clear
        short = self._short(rows, new)
        sound = fine & (short <= 0).flatten(1).all(-1)
        better = fine & ((cost < self.cost[rows]) | ~self.sound[rows])
        gain = self.cost[rows] - cost
        best = (sound & (cost < self.least[rows])).nonzero().flatten()
        self.best.put(rows[best], new.take(best))
        self.least[rows[best]] = cost[best]
        small = sound & better & self.sound[rows] & (gain < LEAST_GAIN * cost.abs())
        # What touches obstacles alone is a better guess than one that others came too close in.
        nearer = (better | (keeps & ~self.sound[rows])).nonzero().flatten()
        self.now.put(rows[nearer], new.take(nearer))
        self.shift[rows[nearer]] = 0.0
        kept = better.nonzero().flatten()
        self.cost[rows[kept]], self.sound[rows[kept]] = cost[kept], sound[kept]
        whole = better & (self.step[rows] >= 1.0)
        self.needed[rows[whole]] += short[whole]
        # Who touches obstacles plans again among larger ones: planes as they are don't keep it from that.
        shorter = torch.where(keeps & ~clear, self.step[rows], BACK * self.step[rows])
        self.step[rows] = torch.where(better, (ON * self.step[rows]).clamp(max=1.0), shorter)
        self.live[rows] = ~small & (self.step[rows] > torch.where(self.sound[rows], BACK, SHORTEST))
        again = (better & self.live[rows]).nonzero().flatten()
        if len(again):
            self._exchange(rows, again, sides)

    def _room(self, rows: Tensor) -> tuple[Room, Tensor]:
        """Planes between the vehicles of some, halfway between where they are and where forces ask them to be; and
        places (c, V, K, d) to begin with."""
        p, step = self.fleet.places(self.now.take(rows).X), self.step[rows].view(-1, 1, 1, 1)
        normals, gap = between_two(p)
        middle = p + step * self.shift[rows]
        offsets = 0.5 * (normals * (middle.unsqueeze(2) + middle.unsqueeze(1))).sum(-1)
        needed = self.needed[rows]
        lacks = (needed - gap).clamp(min=0.0)
        needed = torch.minimum(needed, gap + step * lacks - (1.0 - step) * LOOSE * needed)
        return Room(normals, offsets, needed, self.needed[rows]), middle

    def _solved(self, i: int, rows: Tensor, room: Room, p: Tensor) -> Sides:
        """The vehicles of a form, each on its side."""
        among, (_, whose) = self.forms[i], self.fleet.forms[i]
        balls = [room.balls(p[:, v], v) for v in whose]
        centers, radii = (torch.cat(part) for part in zip(*balls, strict=True))
        own = torch.cat([place * self.fleet.B + self.of[rows] for place in range(len(whose))])
        grown = torch.cat([self.grown[rows, v] for v in whose])
        problem = among.at(own, centers, radii, grown)
        X, U = (torch.cat([part[v][rows] for v in whose]) for part in (self.now.X, self.now.U))
        X[:, 1:, among.problem.position] = torch.cat([p[:, v, 1:] for v in whose])
        solution = SOLVER.solve(problem, U, X0=X)
        return Sides(whose, among.problem.take(own), problem, among.place, centers, solution)

    def _gathered(self, rows: Tensor, sides: Sequence[Sides]) -> tuple[Plans, Tensor, Tensor, Tensor]:
        """Plans, costs (c,), whether all vehicles keep their constraints (c,), and obstacles between the knots."""
        new, count = self.now.take(rows), torch.arange(len(rows))
        cost, keeps = torch.zeros_like(self.cost[rows]), torch.ones_like(self.sound[rows])
        free = keeps.clone()
        for part in sides:
            clear = path_clearance(part.bare, part.solution.X, part.solution.U)
            for place, v in enumerate(part.whose):
                at = place * len(rows) + count
                new.set(v, count, part.solution, at)
                new.iterations[:, v] += part.solution.iterations[at]
                cost += part.solution.cost[at]
                kept = part.solution.violation[at] <= ADMITTED
                keeps &= kept
                touch, grown = (-clear[at]).clamp(min=0.0), self.grown[rows, v]
                larger = torch.maximum(grown + BEYOND * touch + MORE, 2.0 * grown)
                self.grown[rows, v] = torch.where((touch > 0) & kept, larger, grown)
                free &= touch <= 0
        return new, cost, keeps & torch.isfinite(cost), free

    def _short(self, rows: Tensor, new: Plans) -> Tensor:
        """By how much more pairs have to keep at knots (c, V, V, K), m."""
        p, keep = self.fleet.places(new.X), self.fleet.distances.unsqueeze(-1)
        away = p.unsqueeze(2) - p.unsqueeze(1)
        each = zip(self.fleet.members, new.X, new.U, strict=True)
        off = torch.stack([leaves_chords(one.take(self.of[rows]), x, u) for one, x, u in each], dim=1)
        beside = (off.unsqueeze(2) + off.unsqueeze(1)).unsqueeze(-1)
        between = segment_distance(away[..., :-1, :], away[..., 1:, :])
        close = torch.where(keep > 0, CONTACT_FACTOR * keep + beside + MORE - between, 0.0).clamp(min=0.0)
        at = torch.where(keep > 0, keep - away.norm(dim=-1), 0.0)
        at[..., 0] = 0.0
        at = torch.where(at > 0.5 * ADMITTED, at, 0.0)
        more = at
        more[..., :-1] = torch.maximum(more[..., :-1], close)
        more[..., 1:] = torch.maximum(more[..., 1:], close)
        return more

    def _exchange(self, rows: Tensor, again: Tensor, sides: Sequence[Sides]) -> None:
        """Where forces between the vehicles would move them, of some of the fleets in `rows`."""
        c, (V, K, d) = len(again), self.shift.shape[1:]
        forces, answers = self.shift.new_zeros(c, V, K, d), self.shift.new_zeros(c, V, (K - 1) * d, (K - 1) * d)
        for part in sides:
            position = self.fleet.members[part.whose[0]].position
            push = part.forces(position)
            for place, v in enumerate(part.whose):
                forces[:, v] = push[place * len(rows) + again]
            at = torch.cat([place * len(rows) + again for place in range(len(part.whose))])
            kept = self.fleet.distances.amax(-1)[list(part.whose)].repeat_interleave(c)
            found = part.responses(at, push, kept)
            for place, v in enumerate(part.whose):
                answers[:, v] = found[place * c : (place + 1) * c]
        chosen = rows[again]
        normals, gap = between_two(self.fleet.places(self.now.take(chosen).X))
        for i, c in enumerate(chosen.tolist()):
            self.shift[c], _ = balancing_forces(normals[i], gap[i], self.needed[c], forces[i], answers[i], NEAR)
