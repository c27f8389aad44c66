"""Distances from the cells of a grid, one cell at a time, and interpolation in a field, one point at a time."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def distance_from_cells(p: Array, cells: NDArray[np.bool_], origin: Array, resolution: float) -> float:
    """Distance of a point from the nearest marked cell as a closed box."""
    nearest = np.inf
    for index in np.argwhere(cells):
        low = origin + resolution * index
        nearest = min(nearest, float(np.linalg.norm(p - np.clip(p, low, low + resolution))))
    return nearest


def signed_distance(p: Array, cells: NDArray[np.bool_], origin: Array, resolution: float) -> float:
    """The same; inside of marked cells minus the distance from the nearest other cell, or from outside of the grid."""
    outside = distance_from_cells(p, cells, origin, resolution)
    around = np.pad(cells, 1)
    inside = distance_from_cells(p, ~around, origin - resolution, resolution)
    return outside if outside > 0 else -inside


def smooth_weight(t: float) -> float:
    """The quadratic B-spline of a node t steps away."""
    t = abs(t)
    return 0.75 - t * t if t < 0.5 else 0.5 * (1.5 - t) ** 2 if t < 1.5 else 0.0


def linear_weight(t: float) -> float:
    return max(0.0, 1.0 - abs(t))


def lower_square(p: Array, values: Array, origin: Array, spacing: float, core: float, smooth: bool) -> float:
    """G: weighted squares at the nodes near p, or tangents to them nearer than the core, less the weights' variance."""
    weight = smooth_weight if smooth else linear_weight
    u = (p - origin) / spacing
    total, variance = 0.0, 0.0
    for index in itertools.product(*(range(int(np.floor(x)) - 2, int(np.floor(x)) + 4) for x in u)):
        w = np.prod([weight(x - i) for x, i in zip(u, index, strict=True)])
        held = tuple(np.clip(index, 0, np.array(values.shape) - 1))
        beyond = spacing * np.linalg.norm(np.subtract(index, held))
        d = float(values[held])
        total += w * ((d * d if d >= core else core * (2 * d - core)) + beyond**2)
        variance += w * spacing**2 * np.sum((u - np.array(index)) ** 2)
    return total - variance
