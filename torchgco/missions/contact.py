"""Contact: how far the vehicles of missions are from touching the obstacles, of any kind, at rest or moving.

Distances are the judge's, which no solver shares, so that a planner that measures wrongly is found out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.tree import PerElement
from torchgco.dynamics.quadrotor import Airframe
from torchgco.missions.planning_problem import airframe_of, planning_state
from torchgco.obstacles.base import ADMITTED, TOUCH, Obstacles
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
        maps = [solid.map is not None for solid in solids]  # flown at 0.95 of the radius, too
        shrunk = (solid.grown(ADMITTED - TOUCH * solid.vehicle_radius) for solid in solids)
        solids = tuple(less if is_map else solid for less, is_map, solid in zip(shrunk, maps, solids, strict=True))
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
