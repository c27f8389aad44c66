"""Vehicles that are in each other's way come apart: forces push them, and each answers by its own least cost.

In every round the forces are those of a quadratic programme that would bring all pairs as far apart as they have to be,
by linear responses of the trajectories (`forces`). Each vehicle is then solved under its forces, and not far from where
they should bring it, so there is always a solution, whatever the vehicles can do.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.fleets.among import SOLVER, Teams
from torchgco.fleets.forces import balancing_forces, between_two, responses, stiffness, under
from torchgco.fleets.plans import Plans

ROUNDS = 24  # at most
PATIENCE, LEFT = 7, 0.9  # rounds, after which no more than this share of what was lacking may be left
WIDEST = 0.25  # as a share of what they keep, how far vehicles move in the first round at most
WIDER, NARROWER = 2.0, 0.3  # times as far after a round that brings them farther apart, and after another one
CLOSE, NEARLY = 0.02, 0.25  # shares of what a pair keeps: with so little lacking there is no other round, and planes do
NEAR = 1.0  # by how many times what they keep two may be farther apart whose forces are looked for


@dataclass(eq=False)
class ComingApart(Teams):
    """Rounds of C teams side by side.

    Attributes:
        near: which of them are so far apart in the end that planes can do the rest, (C,) bool.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        fleet, of, plans = self.fleet, self.of, self.plans
        self.target = fleet.places(plans.X)
        self.force = torch.zeros_like(self.target)
        kept = fleet.distances.amax(-1)
        each = zip(fleet.members, plans.X, plans.U, strict=True)
        cost = torch.stack([one.take(of).cost.total(x, u) for one, x, u in each], dim=1)
        self.weight = stiffness(cost, kept, fleet.N)  # (C, V), until the responses are known
        self.live, self.near = torch.ones(len(of), dtype=torch.bool), torch.zeros(len(of), dtype=torch.bool)
        self.last: list[_Point | None] = [None] * len(of)
        self.history: list[list[float]] = [[] for _ in of]
        self.radius = kept.amax().repeat(len(of)) * WIDEST

    def run(self) -> Plans:
        """The plans of the last round."""
        for _ in range(ROUNDS):
            rows = self.live.nonzero().flatten()
            if len(rows) == 0 or self.late():
                break
            self._round(rows)
        return self.plans

    def _round(self, rows: Tensor) -> None:
        now, answers, springs = self._solved(rows)
        p = self.fleet.places(now.X)
        normals, gaps = between_two(p)
        needed = self.fleet.distances.unsqueeze(-1).expand(gaps.shape[1:])
        short = (needed - gaps).clamp(min=0.0).flatten(1)
        force = self.force[rows] + self.weight[rows][..., None, None] * (self.target[rows] - p)
        for i, c in enumerate(rows.tolist()):
            last, lacks = self.last[c], float(short[i].sum())
            if last is None or lacks < last.lacks:
                self.plans.put(rows[i : i + 1], now.take(torch.tensor([i])))
                self.radius[c] *= WIDER
                worst = float(short[i].amax() / needed.amax())
                self.near[c] = worst <= NEARLY
                if worst <= CLOSE:
                    self.live[c] = False
                    continue
                moved, balance = balancing_forces(normals[i], gaps[i], needed, force[i], answers[i], NEAR)
                balance = balance - springs[i][:, None, None] * moved  # the springs of these responses stay behind
                last = self.last[c] = _Point(lacks, p[i], force[i], moved, balance)
                own = 1.0 / answers[i].diagonal(dim1=-2, dim2=-1).mean(-1)
                self.weight[c] = torch.where((springs[i] > 0) | own.isnan(), self.weight[c], own)
            else:
                self.radius[c] *= NARROWER
            past = self.history[c]
            past.append(last.lacks)
            self.live[c] = len(past) <= PATIENCE or past[-1] <= LEFT * past[-1 - PATIENCE]
            self.live[c] &= self.radius[c] >= CLOSE * needed.amax()  # smaller steps bring nobody apart
            share = min(1.0, float(self.radius[c] / last.moved.norm(dim=-1).amax()))
            self.target[c] = last.p + share * last.moved
            self.force[c] = last.force + share * (last.balance - last.force)

    def _solved(self, rows: Tensor) -> tuple[Plans, Tensor, Tensor]:
        """What vehicles do under their forces, responses (c, V, N d, N d), and with which springs, (c, V)."""
        c, (V, K, d) = len(rows), self.target.shape[1:]
        now, answers = self.plans.take(rows), self.target.new_zeros(c, V, (K - 1) * d, (K - 1) * d)
        springs = self.target.new_zeros(c, V)
        for form, (_, whose) in zip(self.forms, self.fleet.forms, strict=True):
            bare = form.problem.take(torch.cat([place * self.fleet.B + self.of[rows] for place in range(len(whose))]))
            of_each = self.weight, self.force, self.target
            weight, force, target = (torch.cat([part[rows, v] for v in whose]) for part in of_each)
            X, U = (torch.cat([part[v][rows] for v in whose]) for part in (self.plans.X, self.plans.U))
            found = SOLVER.solve(under(bare, force, weight, target), U, X0=X)
            push = force + weight.view(-1, 1, 1) * (target - found.X[..., bare.position])
            answer, spring = responses(bare, found, push, weight)
            for place, v in enumerate(whose):
                at = place * c + torch.arange(c)
                now.set(v, torch.arange(c), found, at)
                self.plans.iterations[rows, v] += found.iterations[at]
                answers[:, v], springs[:, v] = answer[at], spring[at]
        return now, answers, springs


@dataclass
class _Point:
    """Where vehicles of a fleet are, and where forces would move them, as far as is known there."""

    lacks: float  # by how much all pairs are too close, m
    p: Tensor  # (V, K, d)
    force: Tensor
    moved: Tensor
    balance: Tensor  # (V, K, d), the forces that do
