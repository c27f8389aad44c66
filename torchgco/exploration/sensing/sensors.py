"""Sensors that measure distances: a lidar and a depth camera, with noise and missed returns keyed by seed and step.

This code is of its own: neither the solvers' distances nor the judge's are used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Annotated, Any, Self

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.options import Above, Count, Meters, NonNegative, Share, Within, check_options
from torchgco.exploration.sensing.library import call
from torchgco.maps.grid import OccupancyGrid, PointCloud
from torchgco.obstacles.attitude import rotation
from torchgco.obstacles.base import Obstacles
from torchgco.problem.problem import Problem


@dataclass(frozen=True)
class Motion:
    """How M bodies move away from where they are placed: at constant velocity, and along S sines.

    Args:
        velocities: (M, 3), m/s.
        amplitudes, rates, phases: (M, S, 3), m, rad/s, rad: at time t a body is sum_s amplitudes sin(rates t + phases)
            off.
    """

    velocities: np.ndarray
    amplitudes: np.ndarray
    rates: np.ndarray
    phases: np.ndarray

    @classmethod
    def steady(cls, velocities: np.ndarray) -> Self:
        """Without sines."""
        none = np.zeros((len(velocities), 0, 3))
        return cls(velocities, none, none, none)

    @property
    def moves(self) -> np.ndarray:
        """Which bodies move, (M,) bool."""
        return (self.velocities != 0).any(axis=1) | (self.amplitudes != 0).any(axis=(1, 2))

    @property
    def reach(self) -> np.ndarray:
        """How far sines lead bodies away along each axis at most, (M, 3), m."""
        return np.abs(self.amplitudes).sum(axis=1)

    def off(self, t: np.ndarray) -> np.ndarray:
        """How far they are off (K, M, 3), m, at times t (K,), s."""
        offset = t[:, None, None] * self.velocities
        for s in range(self.amplitudes.shape[1]):
            angle = t[:, None, None] * self.rates[:, s] + self.phases[:, s]
            offset = offset + self.amplitudes[:, s] * np.sin(angle)
        return offset

    def take(self, rows: np.ndarray) -> Self:
        """The motion of some bodies."""
        return replace(self, **{name: value[rows] for name, value in vars(self).items()})

    def later(self, t: float) -> Self:
        """The same with time t, s, as time 0; what velocities have led to by then isn't counted."""
        return replace(self, phases=self.phases + t * self.rates)

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """The motion of the bodies of all parts."""
        most = max((motion.amplitudes.shape[1] for motion in parts), default=0)

        def padded(value: np.ndarray) -> np.ndarray:
            return np.pad(value, [(0, 0), (0, most - value.shape[1]), (0, 0)])

        none = cls.steady(np.zeros((0, 3)))
        sines = (
            np.concatenate([padded(getattr(motion, name)) for motion in (none, *parts)])
            for name in ("amplitudes", "rates", "phases")
        )
        return cls(np.concatenate([motion.velocities for motion in (none, *parts)]), *sines)


@dataclass(frozen=True)
class World:
    """Bodies in space at a time.

    Args:
        boxes: (M, 16) float64: centre (3), directions of the sides as rows (9), half their lengths (3), m, and the
            radius by which they are rounded, m. A sphere has sides of length 0, a capsule one side above 0.
        motion: of the boxes away from where they are placed.
        occupied: (X, Y, Z) uint8, 1 where a cell is occupied.
        corner: (3,), m, where cell (0, 0, 0) begins.
        resolution: side of a cell, m.
    """

    boxes: np.ndarray
    motion: Motion
    occupied: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 0), np.uint8))
    corner: tuple[float, float, float] = (0.0, 0.0, 0.0)
    resolution: float = 1.0

    @classmethod
    def of(cls, problem: Problem, b: int) -> Self:
        """The true obstacles of problem b, without the vehicle's radius.

        Raises:
            InputError: obstacles of a kind that has no rays.
        """
        single = problem.take(slice(b, b + 1))
        maps = [obstacles.map for obstacles in single.obstacles if obstacles.map is not None]
        if len(maps) > 1:
            raise InputError("constraints", "one map at most, for a sensor", len(maps))
        parts = [_bodies(obstacles) for obstacles in single.obstacles if obstacles.map is None]
        boxes = np.concatenate([np.zeros((0, 16)), *(bodies[0] for bodies in parts)])
        world = cls(boxes, Motion.joined([bodies[1] for bodies in parts]))
        if not maps:
            return world
        occupied, corner, resolution = _cells(maps[0])
        return replace(world, occupied=occupied, corner=corner, resolution=resolution)

    @property
    def moving(self) -> bool:
        """Whether any body moves."""
        return bool(self.motion.moves.any())

    def at(self, t: float) -> Self:
        """The same bodies where they are at time t, s, and rest."""
        if not self.moving:
            return self
        boxes = self.boxes.copy()
        boxes[:, :3] += self.motion.off(np.array([t]))[0]
        return replace(self, boxes=boxes, motion=Motion.steady(np.zeros((len(boxes), 3))))

    def cast(self, origin: Sequence[float] | np.ndarray, directions: np.ndarray, reach: float) -> np.ndarray:
        """Distances (R,), m, to the first body along unit vectors (R, 3) from a point (3,), m.

        Infinite where there is none within `reach`, m; 0 from inside a body.
        """
        directions = np.ascontiguousarray(directions, np.float64)
        distance = np.empty(len(directions))
        call(
            "tgco_cast", len(directions), np.array(origin, np.float64), directions, float(reach), len(self.boxes),
            np.ascontiguousarray(self.boxes), np.array(self.occupied.shape, np.int64),
            np.ascontiguousarray(self.occupied), np.array(self.corner, np.float64), float(self.resolution),
            np.empty(8 * len(directions)), distance,
        )  # fmt: skip
        return distance


def _cells(map_: Any) -> tuple[np.ndarray, tuple[float, float, float], float]:
    """The occupied cells of one problem's map, where they begin, m, and their side, m.

    A cloud of points is rasterised to the cells that its balls reach into, as large as those of its distance field.

    Raises:
        InputError: a map of the plane.
    """
    source, which = map_.field.source, int(map_.which[0])
    if source.d != 3:
        kind = f"{type(source).__name__} in {source.d}-D"
        raise InputError("scenario", "a map in space, for a sensor", kind)
    if isinstance(source, PointCloud):
        source = _rasterised(source, which, map_.field.spacing)
    blocked = source.is_occupied | (source.is_unknown & (map_.field.unknown == "occupied"))
    occupied, origin = (blocked, source.origin) if source.batch is None else (blocked[which], source.origin)
    x, y, z = (origin if origin.ndim == 1 else origin[which]).tolist()
    return np.ascontiguousarray(occupied, np.uint8), (x, y, z), source.resolution


@lru_cache(4)
def _rasterised(cloud: PointCloud, which: int, side: float) -> OccupancyGrid:
    """The cells of one of its clouds; kept, as every vehicle of a batch asks for the one that all share."""
    return cloud.single(0 if cloud.batch is None else which).rasterised(side)


def _bodies(obstacles: Obstacles) -> tuple[np.ndarray, Motion]:
    """The boxes (M, 16) of obstacles, and how they move, of one problem, without the absent ones."""
    shapes = obstacles.shapes(0)
    if shapes is None or shapes.track is not None:
        raise InputError("scenario", "spheres, boxes, capsules or a map for a sensor", type(obstacles).__name__)
    M, radius = len(shapes.center), np.where(shapes.radius < 1e-12, 0.0, shapes.radius)  # of a sharp box: rounding
    boxes = np.concatenate([shapes.center, shapes.sides.reshape(M, 9), shapes.half, radius[:, None]], axis=1)
    motion = Motion.steady(np.zeros((M, 3)) if shapes.velocity is None else shapes.velocity)
    if shapes.sines is not None:
        motion = Motion(motion.velocities, *shapes.sines)
    return boxes, motion


SCAN_STREAM = 2  # of a mission's draws; 1 is the disturbance's
Angle = Annotated[float, Within(1, 360, "degrees")]
Opening = Annotated[float, Within(1, 170, "degrees")]
Hertz = Annotated[float, Above(0, "Hz")]


@dataclass(frozen=True)
class Scan:
    """One measurement.

    origin, directions   where the rays begin, (3,), m, and unit vectors of space, (R, 3)
    distances            (R,), m, as measured; infinite where nothing came back
    """

    origin: np.ndarray
    directions: np.ndarray
    distances: np.ndarray

    def seen_from(self, attitude: Any, position: Any, believed: Any) -> Scan:
        """The scan as a vehicle with this true attitude places it, that believes to be elsewhere, turned otherwise.

        Args:
            attitude, believed: quaternions (4,); position: (3,), m, where it believes to be.
        """
        rays = self.directions @ turned(np.asarray(attitude)) @ turned(np.asarray(believed)).T
        return Scan(np.array(position, np.float64), rays, self.distances)

    def take(self, rays: np.ndarray) -> Scan:
        """The scan of some rays alone."""
        return Scan(self.origin, self.directions[rays], self.distances[rays])


class Sensor:
    """What a lidar and a depth camera have in common. A subclass gives the rays in the vehicle's frame."""

    range: float
    rate: float
    noise: float
    missed: float

    rays: tuple[int, int]
    field_of_view: tuple[float, float]

    @property
    def pitch(self) -> float:
        """The larger angle between two rays side by side, rad."""
        return float(np.radians(np.array(self.field_of_view) / self.rays).max())

    def pattern(self, shift: np.ndarray) -> np.ndarray:
        """Unit vectors (R, 3) in the vehicle's frame, the pattern moved by a share (2,) of the rays' distance."""
        raise NotImplementedError

    def spread(self, distances: np.ndarray) -> np.ndarray:
        """Standard deviations (R,), m, of measured distances."""
        raise NotImplementedError

    def scan(self, world: World, position: Any, attitude: Any, t: float, key: tuple[int, int, int]) -> Scan:
        """Measure a world at time t, s.

        Args:
            position, attitude: of the vehicle, (3,), m, and a quaternion (4,), scalar first.
            key: (seed, mission, control step), on which all draws depend, and on nothing else.
        """
        seed, mission, step = key
        rng = np.random.Generator(
            np.random.Philox(np.random.SeedSequence(seed, spawn_key=(mission, SCAN_STREAM, step)))
        )
        directions = self.pattern(rng.uniform(-0.5, 0.5, 2)) @ turned(np.asarray(attitude, np.float64)).T
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        distances = world.at(t).cast(position, directions, self.range)
        seen = np.isfinite(distances)
        noise, lost = rng.normal(size=len(distances)), rng.uniform(size=len(distances)) < self.missed
        measured = distances + self.spread(np.where(seen, distances, 0.0)) * noise
        measured = np.where(seen & ~lost, np.clip(measured, 0.0, self.range), np.inf)
        return Scan(np.array(position, np.float64), directions, measured)


@dataclass(frozen=True)
class Lidar(Sensor):
    """A lidar fixed to the vehicle, whose rays are evenly spaced in azimuth and elevation.

    From scan to scan the pattern moves by a drawn part of the rays' distance, as that of a lidar without a fixed
    pattern does.

    Args:
        range: m.
        rays: rays in azimuth and in elevation.
        field_of_view: degrees in azimuth, around straight ahead, and in elevation, around the vehicle's plane.
        rate: scans per second, Hz: one in every control period where it exceeds theirs.
        noise: standard deviation of a distance, m.
        missed: share of the returns that get lost. A lost return looks like open space.

    Raises:
        InputError: a field out of its range.
    """

    range: Meters = 15.0
    rays: tuple[Count, Count] = (300, 32)
    field_of_view: tuple[Angle, Angle] = (360.0, 90.0)
    rate: Hertz = 10.0
    noise: NonNegative = 0.02
    missed: Share = 0.0

    def __post_init__(self) -> None:
        check_options(self, "lidar")
        _keep_tuples(self)
        if self.field_of_view[1] > 180:
            raise InputError("lidar.field_of_view", "at most 180 degrees in elevation", self.field_of_view[1])

    @cached_property
    def _angles(self) -> tuple[np.ndarray, np.ndarray]:
        pitch = np.radians(self.field_of_view) / self.rays
        around, up = (
            (np.arange(count) + 0.5) * step - 0.5 * count * step for count, step in zip(self.rays, pitch, strict=True)
        )
        azimuth, elevation = np.meshgrid(around, up, indexing="ij")
        return azimuth.ravel(), elevation.ravel()

    def pattern(self, shift: np.ndarray) -> np.ndarray:
        """See `Sensor`."""
        pitch = np.radians(self.field_of_view) / self.rays
        azimuth, elevation = (angles + by for angles, by in zip(self._angles, shift * pitch, strict=True))
        flat = np.cos(elevation)
        return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])

    def spread(self, distances: np.ndarray) -> np.ndarray:
        """See `Sensor`."""
        return np.full_like(distances, self.noise)


@dataclass(frozen=True)
class Depth(Sensor):
    """A depth camera that looks straight ahead: a pinhole whose rays are evenly spaced in the image.

    Args:
        range: m.
        rays: pixels across and down.
        field_of_view: degrees across and down.
        rate: images per second, Hz: one in every control period where it exceeds theirs.
        noise: standard deviation of a distance of 1 m, m; it grows with the square of the distance, as in stereo.
        missed: share of the returns that get lost. A lost return looks like open space.

    Raises:
        InputError: a field out of its range.
    """

    range: Meters = 8.0
    rays: tuple[Count, Count] = (120, 90)
    field_of_view: tuple[Opening, Opening] = (90.0, 75.0)
    rate: Hertz = 20.0
    noise: NonNegative = 0.002
    missed: Share = 0.0

    def __post_init__(self) -> None:
        check_options(self, "depth")
        _keep_tuples(self)

    def pattern(self, shift: np.ndarray) -> np.ndarray:
        """See `Sensor`."""
        reach = np.tan(0.5 * np.radians(self.field_of_view))
        across, down = (
            (2.0 * (np.arange(count) + 0.5 + by) / count - 1.0) * edge
            for count, by, edge in zip(self.rays, shift, reach, strict=True)
        )
        y, z = (grid.ravel() for grid in np.meshgrid(across, down, indexing="ij"))
        return np.column_stack([np.ones_like(y), y, z])

    def spread(self, distances: np.ndarray) -> np.ndarray:
        """See `Sensor`."""
        return self.noise * distances**2


def _keep_tuples(sensor: Lidar | Depth) -> None:
    """Lists, as configurations give them, as tuples, so that equal sensors are equal."""
    for name in ("rays", "field_of_view"):
        object.__setattr__(sensor, name, tuple(getattr(sensor, name)))


def turned(q: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) of a quaternion of any length above 0, from the vehicle's frame to space."""
    return rotation(q / np.linalg.norm(q))
