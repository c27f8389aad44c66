"""The motion along a path that plans are to follow: as fast as its corners allow, at rest where its free part ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SWERVE = 0.25  # m at most, by which a turn misses its corner
TIGHT = 0.02  # m by which it may where nothing is free beyond the corner: of what plans keep beyond contact
STEEP = 2.5  # m/s^2 at most, straight up and down: thrust changes more slowly than a vehicle tilts
REFERENCE_SMOOTHING = 5  # steps before and after, over which positions are averaged: that limits the jerk
RESTS_BEFORE = 0.3  # s before the horizon's end in which the reference rests


@dataclass(frozen=True)
class Pace:
    """Limits of a reference: speed, m/s, acceleration and deceleration, m/s^2."""

    speed: float
    acceleration: float
    deceleration: float

    def slower(self, share: float) -> Pace:
        """The limits of the same motion with times longer by 1 / share."""
        return Pace(share * self.speed, share**2 * self.acceleration, share**2 * self.deceleration)


def taut(path: np.ndarray, is_free) -> np.ndarray:
    """The corners of a path (K, 3) with shortcuts: from each corner on to the farthest point in a free straight line.

    Args:
        is_free: whether all points (M, 3) are free; called with points along straight lines.
    """
    corners, i, last = [path[0]], 0, len(path) - 1
    while i < last:
        step, j = 1, i + 1
        while j < last and is_free(between(path[i], path[min(i + 2 * step, last)])):
            step, j = 2 * step, min(i + 2 * step, last)
        low, high = j, min(i + 2 * step, last)
        while low < high:
            middle = (low + high + 1) // 2
            if is_free(between(path[i], path[middle])):
                low = middle
            else:
                high = middle - 1
        corners.append(path[low])
        i = low
    return np.array(corners)


def between(a: np.ndarray, b: np.ndarray, spacing: float = 0.1) -> np.ndarray:
    """Points (K, 3) along the straight line from a to b (3,), both included, at most `spacing` apart, m."""
    count = 1 + int(np.ceil(np.linalg.norm(b - a) / spacing))
    return a + np.linspace(0.0, 1.0, count + 1)[:, None] * (b - a)


def lengths(corners: np.ndarray) -> np.ndarray:
    """The length of a polyline up to each of its corners (K, 3), (K,), m."""
    return np.concatenate([[0.0], np.linalg.norm(np.diff(corners, axis=0), axis=1).cumsum()])


def along(corners: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and unit directions (M, 3) of a polyline at the lengths s (M,), m."""
    arc = lengths(corners)
    if arc[-1] < 1e-9:
        return np.repeat(corners[:1], len(s), axis=0), np.zeros((len(s), 3))
    points = np.column_stack([np.interp(s, arc, corners[:, i]) for i in range(3)])
    piece = np.clip(np.searchsorted(arc, s, side="right") - 1, 0, len(corners) - 2)
    steps = np.diff(corners, axis=0)
    size = np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-9)
    return points, (steps / size)[piece]


def motion(
    corners: np.ndarray, velocity: np.ndarray, pace: Pace, count: int, dt: float, swing: np.ndarray | float = SWERVE
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities (count + 1, 3) along a polyline (K, 3) that begins at the vehicle, every dt, s.

    It starts with the vehicle's velocity (3,), and rests at the polyline's end, or shortly before the last of them.
    Turns miss the inner corners by `swing` (K-2,), m.
    """
    arc, last, slow = lengths(corners), count * dt - RESTS_BEFORE, _corner_speeds(corners, pace, swing)
    steps = np.diff(corners, axis=0) / np.maximum(np.diff(arc), 1e-9)[:, None]
    places, s = np.zeros(count + 1), 0.0
    v = max(0.0, float(steps[0] @ velocity)) if len(steps) else 0.0
    for k in range(count):
        wanted = min(pace.speed, np.sqrt(2.0 * pace.deceleration * (arc[-1] - s)), pace.deceleration * (last - k * dt))
        ahead = arc[1:-1] - s
        if (ahead > 0).any():
            room = slow[ahead > 0] ** 2 + 2.0 * pace.deceleration * ahead[ahead > 0]
            wanted = min(wanted, float(np.sqrt(room.min())))
        pull = _acceleration(steps[np.searchsorted(arc[1:-1], s, side="right")], pace) if len(steps) else 0.0
        v = max(0.0, min(wanted, v + pull * dt), v - 2.0 * pace.deceleration * dt)
        s = min(arc[-1], s + v * dt)
        places[k + 1] = s
    return _smoothed(along(corners, places)[0], velocity, dt)


def _acceleration(direction: np.ndarray, pace: Pace) -> float:
    """The largest acceleration along a unit vector, m/s^2."""
    return 1.0 / max(float(np.hypot(*direction[:2])) / pace.acceleration, abs(float(direction[2])) / STEEP, 1e-3)


def _smoothed(points: np.ndarray, velocity: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Means of positions (K, 3) over some steps around each, with the vehicle's velocity before them; and velocities.

    The first remains where it is.
    """
    before = points[0] - np.arange(REFERENCE_SMOOTHING, 0, -1)[:, None] * dt * velocity
    whole = np.concatenate([before, points, np.repeat(points[-1:], REFERENCE_SMOOTHING, axis=0)])
    width = 2 * REFERENCE_SMOOTHING + 1
    sums = np.concatenate([np.zeros((1, 3)), whole.cumsum(axis=0)])
    mean = (sums[width:] - sums[:-width]) / width
    fade = np.exp(-np.arange(len(mean)) / REFERENCE_SMOOTHING)[:, None]
    mean = mean + fade * (points[0] - mean[0])
    speeds = np.diff(mean, axis=0, append=mean[-1:]) / dt
    return mean, speeds


def swings(corners: np.ndarray, is_free) -> np.ndarray:
    """How far, m, turns may miss the inner corners of a polyline (K, 3), (K-2,): as far as their outside is free.

    Args:
        is_free: which of some points (M, 3) are free, (M,) bool.
    """
    turn = _turns(corners)
    outward = -turn / np.maximum(np.linalg.norm(turn, axis=1, keepdims=True), 1e-9)
    reach, free = np.full(len(turn), TIGHT), np.ones(len(turn), bool)
    for far in SWERVE * np.array([0.25, 0.5, 0.75, 1.0]) if len(turn) else ():
        free &= is_free(corners[1:-1] + far * outward)
        reach[free] = far
    return reach


def _turns(corners: np.ndarray) -> np.ndarray:
    """The changes of direction at the inner corners of a polyline (K, 3), (K-2, 3)."""
    steps = np.diff(corners, axis=0)
    return np.diff(steps / np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-9), axis=0)


def _corner_speeds(corners: np.ndarray, pace: Pace, swing: np.ndarray | float) -> np.ndarray:
    """The speeds at the inner corners of a polyline, (K-2,), m/s: slower where it turns more, or up or down.

    A turn of radius r misses its corner by about r a^2 / 8, with a the change of direction.
    """
    turn = _turns(corners)
    size = np.maximum(np.linalg.norm(turn, axis=1), 1e-6)
    most = np.array([_acceleration(direction, pace) for direction in turn / size[:, None]])
    return np.minimum(pace.speed, np.sqrt(8.0 * swing * most) / size)
