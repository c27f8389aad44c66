"""Grids whose axes are turned in the plane, as cells along the axes."""

from __future__ import annotations

import math

import numpy as np

from torchgco.maps.files.source import MOST_CELLS, Source
from torchgco.maps.grid import OCCUPIED_FROM

UNKNOWN_CELL = np.nextafter(np.float32(OCCUPIED_FROM), np.float32(0.0))  # worse than free, better than occupied
QUARTER_TURN = 1e-9  # rad: closer to a quarter turn is one
SLAB = 2**20  # cells turned at once


def rotated(
    source: Source, cells: np.ndarray, origin: np.ndarray, yaw: float, resolution: float
) -> tuple[np.ndarray, np.ndarray]:
    """Cells (X, Y) turned by `yaw` about their lowest corner `origin`, as cells along the axes with their own origin.

    By quarter turns exactly. Otherwise a cell is as the worst of the turned cells that it touches: occupied, else
    unknown, else free. So what was occupied stays so, and walls grow by less than a cell. Cells beyond are unknown.

    Returns:
        Bool or float32 (X', Y') with NaN where unknown, and the lowest corner (2,) of the first.
    """
    quarters = round(yaw / (math.pi / 2))
    exact = abs(yaw - quarters * math.pi / 2) < QUARTER_TURN
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * np.array(cells.shape) @ turn.T
    low, high = corners.min(0), corners.max(0)
    if exact:
        return np.rot90(cells, quarters), origin + resolution * np.round(low)
    X, Y = (int(side) for side in np.ceil(high - low))
    source.limit(X * Y, MOST_CELLS, f"cells ({X:,} x {Y:,} after turning by the origin's yaw)")
    padded = np.pad(cells.astype(np.float32), 3, constant_values=np.float32("nan"))
    padded[np.isnan(padded)] = UNKNOWN_CELL
    result = np.empty((X, Y), np.float32)
    for first in range(0, X, max(SLAB // Y, 1)):
        last = min(first + max(SLAB // Y, 1), X)
        result[first:last] = _worst(padded, turn, low + np.array([first, 0]), (last - first, Y))
    result[result == UNKNOWN_CELL] = np.nan
    return result, origin + resolution * low


def _worst(padded: np.ndarray, turn: np.ndarray, low: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The worst cell that each cell of a slab touches, its corner at `low` in cells; padded by three on each side."""
    centers = np.stack(np.meshgrid(*(np.arange(side) + 0.5 for side in shape), indexing="ij"), -1) + low
    before = centers @ turn  # turned back
    reach = 0.5 * np.abs(turn).sum(0)  # half the sides of the box around a turned cell
    limit = np.array(padded.shape) - 1
    from_ = np.floor(before - reach).astype(np.int64) + 3
    to = np.floor(before + reach).astype(np.int64) + 3
    worst = np.zeros(shape, np.float32)
    for a in range(3):
        for b in range(3):
            index = np.clip(np.minimum(from_ + np.array([a, b]), to), 0, limit)
            np.maximum(worst, padded[index[..., 0], index[..., 1]], out=worst)
    return worst
