"""The part of a map that is read: what lies in a box, or in the layer that a vehicle in the plane passes through."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from torchgco.base.errors import InputError, shown
from torchgco.maps.files.rotated import UNKNOWN_CELL
from torchgco.maps.files.source import FARTHEST_AT, Source, made
from torchgco.maps.grid import OccupancyGrid, coordinates

TOUCHES_WITHIN = 1e-9  # of a cell: a box that ends this close to a cell doesn't touch it


@dataclass(frozen=True)
class Box:
    """From one corner (d,) to the opposite one, m; infinite where the map isn't cut."""

    low: np.ndarray
    high: np.ndarray

    def of(self, source: Source, d: int) -> Box:
        """Itself, for a map of d dimensions; InputError where it has others."""
        if len(self.low) != d:
            raise InputError(f"{source.name}.box", f"corners of {d} coordinates, as {source.path} is {d}-D", str(self))
        return self

    def between(self, low: float, high: float) -> Box:
        """What of a box in space lies between two heights."""
        floor, top = np.array([-np.inf, -np.inf, low]), np.array([np.inf, np.inf, high])
        return Box(np.maximum(self.low, floor), np.minimum(self.high, top))

    def cells(self, resolution: float, origin: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """The first cell (d,) that the box touches, of cells that begin at an origin, and the one after the last."""
        first = np.floor((self.low - origin) / resolution + TOUCHES_WITHIN)
        last = np.ceil((self.high - origin) / resolution - TOUCHES_WITHIN)
        most = 2.0**40
        return np.clip(first, -most, most).astype(np.int64), np.clip(last, -most, most).astype(np.int64)

    def __repr__(self) -> str:
        if np.isinf(self.low[:2]).all():
            return f"the layer between {self.low[-1]:g} m and {self.high[-1]:g} m"
        corners = (", ".join(f"{x:g}" for x in corner) for corner in (self.low, self.high))
        return "the box from ({}) to ({})".format(*corners)


def checked_box(value: Any, field: str) -> Box:
    """Two corners, each of 2 or 3 coordinates.

    Raises:
        InputError: other numbers, or a corner that isn't below the other one.
    """
    box = coordinates(value, field)
    if box.shape not in ((2, 2), (2, 3)) or not (np.abs(box) <= FARTHEST_AT).all() or not (box[0] < box[1]).all():
        expected = f"two corners (low, high), low < high, of 2 or 3 coordinates within {FARTHEST_AT:g} m"
        raise InputError(field, expected, shown(value))
    return Box(box[0], box[1])


def part(
    source: Source, whole: OccupancyGrid | np.ndarray, box: Box, radius: float | None
) -> OccupancyGrid | np.ndarray:
    """The cells of a grid that a box touches, or those of some points (P, d) whose balls do.

    Raises:
        InputError: a box of another space than the map's, or nothing in it.
    """
    box.of(source, whole.d if isinstance(whole, OccupancyGrid) else whole.shape[1])
    if isinstance(whole, OccupancyGrid):
        first, last = (np.clip(cells, 0, whole.shape) for cells in box.cells(whole.resolution, whole.origin))
        if not (first < last).all():
            source.refuse(f"a cell in {box}", f"cells from {whole.origin.tolist()} to {whole.upper.tolist()}")
        cells = whole.occupied[tuple(map(slice, first, last))]
        return made(source, np.ascontiguousarray(cells), whole.origin + whole.resolution * first, whole.resolution)
    reach = radius or 0.0
    inside = ((whole >= box.low - reach) & (whole <= box.high + reach)).all(-1)
    if not inside.any():
        source.refuse(f"a point in {box}", f"points from {whole.min(0).tolist()} to {whole.max(0).tolist()}")
    return whole[inside]


def checked_layer(value: Any, field: str) -> tuple[float, float]:
    """Two heights (low, high), m."""
    layer = coordinates(value, field)
    if layer.shape != (2,) or not -FARTHEST_AT <= layer[0] < layer[1] <= FARTHEST_AT:
        raise InputError(field, f"heights (low, high), low < high, within {FARTHEST_AT:g} m", shown(value))
    return float(layer[0]), float(layer[1])


def flat(
    source: Source, whole: OccupancyGrid | np.ndarray, layer: tuple[float, float], radius: float | None
) -> OccupancyGrid | np.ndarray:
    """What of a map in space lies in the layer, seen from above.

    A cell of the plane is as the worst of the cells above it that touch the layer: occupied, else unknown, else free.
    Points count whose balls touch it.

    Raises:
        InputError: a map of the plane, or one without a cell or point in the layer.
    """
    d = whole.d if isinstance(whole, OccupancyGrid) else whole.shape[1]
    if d != 3:
        raise InputError(f"{source.name}.layer", f"none, as {source.path} is a map of the plane", layer)
    low, high = layer
    if isinstance(whole, OccupancyGrid):
        bottoms = whole.origin[2] + whole.resolution * np.arange(whole.shape[2])
        inside = (bottoms < high) & (bottoms + whole.resolution > low)
        if not inside.any():
            source.refuse(f"cells between {low:g} m and {high:g} m", f"{whole.origin[2]:g} m to {whole.upper[2]:g} m")
        cells = whole.occupied[..., inside]
        if cells.dtype == np.bool_:
            return made(source, cells.any(-1), whole.origin[:2], whole.resolution)
        worst = np.where(np.isnan(cells), UNKNOWN_CELL, cells.astype(np.float32)).max(-1)
        worst[worst == UNKNOWN_CELL] = np.nan
        return made(source, worst, whole.origin[:2], whole.resolution)
    reach = radius or 0.0
    points = whole[(whole[:, 2] >= low - reach) & (whole[:, 2] <= high + reach), :2]
    if not len(points):
        got = f"{whole[:, 2].min():g} m to {whole[:, 2].max():g} m"
        source.refuse(f"points between {low:g} m and {high:g} m", got)
    return np.ascontiguousarray(points)
