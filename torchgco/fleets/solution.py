"""What is found for a fleet: a solution per vehicle, and what only all of them together have."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from torch import Tensor

from torchgco.fleets.fleet import Fleet
from torchgco.fleets.verdict import FleetVerdict
from torchgco.solution import Solution


@dataclass(frozen=True)
class FleetSolution:
    """A `Solution` per vehicle, each of B problems: problem b of all of them is fleet b. It has the length V."""

    fleet: Fleet
    vehicles: tuple[Solution, ...]
    verdict: FleetVerdict

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
    def makespan(self) -> Tensor:
        """When the last vehicle comes to stay at its goal, (B,), s; NaN where one doesn't, or states no goal."""
        return self.verdict.makespan

    @property
    def sound(self) -> Tensor:
        """Whether all vehicles are feasible and apart, and have reached the goals that they state, (B,)."""
        return self.verdict.reached

    def __repr__(self) -> str:
        B, V = self.fleet.B, self.fleet.V
        good, cost = int(self.sound.sum()), self.cost
        costs = f"{float(cost.min()):g} to {float(cost.max()):g}" if B > 1 else f"{float(cost[0]):g}"
        return f"FleetSolution(B={B}, V={V}: {good} sound; cost {costs})"
