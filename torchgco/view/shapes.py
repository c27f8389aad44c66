"""Obstacles as the page draws them: boxes, rounded outwards by a radius. A sphere is one without sides.

A kind of obstacles of your own says how it looks in `shapes`; without that it is drawn as the search for paths sees it
(`Obstacles.inflated`), and else not at all; the page says so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil, pi
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from torchgco.maps.distance import Unknown
from torchgco.maps.grid import OccupancyGrid, PointCloud
from torchgco.obstacles.base import Obstacles
from torchgco.obstacles.shapes import RoundedBoxes
from torchgco.view.packing import Packing

NOT_TURNED = (1.0, 0.0, 0.0, 0.0)  # the quaternion of no turn


@dataclass(frozen=True)
class Shapes:
    """M rounded boxes; lengths in metres. An array of one row stands for M equal rows, which takes less room.

    Args:
        center: (M, d) at t = 0.
        half: (M | 1, d): half the sides' lengths before rounding; zero: a sphere, or a disc in the plane.
        radius: (M | 1,) by which they are rounded.
        turn: (M | 1, 4) unit quaternions [w, x, y, z], or (M | 1,) angles in the plane; None: sides along the axes.
        velocity: (M | 1, d), m/s; None: at rest.
        track: (T, M, d), where centres are every `step` seconds, between which they move evenly; None: by velocity.
        until: s, when they stop to move and to count; None: never.
        cells: of a map, which may have a ceiling that the page cuts off at first.
        unknown: what they count as, of the cells that a map doesn't know; None: others.
    """

    center: np.ndarray
    half: np.ndarray
    radius: np.ndarray
    turn: np.ndarray | None = None
    velocity: np.ndarray | None = None
    until: float | None = None
    cells: bool = False
    unknown: Unknown | None = None
    track: np.ndarray | None = None
    step: float = 0.0

    def packed(self, packing: Packing, middle: np.ndarray) -> dict[str, Any]:
        """As the page reads them; centres count from `middle` (d,), near which half precision is finest."""
        entry: dict[str, Any] = {"count": len(self.center), "until": self.until, "middle": middle.tolist()}
        entry |= {"cells": self.cells, "unknown": self.unknown}
        arrays = {"center": self.center - middle, "half": self.half, "radius": self.radius, "turn": self.turn}
        arrays["velocity"] = self.velocity
        if self.track is not None:
            entry |= {"knots": len(self.track), "step": self.step}
            arrays["track"] = (self.track - middle).reshape(-1, self.track.shape[-1])
        return entry | {name: packing.put(once(array)) for name, array in arrays.items() if array is not None}


def once(rows: np.ndarray) -> np.ndarray:
    """Equal rows as a single one."""
    return rows[:1] if len(rows) > 1 and bool((rows == rows[0]).all()) else rows


def _map(obstacles: Any, b: int) -> Shapes:
    """The occupied cells of a grid, or the balls of a cloud."""
    field, g = obstacles.field, int(obstacles.which[b])
    if isinstance(field.source, PointCloud):
        points = field.source.clouds()[g]
        return Shapes(points, np.zeros((1, field.d)), np.array([field.source.radius]))
    grid = field.source.single(g)
    return _cells(grid, grid.is_occupied)


def unknown_of(obstacles: Obstacles, b: int) -> Shapes | None:
    """The unknown cells of a map; None where there are none."""
    if obstacles.map is None or not isinstance(obstacles.map.field.source, OccupancyGrid):
        return None
    grid = obstacles.map.field.source.single(int(obstacles.map.which[b]))
    return _cells(grid, grid.is_unknown, obstacles.map.field.unknown) if bool(grid.is_unknown.any()) else None


def _cells(grid: OccupancyGrid, cells: np.ndarray, unknown: Unknown | None = None) -> Shapes:
    low, high = merged(cells)
    center = grid.origin + 0.5 * grid.resolution * (low + high)
    return Shapes(center, 0.5 * grid.resolution * (high - low), np.zeros(1), cells=True, unknown=unknown)


def shapes_of(obstacles: Obstacles, b: int, duration: float) -> Shapes | None:
    """The obstacles of problem b, as one that is a ball meets them; None where nobody says how they look.

    Args:
        duration: s, for which those that swing follow their sines, but for 0.5 % of the swing.
    """
    if obstacles.map is not None:
        return _map(obstacles.map, b)
    boxes = obstacles.shapes(b)
    if boxes is None:
        return None
    if boxes.sines is not None:
        boxes = _sampled(boxes, duration)
    until = None if obstacles.stops is None else float(obstacles.stops[b]) * obstacles.dt
    half, turn = np.zeros((1, boxes.center.shape[1])), None
    if boxes.half.any():
        half, turn = boxes.half, turns(boxes.sides)
    motion = {"velocity": boxes.velocity, "until": until, "track": boxes.track, "step": boxes.step}
    return Shapes(boxes.center, half, boxes.radius, turn, **motion)


def _sampled(boxes: RoundedBoxes, duration: float) -> RoundedBoxes:
    """Boxes that swing, as boxes with a track, sampled 32 times in the shortest period."""
    assert boxes.sines is not None
    amplitudes, rates, phases = boxes.sines
    fastest = np.abs(rates[amplitudes != 0]).max(initial=0.0)
    count = max(1, ceil(duration * fastest * 32 / (2 * pi)))
    t = np.linspace(0.0, duration, count + 1).reshape(-1, 1, 1, 1)
    track = boxes.center + (amplitudes * np.sin(rates * t + phases)).sum(axis=2)
    return replace(boxes, center=track[0], sines=None, track=track, step=duration / count)


def turns(axes: np.ndarray) -> np.ndarray | None:
    """Angles (M,), or unit quaternions (M, 4), of sides along the rows of axes (M, d, d); None: all are straight."""
    if bool((np.abs(axes - np.eye(axes.shape[-1])) < 1e-9).all()):
        return None
    if axes.shape[-1] == 2:
        return np.arctan2(axes[:, 0, 1], axes[:, 0, 0])
    axes = axes * np.sign(np.linalg.det(axes))[:, None, None]  # a box is the same with all its sides turned about
    return Rotation.from_matrix(axes.transpose(0, 2, 1)).as_quat(scalar_first=True)


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
