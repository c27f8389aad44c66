"""Occupied cells of a map as few boxes."""

from __future__ import annotations

import numpy as np


def merged(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Boxes that fill the occupied cells (X, Y[, Z]) without overlap.

    Runs of cells along the last axis become bars, then bars of equal ends side by side become plates, and so on.

    Returns:
        (M, d) int64: the first cell of each box, and the one after its last.
    """
    d = cells.ndim
    low = np.argwhere(cells)
    high = low + 1
    for axis in range(d - 1, -1, -1):
        others = [other for other in range(d) if other != axis]
        ends = np.column_stack([low[:, others], high[:, others]])
        order = np.lexsort((low[:, axis], *ends.T[::-1]))
        low, high, ends = low[order], high[order], ends[order]
        joins = np.zeros(len(low), dtype=bool)
        joins[1:] = (ends[1:] == ends[:-1]).all(axis=1) & (low[1:, axis] == high[:-1, axis])
        first = np.flatnonzero(~joins)
        last = np.append(first[1:], len(low)) - 1 if len(first) else first
        low, high = low[first], np.where(np.arange(d) == axis, high[last], high[first])
    return low, high
