"""Obstacles as the page draws them: boxes, rounded outwards by a radius. A sphere is one without sides.

A kind of obstacles of your own is drawn once `SHAPES` has a function for it:

    SHAPES[Shore] = lambda shore, b: Shapes(center, half, radius)  # of problem b, as numpy arrays

Without one it is drawn as the search for paths sees it (`Obstacles.inflated`), and else not at all; the page says so.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from torch import Tensor

from torchgco.maps.distance import Unknown
from torchgco.maps.field import BoundField
from torchgco.maps.grid import OccupancyGrid
from torchgco.maps.points import PointCloud
from torchgco.obstacles.base import Obstacles, Solids
from torchgco.obstacles.box_geometry import Cuboids
from torchgco.obstacles.spheres import BoundSpheres
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

    def packed(self, packing: Packing, middle: np.ndarray) -> dict[str, Any]:
        """As the page reads them; centres count from `middle` (d,), near which half precision is finest."""
        held: dict[str, Any] = {"count": len(self.center), "until": self.until, "middle": middle.tolist()}
        held |= {"cells": self.cells, "unknown": self.unknown}
        arrays = {"center": self.center - middle, "half": self.half, "radius": self.radius, "turn": self.turn}
        arrays["velocity"] = self.velocity
        return held | {name: packing.put(once(part)) for name, part in arrays.items() if part is not None}


ShapesOf = Callable[[Any, int], Shapes]


def once(rows: np.ndarray) -> np.ndarray:
    """Equal rows as a single one."""
    return rows[:1] if len(rows) > 1 and bool((rows == rows[0]).all()) else rows


def _rows(values: Tensor, b: int, here: Tensor) -> np.ndarray:
    return values[b][here].detach().cpu().double().numpy()


def _spheres(part: BoundSpheres, b: int) -> Shapes:
    still = _solids(part, Solids(part.centers, part.inflated_radii, part.absent), b)
    stop = None if part.stops is None else float(part.stops[b]) * part.dt
    if part.velocities is None or not bool(part.velocities[b].any()):
        return replace(still, until=stop)
    return replace(still, velocity=_rows(part.velocities, b, ~part.absent[b]), until=stop)


def _solids(part: Obstacles, solids: Solids, b: int) -> Shapes:
    here = ~solids.absent[b]
    center = _rows(solids.centers, b, here)
    radius = (_rows(solids.radii, b, here) - float(part.vehicle_radius[b])).clip(min=0.0)
    if not isinstance(solids, Cuboids):
        return Shapes(center, np.zeros((1, center.shape[1])), radius)
    return Shapes(center, _rows(solids.half_sizes, b, here), radius, turns(_rows(solids.axes, b, here)))


def _map(part: BoundField, b: int) -> Shapes:
    """The occupied cells of a grid, or the balls of a cloud."""
    field, g = part.field, int(part.which[b])
    if isinstance(field.source, PointCloud):
        points = field.source.clouds()[g]
        return Shapes(points, np.zeros((1, field.d)), np.array([field.source.radius]))
    grid = field.source.single(g)
    return _cells(grid, grid.is_occupied)


def unknown_of(part: Obstacles, b: int) -> Shapes | None:
    """The unknown cells of a map; None where there are none."""
    if not isinstance(part, BoundField) or not isinstance(part.field.source, OccupancyGrid):
        return None
    grid = part.field.source.single(int(part.which[b]))
    return _cells(grid, grid.is_unknown, part.field.unknown) if bool(grid.is_unknown.any()) else None


def _cells(grid: OccupancyGrid, cells: np.ndarray, unknown: Unknown | None = None) -> Shapes:
    low, high = merged(cells)
    center = grid.origin + 0.5 * grid.resolution * (low + high)
    return Shapes(center, 0.5 * grid.resolution * (high - low), np.zeros(1), cells=True, unknown=unknown)


# What the page draws for obstacles of each kind, once bound to a problem, and the place of a problem in its batch.
SHAPES: dict[type[Obstacles], ShapesOf] = {BoundSpheres: _spheres, BoundField: _map}


def shapes_of(part: Obstacles, b: int) -> Shapes | None:
    """The obstacles of problem b; None where nobody says how they look."""
    for kind, shapes in SHAPES.items():
        if isinstance(part, kind):
            return shapes(part, b)
    solids = part.inflated()
    return None if solids is None else _solids(part, solids, b)


def turns(axes: np.ndarray) -> np.ndarray | None:
    """Angles (M,), or unit quaternions (M, 4), of sides along the rows of axes (M, d, d); None: all are straight."""
    if bool((np.abs(axes - np.eye(axes.shape[-1])) < 1e-9).all()):
        return None
    if axes.shape[-1] == 2:
        return np.arctan2(axes[:, 0, 1], axes[:, 0, 0])
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
