"""The layer of a map of space that a vehicle in the plane passes through."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchgco.base.errors import InputError, shown
from torchgco.maps.files.rotated import UNKNOWN_CELL
from torchgco.maps.files.source import FARTHEST_AT, Source, made
from torchgco.maps.grid import OccupancyGrid, coordinates


def checked_layer(value: Any, field: str) -> tuple[float, float]:
    """Two heights (low, high), m."""
    layer = coordinates(value, field)
    if layer.shape != (2,) or not -FARTHEST_AT <= layer[0] < layer[1] <= FARTHEST_AT:
        raise InputError(field, f"heights (low, high), low < high, within {FARTHEST_AT:g} m", shown(value))
    return float(layer[0]), float(layer[1])


def flat(
    source: Source, found: OccupancyGrid | np.ndarray, layer: tuple[float, float], radius: float | None
) -> OccupancyGrid | np.ndarray:
    """What of a map in space lies in the layer, seen from above.

    A cell of the plane is as the worst of the cells above it that touch the layer: occupied, else unknown, else free.
    Points count whose balls touch it.

    Raises:
        InputError: a map of the plane, or one without a cell or point in the layer.
    """
    d = found.d if isinstance(found, OccupancyGrid) else found.shape[1]
    if d != 3:
        raise InputError(f"{source.name}.layer", f"none, as {source.path} is a map of the plane", layer)
    low, high = layer
    if isinstance(found, OccupancyGrid):
        bottoms = found.origin[2] + found.resolution * np.arange(found.shape[2])
        held = (bottoms < high) & (bottoms + found.resolution > low)
        if not held.any():
            source.refuse(f"cells between {low:g} m and {high:g} m", f"{found.origin[2]:g} m to {found.upper[2]:g} m")
        cells = found.occupied[..., held]
        if cells.dtype == np.bool_:
            return made(source, cells.any(-1), found.origin[:2], found.resolution)
        worst = np.where(np.isnan(cells), UNKNOWN_CELL, cells.astype(np.float32)).max(-1)
        worst[worst == UNKNOWN_CELL] = np.nan
        return made(source, worst, found.origin[:2], found.resolution)
    reach = radius or 0.0
    points = found[(found[:, 2] >= low - reach) & (found[:, 2] <= high + reach), :2]
    if not len(points):
        got = f"{found[:, 2].min():g} m to {found[:, 2].max():g} m"
        source.refuse(f"points between {low:g} m and {high:g} m", got)
    return np.ascontiguousarray(points)
