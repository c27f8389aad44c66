"""Distances from one box at a time: of points in the box's frame, of segments by dense sampling."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def directions(rotation: Array | float | None, d: int) -> Array:
    """The directions of the sides as columns (d, d): of an angle, a quaternion [w, x, y, z], or None."""
    if rotation is None:
        return np.eye(d)
    if d == 2:
        c, s = np.cos(rotation), np.sin(rotation)
        return np.array([[c, -s], [s, c]])
    w, v = rotation[0], np.asarray(rotation[1:])
    angle, length = 2 * np.arctan2(np.linalg.norm(v), w), np.linalg.norm(v)
    axis = v / length if length > 0 else np.array([1.0, 0.0, 0.0])
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross  # Rodrigues


def distance(p: Array, center: Array, half: Array, rotation: Array | float | None = None, radius: float = 0.0) -> float:
    """Distance of a point from the surface of a box, rounded by a radius; negative inside."""
    axes = directions(rotation, len(p))
    local = axes.T @ (p - center)
    if np.all(np.abs(local) < half):
        return -min(min(h - x, h + x) for x, h in zip(local, half, strict=True)) - radius
    nearest = center + axes @ np.clip(local, -half, half)
    return float(np.linalg.norm(p - nearest)) - radius


def distance_from_capsule(p: Array, start: Array, end: Array, radius: float) -> float:
    """Distance of a point from the surface around a segment, negative inside: the segment is cut into small pieces."""
    middles = start + np.linspace(0, 1, 20001)[:, None] * (end - start)
    return float(np.linalg.norm(p - middles, axis=1).min()) - radius


def segment_distance(
    a: Array,
    b: Array,
    center: Array,
    half: Array,
    rotation: Array | float | None = None,
    radius: float = 0.0,
    samples: int = 2001,
) -> float:
    """Smallest distance over samples of a segment: an upper bound of the true one."""
    return min(distance(a + s * (b - a), center, half, rotation, radius) for s in np.linspace(0, 1, samples))
