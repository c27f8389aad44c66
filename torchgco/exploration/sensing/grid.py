"""The map that a vehicle makes of what it sees, and global search on it, which may pass unknown cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

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


ENTRIES = 8  # of the heap, for each cell
ENTRY_BYTES = 8
COSTLY = 20.0  # by which share a step into an avoided cell costs more


@dataclass
class CellSearch:
    """Cheapest paths on a map, by A* over the 26 neighbours of each cell.

    Args:
        seen: the map.
        radius: distance, m, that the centres of a path's cells keep from occupied ones, except around the start.
        band: m beyond the radius in which a step costs more.
        shy: by which share it costs more at the radius.
        unseen: by which share it costs more into a cell that is unknown: what is known to be free leads farther.
        nearby: m around the start within which it does: where nearly all is unknown, the search would be slow by it.
        greed: paths cost at most so many times what the cheapest does; more than 1 is quicker.
        stride: cells between two of a path: the search passes every so many along each axis.
        near: m from the goal at which a path has arrived.
        leave: m around the start in which the path may be nearer to occupied cells.
        limit: cells that one call looks at, at most; the next call goes on. 0: all that it needs.
    """

    seen: SeenMap
    radius: float
    band: float = 0.5
    shy: float = 1.0
    unseen: float = 0.0
    nearby: float = 8.0
    greed: float = 1.0
    stride: int = 1
    near: float = 0.0
    leave: float = 0.0
    limit: int = 0
    expanded: int = 0  # cells in the last call
    pending: tuple[Any, ...] | None = None  # of a search that hasn't ended: where it began, and its goal and options
    _round: int = 0
    price: np.ndarray = field(init=False)  # (X, Y, Z) float32: further cost of a step into a cell, per cell of length

    def __post_init__(self) -> None:
        shape = self.seen.shape
        self.price = np.zeros(shape, np.float32)
        self._sum, self._from = np.empty(shape, np.float32), np.empty(shape, np.int32)
        self._seen = np.full(shape, -1, np.int32)
        self._room = ENTRIES * self._sum.size
        self._heap = np.empty(self._room * ENTRY_BYTES, np.uint8)
        self._path = np.empty(self._sum.size, np.int32)
        self._left = np.zeros(2, np.int64)

    def path(self, start: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, bool] | None:
        """Centres (K, 3), m, of the cells from start to goal, (3,), m; and whether it arrives.

        Where no path leads to the goal, it ends at the nearest cell to it that can be reached. None: the search hasn't
        ended within its limit. It then goes on from where it began, over the map as it is by then.
        """
        seen, asked = self.seen, (tuple(self.seen.cell(goal)), self.radius, self.stride)
        if self.pending is None or self.pending[1:] != asked:
            self._round, self._left[:] = self._round + 1, 0
            self.pending = (seen.cell(start), *asked)
        expanded = np.zeros(1, np.int64)
        leave, size = int(np.ceil(self.leave / seen.resolution)), seen.resolution
        count = call(
            "tgco_search", np.array(seen.shape, np.int64), seen.from_occupied, seen.state, self.price, self.radius,
            self.band, self.shy, self.unseen, self.nearby / size, self.greed, leave, self.stride,
            self.pending[0], seen.cell(goal), self.near / size, self._round, self._sum, self._from, self._seen,
            self._room, self._heap, self._path, self.limit or np.iinfo(np.int64).max, self._left, expanded,
        )  # fmt: skip
        self.expanded = int(expanded[0])
        if count == 0:
            return None
        self.pending = None
        return seen.centers(self._path[: abs(count)][::-1]), count > 0

    def cost(self, path: np.ndarray) -> float:
        """What a path (K, 3), m, costs on the map as it is, in cells; infinity where it is blocked.

        Unknown cells cost more wherever they are. With `nearby`, each of two paths may be the cheapest where the other
        one leads: a vehicle that takes the cheapest would fly to and fro.
        """
        seen = self.seen
        cells = tuple(np.floor((path - seen.corner) / seen.resolution).astype(int).clip(0, np.array(seen.shape) - 1).T)
        distance = seen.from_occupied[cells]
        if (distance[np.linalg.norm(path - path[0], axis=1) > self.leave] < self.radius).any():
            return np.inf
        close = (1.0 - (distance - self.radius) / self.band).clip(0.0)
        unseen = self.unseen * np.where(close > 0, 4.0, 1.0) * (seen.state[cells] == 0)
        each = 1.0 + self.price[cells] + self.shy * close + unseen
        return float(np.linalg.norm(np.diff(path, axis=0), axis=1) @ each[1:]) / seen.resolution

    def avoid(self, point: np.ndarray, radius: float) -> None:
        """Make the cells within `radius`, m, of a point (3,) costly: nothing more is seen of them from before."""
        seen = self.seen
        axes = [seen.corner[i] + (np.arange(seen.shape[i]) + 0.5) * seen.resolution - point[i] for i in range(3)]
        near = sum(np.meshgrid(*(axis**2 for axis in axes), indexing="ij")) <= radius**2
        self.price[near] += COSTLY
