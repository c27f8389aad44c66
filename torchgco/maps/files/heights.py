"""Heightmaps: one height of the ground per column of cells."""

from __future__ import annotations

import math

import numpy as np

from torchgco.maps.files.source import MOST_CELLS, Source, check_far, made
from torchgco.maps.grid import OccupancyGrid


def above_ground(
    source: Source, heights: np.ndarray, resolution: float | None, origin: np.ndarray | None
) -> OccupancyGrid:
    """Cells that reach below the ground are occupied, those above are free.

    The lowest layer begins at `origin[2]`, by default at the lowest height, rounded down to a whole cell, and the
    highest, free layer lies above the highest ground. A column without a finite height is unknown.

    Args:
        heights: (X, Y), m.
        resolution: side of a cell along all axes, m.
        origin: lowest corner (2,) or (3,) of the first cell, m; by default 0 in x and y.
    """
    resolution = source.needs("resolution", resolution, "the side of a cell, m")
    known = np.isfinite(heights)
    if not known.any():
        source.refuse("at least one finite height", f"{heights.size:,}, none of them finite")
    check_far(source, heights[known])
    place = np.zeros(2) if origin is None else origin
    floor = place[2] if len(place) == 3 else math.floor(heights[known].min() / resolution) * resolution
    layers = max(math.ceil((heights[known].max() - floor) / resolution), 0) + 1
    source.limit(layers * heights.size, MOST_CELLS, "cells")
    bottoms = floor + resolution * np.arange(layers)
    with np.errstate(invalid="ignore"):
        below = bottoms < heights[:, :, None]
    below[..., -1] = False  # rounding
    corner = np.array([*place[:2], floor])
    if known.all():
        return made(source, below, corner, resolution)
    return made(source, np.where(known[:, :, None], below.astype(np.float32), np.float32("nan")), corner, resolution)
