"""Trajectories of all vehicles of fleets, as planning hands them on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.base.status import Status
from torchgco.fleets.fleet import Fleet
from torchgco.fleets.verdict import FleetVerdict
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.problem.problem import Problem
from torchgco.solution import Solution

Solve = Callable[..., Solution]


@dataclass
class Plans:
    """A trajectory per vehicle, of B fleets."""

    X: list[Tensor]  # (B, N+1, n) of each vehicle
    U: list[Tensor]  # (B, N, m)
    K: list[Tensor]  # (B, N, m, n)
    status: Tensor  # (B, V) int64
    iterations: Tensor  # (B, V) int64, of all solves

    @classmethod
    def at_rest(cls, fleet: Fleet) -> Plans:
        """Nobody moves."""
        B, V, N, like = fleet.B, fleet.V, fleet.N, fleet.members[0].x0
        X = [one.x0.unsqueeze(1).repeat(1, N + 1, 1) for one in fleet.members]
        U = [like.new_zeros(B, N, one.m) for one in fleet.members]
        K = [like.new_zeros(B, N, one.m, one.n) for one in fleet.members]
        number = torch.full((B, V), int(Status.MAX_ITERATIONS), dtype=torch.int64, device=like.device)
        return cls(X, U, K, number, torch.zeros_like(number))

    def take(self, rows: Tensor) -> Plans:
        """Those of some fleets."""
        X, U, K = ([part[rows] for part in parts] for parts in (self.X, self.U, self.K))
        return Plans(X, U, K, self.status[rows], self.iterations[rows])

    def put(self, rows: Tensor, other: Plans) -> None:
        """Those of other fleets in the place of some."""
        for mine, theirs in ((self.X, other.X), (self.U, other.U), (self.K, other.K)):
            for part, new in zip(mine, theirs, strict=True):
                part[rows] = new
        self.status[rows], self.iterations[rows] = other.status, other.iterations

    def set(self, v: int, rows: Tensor, found: Solution, of: Tensor) -> None:
        """Vehicle v of some fleets: the trajectories at places `of` of a solution."""
        self.X[v][rows], self.U[v][rows], self.K[v][rows] = found.X[of], found.U[of], found.K[of]
        self.status[rows, v] = found.status[of]

    def solutions(self, fleet: Fleet, verdict: FleetVerdict, late: bool = False) -> tuple[Solution, ...]:
        """A solution per vehicle, without multipliers; each status says whether constraints and distances are kept.

        Args:
            late: whether time has ended the solve.
        """
        good = torch.stack([one.feasible for one in verdict.vehicles], dim=1) & verdict.apart
        claims = torch.isin(self.status, torch.tensor([Status.CONVERGED, Status.FEASIBLE]))
        self.status = torch.where(good & ~claims & (not late), int(Status.FEASIBLE), self.status)
        lost = Status.TIME_LIMIT if late else Status.INFEASIBLE
        self.status = torch.where(~good & claims, int(lost), self.status)
        return tuple(self._solution(v, one) for v, one in enumerate(fleet.members))

    def _solution(self, v: int, one: Problem) -> Solution:
        X, U = self.X[v], self.U[v]
        violation = torch.stack([X.new_zeros(one.B), *(part.worst(X, U) for part in one.constraints)]).amax(0)
        none, status = torch.zeros_like(self.status[:, v]), self.status[:, v]
        return Solution(
            X, U, self.K[v], torch.zeros_like(U), Multipliers.zero(one, 1.0), one.cost.total(X, U), violation, status,
            self.iterations[:, v], none, none,
        )  # fmt: skip
