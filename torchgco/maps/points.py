"""Clouds of points, such as a lidar measures: each is a ball of one radius."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from torchgco.base.errors import InputError, shown
from torchgco.maps.grid import LARGEST_GRID, OccupancyGrid, coordinates, number

CLOUD_POINTS = 2**28  # of one cloud


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points in the plane or in space, each of them a ball.

    Args:
        points: (P, d), or (B, P, d) one cloud per problem, m. Rows with NaN or infinity are no points: sensors mark
            missing returns so.
        radius: of the ball around each, m, at least 0. About half the distance between neighbours closes the
            surfaces that were measured.

    Attributes:
        points: an array of float64; rows that are no points are NaN throughout.

    Raises:
        InputError: points of another shape, a radius that isn't finite or is negative.
    """

    points: Any
    radius: Any

    def __post_init__(self) -> None:
        points = coordinates(self.points, "cloud.points")
        if points.ndim not in (2, 3) or points.shape[-1] not in (2, 3):
            got = points.shape if points.size else shown(self.points)
            raise InputError("cloud.points", "shape (P, 2), (P, 3) or (B, P, d)", got)
        if points.shape[-2] > CLOUD_POINTS:
            raise InputError("cloud.points", f"at most {CLOUD_POINTS:,} points", points.shape)
        radius = number(self.radius, "cloud.radius")
        if not 0.0 <= radius < np.inf:
            raise InputError("cloud.radius", "a finite length of at least 0 m", radius)
        points[~np.isfinite(points).all(-1)] = np.nan
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "radius", radius)

    @property
    def d(self) -> int:
        """Dimension of space, 2 or 3."""
        return self.points.shape[-1]

    @property
    def batch(self) -> int | None:
        """How many problems have a cloud of their own; None for one cloud that all share."""
        return None if self.points.ndim == 2 else len(self.points)

    def single(self, which: int) -> PointCloud:
        """The cloud of one problem, which all share."""
        return self if self.batch is None else PointCloud(self.points[which], self.radius)

    def clouds(self) -> list[np.ndarray]:
        """The points (P', d) of each problem's cloud, or of the one that all share, without rows of NaN."""
        return [cloud[np.isfinite(cloud[:, 0])] for cloud in self.points.reshape(-1, *self.points.shape[-2:])]

    def rasterised(self, resolution: float) -> OccupancyGrid:
        """The cells that the balls reach into, as a grid around them: at most a cell's diagonal more than the balls.

        Args:
            resolution: side of a cell, m.

        Raises:
            InputError: a resolution that isn't a finite length above 0, clouds of several problems, too many cells.
        """
        side = number(resolution, "resolution")
        if not 0.0 < side < np.inf:
            raise InputError("resolution", "a finite length above 0 m", resolution)
        if self.batch is not None:
            raise InputError("cloud.points", "one cloud; `single` takes one of several", f"{self.batch} clouds")
        (points,) = self.clouds()
        ends = points if len(points) else np.zeros((1, self.d))
        low = ends.min(0) - self.radius - side
        count = np.ceil((ends.max(0) + self.radius + side - low) / side)
        if np.prod(count) > LARGEST_GRID:
            raise InputError("resolution", f"cells of which the cloud takes at most {LARGEST_GRID:,}", resolution)
        occupied = np.zeros(count.astype(int), bool)
        cells, reach = np.floor((points - low) / side).astype(int), int(np.ceil(self.radius / side))
        for offset in np.ndindex(*[2 * reach + 1] * self.d):
            cell = cells + np.array(offset) - reach
            corner = low + side * cell
            away = np.linalg.norm(points - np.clip(points, corner, corner + side), axis=1)
            occupied[tuple(cell[away <= self.radius].T)] = True
        return OccupancyGrid(occupied, low, side)

    def __repr__(self) -> str:
        batch = "" if self.batch is None else f"{self.batch} of "
        return f"PointCloud({batch}{self.points.shape[-2]} points in {self.d}-D, radius {self.radius:g} m)"
