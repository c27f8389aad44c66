"""Crossing: spheres that fly through the corridor between start and goal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchgco.base.errors import InputError
from torchgco.scenarios import checks
from torchgco.scenarios.base import MAX_DRAWS, equal_spheres
from torchgco.scenarios.layouts import Layouts
from torchgco.scenarios.quadrotor import Quadrotor


@dataclass(frozen=True, kw_only=True)
class Crossing(Quadrotor):
    """Spheres that each pass a random point of the corridor at a random time, horizontally and at constant velocity.

    The times are uniform over the horizon and the headings over the circle.

    Args:
        obstacle_radius: m.
        num_obstacles: how many.
        corridor: box in which the points are uniform: 3 pairs [low, high], m.
        speeds: [least, largest], uniform, m/s.
        clearance: a sphere is redrawn until it stays farther than this from the start for `grace` s, m.
        grace: s; before, the vehicle can hardly have left.
    """

    name: str = "crossing"
    obstacle_radius: checks.Length = 0.60
    num_obstacles: checks.Number = 10
    corridor: checks.Region3 = ((1.0, 18.0), (-1.0, 3.0), (-1.0, 1.0))
    speeds: checks.Speeds = (1.0, 4.0)
    clearance: checks.Length = 1.26
    grace: checks.Duration = 1.0
    stages: checks.Stages = 160

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        centers, velocities = self._movers(rng, self.num_obstacles)
        for _ in range(MAX_DRAWS):
            near = self._near(centers, velocities)
            if not near.any():
                return self._layout(**equal_spheres(centers, self.obstacle_radius), velocities=velocities[None])
            centers[near], velocities[near] = self._movers(rng, int(near.sum()))
        raise InputError(
            "scenario.clearance",
            f"room for {self.num_obstacles} spheres that stay {self.clearance:g} m from the start for {self.grace:g} s",
            f"none in {MAX_DRAWS} draws",
        )

    def _movers(self, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
        """First places (count, 3), m, and velocities (count, 3), m/s."""
        low, high = np.array(self.corridor).T
        point = rng.uniform(low, high, (count, 3))
        time = rng.uniform(0.0, self.stages * self.dt, (count, 1))
        speed = rng.uniform(self.speeds[0], self.speeds[1], (count, 1))
        heading = rng.uniform(-np.pi, np.pi, count)
        velocity = speed * np.column_stack([np.cos(heading), np.sin(heading), np.zeros(count)])
        return point - time * velocity, velocity

    def _near(self, centers: np.ndarray, velocities: np.ndarray) -> np.ndarray:
        """Whether spheres come near the start within the time of grace, (count,)."""
        away = np.asarray(self.start) - centers
        square = np.maximum((velocities**2).sum(1), 1e-12)
        time = np.clip((away * velocities).sum(1) / square, 0.0, self.grace)
        return np.linalg.norm(away - time[:, None] * velocities, axis=1) <= self.clearance
