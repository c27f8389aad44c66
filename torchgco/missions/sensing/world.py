"""The true world as a sensor sees it: bodies and occupied cells, and the distances of rays to them.

This code is of its own: neither the solvers' distances nor the judge's are used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from torchgco.base.errors import InputError
from torchgco.maps.field import BoundField
from torchgco.maps.grid import OccupancyGrid
from torchgco.missions.sensing.library import call
from torchgco.obstacles.base import Obstacles
from torchgco.obstacles.boxes import BoundBoxes
from torchgco.obstacles.spheres import BoundSpheres
from torchgco.problem.problem import Problem


def _no_cells() -> np.ndarray:
    return np.zeros((0, 0, 0), np.uint8)


@dataclass(frozen=True)
class World:
    """Bodies in space at a time.

    Args:
        boxes: (M, 16) float64: centre (3), directions of the sides as rows (9), half their lengths (3), m, and the
            radius by which they are rounded, m. A sphere has sides of length 0, a capsule one side above 0.
        velocities: (M, 3), m/s.
        occupied: (X, Y, Z) uint8, 1 where a cell is occupied.
        corner: (3,), m, where cell (0, 0, 0) begins.
        resolution: side of a cell, m.
    """

    boxes: np.ndarray
    velocities: np.ndarray
    occupied: np.ndarray = field(default_factory=_no_cells)
    corner: tuple[float, float, float] = (0.0, 0.0, 0.0)
    resolution: float = 1.0

    @classmethod
    def of(cls, problem: Problem, b: int) -> Self:
        """The true obstacles of problem b, without the vehicle's radius.

        Raises:
            InputError: obstacles of a kind that has no rays.
        """
        one = problem.take(slice(b, b + 1))
        maps = [part for part in one.constraints if isinstance(part, BoundField)]
        if len(maps) > 1:
            raise InputError("constraints", "one map at most, for a sensor", len(maps))
        parts = [_bodies(part) for part in one.constraints if isinstance(part, Obstacles) and part not in maps]
        boxes, velocities = zip(*parts, strict=True) if parts else ((np.zeros((0, 16)),), (np.zeros((0, 3)),))
        world = cls(np.concatenate(boxes), np.concatenate(velocities))
        if not maps:
            return world
        occupied, corner, resolution = _cells(maps[0])
        return replace(world, occupied=occupied, corner=corner, resolution=resolution)

    @property
    def moving(self) -> bool:
        """Whether any body moves."""
        return bool((self.velocities != 0).any())

    def at(self, t: float) -> Self:
        """The same bodies where they are at time t, s."""
        if not self.moving:
            return self
        boxes = self.boxes.copy()
        boxes[:, :3] += t * self.velocities
        return replace(self, boxes=boxes)

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


def _cells(part: BoundField) -> tuple[np.ndarray, tuple[float, float, float], float]:
    """The occupied cells of one problem's map, where they begin, m, and their side, m.

    Raises:
        InputError: a cloud of points, which has no cells, or a map of the plane.
    """
    source, which = part.field.source, int(part.which[0])
    if not isinstance(source, OccupancyGrid) or source.d != 3:
        kind = f"{type(source).__name__} in {source.d}-D"
        raise InputError("scenario", "an occupancy grid in space, for a sensor", kind)
    held = source.is_occupied | (source.is_unknown & (part.field.unknown == "occupied"))
    occupied, origin = (held, source.origin) if source.batch is None else (held[which], source.origin)
    x, y, z = (origin if origin.ndim == 1 else origin[which]).tolist()
    return np.ascontiguousarray(occupied, np.uint8), (x, y, z), source.resolution


def _bodies(part: Obstacles) -> tuple[np.ndarray, np.ndarray]:
    """The boxes (M, 16) and velocities (M, 3) of obstacles of one problem, without the absent ones."""
    there = ~part.absent[0].numpy()
    vehicle = float(part.vehicle_radius[0])
    if isinstance(part, BoundSpheres):
        centers, radii = part.centers[0].numpy(), part.inflated_radii[0].numpy() - vehicle
        axes, half = np.tile(np.eye(3).ravel(), (len(centers), 1)), np.zeros_like(centers)
        velocities = np.zeros_like(centers) if part.velocities is None else part.velocities[0].numpy()
    elif isinstance(part, BoundBoxes):
        centers, radii = part.centers[0].numpy(), part.inflated_radii[0].numpy() - vehicle
        axes, half = part.axes[0].numpy().reshape(-1, 9), part.half_sizes[0].numpy()
        velocities = np.zeros_like(centers)
    else:
        kinds = "spheres, boxes, capsules or a map for a sensor"
        raise InputError("scenario", kinds, type(part).__name__)
    radii = np.where(radii < 1e-12, 0.0, radii)  # what rounding leaves of a sharp box
    return np.concatenate([centers, axes, half, radii[:, None]], axis=1)[there], velocities[there]
