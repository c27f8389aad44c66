"""The map that a vehicle makes of what it sees: cells that are free, occupied, or unknown until a ray passes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from torchgco.exploration.sensing.library import call
from torchgco.exploration.sensing.sensors import Scan

UNKNOWN, FREE, OCCUPIED = 0, 1, 2
SEEN_OCCUPIED, NOT_FREE = 1 << OCCUPIED, (1 << OCCUPIED) | (1 << UNKNOWN)  # kinds of cells
# Log-odds. Returns make an unknown cell occupied, and outweigh many rays that pass: they may pass through the free part
# of a cell that an obstacle fills in part. For the same reason it takes several of them to make a cell free.
# Beside an occupied cell it takes more, as the surface may go on into this one.
HIT, MISS, LEAST_ODDS, MOST_ODDS, FREE_AT, FREE_BESIDE, OCCUPIED_AT = 2.0, -0.1, -2.0, 3.5, -0.55, -1.45, 0.5
REACH = 4  # as C has it
CHORD = 0.5  # of a cell's side: what a ray passes for less, it doesn't show


@dataclass
class SeenMap:
    """A grid of cells with their log-odds, and the distances of cells from what blocks the way. It changes in place.

    Args:
        corner: (3,), m, where cell (0, 0, 0) begins; outside of the grid nothing can be flown.
        shape: number of cells (3,).
        resolution: side of a cell, m.
        reach: up to which distances are known, in cells, at most `REACH`.
    """

    corner: np.ndarray
    shape: tuple[int, int, int]
    resolution: float
    reach: int = REACH
    odds: np.ndarray = field(init=False)  # (X, Y, Z) float32
    state: np.ndarray = field(init=False)  # (X, Y, Z) uint8
    from_occupied: np.ndarray = field(init=False)  # (X, Y, Z) float32, m, to occupied cells

    def __post_init__(self) -> None:
        self.corner = np.array(self.corner, np.float64)
        self.odds = np.zeros(self.shape, np.float32)
        self.state = np.zeros(self.shape, np.uint8)
        self.from_occupied = np.empty(self.shape, np.float32)
        self._beside, self._counts = np.zeros(self.shape, np.uint8), np.zeros(self.shape, np.uint32)
        self._touched, self._changed = (np.empty(self.state.size + 1, np.int32) for _ in range(2))
        self._size = np.array(self.shape, np.int64)
        self._work = np.empty(2 * int(np.prod(self._size + 2 * self.reach)), np.uint8)
        self._scratch = np.empty(0)
        self._layers = np.empty(self.shape[0] + 1, np.int64)
        self.measure()

    def add(self, scan: Scan, reach: float, before: float = 0.0) -> np.ndarray:
        """Add a scan. Returns the flat indices of the cells whose state changed, int32.

        Args:
            reach: m, up to which a ray without a return shows free space.
            before: m before a return from which on a ray shows none.
        """
        count = call(
            "tgco_add_scan", self._size, self.corner, self.resolution, self.odds, self.state, self._beside,
            self._counts, len(scan.distances), np.ascontiguousarray(scan.origin, np.float64),
            np.ascontiguousarray(scan.directions, np.float64), np.ascontiguousarray(scan.distances, np.float64),
            float(reach), float(before), CHORD * self.resolution,
            HIT, MISS, LEAST_ODDS, MOST_ODDS, FREE_AT, FREE_BESIDE, OCCUPIED_AT, self._touched, self._changed,
        )  # fmt: skip
        return self._changed[:count].copy()

    def clear(self, center: Sequence[float] | np.ndarray, radius: float) -> np.ndarray:
        """Mark the cells whose cubes touch a ball as free, as if seen. Returns the indices of those that changed."""
        axes = [self.corner[i] + (np.arange(self.shape[i]) + 0.5) * self.resolution for i in range(3)]
        away = [
            np.clip(np.abs(axis - p) - 0.5 * self.resolution, 0, None) for axis, p in zip(axes, center, strict=True)
        ]
        near = sum(np.meshgrid(*(offset**2 for offset in away), indexing="ij")) <= radius**2
        new = near & (self.state == UNKNOWN)
        self.odds[new], self.state[new] = FREE_BESIDE, FREE
        return np.flatnonzero(new).astype(np.int32)

    def remeasure(self, changed: np.ndarray) -> None:
        """Update the distances around cells that have changed, given by flat indices, int32."""
        if len(changed):
            call(
                "tgco_distances_around", self._size, self.resolution, self.state, self.reach, len(changed), changed,
                self._touched, self._work, self.from_occupied,
            )  # fmt: skip

    def measure(self) -> None:
        """Compute the distances of all cells."""
        call(
            "tgco_distances", self._size, self.resolution, self.state, SEEN_OCCUPIED, 1, self.reach,
            np.zeros(3, np.int64), self._size, self._work, self.from_occupied,
        )  # fmt: skip

    def cell(self, point: Sequence[float] | np.ndarray) -> np.ndarray:
        """The cell (3,) int64 that holds a point, or the nearest of the grid."""
        cell = np.floor((np.asarray(point) - self.corner) / self.resolution).astype(np.int64)
        return np.clip(cell, 0, self._size - 1)

    def box(self, inset: float) -> tuple[np.ndarray, np.ndarray]:
        """The lowest and the highest point (3,), m, of what is left of the grid `inset`, m, within its faces."""
        high = self.corner + self._size * self.resolution
        by = np.minimum(inset, 0.5 * (high - self.corner))
        return self.corner + by, high - by

    def centers(self, cells: np.ndarray) -> np.ndarray:
        """The centres (K, 3), m, of cells given by flat indices (K,)."""
        return self.corner + (np.stack(np.unravel_index(cells, self.shape), axis=-1) + 0.5) * self.resolution

    def gaps(self, points: np.ndarray, reach: float, kinds: int = NOT_FREE) -> np.ndarray:
        """Distances (K,), m, of points (K, 3) from cells of these kinds, exact up to `reach`, m, else that.

        What lies outside of the grid is blocked.
        """
        points, gap = np.ascontiguousarray(points, np.float64), np.empty(len(points))
        reach = float(min(reach, self.reach * self.resolution))
        call("tgco_gaps", self._size, self.corner, self.resolution, self.state, kinds, reach, len(points), points, gap)
        return gap

    def corridor(self, points: np.ndarray, reach: float, most: int, kinds: int = NOT_FREE) -> tuple[np.ndarray, ...]:
        """Half-spaces n x >= b around points (K, 3) that cut off all cells of these kinds within `reach`, m.

        The faces of the grid cut off nothing: see `box`.

        Returns:
            (K, most, 4): n and b, zeros where fewer planes are needed; and (K,), m: how far each point may move before
            a cell counts that no plane has cut off.
        """
        points = np.ascontiguousarray(points, np.float64)
        planes, room = np.zeros((len(points), most, 4)), np.empty(len(points))
        low, high = self.cell(points.min(axis=0) - reach), self.cell(points.max(axis=0) + reach)
        need = 7 * int(np.prod(high - low + 1)) + 4
        if len(self._scratch) < need:
            self._scratch = np.empty(need)
        call(
            "tgco_corridor", self._size, self.corner, self.resolution, self.state, kinds, float(reach), len(points),
            points, most, low, high, planes, room, self._scratch, self._layers,
        )  # fmt: skip
        return planes, room
