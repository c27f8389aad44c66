"""Scenarios in the plane: disc obstacles for the planar vehicle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.options import Within
from torchgco.scenarios import checks
from torchgco.scenarios.base import Family, equal_spheres, uniform_clear
from torchgco.scenarios.layouts import Layouts

# A cup that opens towards the start and stands on the straight line to the goal.
TRAP = ((0.0, -0.25), (0.1, 0.0), (0.12, 0.25), (0.0, 0.5), (-0.2, 0.6), (-0.2, -0.35))


Bound = Annotated[float, Within(-checks.TOO_LARGE, checks.TOO_LARGE, "m/s^2")]


@dataclass(frozen=True, kw_only=True)
class Planar(Family):
    """Base of the planar families: state n = 6 [p, theta, p', theta'], control m = 2 [a_left, a_right].

    Args:
        control_lower, control_upper: one number for both wheels, or one each, m/s^2, or None for the model's own.
            Without reversing (a lower bound of 0) waiting in a trap is cheaper than leaving it.
    """

    vehicle_radius: checks.Length = 0.06
    start: checks.Point2 = (-1.0, 0.0)
    goal: checks.Point2 = (1.0, 0.4)
    goal_radius: checks.Size = 0.3
    stages: checks.Stages = 200
    dt: checks.TimeStep = 0.05
    control_lower: Bound | tuple[Bound, Bound] | None = -10.0
    control_upper: Bound | tuple[Bound, Bound] | None = 10.0

    zeros: ClassVar[int] = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        for field in ("control_lower", "control_upper"):
            value = getattr(self, field)
            if isinstance(value, int | float):
                object.__setattr__(self, field, (value, value))
        lower, upper = self.control_lower, self.control_upper
        if lower is not None and upper is not None and np.greater(lower, upper).any():
            raise InputError("scenario.control_lower", f"at most control_upper, {upper}", lower)

    def _layout(self, **obstacles: Any) -> Layouts:
        return super()._layout(control_lower=self.control_lower, control_upper=self.control_upper, **obstacles)


@dataclass(frozen=True, kw_only=True)
class PlanarTrap(Planar):
    """Discs at fixed places, each coordinate jittered: a cup in front of the goal.

    Args:
        obstacle_radius: m.
        centers: (M, 2), m.
        jitter: standard deviation of each coordinate, m.
    """

    name: str = "planar_trap"
    obstacle_radius: checks.Length = 0.10
    centers: Sequence[checks.Point2] = TRAP
    jitter: checks.Length = 0.03

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.centers:
            raise InputError("scenario.centers", "at least one disc", "none")

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        centers = np.array(self.centers)
        centers = centers + self.jitter * rng.standard_normal(centers.shape)
        return self._layout(**equal_spheres(centers, self.obstacle_radius))


@dataclass(frozen=True, kw_only=True)
class PlanarRandom(Planar):
    """Discs with centres uniform in a region, which may overlap.

    Args:
        obstacle_radius: m.
        num_obstacles: how many.
        region: 2 pairs [low, high], m.
        start_clearance, goal_clearance: a centre is redrawn until it is more than this from start and goal, m.
    """

    name: str = "planar_random"
    obstacle_radius: checks.Length = 0.08
    num_obstacles: checks.Number = 15
    region: checks.Region2 = ((-0.8, 0.9), (-0.8, 0.9))
    start_clearance: checks.Length = 0.22
    goal_clearance: checks.Length = 0.19

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        clear = ((self.start, self.start_clearance), (self.goal, self.goal_clearance))
        centers = uniform_clear(rng, self.region, self.num_obstacles, clear)
        return self._layout(**equal_spheres(centers, self.obstacle_radius))
