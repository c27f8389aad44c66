"""What a vehicle saw of its world and sought on its map, period by period, as the page shows it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchgco.exploration.sensing.grid import OCCUPIED
from torchgco.missions.log import SeenLog
from torchgco.view.packing import Packing

STRAIGHT = 1e-9  # m: corners of a path that turn it less are left out


@dataclass(frozen=True)
class Sensed:
    """The map of a mission with a sensor, its paths, and which of its plans are safe; K control periods.

    Args:
        seen: how the map changed.
        sought: paths (P, d), m, to the goal over cells that aren't known to be occupied, one per period.
        safe: (K,) bool: whether the plan comes to rest in space that is known to be free.
    """

    seen: SeenLog
    sought: Sequence[np.ndarray]
    safe: np.ndarray

    def until(self, periods: int) -> Sensed:
        """The first periods alone."""
        log = self.seen
        seen = SeenLog(log.corner, log.shape, log.resolution, log.changes[:periods], log.safe[:periods])
        return Sensed(seen, self.sought[:periods], self.safe[:periods])

    def packed(self, packing: Packing, heights: np.ndarray) -> dict[str, Any]:
        """As the page reads it: a change is the number of its cell plus its new state times the number of all cells.

        Args:
            heights: (K,), m, of the vehicle; free cells are shown, and kept, where it flies alone.
        """
        log, cells, kept = self.seen, int(np.prod(self.seen.shape)), self._kept(heights)
        changes = [
            np.sort(index[kept[index]].astype(np.int64) + cells * states[kept[index]].astype(np.int64))
            for index, states in log.changes
        ]
        paths = [corners(path) for path in self.sought]
        none = np.zeros(0, np.int64)
        return {
            "corner": log.corner.tolist(), "shape": list(log.shape), "resolution": log.resolution,
            "changes": packing.put_whole(np.concatenate([none, *changes])),
            "counts": packing.put_whole(np.array([len(change) for change in changes])),
            "paths": packing.put(np.concatenate([np.zeros((0, len(log.shape))), *paths]), steps=True),
            "corners": packing.put_whole(np.array([len(path) for path in paths])),
            "safe": [int(safe) for safe in self.safe],
        }  # fmt: skip

    def _kept(self, heights: np.ndarray) -> np.ndarray:
        """Which cells, by flat index, are occupied at any time, or at a height where the vehicle flies."""
        log = self.seen
        kept = np.zeros(log.shape, dtype=bool)
        levels = np.floor((heights - log.corner[2]) / log.resolution).clip(0, log.shape[2] - 1).astype(int)
        kept[:, :, levels.min() : levels.max() + 1] = True
        flat = kept.reshape(-1)
        for index, states in log.changes:
            flat[index[states == OCCUPIED]] = True
        return flat


def corners(path: np.ndarray) -> np.ndarray:
    """The points of a path (P, d) at which it turns, with its ends."""
    if len(path) < 3:
        return path
    before, after = path[1:-1] - path[:-2], path[2:] - path[1:-1]
    length = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    turns = length - (before * after).sum(axis=1) > STRAIGHT
    return path[np.concatenate([[True], turns, [True]])]
