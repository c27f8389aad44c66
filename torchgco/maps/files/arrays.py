"""npz and npy: NumPy's arrays, never its pickles."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchgco.base.files import read_arrays
from torchgco.maps.files.images import above_ground
from torchgco.maps.files.source import MOST_BYTES, MOST_POINTS, Source, finite_points, made
from torchgco.maps.grid import OccupancyGrid

NPZ = "a map with occupied (X, Y[, Z]), origin (d,) and resolution"
MAP_LIMIT = "that a map's file may take"
TASK_KEYS = ("start", "goal", "vehicle_radius", "goal_radius")
NPY = "an npy file of numbers, without pickles"


def read_npz(source: Source) -> OccupancyGrid:
    """The grid of the arrays `occupied`, `origin` and `resolution`; others are for `scenario=map`."""
    source.size(NPZ)
    arrays = read_arrays(source.path, source.field, NPZ, ("occupied", "origin", "resolution"), MOST_BYTES, MAP_LIMIT)
    occupied, origin = arrays["occupied"], arrays["origin"]
    if origin.shape != (occupied.ndim,):  # one grid per problem isn't for files
        source.refuse("origin (d,) for occupied (X, Y[, Z])", f"{origin.shape} for {occupied.shape}")
    return made(source, occupied, origin, arrays["resolution"])


def read_task(path: Path) -> dict[str, np.ndarray]:
    """What an npz file says of the flight beside its map: start, goal (d,), vehicle_radius, goal_radius, m."""
    if path.suffix.lower() != ".npz":
        return {}
    arrays = read_arrays(path, "scenario.path", NPZ, room=MOST_BYTES, limit=MAP_LIMIT)
    return {name: arrays[name] for name in TASK_KEYS if name in arrays}


def read_npy(
    source: Source, resolution: float | None, origin: np.ndarray | None, height: float | None
) -> OccupancyGrid | np.ndarray:
    """Bools (X, Y[, Z]) as a grid; with `height`, numbers (X, Y) as heights in it; else points (P, 2 or 3)."""
    array = _array(source)
    if height is not None:
        if array.ndim != 2 or array.dtype.kind not in "iuf":
            source.refuse("heights (X, Y), numbers", f"{array.dtype} of shape {array.shape}")
        return above_ground(source, np.asarray(array, np.float64) * height, resolution, origin)
    if array.dtype == np.bool_:
        if array.ndim not in (2, 3) or not array.size:
            source.refuse("occupied cells (X, Y[, Z])", f"shape {array.shape}")
        source.needs("resolution", resolution, "the side of a cell, m")
        return made(source, array, np.zeros(array.ndim) if origin is None else origin, resolution)
    if array.ndim != 2 or array.shape[1] not in (2, 3) or array.dtype.kind not in "iuf":
        expected = "points (P, 2 or 3), numbers, or cells (X, Y[, Z]), bools"
        source.refuse(expected, f"{array.dtype} of shape {array.shape}")
    source.limit(len(array), MOST_POINTS, "points")
    return finite_points(source, array)


def _array(source: Source) -> np.ndarray:
    """The array; NumPy compares its size with the file's before memory is taken."""
    source.limit(source.size(NPY), MOST_BYTES, "bytes")
    with source.library(NPY):
        array = np.load(source.path, mmap_mode="r", allow_pickle=False)
        if array.dtype.kind not in "biuf":
            source.refuse(NPY, array.dtype)
        return np.array(array)
