"""Layouts as maps: the cells whose centres lie in spheres, capsules and sharp boxes, or that these reach into."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from torchgco.maps import OccupancyGrid
from torchgco.obstacles.box_geometry import segment_distance
from torchgco.scenarios import Layouts

BESIDE = 6.0  # m: so far beyond start and goal a map extends, along each axis
PASSAGE = 2.0  # m beyond the shapes, so that ways around all of them lie on the map
TOUCH = 1e-9  # m: cells that a shape touches by less are free


@dataclass(frozen=True)
class Window:
    """The part of space that a map shows: from `origin` on, `shape` cells of `resolution`."""

    origin: np.ndarray
    shape: tuple[int, ...]
    resolution: float
    reach: float  # half the side of the boxes, around the centres of cells, into which a shape has to reach

    @classmethod
    def around(cls, layouts: Layouts, index: int, resolution: float, touching: bool) -> Window:
        """The window around start, goal and all shapes of a layout."""
        assert layouts.start is not None and layouts.goal is not None
        ends = np.stack([part[index, : layouts.dimension] for part in (layouts.start, layouts.goal)])
        scale = min(1.0, float(np.ptp(ends, axis=0).max()) / BESIDE)  # of small worlds, as that of planar_random
        shapes = np.concatenate([[ends[0]], *_extents(layouts, index)])
        low = np.minimum(ends.min(0) - scale * BESIDE, shapes.min(0) - scale * PASSAGE)
        high = np.maximum(ends.max(0) + scale * BESIDE, shapes.max(0) + scale * PASSAGE)
        shape = tuple(np.ceil((high - low) / resolution - 1e-6).astype(int).tolist())
        return cls(low, shape, resolution, 0.5 * resolution if touching else 0.0)

    def cells(self, low: np.ndarray, high: np.ndarray) -> tuple[slice, ...]:
        """The cells that may reach into the box between two corners (d,), m."""
        first = np.floor((low - self.origin) / self.resolution).astype(int)
        last = np.ceil((high - self.origin) / self.resolution).astype(int)
        limits = zip(first, last, self.shape, strict=True)
        return tuple(slice(min(max(0, a), n), min(max(0, b), n)) for a, b, n in limits)

    def centers(self, cells: tuple[slice, ...]) -> np.ndarray:
        """Their centres, (..., d), m."""
        places = np.stack(np.meshgrid(*(np.arange(part.start, part.stop) for part in cells), indexing="ij"), axis=-1)
        return self.origin + self.resolution * (places + 0.5)


def rasterised(
    layouts: Layouts, index: int, resolution: float, touching: bool = False, enclosed: bool = True
) -> OccupancyGrid:
    """A layout as a grid.

    Args:
        touching: whether a cell is occupied where a shape reaches into it; else where its centre lies in one.
        enclosed: whether the outermost cells are occupied, so that no way leads around the map.
    """
    window = Window.around(layouts, index, resolution, touching)
    occupied = np.zeros(window.shape, bool)
    for center, radius in zip(layouts.centers[index], layouts.radii[index], strict=True):
        if np.isfinite(radius):
            _mark(occupied, window, center, center, radius)
    if layouts.box_centers is not None and layouts.box_half_sizes is not None:
        for k, center in enumerate(layouts.box_centers[index]):
            if np.isfinite(center).all():
                _box(occupied, window, layouts, index, k)
    if enclosed:
        for axis in range(occupied.ndim):
            edges = np.moveaxis(occupied, axis, 0)
            edges[0] = edges[-1] = True
    return OccupancyGrid(occupied, window.origin, resolution)


def _extents(layouts: Layouts, index: int) -> list[np.ndarray]:
    """The lowest and highest points (K, d), m, of a layout's shapes: those of the spheres, then of the boxes."""
    there = np.isfinite(layouts.radii[index])
    centers, radii = layouts.centers[index, there], layouts.radii[index, there, None]
    found = [centers - radii, centers + radii]
    if layouts.box_centers is not None and layouts.box_half_sizes is not None:
        for k in np.flatnonzero(np.isfinite(layouts.box_centers[index]).all(-1)):
            radius = 0.0 if layouts.box_radii is None else layouts.box_radii[index, k]
            reach = _reach(layouts, index, k) + radius
            found.append(layouts.box_centers[index, k] + np.outer([-1.0, 1.0], reach))
    return found


def _mark(occupied: np.ndarray, window: Window, a: np.ndarray, b: np.ndarray, radius: float) -> None:
    """Mark the cells that are nearer than a radius to the segment from a to b (d,)."""
    cells = window.cells(np.minimum(a, b) - radius, np.maximum(a, b) + radius)
    local = a - window.centers(cells)
    begin = [torch.from_numpy(np.ascontiguousarray(x)) for x in np.moveaxis(local, -1, 0)]
    along = [torch.full_like(begin[0], float(x)) for x in b - a]
    half = [torch.full_like(begin[0], window.reach)] * len(begin)
    occupied[cells] |= segment_distance(begin, along, half).numpy() < radius - TOUCH


def _box(occupied: np.ndarray, window: Window, layouts: Layouts, index: int, k: int) -> None:
    assert layouts.box_centers is not None and layouts.box_half_sizes is not None
    center, half = layouts.box_centers[index, k], layouts.box_half_sizes[index, k]
    radius = 0.0 if layouts.box_radii is None else float(layouts.box_radii[index, k])
    axes = _box_axes(layouts, index, k)
    if radius > 0 and (half > 0).sum() <= 1:
        side = (axes * half[:, None]).sum(0)
        _mark(occupied, window, center - side, center + side, radius)
        return
    if radius > 0:
        raise ValueError("rounded boxes with more than one side aren't rasterised")
    reach = _reach(layouts, index, k)
    cells = window.cells(center - reach, center + reach)
    away = window.centers(cells) - center
    # Boxes that no axis of either separates; a few cells at turned edges are marked although they only come near.
    own = (np.abs(away @ axes.T) < half + window.reach * np.abs(axes).sum(1) - TOUCH).all(-1)
    space = (np.abs(away) < reach + window.reach - TOUCH).all(-1)
    occupied[cells] |= own & space


def _box_axes(layouts: Layouts, index: int, k: int) -> np.ndarray:
    """The directions of a box's sides, as rows."""
    return np.eye(layouts.dimension) if layouts.box_rotations is None else _axes(layouts.box_rotations[index, k])


def _reach(layouts: Layouts, index: int, k: int) -> np.ndarray:
    """How far the sharp box k reaches from its centre along each axis, (d,), m."""
    assert layouts.box_half_sizes is not None
    return (np.abs(_box_axes(layouts, index, k)) * layouts.box_half_sizes[index, k][:, None]).sum(0)


def _axes(rotation: np.ndarray) -> np.ndarray:
    """The directions of a box's sides, as rows: from an angle, or a quaternion about z alone."""
    if rotation.ndim == 0:
        c, s = np.cos(rotation), np.sin(rotation)
        return np.array([[c, s], [-s, c]])
    w, x, y, z = rotation
    if x != 0 or y != 0:
        raise ValueError("boxes turned about another axis than z aren't rasterised")
    c, s = w * w - z * z, 2 * w * z
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
