"""Bodies that move: known, or followed in the returns of a sensor, as balls at constant velocity."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol, Self

import numpy as np
from scipy.ndimage import label

from torchgco.exploration.sensing.grid import FREE, OCCUPIED, SeenMap
from torchgco.exploration.sensing.sensors import Motion, Scan, World

BESIDE = 0.3  # m around a ball, within which returns are its own
JOINED = 0.4  # m: returns closer than about this belong to one body
LEAST_RETURNS = 2  # returns of a body at least
SMALLEST = 0.05  # m: radius of a body at least
LARGEST_BODY = 1.6  # m: what is wider along an axis is no body that moves
SEEN = 0.2  # m: standard deviation of a centre as it is seen
ACCELERATION = 1.0  # m/s^2: standard deviation of what bodies do between two scans
FASTEST = 1.0  # m/s: standard deviation of a velocity before anything is known of it
LOOK = 10  # scans of a body between two looks whether it has moved
STAYS = 0.25  # m: a body that has moved by less is at rest
GIVEN_UP = 0.6  # s without a return, after which a body is given up
LOOKS = 6  # moments at which bodies are looked at while a point stays clear
# m/s by which balls grow ahead of their time, as velocities are estimates, and m at most: bodies at 0.8 m/s that change
# it by 0.4 m/s^2 (medians), seen with errors of 0.1 m, are 0.3, 0.6 and 0.9 m off after 0.5, 1 and 1.5 s.
GROWTH, MOST_GROWTH = 0.6, 1.0


@dataclass(frozen=True)
class Moving:
    """Rounded boxes that move; balls have no sides.

    Args:
        centers: (M, 3), m, where they are placed.
        motion: away from there.
        radii: (M,), m, by which the boxes are rounded.
        growth: m/s by which they are wider later.
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
        """Balls at constant velocity: centres (M, 3), m, velocities (M, 3), m/s, radii (M,), m; growth, m/s."""
        straight = np.broadcast_to(np.eye(3), (len(centers), 3, 3))
        return cls(centers, Motion.steady(velocities), radii, growth, np.zeros_like(centers), straight)

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Centres (K, M, 3) and radii (K, M) after times t (K,), s."""
        more = np.minimum(self.growth * t, MOST_GROWTH)
        return self.centers + self.motion.off(t), self.radii + more[:, None]

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
        size = size + min(self.growth * horizon, MOST_GROWTH)
        ways = np.stack([self.centers, self.centers + horizon * self.motion.velocities])
        inside = (ways.min(axis=0) - size <= high) & (ways.max(axis=0) + size >= low)
        return self.take(inside.all(axis=1))

    def gaps(self, points: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Distances (K,), m, of points (K, 3) from the nearest surface at times t (K,), s; infinite without bodies."""
        moments, inverse = np.unique(t, return_inverse=True)
        centers, radii = (array[inverse] for array in self.at(moments))
        square, deepest = np.zeros(radii.shape), np.full(radii.shape, -np.inf)
        away = [points[:, i, None] - centers[..., i] for i in range(3)]
        for i in range(3):
            along = away[i] if self.straight else sum(self.sides[:, i, j] * away[j] for j in range(3))
            over = np.abs(along) - self.half_sizes[:, i]
            np.maximum(deepest, over, out=deepest)
            square += np.square(np.maximum(over, 0.0, out=over), out=over)
        return (np.where(deepest > 0, np.sqrt(square), deepest) - radii).min(axis=1, initial=np.inf)

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
        """Estimated balls that are smaller where the vehicle at a point (3,) would be nearer than `least`, m, now.

        It hasn't touched them, so their sizes are wrong by that much; what is known stays as it is.
        """
        if self.growth == 0 or len(self.radii) == 0:
            return self
        gaps = self._apart(point[None], np.zeros(1))[0][0]
        return replace(self, radii=np.maximum(self.radii - np.maximum(least - gaps, 0.0), SMALLEST))

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
    """A body that is followed.

    Args:
        center, velocity, radius: (3,), m, (3,), m/s, and m.
        last, scans: time of the last scan with it, s, and the number of scans with it.
        origin, began: where and when it was at the last look whether it moves, m and s.
    """

    center: np.ndarray
    velocity: np.ndarray
    radius: float
    last: float
    origin: np.ndarray
    began: float
    scans: int = 1
    spread: np.ndarray = field(default_factory=lambda: np.diag([SEEN**2, FASTEST**2]))  # of place and velocity, (2, 2)

    def expected(self, t: float) -> np.ndarray:
        """Where it should be at time t, s, (3,), m."""
        return self.center + (t - self.last) * self.velocity

    def take(self, center: np.ndarray, t: float) -> None:
        """It is seen at a centre (3,), m, at time t, s: a step of a Kalman filter, the same along each axis."""
        dt = max(t - self.last, 1e-3)
        ahead = np.array([[1.0, dt], [0.0, 1.0]])
        push = ACCELERATION * np.array([0.5 * dt**2, dt])
        spread = ahead @ self.spread @ ahead.T + np.outer(push, push)
        gain = spread[:, 0] / (spread[0, 0] + SEEN**2)
        off = center - self.center - dt * self.velocity
        self.center = self.center + dt * self.velocity + gain[0] * off
        self.velocity = self.velocity + gain[1] * off
        self.spread = spread - np.outer(gain, spread[0])
        self.scans, self.last = self.scans + 1, t


@dataclass
class Tracks:
    """Bodies that may move, followed from scan to scan.

    A body is a cluster of returns of limited size, away from surfaces in cells that never were free. Its centre lies
    behind its nearest return, at the depth of half its width across the line of sight. A Kalman filter estimates its
    place and velocity. Until it has been seen for some scans, and while it moves, its returns stay out of the map; a
    body that turns out to be at rest goes into it.

    Args:
        pitch: angle between two rays, rad: a body may be wider than its returns by that.
    """

    pitch: float
    tracks: list[Track] = field(default_factory=list)
    _was_free: np.ndarray | None = None  # (cells,) bool

    def observe(self, scan: Scan, seen: SeenMap, t: float) -> np.ndarray:
        """See `Movers`."""
        keep, points = np.ones(len(scan.distances), bool), returns(scan)
        rays = np.flatnonzero(np.isfinite(scan.distances))
        points = points[rays]
        loose = self._loose(seen, points)
        for track in sorted(self.tracks, key=lambda track: -track.scans):
            away = np.linalg.norm(points - track.expected(t), axis=1)
            near = loose & (away <= track.radius + BESIDE)
            if near.sum() >= LEAST_RETURNS:
                self._follow(track, points[near], scan.origin, t)
                loose &= ~near
        for members in clusters(points[loose]):
            self._begin(points[loose][members], scan.origin, t)
        self.tracks = [track for track in self.tracks if t - track.last <= GIVEN_UP and not self._rests(track, seen, t)]
        keep[rays] = ~self.now(t).holds(points)
        return keep

    def _rests(self, track: Track, seen: SeenMap, t: float) -> bool:
        """Whether a body has stayed where it was; its cells are then those of a surface."""
        if track.scans % LOOK or track.last < t:
            return False
        if np.linalg.norm(track.center - track.origin) > STAYS:
            track.origin, track.began = track.center, t
            return False
        assert self._was_free is not None
        low, high = (seen.cell(track.center + side * (track.radius + BESIDE)) for side in (-1.0, 1.0))
        self._was_free.reshape(seen.shape)[tuple(slice(a, b + 1) for a, b in zip(low, high, strict=True))] = False
        return True

    def note(self, seen: SeenMap, changed: np.ndarray) -> None:
        """See `Movers`."""
        was_free = (seen.state == FREE).ravel() if self._was_free is None else self._was_free
        was_free[changed[seen.state.ravel()[changed] == FREE]] = True
        self._was_free = was_free

    def now(self, t: float) -> Moving:
        """See `Movers`."""
        if not self.tracks:
            return nothing()
        v = np.array([track.velocity for track in self.tracks])
        age = np.array([t - track.last for track in self.tracks])
        centers = np.array([track.center for track in self.tracks]) + age[:, None] * v
        return Moving.balls(centers, v, np.array([track.radius for track in self.tracks]), GROWTH)

    def _loose(self, seen: SeenMap, points: np.ndarray) -> np.ndarray:
        """Which points (R, 3) aren't in or beside occupied cells that never were free, (R,) bool."""
        cells = np.floor((points - seen.corner) / seen.resolution).astype(np.int64)
        loose = np.atleast_1d(((cells >= 1) & (cells < np.array(seen.shape) - 1)).all(axis=1))
        if self._was_free is None or not loose.any():
            return np.zeros(len(points), bool)
        index = np.atleast_1d(np.ravel_multi_index(tuple(cells[loose].T), seen.shape))
        was, state = self._was_free, seen.state.ravel()
        steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
        around = index[:, None] + steps @ np.array([seen.shape[1] * seen.shape[2], seen.shape[2], 1])
        loose[loose] = ~((state[around] == OCCUPIED) & ~was[around]).any(axis=1)
        return loose

    def _begin(self, points: np.ndarray, origin: np.ndarray, t: float) -> None:
        """A cluster of returns (R, 3) that no track expects begins one, unless it is too large for a body."""
        if np.ptp(points, axis=0).max() > LARGEST_BODY:
            return
        center, radius = seen_ball(points, origin, self.pitch)
        self.tracks.append(Track(center, np.zeros(3), radius, t, center, t))

    def _follow(self, track: Track, points: np.ndarray, origin: np.ndarray, t: float) -> None:
        """Returns (R, 3) of a body continue its track."""
        center, radius = seen_ball(points, origin, self.pitch)
        if radius < track.radius:  # it is seen in part, or from farther away
            center = center + (track.radius - radius) * unit(center - origin)
        track.take(center, t)
        track.radius = max(0.98 * track.radius, radius)


def returns(scan: Scan) -> np.ndarray:
    """Where the rays of a scan ended, (R, 3), m; anything where nothing came back."""
    return scan.origin + np.where(np.isfinite(scan.distances), scan.distances, 0.0)[:, None] * scan.directions


def clusters(points: np.ndarray) -> list[np.ndarray]:
    """The indices of the points (R, 3) of each cluster: of cubes of `JOINED` that touch."""
    if len(points) == 0:
        return []
    cubes = np.floor((points - points.min(axis=0)) / JOINED).astype(int)
    grid = np.zeros(cubes.max(axis=0) + 1, bool)
    grid[tuple(cubes.T)] = True
    names, count = label(grid, np.ones((3, 3, 3)))
    labels = names[tuple(cubes.T)]
    return [rows for rows in (np.flatnonzero(labels == n + 1) for n in range(count)) if len(rows) >= LEAST_RETURNS]


def seen_ball(points: np.ndarray, origin: np.ndarray, pitch: float) -> tuple[np.ndarray, float]:
    """Centre (3,) and radius, m, of a ball whose near side gave the returns (R, 3), seen from `origin` (3,)."""
    line = unit(points.mean(axis=0) - origin)
    along = (points - origin) @ line
    across = points - origin - along[:, None] * line
    middle = 0.5 * (across.min(axis=0) + across.max(axis=0))
    middle -= (middle @ line) * line
    radius = float(np.linalg.norm(across - middle, axis=1).max() + 0.5 * pitch * along.min())
    return origin + middle + (along.min() + radius) * line, radius


def unit(v: np.ndarray) -> np.ndarray:
    """A vector (3,) at length 1."""
    return v / max(float(np.linalg.norm(v)), 1e-9)
