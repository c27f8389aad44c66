"""What flights are judged by while they last: how far vehicles are from contact, and the gates that they have passed.

Distances are the judge's, which no solver shares, so that a planner that measures wrongly is found out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.tree import PerElement
from torchgco.constraints.gates import GateBalls, gates_of
from torchgco.dynamics.quadrotor import Airframe
from torchgco.judging.gates import through_balls
from torchgco.missions.planning_problem import airframe_of, planning_state
from torchgco.obstacles.base import ADMITTED, TOUCH, Obstacles
from torchgco.obstacles.measured import segment_distance
from torchgco.problem.problem import Problem


@dataclass(frozen=True)
class Contact(PerElement):
    """The obstacles of B planning problems, as vehicles touch them: at CONTACT_FACTOR of the full radii.

    A constraint that is given as a function has no distance and is left out, as by the judge. Vehicles are given by the
    plants' states x (B, ..., 17), from which a `Body` has its attitude; where all are balls, positions (B, ..., 3) do.
    """

    obstacles: tuple[Any, ...]  # as at time 0
    airframe: Airframe | None = None  # of vehicles with a body

    batched: ClassVar[tuple[str, ...]] = ("obstacles",)

    @classmethod
    def among(cls, problem: Problem) -> Self:
        """The obstacles among a problem's constraints.

        Raises:
            InputError: obstacles of a kind that can't be judged.
        """
        solids = tuple(solid for solid in problem.constraints if isinstance(solid, Obstacles))
        for solid in solids:
            if type(solid).measured is Obstacles.measured:
                raise InputError("constraints", "obstacles that say their distances, `measured`", type(solid).__name__)
        less = lambda solid: solid.grown(ADMITTED - TOUCH * solid.vehicle_radius)
        solids = tuple(solid if solid.map is None else less(solid) for solid in solids)  # maps at 0.95 of it, too
        return cls(solids, airframe_of(problem.dynamics) if any(solid.body is not None for solid in solids) else None)

    @property
    def moving(self) -> bool:
        """Whether any obstacle moves."""
        return any(obstacle.moving for obstacle in self.obstacles)

    def distance(self, x: Tensor, t: float) -> Tensor:
        """Smallest distances (B,), m, of vehicles at x (B, 17) at time t, s: negative in contact.

        Infinite where there is no obstacle.
        """
        return self._nearest(torch.stack((x, x), dim=1), t, 0.0)

    def distances(self, x: Tensor, dt: float) -> Tensor:
        """The same (B, K) of vehicles at x (B, K, 17) at times k dt, s."""
        by_time = [self.distance(x[:, k], k * dt) for k in range(x.shape[1])]
        return torch.stack(by_time, dim=1) if by_time else x[..., 0]

    def along(self, x: Tensor, dt: float) -> Tensor:
        """Smallest distances (B,) on the ways between x (B, K, 17), K above 0, at times k dt, s.

        Positions move straight from one to the next; a body turns evenly, see `BoundBody.clearances`.
        """
        return self._nearest(x, 0.0, dt) if x.shape[1] > 1 else self.distance(x[:, 0], 0.0)

    def clear(self, problem: Problem, x: Tensor) -> Tensor:
        """Whether vehicles touch nothing that hover at x (B, 17) at a problem's starts, (B,) bool."""
        return problem.start_is_clear if self.airframe is None else self.distance(x, 0.0) >= 0

    def moved(self, before: Tensor, now: Tensor) -> Tensor:
        """How far (B,), m, the part of the vehicle that moved farthest is from where it was: of x (B, 17) each."""
        farthest = (now[..., :3] - before[..., :3]).norm(dim=-1)
        for obstacle in self.obstacles:
            if obstacle.body is not None:
                a, b = (obstacle.places(self._planning(x)) for x in (before, now))
                farthest = torch.maximum(farthest, (b - a).norm(dim=-1).amax(-1))
        return farthest

    def _nearest(self, x: Tensor, t: float, dt: float) -> Tensor:
        p, nearest = x[..., :3].contiguous(), torch.full_like(x[:, 0, 0], torch.inf)
        for obstacle in self.obstacles:
            now = obstacle.later(t).with_step(dt) if obstacle.moving else obstacle
            X = p if obstacle.body is None else self._planning(x)
            nearest = torch.minimum(nearest, now.clearances(X)[1])
        return nearest

    def _planning(self, x: Tensor) -> Tensor:
        """The states of the planning model, of which a body's attitude is a function."""
        if x.shape[-1] == 3 or self.airframe is None:
            raise InputError("x", "states (..., 17) of a vehicle with a Body", "positions alone")
        return planning_state(x, self.airframe)


@dataclass(frozen=True)
class Passing(PerElement):
    """The gates of B problems, balls with centers (B, G, 3) and radii (B, G), m, and how many are passed, (B,) int64.

    A gate is passed where the straight line from one sample to the next comes within its radius, and a millimetre, once
    all gates before it have been.
    """

    centers: Tensor
    radii: Tensor
    passed: Tensor

    batched: ClassVar[tuple[str, ...]] = ("centers", "radii", "passed")

    @classmethod
    def among(cls, problem: Problem) -> Self | None:
        """Those of the problems, none of them passed; None without gates.

        Raises:
            InputError: gates that are squares.
        """
        gates = gates_of(problem)
        if gates is None:
            return None
        if not isinstance(gates, GateBalls):
            raise InputError("gates.normals", "balls as gates of a mission", "squares")
        return cls(gates.centers, gates.sizes, torch.zeros_like(gates.sizes[:, 0], dtype=torch.int64))

    @property
    def done(self) -> Tensor:
        """Whether all gates are passed, (B,) bool."""
        return self.passed == self.radii.shape[1]

    def after(self, a: Tensor, b: Tensor) -> Tensor:
        """How many are passed after straight lines from a to b (B, 3), m; (B,) int64."""
        passed, each = self.passed.clone(), torch.arange(len(self.passed))
        for _ in range(self.radii.shape[1]):
            next_gate = passed.clamp(max=self.radii.shape[1] - 1)
            center, reach = self.centers[each, next_gate], self.radii[each, next_gate] + ADMITTED
            more = (segment_distance(a - center, b - center) <= reach) & (passed < self.radii.shape[1])
            if not bool(more.any()):
                break
            passed += more
        return passed

    def along(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """A flight along samples p (T, 3) of the first problem: when, and how closely, it passes its gates.

        Returns:
            The sample by which each gate is passed, (G,) int64, T for those that aren't; and the least distance from
            its middle on the way through it, m, or until the end; infinite for those after a gate that isn't passed.
        """
        G, T = self.radii.shape[1], len(p)
        if T < 2:
            return torch.full((G,), T), torch.full((G,), torch.inf, dtype=p.dtype)
        way = through_balls(self.centers[:1], self.radii[:1], p.unsqueeze(0))
        return way.when[0], way.distance[0]
