"""Slow, obvious versions of ray casting, map updates and distances, in NumPy."""

import numpy as np


def inside(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Whether points (P, 3) lie in any of the boxes (M, 16): centre, directions of the sides, half sides, radius."""
    found = np.zeros(len(points), bool)
    for box in boxes:
        local = (points - box[:3]) @ box[3:12].reshape(3, 3).T
        away = np.maximum(np.abs(local) - box[12:15], 0.0)
        found |= np.linalg.norm(away, axis=1) <= box[15]
    return found


def in_cells(points: np.ndarray, occupied: np.ndarray, corner: np.ndarray, resolution: float) -> np.ndarray:
    """Whether points (P, 3) lie in an occupied cell."""
    at = np.floor((points - corner) / resolution).astype(int)
    within = ((at >= 0) & (at < occupied.shape)).all(axis=1)
    at[~within] = 0
    return within & (occupied[tuple(at.T)] > 0)


def march(origin: np.ndarray, direction: np.ndarray, reach: float, is_inside, step: float) -> float:
    """The first multiple of `step` along a ray at which a point is inside; infinite where none is."""
    t = np.arange(0.0, reach, step)
    hit = is_inside(origin + t[:, None] * direction)
    return float(t[np.argmax(hit)]) if hit.any() else np.inf


def cubes(shape: tuple[int, ...], corner: np.ndarray, resolution: float) -> np.ndarray:
    """The centres of all cells, (cells, 3)."""
    return corner + (np.stack(np.indices(shape), axis=-1).reshape(-1, 3) + 0.5) * resolution


def chords(origin: np.ndarray, direction: np.ndarray, length: float, centers: np.ndarray, side: float) -> np.ndarray:
    """The length of a ray inside of each cube, (cells,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = ((centers + by - origin) / direction for by in (-0.5 * side, 0.5 * side))
    enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    return np.maximum(np.minimum(leave, length) - np.maximum(enter, 0.0), 0.0)


def distances(points: np.ndarray, centers: np.ndarray, side: float) -> np.ndarray:
    """The distance of points (P, 3) from the nearest of some cubes; infinite without any."""
    if len(centers) == 0:
        return np.full(len(points), np.inf)
    away = np.maximum(np.abs(points[:, None] - centers) - 0.5 * side, 0.0)
    return np.linalg.norm(away, axis=-1).min(axis=1)
