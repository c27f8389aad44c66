"""Sensors that measure distances: a lidar and a depth camera, with noise and missed returns keyed by seed and step."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.options import Above, Count, Meters, NonNegative, Share, Within, check_options
from torchgco.exploration.sensing.world import World
from torchgco.obstacles.attitude import rotation

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
