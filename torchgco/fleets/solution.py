"""What is found for a fleet: a solution per vehicle, and what only all of them together have."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchgco.base.status import Status
from torchgco.dynamics.rollout import open_loop
from torchgco.fleets.fleet import Fleet
from torchgco.fleets.plans import Plans
from torchgco.fleets.verdict import FleetVerdict, judge_fleet
from torchgco.problem.problem import Problem
from torchgco.solution import Solution


@dataclass(frozen=True)
class FleetSolution:
    """A `Solution` per vehicle, each of B problems: problem b of all of them is fleet b. It has the length V."""

    fleet: Fleet
    vehicles: tuple[Solution, ...]
    verdict: FleetVerdict

    @classmethod
    def of(cls, fleet: Fleet, U: Sequence[Tensor]) -> FleetSolution:
        """What controls (B, N, m) of each vehicle lead to; statuses say FEASIBLE or MAX_ITERATIONS."""
        plans = Plans.at_rest(fleet)
        plans.U = list(U)
        plans.X = [open_loop(one.dynamics, one.x0, u) for one, u in zip(fleet.members, U, strict=True)]
        verdict = judge_fleet(fleet, U)
        return cls(fleet, plans.solutions(fleet, verdict), verdict)

    def __len__(self) -> int:
        return len(self.vehicles)

    def __getitem__(self, v: int) -> Solution:
        return self.vehicles[v]

    def __iter__(self) -> Iterator[Solution]:
        return iter(self.vehicles)

    @property
    def cost(self) -> Tensor:
        """The sum of the vehicles' costs, (B,)."""
        return self.verdict.cost

    @property
    def least_distance(self) -> Tensor:
        """The smallest distance of two centres that keep one, between the knots too, (B,), m."""
        return self.verdict.least_distance

    @property
    def status(self) -> Tensor:
        """A status for each fleet, (B,): CONVERGED or FEASIBLE where all vehicles are, else that of the first other."""
        every = torch.stack([one.status for one in self.vehicles], dim=1)
        lost = (every != int(Status.CONVERGED)) & (every != int(Status.FEASIBLE))
        first = every.gather(1, lost.long().argmax(1, keepdim=True)).squeeze(1)
        good = torch.where((every == int(Status.CONVERGED)).all(1), int(Status.CONVERGED), int(Status.FEASIBLE))
        return torch.where(lost.any(1), first, good)

    @property
    def makespan(self) -> Tensor:
        """When the last vehicle comes to stay at its goal, (B,), s; NaN where one doesn't, or states no goal."""
        return self.verdict.makespan

    @property
    def sound(self) -> Tensor:
        """Whether all vehicles are feasible and apart, and have reached the goals that they state, (B,)."""
        return self.verdict.reached

    def arrays(self) -> tuple[Sequence[Problem], list[np.ndarray], list[np.ndarray], np.ndarray]:
        """Problems, X (B, N+1, n) and U (B, N, m) of each vehicle, and what pairs keep, (V, V): for pictures."""
        X, U = ([getattr(one, name).detach().numpy() for one in self.vehicles] for name in ("X", "U"))
        return self.fleet.members, X, U, self.fleet.distances.numpy()

    def __repr__(self) -> str:
        B, V = self.fleet.B, self.fleet.V
        good, cost = int(self.sound.sum()), self.cost[torch.isfinite(self.cost)].tolist()
        costs = " to ".join(f"{value:g}" for value in dict.fromkeys([min(cost), max(cost)])) if cost else "unknown"
        return f"FleetSolution(B={B}, V={V}: {good} sound; cost {costs})"
