"""Scenarios in the plane: disc obstacles for the planar vehicle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchgco.base.errors import InputError
from torchgco.scenarios import checks
from torchgco.scenarios.base import Family, equal_spheres, uniform_clear
from torchgco.scenarios.layouts import Layouts

# A cup that opens towards the start and stands on the straight line to the goal.
TRAP = ((0.0, -0.25), (0.1, 0.0), (0.12, 0.25), (0.0, 0.5), (-0.2, 0.6), (-0.2, -0.35))


@dataclass(frozen=True, kw_only=True)
class Planar(Family):
    """Base of the planar families: state n = 6 [p, theta, p', theta'], control m = 2 [a_left, a_right].

    control_lower, control_upper
        one number for both wheels, or one each, or None for the model's own. Without reversing (a lower bound
        of 0) waiting in a trap is cheaper than leaving it.
    """

    vehicle_radius: float = 0.06
    start: Sequence[float] = (-1.0, 0.0)
    goal: Sequence[float] = (1.0, 0.4)
    goal_radius: float = 0.3
    stages: int = 200
    dt: float = 0.05
    control_lower: float | Sequence[float] | None = -10.0
    control_upper: float | Sequence[float] | None = 10.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for field in ("control_lower", "control_upper"):
            value = getattr(self, field)
            if isinstance(value, int | float):
                object.__setattr__(self, field, (value, value))
            if value is not None:
                self._set(field, checks.vector, length=2)
        lower, upper = self.control_lower, self.control_upper
        if lower is not None and upper is not None and np.greater(lower, upper).any():
            raise InputError("scenario.control_lower", f"at most control_upper, {upper}", lower)

    @property
    def dimension(self) -> int:
        """2."""
        return 2

    def _at_rest(self, position: Sequence[float]) -> np.ndarray:
        return np.array([*position, 0.0, 0.0, 0.0, 0.0])

    def _layout(self, **obstacles: Any) -> Layouts:
        return super()._layout(control_lower=self.control_lower, control_upper=self.control_upper, **obstacles)


@dataclass(frozen=True, kw_only=True)
class PlanarTrap(Planar):
    """Discs at `centers` (M, 2) m, each coordinate jittered by N(0, jitter^2): a cup in front of the goal."""

    name: str = "planar_trap"
    obstacle_radius: float = 0.10
    centers: Sequence[Sequence[float]] = TRAP
    jitter: float = 0.03

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set("centers", checks.vectors, length=2)
        for field in ("obstacle_radius", "jitter"):
            self._set(field, checks.number, at_least=0)

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        centers = np.array(self.centers)
        centers = centers + self.jitter * rng.standard_normal(centers.shape)
        return self._layout(**equal_spheres(centers, self.obstacle_radius))


@dataclass(frozen=True, kw_only=True)
class PlanarRandom(Planar):
    """`num_obstacles` discs, centres uniform in `region` (2 pairs [low, high], m), which may overlap.

    A centre is redrawn until it is more than `start_clearance` from the start and `goal_clearance` from the
    goal, m.
    """

    name: str = "planar_random"
    obstacle_radius: float = 0.08
    num_obstacles: int = 15
    region: Sequence[Sequence[float]] = ((-0.8, 0.9), (-0.8, 0.9))
    start_clearance: float = 0.22
    goal_clearance: float = 0.19

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set("num_obstacles", checks.integer, at_least=0, at_most=checks.MOST_OBSTACLES)
        self._set("region", checks.box, dimension=2)
        for field in ("obstacle_radius", "start_clearance", "goal_clearance"):
            self._set(field, checks.number, at_least=0)

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        clear = ((self.start, self.start_clearance), (self.goal, self.goal_clearance))
        centers = uniform_clear(rng, self.region, self.num_obstacles, clear)
        return self._layout(**equal_spheres(centers, self.obstacle_radius))
