"""Scenarios in space for the quadrotor's planning model: spheres, resting, moving and in walls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.options import Within
from torchgco.scenarios import checks
from torchgco.scenarios.base import Family, equal_spheres, uniform_clear
from torchgco.scenarios.layouts import Layouts

PLANNING_STATES = 14  # [p, v, q, w, a]
MOST_HOLES = 1000  # in a wall


@dataclass(frozen=True, kw_only=True)
class Quadrotor(Family):
    """Base of the quadrotor families: positions of start and goal.

    What a vehicle is like at rest there, and its control bounds, are the model's: a hovering thrust depends on g.
    """

    vehicle_radius: checks.Length = 0.36
    start: checks.Point3 = (-1.0, 1.0, 0.0)
    goal: checks.Point3 = (20.0, 1.0, 0.2)
    goal_radius: checks.Size = 2.0
    stages: checks.Stages = 100
    dt: checks.TimeStep = 0.05

    @property
    def states(self) -> int:
        """n of the model that flies among them."""
        return PLANNING_STATES


@dataclass(frozen=True, kw_only=True)
class Forest(Quadrotor):
    """Spheres with centres uniform in a region, which may overlap.

    Args:
        obstacle_radius: m.
        num_obstacles: how many.
        density: per m^3 of the region; if given, num_obstacles is the nearest whole number that it implies.
        region: 3 pairs [low, high], m.
        clearance: a centre is redrawn until it is more than this from start and goal, m.
    """

    name: str = "forest"
    obstacle_radius: checks.Length = 0.60
    num_obstacles: checks.Number = 30
    density: checks.Density | None = None
    region: checks.Region3 = ((2.0, 16.0), (-1.0, 3.0), (-1.0, 1.0))
    clearance: checks.Length = 1.26

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.obstacle_count > checks.MOST_OBSTACLES:
            expected = f"at most {checks.MOST_OBSTACLES} obstacles in scenario.region"
            raise InputError("scenario.density", expected, f"{self.density}, which makes {self.obstacle_count}")

    @property
    def obstacle_count(self) -> int:
        """M, from density where it is given, else num_obstacles."""
        if self.density is None:
            return self.num_obstacles
        return round(self.density * float(np.prod([high - low for low, high in self.region])))

    def _centers(self, rng: np.random.Generator) -> np.ndarray:
        clear = ((self.start, self.clearance), (self.goal, self.clearance))
        return uniform_clear(rng, self.region, self.obstacle_count, clear)

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        return self._layout(**equal_spheres(self._centers(rng), self.obstacle_radius))


@dataclass(frozen=True, kw_only=True)
class ForestMoving(Forest):
    """A forest whose spheres move, each in a random horizontal direction at a constant velocity.

    At the first instant it is the Forest of the same seed and number.

    Args:
        speed, slowest: the largest and the smallest speed, m/s; speeds are uniform between them.
    """

    name: str = "forest_moving"
    speed: checks.Speed = 1.0
    slowest: checks.Speed = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.slowest > self.speed:
            raise InputError("scenario.slowest", f"at most scenario.speed, {self.speed} m/s", self.slowest)

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        centers = self._centers(rng)
        speed = rng.uniform(self.slowest, self.speed, len(centers))
        heading = rng.uniform(-np.pi, np.pi, len(centers))
        direction = np.column_stack([np.cos(heading), np.sin(heading), np.zeros(len(centers))])
        spheres = equal_spheres(centers, self.obstacle_radius)
        return self._layout(**spheres, velocities=(speed[:, None] * direction)[None])


@dataclass(frozen=True, kw_only=True)
class Walls(Quadrotor):
    """Walls of spheres between start and goal, with round holes at random places.

    M is the size of the full grids in every layout (absent spheres last), so it never depends on the draw.

    Args:
        obstacle_radius: m.
        positions: x of each wall, m.
        extent: [[low, high] in y, [low, high] in z] of the grid of centres, which starts at the low ends, m.
        pitch: distance between neighbours on the grid, m.
        holes: holes in each wall.
        hole_radius: spheres nearer than this to a hole, centre to centre in the wall's plane, are left out, m.
        hole_region: box [[y], [z]] in which the centres of holes are uniform, m.
    """

    name: str = "walls"
    obstacle_radius: checks.Length = 0.60
    stages: checks.Stages = 160
    positions: Sequence[checks.Coordinate] = (7.0, 13.0)
    extent: checks.Region2 = ((-5.0, 7.0), (-3.0, 3.0))
    pitch: checks.Size = 0.9
    holes: Annotated[int, Within(0, MOST_HOLES)] = 1
    hole_radius: checks.Length = 1.5
    hole_region: checks.Region2 = ((-1.5, 3.5), (-1.0, 1.0))

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.positions:
            raise InputError("scenario.positions", "at least one wall", "none")
        steps = [(high - low) / self.pitch + 1 for low, high in self.extent]
        if len(self.positions) * steps[0] * steps[1] > checks.MOST_OBSTACLES:
            expected = f"grids of at most {checks.MOST_OBSTACLES} spheres in scenario.extent"
            raise InputError("scenario.pitch", expected, self.pitch)

    def _grid(self) -> np.ndarray:
        """Centres in the plane of a wall, (G, 2): all z for each y."""
        # The small addition keeps an end that a whole number of pitches reaches up to rounding.
        steps = [int((high - low) / self.pitch + 1e-9) for low, high in self.extent]
        y, z = (low + self.pitch * np.arange(n + 1) for n, (low, _) in zip(steps, self.extent, strict=True))
        return np.stack(np.meshgrid(y, z, indexing="ij"), axis=-1).reshape(-1, 2)

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        grid = self._grid()
        low, high = np.array(self.hole_region).T
        standing = []
        for x in self.positions:
            holes = rng.uniform(low, high, (self.holes, 2))
            distance = np.linalg.norm(grid[:, None] - holes, axis=2)
            wall = grid[(distance >= self.hole_radius).all(axis=1)]
            standing.append(np.column_stack([np.full(len(wall), x), wall]))
        centers = np.full((len(self.positions) * len(grid), 3), np.nan)
        present = np.concatenate(standing)
        centers[: len(present)] = present
        return self._layout(**equal_spheres(centers, self.obstacle_radius))
