"""Exact distances from what a map holds near a single point: for starts, where an interpolated bound may be too low."""

from __future__ import annotations

import numpy as np

from torchgco.maps.grid import OccupancyGrid
from torchgco.maps.points import PointCloud


def distance_within(
    source: OccupancyGrid | PointCloud, unknown: str, which: int, p: np.ndarray, within: float
) -> float:
    """Distance of a point (d,) from the nearest occupied cell, or point, of a map, m; infinite beyond `within`.

    Args:
        unknown: what the unknown cells of a grid count as, "occupied" or "free".
        which: the number of the map, 0 of one that all problems share.
    """
    if isinstance(source, PointCloud):
        points = source.clouds()[which]
        least = np.linalg.norm(points - p, axis=1).min(initial=np.inf) - source.radius
        return float(least) if least <= within else np.inf
    h = source.resolution
    origin = source.origin if source.origin.ndim == 1 else source.origin[which]
    first = np.maximum(np.floor((p - within - origin) / h), 0).astype(int)
    last = np.minimum(np.floor((p + within - origin) / h) + 1, source.shape).astype(int)
    if (last <= first).any():
        return np.inf
    near = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
    values = source.occupied[which][near] if source.batch is not None else source.occupied[near]
    (held,) = OccupancyGrid(values, origin + h * first, h).held(unknown)
    low = origin + h * (first + np.argwhere(held))
    least = np.linalg.norm(p - np.clip(p, low, low + h), axis=1).min(initial=np.inf)
    return float(least) if least <= within else np.inf
