"""Bodies that move: known, or followed in the returns of a sensor, as boxes at constant velocity."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Protocol, Self

import numpy as np
from scipy.ndimage import label

from torchgco.exploration.sensing.grid import FREE, OCCUPIED, SeenMap
from torchgco.exploration.sensing.sensors import Motion, Scan, World

BESIDE = 0.3  # m around a ball, within which returns are its own
LEAST_RETURNS = 2  # returns of a body at least
SURFACE = 0.05  # m: error of a face that rays end on, by noise and as bodies move during a scan
EDGE = 0.3  # of the distance between two rays: by how much a face that lies beside them errs, uniform between both
SHRINK = 0.05  # share by which a face moves in one scan to where it is seen, if that is within the body
LARGEST_BODY = 1.6  # m: what is wider along an axis is no body that moves
ACCELERATION = 1.0  # m/s^2: standard deviation of what bodies do between two scans
FASTEST = 1.0  # m/s: standard deviation of a velocity before anything is known of it
LOOK = 10  # scans of a body between two looks whether it has moved
STAYS = 0.25  # m: a body that has moved by less is at rest
SETTLES = 1.0  # s after which a cell that stays occupied is one of a surface: bodies that move leave it by then
GIVEN_UP = 0.6  # s without a return, after which a body is given up
LOOKS = 6  # moments at which bodies are looked at while a point stays clear
# m/s^2: the largest change of velocity that is expected of what is followed, by which it grows ahead of its time, and m
# at most: nine of ten points of cubes on trefoils, seen within 7 m, are 0.2, 0.6 and 0.9 m off after 0.5, 1 and 1.5 s.
GROWTH, MOST_GROWTH = 0.75, 1.0


@dataclass(frozen=True)
class Moving:
    """Rounded boxes that move; balls have no sides.

    Args:
        centers: (M, 3), m, where they are placed.
        motion: away from there.
        radii: (M,), m, by which the boxes are rounded.
        growth: m/s^2: at time t, s, they are wider by growth t^2 / 2 to each side.
        half_sizes: half the sides (M, 3), m.
        sides: their directions, as rows, (M, 3, 3).
    """

    centers: np.ndarray
    motion: Motion
    radii: np.ndarray
    growth: float
    half_sizes: np.ndarray
    sides: np.ndarray

    @classmethod
    def balls(cls, centers: np.ndarray, velocities: np.ndarray, radii: np.ndarray, growth: float = 0.0) -> Self:
        """Balls at constant velocity: centres (M, 3), m, velocities (M, 3), m/s, radii (M,), m; growth, m/s^2."""
        straight = np.broadcast_to(np.eye(3), (len(centers), 3, 3))
        return cls(centers, Motion.steady(velocities), radii, growth, np.zeros_like(centers), straight)

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Centres (K, M, 3) and radii (K, M) after times t (K,), s."""
        return self.centers + self.motion.off(t), self.radii + self.more(t)[:, None]

    def more(self, t: Any) -> Any:
        """By how much they are wider at times t, s, in m."""
        return np.minimum(0.5 * self.growth * t**2, MOST_GROWTH)

    def take(self, rows: np.ndarray) -> Self:
        """Some of the bodies."""
        names = ("centers", "motion", "radii", "half_sizes", "sides")
        parts = {name: getattr(self, name) for name in names}
        parts = {name: value.take(rows) if name == "motion" else value[rows] for name, value in parts.items()}
        return replace(self, **parts)

    @property
    def straight(self) -> bool:
        """Whether all sides lie along the axes."""
        return bool((self.sides == np.eye(3)).all())

    def within(self, low: np.ndarray, high: np.ndarray, horizon: float) -> Self:
        """Those that may come into a box from `low` to `high` (3,), m, within the horizon, s."""
        size = np.abs(self.sides * self.half_sizes[..., None]).sum(axis=1) + self.radii[:, None] + self.motion.reach
        size = size + self.more(horizon)
        ways = np.stack([self.centers, self.centers + horizon * self.motion.velocities])
        inside = (ways.min(axis=0) - size <= high) & (ways.max(axis=0) + size >= low)
        return self.take(inside.all(axis=1))

    def gaps(self, points: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Distances (K,), m, of points (K, 3) from the nearest surface at times t (K,), s; infinite without bodies."""
        return self.each(points, t).min(axis=1, initial=np.inf)

    def each(self, points: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Distances (K, M), m, of points (K, 3) from all surfaces at times t (K,), s."""
        moments, inverse = np.unique(t, return_inverse=True)
        centers, radii = (array[inverse] for array in self.at(moments))
        square, deepest = np.zeros(radii.shape), np.full(radii.shape, -np.inf)
        away = [points[:, i, None] - centers[..., i] for i in range(3)]
        for i in range(3):
            along = away[i] if self.straight else sum(self.sides[:, i, j] * away[j] for j in range(3))
            over = np.abs(along) - self.half_sizes[:, i]
            np.maximum(deepest, over, out=deepest)
            square += np.square(np.maximum(over, 0.0, out=over), out=over)
        return np.where(deepest > 0, np.sqrt(square), deepest) - radii

    def _apart(self, points: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Signed distances (K, M), m, of points (K, 3) from the surfaces, and the unit vectors (K, M, 3) away."""
        centers, radii = self.at(t)
        local = np.einsum("mij,kmj->kmi", self.sides, points[:, None] - centers)
        over = np.abs(local) - self.half_sizes
        deepest = over.max(axis=-1)
        away = np.sign(local) * np.maximum(over, 0.0)
        length = np.linalg.norm(away, axis=-1)
        side = np.where(local < 0, -1.0, 1.0) * (np.arange(3) == over.argmax(axis=-1)[..., None])
        outside = length[..., None] > 1e-9
        normals = np.where(outside, away / np.maximum(length, 1e-9)[..., None], side)
        return np.where(deepest > 0, length, deepest) - radii, np.einsum("mij,kmi->kmj", self.sides, normals)

    def planes(self, points: np.ndarray, t: np.ndarray, most: int, hold: float = 0.0) -> np.ndarray:
        """Half-spaces n x >= b (K, most, 4) that part points (K, 3) at times t (K,), s, from the nearest bodies.

        Zeros where there are fewer. The last point stays clear for `hold`, s: each body counts where it comes nearest.
        """
        gaps, normals = self._apart(points, t)
        if hold > 0 and len(self.radii):
            later = t[-1] + np.linspace(0.0, hold, LOOKS)
            apart, away = self._apart(np.repeat(points[-1:], LOOKS, axis=0), later)
            first = apart.argmin(axis=0)
            gaps[-1], normals[-1] = apart.min(axis=0), away[first, np.arange(len(first))]
        offsets = (normals * points[:, None]).sum(-1) - gaps
        planes, order = np.zeros((len(points), most, 4)), np.argsort(gaps, axis=1)[:, :most]
        rows = np.arange(len(points))[:, None]
        planes[:, : order.shape[1], :3], planes[:, : order.shape[1], 3] = normals[rows, order], offsets[rows, order]
        return planes

    def clear_of(self, point: np.ndarray, least: float) -> Self:
        """Estimated bodies that are smaller where the vehicle at a point (3,) would be nearer than `least`, m, now.

        It hasn't touched them, so their sizes are wrong by that much; what is known stays as it is.
        """
        if self.growth == 0 or len(self.radii) == 0:
            return self
        gaps = self._apart(point[None], np.zeros(1))[0][0]
        return replace(self, radii=self.radii - np.maximum(least - gaps, 0.0))

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Which of some points (R, 3) belong to the bodies where they are now, (R,) bool."""
        return self.gaps(points, np.zeros(len(points))) <= BESIDE


class Movers(Protocol):
    """What a vehicle knows of moving bodies."""

    def observe(self, scan: Scan, seen: SeenMap, t: float) -> np.ndarray:
        """Take a scan at time t, s, before the map does. Returns which rays the map may have, (R,) bool."""
        ...

    def note(self, seen: SeenMap, changed: np.ndarray) -> None:
        """Cells of the map have changed, given by flat indices."""

    def now(self, t: float) -> Moving:
        """The bodies at time t, s."""
        ...


def nothing() -> Moving:
    """No bodies."""
    return Moving.balls(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


class Unaware:
    """All bodies count as at rest."""

    def observe(self, scan: Scan, seen: SeenMap, t: float) -> np.ndarray:
        """See `Movers`."""
        return np.ones(len(scan.distances), bool)

    def note(self, seen: SeenMap, changed: np.ndarray) -> None:
        """See `Movers`."""

    def now(self, t: float) -> Moving:
        """See `Movers`."""
        return nothing()


@dataclass
class Known:
    """All moving bodies of a world are known, with their motion."""

    world: World

    def observe(self, scan: Scan, seen: SeenMap, t: float) -> np.ndarray:
        """See `Movers`."""
        ended = np.isfinite(scan.distances)
        keep = np.ones(len(ended), bool)
        points = returns(scan)[ended]
        if len(points):
            low, high = points.min(axis=0) - BESIDE, points.max(axis=0) + BESIDE
            keep[ended] = ~self.now(t).within(low, high, 0.0).holds(points)
        return keep

    def note(self, seen: SeenMap, changed: np.ndarray) -> None:
        """See `Movers`."""

    def now(self, t: float) -> Moving:
        """See `Movers`."""
        motion = self.world.motion
        boxes, motion = self.world.boxes[motion.moves], motion.take(motion.moves)
        centers = boxes[:, :3] + t * motion.velocities
        sides = boxes[:, 3:12].reshape(-1, 3, 3)
        return Moving(centers, motion.later(t), boxes[:, 15], 0.0, boxes[:, 12:15], sides)


@dataclass(eq=False)
class Track:
    """A body that is followed, as a box along the axes.

    Its place changes by what both of its faces along an axis have moved in common: where one face alone moves, or they
    move apart, more of a body has come into sight, and it may well be at rest.

    Args:
        center, half, velocity: (3,), m, m and m/s.
        error: of its faces, m, by which it may be larger.
        last, scans: time of the last scan with it, s, and the number of scans with it.
        origin, began: where and when it was at the last look whether it moves, m and s.
        spread: covariance of place and velocity, (2, 2), the same along each axis.
        moves: whether it has left where it was at a look.
    """

    center: np.ndarray
    half: np.ndarray
    velocity: np.ndarray
    error: float
    last: float
    origin: np.ndarray
    began: float
    scans: int = 1
    spread: np.ndarray = field(default_factory=lambda: np.diag([1.0, FASTEST**2]))
    moves: bool = False

    def expected(self, t: float) -> np.ndarray:
        """Where it should be at time t, s, (3,), m."""
        return self.center + (t - self.last) * self.velocity

    def spread_at(self, t: float) -> np.ndarray:
        """The covariance (2, 2) of place and velocity that is expected at time t, s."""
        dt = t - self.last
        ahead, push = np.array([[1.0, dt], [0.0, 1.0]]), ACCELERATION * np.array([0.5 * dt**2, dt])
        return ahead @ self.spread @ ahead.T + np.outer(push, push)

    def take(self, low: np.ndarray, high: np.ndarray, error: float, t: float) -> None:
        """It is seen between two corners (3,), m, with an error, m, at time t, s: a step of a Kalman filter."""
        spread, center = self.spread_at(t), self.expected(t)
        gain = spread[:, 0] / (spread[0, 0] + error**2)
        off_low, off_high = low - (center - self.half), high - (center + self.half)
        off = np.where(off_low * off_high > 0, np.sign(off_low) * np.minimum(abs(off_low), abs(off_high)), 0.0)
        low, high = (_eased(off_low - off, -1.0), _eased(off_high - off, 1.0))
        self.center = center + gain[0] * off + 0.5 * (low + high)
        self.half = self.half + 0.5 * (high - low)
        self.velocity = self.velocity + gain[1] * off
        self.spread = spread - np.outer(gain, spread[0])
        self.scans, self.last, self.error = self.scans + 1, t, error


def _eased(off: np.ndarray, outward: float) -> np.ndarray:
    """How far faces (3,) move that are seen to be `off`, m: outward at once, inward slowly, as they may be hidden."""
    return np.where(off * outward > 0, off, SHRINK * off)


@dataclass
class Tracks:
    """Bodies that may move, followed from scan to scan.

    A body is a cluster of returns of limited size, away from surfaces in cells that never were free. Each return
    belongs to the body whose box it is nearest to. Until a body has been seen for some scans, and while it moves, its
    returns stay out of the map; one that turns out to be at rest goes into it.

    Args:
        pitch: angle between two rays, rad: a body may be wider than its returns by that.
    """

    pitch: float
    tracks: list[Track] = field(default_factory=list)
    _was_free: np.ndarray | None = None  # (cells,) bool
    _settled: np.ndarray | None = None  # (cells,) float32: when what is in an occupied cell counts as a surface, s
    _last: float = 0.0  # s: time of the last scan

    def observe(self, scan: Scan, seen: SeenMap, t: float) -> np.ndarray:
        """See `Movers`."""
        keep, points = np.ones(len(scan.distances), bool), returns(scan)
        rays = np.flatnonzero(np.isfinite(scan.distances))
        points = points[rays]
        self._last = t
        loose = self._loose(seen, points)
        self._follow([track for track in self.tracks if track.moves], points, loose, scan.origin, t)
        large = self._large(seen, points, loose, scan.origin)
        self._follow([track for track in self.tracks if not track.moves], points, loose, scan.origin, t)
        for members in clusters(points[loose], scan.origin, self.pitch):
            self._begin(points[loose][members], scan.origin, t)
        self.tracks = [track for track in self.tracks if t - track.last <= GIVEN_UP and not self._rests(track, seen, t)]
        keep[rays] = ~self.now(t).holds(points) | large
        return keep

    def _follow(self, tracks: list[Track], points: np.ndarray, loose: np.ndarray, origin: np.ndarray, t: float) -> None:
        """Continue tracks by the `loose` ones (R,) bool of points (R, 3), which those that belong to one leave."""
        if not tracks or not loose.any():
            return
        gaps = self._expected(tracks, t).each(points[loose], np.zeros(int(loose.sum())))
        own = np.full(len(points), -1)
        own[loose] = np.where(gaps.min(axis=1) <= BESIDE, gaps.argmin(axis=1), -1)
        for i, track in enumerate(tracks):
            rows = np.flatnonzero(own == i)
            if len(rows) >= LEAST_RETURNS and np.ptp(points[rows], axis=0).max() <= LARGEST_BODY:
                track.take(*self._seen_box(points[rows], origin), t)
                loose[rows] = False

    def _large(self, seen: SeenMap, points: np.ndarray, loose: np.ndarray, origin: np.ndarray) -> np.ndarray:
        """Which points (R, 3) belong to what is too large for a body, (R,) bool; no longer `loose`, but surfaces."""
        large = np.zeros(len(points), bool)
        for members in clusters(points[loose], origin, self.pitch):
            rows = np.flatnonzero(loose)[members]
            large[rows] = np.ptp(points[rows], axis=0).max() > LARGEST_BODY
        loose &= ~large
        cells = np.floor((points[large] - seen.corner) / seen.resolution).astype(np.int64)
        if large.any():
            self._settle(seen, tuple(cells.T))
        return large

    def _settle(self, seen: SeenMap, cells: Any) -> None:
        """Take what is in some cells for a surface, from now on."""
        assert self._was_free is not None and self._settled is not None
        self._was_free.reshape(seen.shape)[cells] = False
        self._settled.reshape(seen.shape)[cells] = -np.inf

    def _rests(self, track: Track, seen: SeenMap, t: float) -> bool:
        """Whether a body has stayed where it was; its cells are then those of a surface."""
        if track.scans % LOOK or track.last < t:
            return False
        if np.linalg.norm(track.center - track.origin) > STAYS:
            track.origin, track.began, track.moves = track.center, t, True
            return False
        low, high = (seen.cell(track.center + side * (track.half + BESIDE)) for side in (-1.0, 1.0))
        self._settle(seen, tuple(slice(a, b + 1) for a, b in zip(low, high, strict=True)))
        return True

    def note(self, seen: SeenMap, changed: np.ndarray) -> None:
        """See `Movers`."""
        was_free = (seen.state == FREE).ravel() if self._was_free is None else self._was_free
        settled = np.full(was_free.shape, np.inf, np.float32) if self._settled is None else self._settled
        free, occupied = (changed[seen.state.ravel()[changed] == state] for state in (FREE, OCCUPIED))
        was_free[free], settled[free] = True, np.inf
        settled[occupied] = np.minimum(settled[occupied], self._last + SETTLES)
        self._was_free, self._settled = was_free, settled

    def now(self, t: float) -> Moving:
        """See `Movers`."""
        return self._expected(self.tracks, t)

    def _expected(self, tracks: list[Track], t: float) -> Moving:
        """Bodies that are followed, where they should be at time t, s."""
        if not tracks:
            return nothing()
        centers = np.array([track.expected(t) for track in tracks])
        half = np.array([track.half for track in tracks])
        straight = np.broadcast_to(np.eye(3), (len(centers), 3, 3))
        motion = Motion.steady(np.array([track.velocity for track in tracks]))
        error = np.array([track.error for track in tracks])
        return Moving(centers, motion, error, GROWTH, half, straight)

    def _loose(self, seen: SeenMap, points: np.ndarray) -> np.ndarray:
        """Which points (R, 3) aren't in or beside cells of surfaces, (R,) bool: occupied for long, and never free.

        What has just come into sight may move: the cells that it leaves behind would make it a surface for good.
        """
        cells = np.floor((points - seen.corner) / seen.resolution).astype(np.int64)
        loose = np.atleast_1d(((cells >= 1) & (cells < np.array(seen.shape) - 1)).all(axis=1))
        if self._was_free is None or not loose.any():
            return np.zeros(len(points), bool)
        index = np.atleast_1d(np.ravel_multi_index(tuple(cells[loose].T), seen.shape))
        assert self._settled is not None
        steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
        around = index[:, None] + steps @ np.array([seen.shape[1] * seen.shape[2], seen.shape[2], 1])
        surface = (
            (seen.state.ravel()[around] == OCCUPIED) & ~self._was_free[around] & (self._settled[around] <= self._last)
        )
        loose[loose] = ~surface.any(axis=1)
        return loose

    def _begin(self, points: np.ndarray, origin: np.ndarray, t: float) -> None:
        """A cluster of returns (R, 3) that no track expects begins one, unless it is too large for a body."""
        if np.ptp(points, axis=0).max() > LARGEST_BODY:
            return
        low, high, error = self._seen_box(points, origin)
        center = 0.5 * (low + high)
        self.tracks.append(
            Track(center, 0.5 * (high - low), np.zeros(3), error, t, center, t, 1, np.diag([error**2, FASTEST**2]))
        )

    def _seen_box(self, points: np.ndarray, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """The corners (3,), m, of the box around returns (R, 3), and the error of its faces, m.

        Rays end on the near side alone: along the axis of sight a body is as deep at least as it is wide at least.
        """
        low, high = points.min(axis=0), points.max(axis=0)
        sight = 0.5 * (low + high) - origin
        axis, gap = int(np.abs(sight).argmax()), self.pitch * float(np.linalg.norm(sight))
        depth = max(np.delete(high - low, axis).min() - (high - low)[axis], 0.0)
        low[axis], high[axis] = low[axis] - depth * (sight[axis] < 0), high[axis] + depth * (sight[axis] > 0)
        return low, high, EDGE * gap + SURFACE


def returns(scan: Scan) -> np.ndarray:
    """Where the rays of a scan ended, (R, 3), m; anything where nothing came back."""
    return scan.origin + np.where(np.isfinite(scan.distances), scan.distances, 0.0)[:, None] * scan.directions


def clusters(points: np.ndarray, origin: np.ndarray, pitch: float) -> list[np.ndarray]:
    """The indices of the points (R, 3) of each cluster, seen from `origin` (3,): less than about two rays apart."""
    if len(points) == 0:
        return []
    away = points - origin
    far = np.linalg.norm(away, axis=1).clip(1e-3)
    angles = np.log(far), np.arctan2(away[:, 1], away[:, 0]), np.arcsin(away[:, 2] / far)
    cubes = np.column_stack(angles) / pitch
    cubes = np.floor(cubes - cubes.min(axis=0)).astype(int)
    grid = np.zeros(cubes.max(axis=0) + 1, bool)
    grid[tuple(cubes.T)] = True
    names, count = label(grid, np.ones((3, 3, 3)))
    labels = names[tuple(cubes.T)]
    return [rows for rows in (np.flatnonzero(labels == n + 1) for n in range(count)) if len(rows) >= LEAST_RETURNS]
