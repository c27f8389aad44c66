"""Obstacles as a map shows them: seen along an axis or cut by a plane."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from scipy.spatial import ConvexHull

from torchgco.obstacles.measured import closest, segment_distance
from torchgco.obstacles.shapes import RoundedBoxes

Plane = tuple[int, int]  # the two coordinates that a map shows: (0, 1) from above, (0, 2) from the side
ABOVE: Plane = (0, 1)
SIDE: Plane = (0, 2)
ANGLES = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
RAYS = np.stack((np.cos(ANGLES), np.sin(ANGLES)), axis=-1)  # in which rounded outlines are drawn
EDGES = np.array([(i, i + bit) for bit in (1, 2, 4) for i in range(8) if not i & bit])  # of a box, by its corners
FLAT = 1e-12  # m: an edge that rises less lies in a plane
LEVELS = np.sin(np.linspace(-0.5 * np.pi, 0.5 * np.pi, 33))  # at which a rounded box is cut, shares of its rounding


@dataclass(frozen=True, eq=False)
class Track:
    """Places (T, d), m, `step` seconds apart, between which a centre moves evenly, and after which it rests."""

    places: np.ndarray
    step: float

    def at(self, t: np.ndarray | float) -> np.ndarray:
        """Where it is, (..., d), at times t (...), s."""
        times = self.step * np.arange(len(self.places))
        return np.stack([np.interp(t, times, axis) for axis in self.places.T], axis=-1)


@dataclass(frozen=True, eq=False)
class Ball:
    """A sphere, or a disc in the plane; lengths in metres.

    center (d,) at t = 0; velocity (d,), m/s; track: along which it moves instead
    """

    center: np.ndarray
    radius: float
    velocity: np.ndarray
    track: Track | None = None

    @property
    def moving(self) -> bool:
        return self.track is not None or bool(self.velocity.any())

    @property
    def corners(self) -> np.ndarray:
        """The centre (1, d) at t = 0, all that there is before rounding."""
        return self.center[None]

    def at(self, t: np.ndarray | float) -> np.ndarray:
        """Centres (..., d) at times t (...), s."""
        return self.center + np.asarray(t)[..., None] * self.velocity if self.track is None else self.track.at(t)

    def distance(self, points: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Distances (K,) of points (K, d) at times t (K,) from the centre."""
        return np.linalg.norm(points - self.at(t), axis=-1)

    def along(self, points: np.ndarray, t: np.ndarray, within: float) -> np.ndarray:
        """Distances (K-1,) of the centre from the ways between points (K, d) at times t (K,): both move straight."""
        away = torch.from_numpy(points - self.at(t))
        return segment_distance(away[:-1], away[1:]).numpy()

    def outline(self, margin: float = 0.0, plane: Plane = ABOVE, t: float = 0.0) -> np.ndarray:
        """The silhouette (P, 2) of all points within `margin`."""
        return _around(self.at(t)[None, list(plane)], self.radius + margin)

    def section(self, plane: Plane, depth: float, margin: float = 0.0, t: float = 0.0) -> np.ndarray | None:
        """Where the points within `margin` cut the plane in which the hidden coordinate is `depth`: (P, 2), or None."""
        center, reach = self.at(t), self.radius + margin
        off = center[_hidden(plane)] - depth
        return _around(center[None, list(plane)], np.sqrt(reach**2 - off**2)) if abs(off) < reach else None


@dataclass(frozen=True, eq=False)
class Box:
    """A box, rounded outwards by `radius`; lengths in metres.

    center, half (d,): half the sides' lengths; sides (d, d): their directions, as rows
    swing: amplitudes, rates and phases (3, S, d) of the sines along which the centre moves; None: it has none
    velocity: (d,), m/s, with which it moves beside; None: 0
    track: along which it moves instead
    """

    center: np.ndarray
    half: np.ndarray
    sides: np.ndarray
    radius: float = 0.0
    swing: np.ndarray | None = None
    velocity: np.ndarray | None = None
    track: Track | None = None

    @property
    def moving(self) -> bool:
        parts = self.velocity, None if self.swing is None else self.swing[0]
        return self.track is not None or any(array is not None and bool(array.any()) for array in parts)

    @property
    def corners(self) -> np.ndarray:
        """The corners (2^d, d) before rounding, at t = 0; those of a side differ in one bit of their index."""
        return self._corners(0.0)

    def _corners(self, t: float) -> np.ndarray:
        signs = np.array(list(product((-1.0, 1.0), repeat=len(self.center))))
        return self.at(t) + (signs * self.half) @ self.sides

    def at(self, t: np.ndarray | float) -> np.ndarray:
        """Centres (..., d) at times t (...), s."""
        if self.track is not None:
            return self.track.at(t)
        t, center = np.asarray(t), np.broadcast_to(self.center, (*np.shape(t), len(self.center)))
        if self.velocity is not None:
            center = center + t[..., None] * self.velocity
        if self.swing is None:
            return center
        amplitudes, rates, phases = self.swing
        return center + (amplitudes * np.sin(t[..., None, None] * rates + phases)).sum(axis=-2)

    def distance(self, points: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Signed distances (K,) of points (K, d) from the box before rounding."""
        over = np.abs((points - self.at(t)) @ self.sides.T) - self.half
        return np.linalg.norm(np.maximum(over, 0.0), axis=-1) + np.minimum(over.max(axis=-1), 0.0)

    def along(self, points: np.ndarray, t: np.ndarray, within: float) -> np.ndarray:
        """Signed distances (K-1,) of the box before rounding from the ways between points (K, d) at times t (K,).

        Both move straight. Those above `within` (m) may be loose lower bounds.
        """
        away, ends = points - self.at(t), self.distance(points, t)
        least = 0.5 * (ends[:-1] + ends[1:] - np.linalg.norm(np.diff(away, axis=0), axis=1))
        near = np.flatnonzero(least < within)
        if len(near):
            starts, steps = (torch.from_numpy(array[near]) for array in (away[:-1], np.diff(away, axis=0)))
            axes, half = (torch.from_numpy(array).expand(len(near), *array.shape) for array in (self.sides, self.half))
            least[near] = closest(axes.double(), torch.zeros_like(starts), half.double(), starts, steps).numpy()
        return least

    def outline(self, margin: float = 0.0, plane: Plane = ABOVE, t: float = 0.0) -> np.ndarray:
        """The silhouette (P, 2) of all points within `margin`; counterclockwise."""
        seen, reach = self._corners(t)[:, plane], self.radius + margin
        # Rounded boxes may have sides of length 0, and then no hull of their corners.
        return _around(seen, reach) if reach > 0 else seen[ConvexHull(seen).vertices]

    def section(self, plane: Plane, depth: float, margin: float = 0.0, t: float = 0.0) -> np.ndarray | None:
        """Where the points within `margin` cut the plane in which the hidden coordinate is `depth`: (P, 2), or None.

        A cut through a rounded box is the hull of cuts through the sharp one nearby, each grown by what the rounding
        has left at this distance.
        """
        corners, hidden, reach = self._corners(t), _hidden(plane), self.radius + margin
        heights = corners[:, hidden] - depth
        if abs(heights.mean()) > np.ptp(heights) / 2 + reach:
            return None
        levels = np.concatenate((reach * LEVELS, heights[np.abs(heights) <= reach])) if reach > 0 else np.zeros(1)
        level, points = _crossings(corners, hidden, depth + levels)
        left = np.sqrt(np.maximum(reach**2 - levels[level] ** 2, 0.0))
        return _around(points[:, plane], left) if len(points) else None


Solid = Ball | Box


def solids(shapes: RoundedBoxes) -> list[Solid]:
    """The obstacles of a problem."""
    M, d = shapes.center.shape
    velocities = np.zeros((M, d)) if shapes.velocity is None else shapes.velocity
    bodies: list[Solid] = []
    for i in range(M):
        center, half, radius, velocity = shapes.center[i], shapes.half[i], float(shapes.radius[i]), velocities[i]
        swing = None if shapes.sines is None else shapes.sines[:, i]
        track = None if shapes.track is None else Track(shapes.track[:, i], shapes.step)
        if half.any() or swing is not None:
            bodies.append(Box(center, half, shapes.sides[i], radius, swing, velocity, track))
        else:
            bodies.append(Ball(center, radius, velocity, track))
    return bodies


def bodies(layouts: Mapping[str, np.ndarray], i: int) -> tuple[Solid, ...]:
    """The obstacles present in layout i of the arrays of a layout file."""
    radii = np.asarray(layouts.get("radii", np.empty((i + 1, 0))), dtype=float)[i]
    here = np.flatnonzero(np.isfinite(radii))
    if len(here) == 0:
        return _boxes(layouts, i)
    centers = np.asarray(layouts["centers"], dtype=float)[i]
    velocities = np.nan_to_num(layouts["velocities"][i]) if "velocities" in layouts else np.zeros_like(centers)
    return (*(Ball(centers[j], float(radii[j]), velocities[j]) for j in here), *_boxes(layouts, i))


def _boxes(layouts: Mapping[str, np.ndarray], i: int) -> tuple[Box, ...]:
    if "box_centers" not in layouts:
        return ()
    centers, halves = (np.asarray(layouts[name], dtype=float)[i] for name in ("box_centers", "box_half_sizes"))
    turns, rounding = layouts.get("box_rotations"), layouts.get("box_radii")
    swings = None
    if "box_amplitudes" in layouts:
        swings = np.stack(
            [np.asarray(layouts[f"box_{name}"], dtype=float)[i] for name in ("amplitudes", "rates", "phases")]
        )
    boxes = []
    for k in np.flatnonzero(np.isfinite(centers).all(axis=1)):
        sides = np.eye(centers.shape[1]) if turns is None else _sides(np.asarray(turns, dtype=float)[i, k])
        radius = 0.0 if rounding is None else float(np.asarray(rounding)[i, k])
        boxes.append(Box(centers[k], halves[k], sides, radius, None if swings is None else swings[:, k]))
    return tuple(boxes)


def _hidden(plane: Plane) -> int:
    (axis,) = {0, 1, 2} - set(plane)
    return axis


def _around(points: np.ndarray, reach: np.ndarray | float) -> np.ndarray:
    """The outline (P, 2) of the hull of circles around points (K, 2), of radii `reach`, (K,) or one for all."""
    best = (RAYS @ points.T + reach).argmax(axis=1)
    return points[best] + np.broadcast_to(reach, len(points))[best, None] * RAYS


def _crossings(corners: np.ndarray, axis: int, levels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the edges of a box with corners (8, 3) meet planes in which coordinate `axis` is one of the levels (S,).

    Returns the index of the level (K,) and the points (K, 3).
    """
    a, b = corners[EDGES[:, 0]], corners[EDGES[:, 1]]
    rise, off = b[:, axis] - a[:, axis], levels[:, None] - a[:, axis]
    flat = np.abs(rise) < FLAT
    share = np.where(flat, 0.0, off / np.where(flat, 1.0, rise))
    level, edge = np.nonzero(np.where(flat, np.abs(off) < FLAT, (share >= 0) & (share <= 1)))
    met = a[edge] + share[level, edge, None] * (b - a)[edge]
    lying = flat[edge]  # in the plane: both ends count
    return np.concatenate((level, level[lying])), np.concatenate((met, b[edge[lying]]))


def _sides(turn: np.ndarray) -> np.ndarray:
    """The directions (d, d) of a box's sides, as rows, from an angle or a quaternion [w, x, y, z]."""
    if turn.ndim == 0:
        return np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    w, v = turn[0], turn[1:]
    rows = [2.0 * (v @ e) * v + (w * w - v @ v) * e + 2.0 * w * np.cross(v, e) for e in np.eye(3)]
    return np.array(rows) / (turn @ turn)
