"""Scenes in which obstacles move on known ways: traffic, walkers, gates that slide and turn, belts, a swarm.

A layout is drawn again until a point gets through at a given pace (`passable`), from rest and to rest: so there is a
way for a vehicle that turns and brakes quickly. Nothing is guaranteed of slower ones.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.options import INCREASING, Above, AtMost, Share, Within
from torchgco.scenarios import checks
from torchgco.scenarios.base import Family
from torchgco.scenarios.crossing import Crossing
from torchgco.scenarios.layouts import Layouts
from torchgco.scenarios.passable import way_through

TRIES = 200  # draws of a layout, before an InputError
FRAME = 0.3  # m, thickness of the walls around a region
Some = Annotated[int, Within(1, 1000)]
Rate = Annotated[float, Above(0, "rad/s"), AtMost(100, "rad/s")]


def drawn_with_a_way(family: Any, draw: Any, region: Sequence[Sequence[float]]) -> Layouts:
    """The first layout of `draw()` that a point gets through, by the fields of a family.

    Raises:
        InputError: none in `TRIES` draws.
    """
    for _ in range(TRIES):
        layout = draw()
        if way_through(layout, region, family.pace, family.room, family.grace, family.cell) is not None:
            return layout
    expected = f"layouts that a point gets through at this pace, keeping {family.room:g} m, in {family.stages} stages"
    raise InputError("scenario.pace", expected, f"{family.pace:g} m/s: none in {TRIES} draws")


@dataclass(frozen=True, kw_only=True)
class AmongMovers(Family):
    """Base of the families in the plane: positions alone, so that any model moves there, and walls around `region`.

    Args:
        region: 2 pairs [low, high], m, with walls around it.
        pace: the speed at which a point has to get through, m/s.
        room: how much it keeps clear beyond the vehicle's radius, m.
        grace: how long it rests at the start first, and at the goal in the end, s.
        cell: side of the cells on which its way is sought, m.
    """

    vehicle_radius: checks.Length = 0.2
    start: checks.Point2 = (0.0, 0.0)
    goal: checks.Point2 = (6.4, 0.0)
    goal_radius: checks.Size = 0.3
    stages: checks.Stages = 160
    dt: checks.TimeStep = 0.1
    region: checks.Region2 = ((-1.0, 7.4), (-2.4, 2.4))
    pace: checks.Pace = 0.9
    room: checks.Length = 0.08
    grace: checks.Duration = 1.0
    cell: checks.Size = 0.2

    @property
    def states(self) -> None:  # type: ignore[override]
        """None: the vehicle says what it is like at rest."""
        return

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        return drawn_with_a_way(self, lambda: self._layout(**self._obstacles(rng)), self.region)

    @abstractmethod
    def _obstacles(self, rng: np.random.Generator) -> dict[str, Any]:
        """The fields of Layouts for the obstacles of one draw."""

    def _wall(self, x: float, y: float, opening: float, thickness: float = 0.2) -> list[Box]:
        """A wall across the region at x with an opening about y, m."""
        low, high = self.region[1]
        ends = (low, y - 0.5 * opening), (y + 0.5 * opening, high)
        return [Box((x, 0.5 * (a + b)), (0.5 * thickness, 0.5 * (b - a))) for a, b in ends if b > a]

    def _boxes(self, inside: Sequence[Box], moving: bool = False) -> dict[str, Any]:
        """The fields of Layouts for boxes inside of the region, and the walls around it."""
        (x, y), ends = np.array(self.region), 0.5 * FRAME
        mid = x.mean(), y.mean()
        half = 0.5 * np.ptp(x) + FRAME, 0.5 * np.ptp(y)
        level = [Box((mid[0], side + sign * ends), (half[0], ends)) for side, sign in zip(y, (-1, 1), strict=True)]
        upright = [Box((side + sign * ends, mid[1]), (ends, half[1])) for side, sign in zip(x, (-1, 1), strict=True)]
        boxes = [*inside, *level, *upright]
        found = {
            "box_centers": np.array([[box.center for box in boxes]], np.float64),
            "box_half_sizes": np.array([[box.half for box in boxes]], np.float64),
            "box_radii": np.array([[box.radius for box in boxes]]),
        }
        if moving:
            for name in ("amplitudes", "rates", "phases"):
                found[f"box_{name}"] = np.array([[[getattr(box, name)] for box in boxes]], np.float64)
        return found

    def _count(self, speed: float, gap: float) -> int:
        """How many discs, a gap apart, keep a lane from being empty."""
        low, high = self.region[1]
        return int((speed * self.stages * self.dt + high - low) / gap) + 3

    def _lane(self, rng: np.random.Generator, speed: float, side: float, gap: float) -> tuple[np.ndarray, float]:
        """Along y: where the discs of a lane are at first, and their velocity."""
        low, high = self.region[1]
        along = rng.uniform(0.0, gap) + gap * np.arange(self._count(speed, gap))
        return 0.5 * (low + high) + side * (0.5 * (high - low) + gap - along), side * speed


@dataclass(frozen=True)
class Box:
    """A box, m, that swings: center + amplitudes sin(rates t + phases)."""

    center: tuple[float, float]
    half: tuple[float, float]
    radius: float = 0.0
    amplitudes: tuple[float, float] = (0.0, 0.0)
    rates: tuple[float, float] = (0.0, 0.0)
    phases: tuple[float, float] = (0.0, 0.0)


def _spheres(parts: Sequence[tuple[float, np.ndarray, float, float]], most: int) -> dict[str, np.ndarray]:
    """The fields of Layouts for lanes at x: places along y, velocity along y, and radius; NaN up to `most` discs."""
    x, y, v, radii = (np.concatenate([np.broadcast_to(part[i], len(part[1])) for part in parts]) for i in (0, 1, 2, 3))
    rows = np.full((1, most, 5), np.nan)
    rows[0, : len(y)] = np.stack((x, y, radii, np.zeros_like(v), v), axis=-1)
    return {"centers": rows[..., :2], "radii": rows[..., 2], "velocities": rows[..., 3:]}


@dataclass(frozen=True, kw_only=True)
class Traffic(AmongMovers):
    """Lanes of discs that cross the way, each at a speed and with gaps of its own.

    Args:
        lanes: x of each, m.
        speeds: [least, largest], uniform, m/s; the direction is drawn, too.
        radii: [least, largest], uniform for a lane, m.
        gaps: [least, largest] room between two discs beyond what the vehicle fills, uniform for a lane, m.
    """

    name: str = "traffic"
    lanes: Sequence[checks.Coordinate] = (1.4, 3.2, 5.0)
    speeds: checks.Speeds = (0.3, 0.8)
    radii: checks.Sizes = (0.35, 0.45)
    gaps: checks.Sizes = (0.6, 1.2)

    def _obstacles(self, rng: np.random.Generator) -> dict[str, Any]:
        parts = []
        for x in self.lanes:
            speed, radius, gap = (rng.uniform(*limits) for limits in (self.speeds, self.radii, self.gaps))
            y, v = self._lane(rng, speed, rng.choice((-1.0, 1.0)), 2.0 * (radius + self.vehicle_radius) + gap)
            parts.append((x, y, v, radius))
        narrowest = 2.0 * (self.radii[0] + self.vehicle_radius) + self.gaps[0]
        return _spheres(parts, len(self.lanes) * self._count(self.speeds[1], narrowest)) | self._boxes(())


@dataclass(frozen=True, kw_only=True)
class Conveyor(AmongMovers):
    """Belts of discs so close together that the vehicle passes only where some are missing.

    Args:
        belts: x of each, m.
        speeds: [least, largest], uniform, m/s; the direction is drawn, too.
        radius: of the discs, m.
        missing: share of them.
    """

    name: str = "conveyor"
    belts: Sequence[checks.Coordinate] = (1.4, 3.2, 5.0)
    speeds: checks.Speeds = (0.2, 0.6)
    radius: checks.Size = 0.45
    missing: Share = 0.3

    def _obstacles(self, rng: np.random.Generator) -> dict[str, Any]:
        parts = []
        gap = 2.0 * self.radius + self.vehicle_radius
        for x in self.belts:
            y, v = self._lane(rng, rng.uniform(*self.speeds), rng.choice((-1.0, 1.0)), gap)
            there = rng.random(len(y)) >= self.missing
            parts.append((x, y[there], v, self.radius))
        return _spheres(parts, len(self.belts) * self._count(self.speeds[1], gap)) | self._boxes(())


@dataclass(frozen=True, kw_only=True)
class Walkers(AmongMovers):
    """A room with two walls, a door in each, and walkers that go straight on, through walls too.

    Each passes a random point of the room at a random time.

    Args:
        num_obstacles: how many walkers.
        obstacle_radius: of each, m.
        speeds: [least, largest], uniform, m/s.
        walls: x of each, m.
        door: how wide a door is; its middle is uniform in the wall, m.
        clearance: a walker is redrawn until it stays farther than this from the start for `grace` s, m.
    """

    name: str = "walkers"
    start: checks.Point2 = (0.7, 3.0)
    goal: checks.Point2 = (7.3, 3.0)
    region: checks.Region2 = ((0.0, 8.0), (0.0, 6.0))
    num_obstacles: checks.Number = 10
    obstacle_radius: checks.Size = 0.3
    speeds: checks.Speeds = (0.4, 1.3)
    walls: Sequence[checks.Coordinate] = (2.8, 5.4)
    door: checks.Size = 1.2
    clearance: checks.Length = 0.9

    def _obstacles(self, rng: np.random.Generator) -> dict[str, Any]:
        low, high = self.region[1]
        doors = rng.uniform(low + 0.5 * self.door, high - 0.5 * self.door, len(self.walls))
        walls = [box for x, y in zip(self.walls, doors, strict=True) for box in self._wall(x, y, self.door)]
        centers, velocities = np.empty((0, 2)), np.empty((0, 2))
        t = np.linspace(0.0, self.grace, 20)[:, None, None]
        for _ in range(TRIES):
            new = self._walkers(rng, self.num_obstacles - len(centers))
            away = np.linalg.norm(new[0] + t * new[1] - np.array(self.start), axis=-1).min(axis=0)
            centers, velocities = (
                np.vstack((rows, more[away > self.clearance]))
                for rows, more in ((centers, new[0]), (velocities, new[1]))
            )
        if len(centers) < self.num_obstacles:
            expected = f"room for {self.num_obstacles} walkers that stay {self.clearance:g} m from the start"
            raise InputError("scenario.clearance", expected, f"{len(centers)} in {TRIES} draws")
        radii = np.full((1, len(centers)), self.obstacle_radius)
        return {"centers": centers[None], "radii": radii, "velocities": velocities[None]} | self._boxes(walls)

    def _walkers(self, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
        """First places (count, 2), m, and velocities (count, 2), m/s."""
        low, high = np.array(self.region).T
        point, time = rng.uniform(low, high, (count, 2)), rng.uniform(0.0, self.stages * self.dt, (count, 1))
        heading, speed = rng.uniform(-np.pi, np.pi, count), rng.uniform(*self.speeds, (count, 1))
        velocity = speed * np.column_stack([np.cos(heading), np.sin(heading)])
        return point - time * velocity, velocity


@dataclass(frozen=True, kw_only=True)
class Sliding(AmongMovers):
    """Walls with an opening each, over which a leaf slides to and fro.

    Args:
        walls: x of each, m.
        opening: how wide it is; its middle is uniform in the wall, m. The leaf is as wide, and leaves it free once in a
            period.
        periods: [least, largest], uniform, s.
    """

    name: str = "sliding"
    vehicle_radius: checks.Length = 0.15
    walls: Sequence[checks.Coordinate] = (2.0, 4.4)
    opening: checks.Size = 0.8
    periods: checks.Sizes = (3.0, 6.0)

    def _obstacles(self, rng: np.random.Generator) -> dict[str, Any]:
        low, high = self.region[1]
        boxes, half = [], 0.5 * self.opening
        for x in self.walls:
            y = rng.uniform(low + half, high - half)
            rate, phase = 2.0 * np.pi / rng.uniform(*self.periods), rng.uniform(0.0, 2.0 * np.pi)
            leaf = Box((x, y + half), (0.12, half), 0.0, (0.0, half), (0.0, rate), (0.0, phase))
            boxes += [*self._wall(x, y, self.opening), leaf]
        return self._boxes(boxes, moving=True)


@dataclass(frozen=True, kw_only=True)
class Revolving(AmongMovers):
    """Walls with a revolving door each: arms that turn about the middle of an opening.

    Args:
        walls: x of each, m.
        opening: how wide it is; its middle is uniform in the wall, m.
        arms: of each door.
        length, radius: of an arm, a row of discs, m.
        rates: [least, largest], uniform, rad/s; the direction is drawn, too.
    """

    name: str = "revolving"
    vehicle_radius: checks.Length = 0.15
    walls: Sequence[checks.Coordinate] = (2.0, 4.4)
    opening: checks.Size = 2.2
    arms: Some = 3
    length: checks.Size = 1.0
    radius: checks.Size = 0.07
    rates: Annotated[tuple[Rate, Rate], INCREASING] = (0.3, 0.8)

    def _obstacles(self, rng: np.random.Generator) -> dict[str, Any]:
        low, high = self.region[1]
        boxes, quarter = [], 0.5 * np.pi
        along = np.linspace(0.0, self.length, int(np.ceil(self.length / (2.0 * self.radius))) + 1)
        for x in self.walls:
            y = rng.uniform(low + 0.5 * self.opening, high - 0.5 * self.opening)
            rate, first = rng.choice((-1.0, 1.0)) * rng.uniform(*self.rates), rng.uniform(0.0, 2.0 * np.pi)
            boxes += self._wall(x, y, self.opening)
            for k in range(self.arms):
                angle = first + 2.0 * np.pi * k / self.arms
                sines = (rate, rate), (angle + quarter, angle)  # x as the cosine, y as the sine
                boxes += [Box((x, y), (0.0, 0.0), self.radius, (r, r), *sines) for r in along[min(k, 1) :]]
        return self._boxes(boxes, moving=True)


@dataclass(frozen=True, kw_only=True)
class Swarm(Crossing):
    """Balls that each pass a random point of the corridor at a random time, in any direction of space.

    Args:
        pace, room, grace, cell: as of `AmongMovers`.
    """

    name: str = "swarm"
    num_obstacles: checks.Number = 40
    stages: checks.Stages = 160
    pace: checks.Pace = 6.0
    room: checks.Length = 0.1
    cell: checks.Size = 0.4

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        low, high = np.minimum(self.start, self.goal), np.maximum(self.start, self.goal)
        beside = 2.0 * (self.obstacle_radius + self.vehicle_radius)
        region = np.stack((low - beside, high + beside), axis=-1).tolist()
        return drawn_with_a_way(self, lambda: super(Swarm, self)._draw_one(rng), region)

    def _movers(self, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
        """First places (count, 3), m, and velocities (count, 3), m/s."""
        low, high = np.array(self.corridor).T
        point, time = rng.uniform(low, high, (count, 3)), rng.uniform(0.0, self.stages * self.dt, (count, 1))
        direction = rng.standard_normal((count, 3))
        velocity = rng.uniform(*self.speeds, (count, 1)) * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        return point - time * velocity, velocity
