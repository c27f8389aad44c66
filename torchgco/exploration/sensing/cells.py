"""Global search on a vehicle's map: cells that aren't known to be occupied may be passed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from torchgco.exploration.sensing.grid import SeenMap
from torchgco.exploration.sensing.library import call

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
