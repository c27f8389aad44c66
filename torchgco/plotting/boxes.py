"""Boxes as a map shows them: their outlines from above, rounded, also grown by the vehicle's radius."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull

DIRECTIONS = 72  # in which a grown outline is drawn


class Outline(NamedTuple):
    """A box seen from above, a rounded one with a corner in each of DIRECTIONS."""

    corners: np.ndarray  # (P, 2) m, counterclockwise
    height: float  # of its centre, m; nan in the plane

    def grown(self, radius: float) -> np.ndarray:
        """The outline (DIRECTIONS, 2) of all points within `radius`, m."""
        return _around(self.corners, radius)


def outlines(layouts: Mapping[str, np.ndarray], i: int) -> tuple[Outline, ...]:
    """The boxes present in layout i of the arrays of a layout file."""
    if "box_centers" not in layouts:
        return ()
    centers, halves = (np.asarray(layouts[name], dtype=float)[i] for name in ("box_centers", "box_half_sizes"))
    turns, rounding = layouts.get("box_rotations"), layouts.get("box_radii")
    found = []
    for k in np.flatnonzero(np.isfinite(centers).all(axis=1)):
        d = centers.shape[1]
        sides = np.eye(d) if turns is None else _sides(np.asarray(turns, dtype=float)[i, k])
        corners = centers[k] + np.array(list(product((-1.0, 1.0), repeat=d))) * halves[k] @ sides
        seen, radius = corners[:, :2], 0.0 if rounding is None else float(np.asarray(rounding)[i, k])
        # Rounded boxes may have sides of length 0, and then no hull of their corners.
        outer = _around(seen, radius) if radius > 0 else seen[ConvexHull(seen).vertices]
        found.append(Outline(outer, float(centers[k, 2]) if d == 3 else np.nan))
    return tuple(found)


def _around(corners: np.ndarray, radius: float) -> np.ndarray:
    """The outline (DIRECTIONS, 2) of all points within `radius` of a convex polygon with corners (P, 2)."""
    angle = np.linspace(0.0, 2.0 * np.pi, DIRECTIONS, endpoint=False)
    rays = np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    return corners[(rays @ corners.T).argmax(axis=1)] + radius * rays


def _sides(turn: np.ndarray) -> np.ndarray:
    """The directions (d, d) of a box's sides, as rows, from an angle or a quaternion [w, x, y, z]."""
    if turn.ndim == 0:
        return np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    w, v = turn[0], turn[1:]
    rows = [2.0 * (v @ e) * v + (w * w - v @ v) * e + 2.0 * w * np.cross(v, e) for e in np.eye(3)]
    return np.array(rows) / (turn @ turn)
