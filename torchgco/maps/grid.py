"""What maps are made of: occupancy grids, whose cells are occupied, free or unknown, and clouds of points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from torch import Tensor

from torchgco.base.errors import InputError, shown

OCCUPIED_FROM = 0.5  # the probability from which a cell counts as occupied
LETHAL, NO_COST = 254, 255  # costs in ROS's navigation: an obstacle in the cell, and unknown
NO_TURN = 1e-6  # of a quaternion's x, y and z: less is no turn
LARGEST_GRID = 2**30  # of one grid: more is a mistake in the resolution


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """Cells of equal size along the axes, each of them occupied, free or unknown.

    Cell (i, j[, k]) fills the box from `origin + resolution (i, j[, k])` to `origin + resolution (i + 1, ...)`: the
    origin is the lowest corner of the first cell, not its centre. The first axis of `occupied` is x, the second y, the
    third z. An image has its rows along -y and comes transposed and flipped.

    Args:
        occupied: (X, Y[, Z]), or (B, X, Y[, Z]) one grid per problem. Bool: occupied or free. Numbers in [0, 1]: the
            probability that the cell is occupied, which it counts as from 0.5; NaN where unknown. Whole numbers: 0
            free, 1 occupied, -1 unknown. The array isn't copied: don't change it.
        origin: (d,), or (B, d) one per problem, m.
        resolution: side of a cell, m.

    Attributes:
        occupied: an array of bool, or of floating numbers in [0, 1] and NaN.
        origin: an array (d,) or (B, d) of float64.

    Raises:
        InputError: another number of axes than the origin says, none or too many cells, values outside of the range,
            origin or resolution that aren't finite, a resolution that isn't above 0.
    """

    occupied: Any
    origin: Any
    resolution: Any

    def __post_init__(self) -> None:
        resolution = number(self.resolution, "grid.resolution")
        if not 0.0 < resolution < np.inf:
            raise InputError("grid.resolution", "a finite length above 0 m", resolution)
        origin = coordinates(self.origin, "grid.origin")
        if origin.ndim not in (1, 2) or origin.shape[-1] not in (2, 3) or not np.isfinite(origin).all():
            raise InputError("grid.origin", "2 or 3 finite coordinates, m", shown(self.origin))
        cells = _cells(self.occupied)
        d = origin.shape[-1]
        axes = "(X, Y)" if d == 2 else "(X, Y, Z)"
        if cells.ndim not in (d, d + 1):
            raise InputError("grid.occupied", f"shape {axes}, or (B, ...), as the origin is {d}-D", cells.shape)
        if min(cells.shape[-d:]) < 1 or np.prod(cells.shape[-d:], dtype=float) > LARGEST_GRID:
            raise InputError("grid.occupied", f"1 to {LARGEST_GRID:,} cells", cells.shape)
        if origin.ndim == 2 and (cells.ndim == d or len(origin) != len(cells)):
            expected = "(d,), or (B, d) where there is one grid per problem"
            raise InputError("grid.origin", expected, f"shape {origin.shape} for cells {cells.shape}")
        for name, value in (("occupied", cells), ("origin", origin), ("resolution", resolution)):
            object.__setattr__(self, name, value)

    @classmethod
    def from_costmap(cls, costs: Any, origin: Any, resolution: Any, occupied_from: int = LETHAL) -> OccupancyGrid:
        """The grid of a costmap of ROS's navigation: lethal cells are occupied, 255 is unknown.

        Costs of inflation, below 254, are left out: a vehicle keeps its own radius.

        Args:
            costs: (height, width), whole numbers from 0 to 255, rows from the lowest y up, as `Costmap2D` has them.
            origin: (2,), m.
            resolution: side of a cell, m.
            occupied_from: the least cost of an occupied cell; 253 adds those where a robot's inscribed circle touches.

        Raises:
            InputError: another shape, or costs out of range.
        """
        values = np.asarray(costs)
        if values.ndim != 2 or values.dtype.kind not in "iu":
            got = f"{values.dtype} of shape {values.shape}"
            raise InputError("grid.costs", "whole numbers (height, width)", got)
        if ((values < 0) | (values > NO_COST)).any():
            raise InputError("grid.costs", f"0 to {NO_COST}", f"{values.min()} to {values.max()}")
        cells = np.where(values == NO_COST, np.float32("nan"), (values >= occupied_from).astype(np.float32))
        return cls(cells.T, origin, resolution)

    @classmethod
    def from_esdf(cls, distances: Any, origin: Any, resolution: Any) -> OccupancyGrid:
        """The grid of a distance field of another program, whose values stand for the centres of cells.

        Cells are occupied where the distance is at most 0, NaN is unknown. A `DistanceField` of the grid has exact
        distances from these cells; others' are often approximate, or end at a largest one.

        Args:
            distances: (X, Y[, Z]), or (B, ...), m; negative inside, or 0 in occupied cells.
            origin, resolution: as of the grid.

        Raises:
            InputError: no floating numbers, or none that is positive.
        """
        values = np.asarray(distances)
        if values.dtype.kind != "f" or not (values > 0).any():
            got = f"{values.dtype} of shape {values.shape}" if values.dtype.kind != "f" else "none above 0"
            raise InputError("grid.distances", "floating numbers, m, above 0 in free cells", got)
        cells = np.where(np.isnan(values), np.float32("nan"), (values <= 0).astype(np.float32))
        return cls(cells, origin, resolution)

    @classmethod
    def from_ros(cls, message: Any) -> OccupancyGrid:
        """The grid of a message nav_msgs/OccupancyGrid: percent as probabilities, -1 unknown.

        Raises:
            InputError: a message of another kind, data of another length, an origin that is turned.
        """
        try:
            info, data = message.info, np.asarray(message.data)
            position, turn = info.origin.position, info.origin.orientation
            shape = int(info.height), int(info.width)
        except (AttributeError, TypeError, ValueError):
            raise InputError("grid.message", "a nav_msgs/OccupancyGrid, with info and data", shown(message)) from None
        if max(abs(turn.x), abs(turn.y), abs(turn.z)) > NO_TURN:
            expected = "an origin that isn't turned; `read` turns grids of bags"
            raise InputError("grid.message", expected, f"a quaternion with {turn.x:g}, {turn.y:g}, {turn.z:g}")
        return cls(values_of_ros(data, shape), [position.x, position.y], info.resolution)

    @property
    def d(self) -> int:
        """Dimension of space, 2 or 3."""
        return self.origin.shape[-1]

    @property
    def batch(self) -> int | None:
        """How many problems have a grid of their own; None for one grid that all share."""
        return None if self.occupied.ndim == self.d else len(self.occupied)

    @property
    def shape(self) -> tuple[int, ...]:
        """Cells along each axis, (X, Y[, Z])."""
        return self.occupied.shape[-self.d :]

    @property
    def upper(self) -> np.ndarray:
        """The highest corner of the last cell, (d,) or (B, d), m."""
        return self.origin + self.resolution * np.array(self.shape)

    @cached_property
    def is_occupied(self) -> np.ndarray:
        """Whether cells are occupied, of the shape of `occupied`; unknown ones aren't."""
        if self.occupied.dtype == np.bool_:
            return self.occupied
        with np.errstate(invalid="ignore"):
            return self.occupied >= OCCUPIED_FROM

    @cached_property
    def is_unknown(self) -> np.ndarray:
        """Whether cells are unknown, of the shape of `occupied`."""
        return np.zeros(1, bool) & self.occupied if self.occupied.dtype == np.bool_ else np.isnan(self.occupied)

    def held(self, unknown: str) -> np.ndarray:
        """Which cells of each grid are occupied, (G, X, Y[, Z]) bool, and `unknown` ones where these are "occupied"."""
        cells = self.is_occupied | self.is_unknown if unknown == "occupied" else self.is_occupied
        return cells if self.batch is not None else cells[None]

    def single(self, which: int) -> OccupancyGrid:
        """The grid of one problem, which all share."""
        if self.batch is None:
            return self
        origin = self.origin[which] if self.origin.ndim == 2 else self.origin
        return OccupancyGrid(self.occupied[which], origin, self.resolution)

    def enclosed(self) -> OccupancyGrid:
        """The grid with one more occupied cell on every side, so that no way leads out of it."""
        rim = [(0, 0)] * (self.occupied.ndim - self.d) + [(1, 1)] * self.d
        cells = np.pad(self.occupied, rim, constant_values=1)
        return OccupancyGrid(cells, self.origin - self.resolution, self.resolution)

    def holds(self, point: Any) -> bool:
        """Whether a point (d,), m, lies on a grid that all problems share."""
        return bool(((point >= self.origin) & (point <= self.upper)).all())

    def cell(self, points: Any) -> np.ndarray:
        """Indices (..., d) of the cells that hold points (..., d), m; outside of the grid they aren't in its shape.

        For one grid that all problems share, or points (B, ..., d) of grids with an origin each.
        """
        points = np.asarray(points, float)
        origin = self.origin
        if origin.ndim == 2:
            origin = origin.reshape(len(origin), *([1] * (points.ndim - 2)), self.d)
        return np.floor((points - origin) / self.resolution).astype(np.int64)

    def __repr__(self) -> str:
        batch = "" if self.batch is None else f"{self.batch} of "
        cells = " x ".join(map(str, self.shape))
        return f"OccupancyGrid({batch}{cells} cells of {self.resolution:g} m)"


def values_of_ros(data: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The probabilities (X, Y), NaN where unknown, that a nav_msgs/OccupancyGrid of height and width holds as percent.

    Raises:
        InputError: data of another length, or out of its range.
    """
    data = data.astype(np.int8) if data.dtype.kind in "iu" else data
    if data.shape != (shape[0] * shape[1],) or data.dtype.kind != "i" or ((data < -1) | (data > 100)).any():
        expected = f"{shape[0]} x {shape[1]} whole numbers from -1 to 100"
        raise InputError("grid.message", expected, f"{data.dtype} of shape {data.shape}")
    return np.where(data < 0, np.float32("nan"), data / np.float32(100.0)).reshape(shape).T


def number(value: Any, field: str) -> float:
    """A number, also as an array or tensor of one; InputError for all else."""
    values = coordinates(value, field)
    if values.size != 1:
        raise InputError(field, "a number", shown(value))
    return float(values.reshape(()))


def coordinates(value: Any, field: str) -> np.ndarray:
    """Numbers as a new array of float64; InputError for all else."""
    values = _array(value, field, "numbers")
    if values.dtype.kind not in "iuf":
        raise InputError(field, "numbers", shown(value))
    return np.array(values, float)


def _array(value: Any, field: str, expected: str) -> np.ndarray:
    """An array of what an array, a tensor or nested lists hold."""
    if isinstance(value, Tensor):
        value = value.detach().cpu().numpy()
    try:
        return np.asarray(value)
    except (TypeError, ValueError):  # lists of different length
        raise InputError(field, expected, shown(value)) from None


def _cells(value: Any) -> np.ndarray:
    """The cells as bool, or as probabilities with NaN where unknown.

    Raises:
        InputError: neither bools nor numbers, or numbers out of range.
    """
    cells = _array(value, "grid.occupied", "an array of bools or numbers")
    if cells.dtype == np.bool_:
        return cells
    if cells.dtype.kind not in "iuf":
        raise InputError("grid.occupied", "an array of bools or numbers", f"an array of {cells.dtype}")
    whole = cells.dtype.kind in "iu"
    with np.errstate(invalid="ignore"):
        wrong = (cells < -1) | (cells > 1) if whole else (cells < 0) | (cells > 1)
    if wrong.any():
        expected = "0 free, 1 occupied, -1 unknown" if whole else "probabilities in [0, 1], NaN where unknown"
        raise InputError("grid.occupied", expected, cells[wrong][0])
    if not whole:
        return cells
    return np.where(cells < 0, np.float32("nan"), cells.astype(np.float32))


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
