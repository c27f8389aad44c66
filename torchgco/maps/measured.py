"""Distances from what a map holds, as the judge and the certificate measure them: from cells as boxes, from points.

Nothing is shared with the solvers' distance fields: cells and points near a segment are found in a tree, and each is
measured by itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from torchgco.base.shapes import computing_on
from torchgco.maps.distance import DistanceField
from torchgco.maps.grid import OccupancyGrid
from torchgco.obstacles.measured import closest

EXACT_TO = 2.0  # m: distances up to here are exact, farther ones lower bounds
BOUND_ROUNDING = 1e-12  # m, of a bound's rounding
PAIRS_AT_ONCE = 2**17  # pairs measured together


@dataclass(frozen=True)
class Solid:
    """The occupied cells next to free ones, or the points, of one map."""

    centers: np.ndarray  # (P, d), m
    half: float  # half a cell's side; 0 for points
    radius: float  # of points; 0 for cells
    tree: Any  # scipy's, of the centres; None where there is none
    cells: np.ndarray | None = None  # whether cells are occupied; the first one's lowest corner
    origin: np.ndarray | None = None

    @property
    def reach(self) -> float:
        """The largest distance of a solid's surface from its centre, m."""
        return self.half * self.centers.shape[1] ** 0.5 + self.radius

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Whether points (Q, d) lie in occupied cells, those inside of others among them."""
        if self.cells is None or self.origin is None:
            return np.zeros(len(points), bool)
        with np.errstate(invalid="ignore"):
            cell = np.floor((points - self.origin) / (2 * self.half))
        within: np.ndarray = np.all((cell >= 0) & (cell < self.cells.shape), axis=-1)
        index = np.where(within[:, None], cell, 0).astype(int)
        occupied: np.ndarray = self.cells[tuple(index.T)]
        return np.logical_and(within, occupied)


def segment_distances(field: DistanceField, which: Tensor, p: Tensor) -> Tensor:
    """Distances (B, K-1), m, of a field's maps `which` (B,) from the straight segments between points p (B, K, d).

    Below `EXACT_TO` close lower bounds, within 1e-9 m, of the signed distances from the nearest cell or point: negative
    where a segment enters one. Farther away they may be loose. Infinite where nothing is occupied, NaN at points that
    are NaN.
    """
    paths = zip(which.tolist(), p.detach().cpu().double(), strict=True)
    with computing_on(torch.device("cpu")):  # as the trees of solids do, wherever the problem lies
        rows = [path_distances(field, i, path) for i, path in paths]
    return torch.stack(rows).to(p)


def path_distances(field: DistanceField, which: int, p: Tensor) -> Tensor:
    """The same for points p (K, d), float64, and one of a field's maps, (K-1,)."""
    solid, a, along = solids_of(field)[which], p[:-1], p.diff(dim=0)
    finite = torch.isfinite(a).all(-1) & torch.isfinite(along).all(-1)
    distances = torch.where(finite, torch.inf, torch.nan).double()
    rows = finite.nonzero().flatten().numpy()
    if solid.tree is None or len(rows) == 0:
        return distances
    middle, half = (a + 0.5 * along)[rows].numpy(), 0.5 * along[rows].norm(dim=-1).numpy()
    nearest, _ = solid.tree.query(middle)
    # The distance changes no faster than the point moves, and a solid reaches no farther than `reach`.
    bound = nearest - half - solid.reach - BOUND_ROUNDING
    close = bound < EXACT_TO
    distance = bound.copy()
    distance[close] = np.inf
    distance[close] = _measured(solid, a[rows[close]], along[rows[close]], middle[close], (nearest + half)[close])
    inside = solid.holds(a[rows].numpy()) | solid.holds((a + along)[rows].numpy())
    distances[rows] = torch.from_numpy(np.where(inside, np.minimum(distance, -solid.half), distance))
    return distances


def _measured(solid: Solid, a: Tensor, along: Tensor, middle: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Distances (E,) of the solids from segments from a to a + along (E, d), with one at `least` (E,) at most."""
    lists = solid.tree.query_ball_point(middle, least + solid.reach + BOUND_ROUNDING) if len(middle) else []
    near = np.concatenate([np.asarray(ball, int) for ball in lists]) if len(lists) else np.zeros(0, int)
    segment = np.repeat(np.arange(len(lists)), [len(ball) for ball in lists])
    distance = np.full(len(middle), np.inf)
    for first in range(0, len(near), PAIRS_AT_ONCE):
        pairs = slice(first, first + PAIRS_AT_ONCE)
        which, center = segment[pairs], torch.from_numpy(solid.centers[near[pairs]])
        axes = torch.eye(center.shape[1], dtype=center.dtype).expand(len(center), -1, -1)
        away = closest(axes, center, torch.full_like(center, solid.half), a[which], along[which])
        np.minimum.at(distance, which, away.numpy() - solid.radius)
    return distance


def solids_of(field: DistanceField) -> list[Solid]:
    """What each of a field's maps holds; kept as long as the map."""
    kept = _kept.setdefault(field.source, {})
    if field.unknown not in kept:
        kept[field.unknown] = _solids(field)
    return kept[field.unknown]


_kept: WeakKeyDictionary[object, dict[str, list[Solid]]] = WeakKeyDictionary()


def _solids(field: DistanceField) -> list[Solid]:
    source = field.source
    if not isinstance(source, OccupancyGrid):
        return [Solid(points, 0.0, source.radius, _tree(points)) for points in source.clouds()]
    each = source.held(field.unknown)
    origins = np.broadcast_to(source.origin, (len(each), source.d))
    solids = []
    for cells, origin in zip(each, origins, strict=True):
        inner = padded = np.pad(cells, 1)
        for axis in range(cells.ndim):
            inner = inner & np.roll(padded, 1, axis) & np.roll(padded, -1, axis)
        surface = np.argwhere(cells & ~inner[tuple([slice(1, -1)] * cells.ndim)])
        centers = origin + source.resolution * (surface + 0.5)
        solids.append(Solid(centers, 0.5 * source.resolution, 0.0, _tree(centers), cells, origin))
    return solids


def _tree(points: np.ndarray) -> Any:
    from scipy.spatial import cKDTree

    return cKDTree(points) if len(points) else None
