"""Where a vehicle goes to see what its sensor can't be turned to: above and below it, or behind an edge.

A path that goes on into unknown space ends, for plans, where its free part ends. Scans on the way there show more, and
the free part grows. It doesn't where the unknown cells lie outside of the sensor's field of view, such as those above
a door in a ceiling. They are seen from aside.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from torchgco.missions.sensing.grid import FREE, NOT_FREE, SEEN_OCCUPIED, UNKNOWN, SeenMap
from torchgco.missions.sensing.sensors import Sensor, turned

AROUND = 3.5  # m from what is to be seen, within which places are sought
NEAREST = 0.5  # m from it at least
MOST_CELLS, MOST_PLACES = 40, 60  # that are tested for a free line of sight
OTHER = 0.3  # m: places are tried again where the middle of what is to be seen has moved by more
AWAY = 0.6  # m from places that have been tried
WORTH = 4.0  # m of a longer way that seeing all cells instead of none is worth
COMMITS = 4.0  # m from the end of what is known, within which a vehicle goes there before it turns elsewhere
EARLY = 4  # points of a path, the vehicle's own among them, that may be nearer
THERE = 0.25  # m from a place, at which it has been reached


def goes_there(seen: SeenMap, position: np.ndarray, path: np.ndarray, end: np.ndarray | None, keep: float) -> bool:
    """Whether a path (K, 3) from a position still leads to unknown space at the point `end` (3,), through free cells.

    A vehicle that is near such an end goes there first. What is unknown is dear near a vehicle alone, and becomes so as
    it comes nearer, and other ends cheap: it could go to and fro between two of them for ever.
    """
    if end is None or np.linalg.norm(end - position) > COMMITS:
        return False
    points = halved(np.concatenate([position[None], path[1:]]))
    blocked = barred(seen.gaps(points, keep, NOT_FREE), keep)
    if not len(blocked) or np.linalg.norm(points[blocked[0]] - end) > 2 * seen.resolution:
        return False
    gaps = seen.gaps(np.concatenate([position[None], path[1:]]), keep, SEEN_OCCUPIED)
    return bool((gaps[1:] >= gaps[0] - 0.5 * seen.resolution)[:2].all() and (gaps[3:] >= keep).all())


def rest_of(path: np.ndarray, position: np.ndarray) -> np.ndarray:
    """A path (K, 3) from its point nearest to a position on, two points at least where it has them."""
    nearest = np.linalg.norm(path - position, axis=1).argmin()
    return path[min(nearest, len(path) - 2) :]


def barred(gaps: np.ndarray, keep: float, early: float = 0.0) -> np.ndarray:
    """Indices of the points of a path (K,) that come nearer than `keep`, m, to something, by their gaps (K,), m.

    Near the vehicle `early` m will do: it leaves a place that is too near.
    """
    return np.flatnonzero(gaps < np.where(np.arange(len(gaps)) < EARLY, min(early, keep), keep))


def halved(points: np.ndarray) -> np.ndarray:
    """The points (K, 3) of a path, and those midway between them."""
    found = np.repeat(points, 2, axis=0)[:-1]
    found[1::2] = 0.5 * (points[:-1] + points[1:])
    return found


@dataclass
class Look:
    """What one vehicle seeks to see, and from where.

    Args:
        place: where it goes for that, (3,), m; None: nowhere.
        cells: centres of the cells to be seen, (K, 3), m.
        tried: places that it went to for them before.
        periods: that the way to the place has taken so far.
    """

    place: np.ndarray | None = None
    cells: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    tried: list[np.ndarray] = field(default_factory=list)
    periods: int = 0

    def begin(self, seen: SeenMap, sensor: Sensor, x: np.ndarray, cells: np.ndarray, keep: float) -> bool:
        """Choose a place from which unknown cells (K, 3) can be seen by a vehicle in the state x; whether there is one.

        Args:
            keep: m that places keep from what isn't known to be free.
        """
        if not len(self.cells) or np.linalg.norm(cells.mean(axis=0) - self.cells.mean(axis=0)) > OTHER:
            self.tried = []
        self.cells, self.periods = cells, 0
        self.place = viewpoint(seen, sensor, x, cells, keep, self.tried)
        if self.place is not None:
            self.tried.append(self.place)
        return self.place is not None

    def goes_on(self, seen: SeenMap, position: np.ndarray, most: int) -> bool:
        """Whether the vehicle is still on its way to a place, and half of the cells are still unknown.

        Args:
            most: periods that a way takes at most.
        """
        if self.place is None:
            return False
        self.periods += 1
        over = self.periods > most or np.linalg.norm(position - self.place) < THERE
        if over or (states(seen, self.cells) == UNKNOWN).mean() <= 0.5:
            self.place = None
        return self.place is not None


def states(seen: SeenMap, points: np.ndarray) -> np.ndarray:
    """The states (...) of the cells of points (..., 3) within the grid, or nearest to it."""
    cells = np.clip(np.floor((points - seen.corner) / seen.resolution).astype(np.int64), 0, np.array(seen.shape) - 1)
    return seen.state[cells[..., 0], cells[..., 1], cells[..., 2]]


def unknown_near(seen: SeenMap, points: np.ndarray, reach: float) -> np.ndarray:
    """Centres (K, 3), m, of unknown cells nearer than `reach`, m, to points (M, 3); some of many."""
    wide = int(np.ceil(reach / seen.resolution))
    near = np.stack(np.meshgrid(*[np.arange(-wide, wide + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    cells = (np.floor((points - seen.corner) / seen.resolution).astype(np.int64)[:, None] + near).reshape(-1, 3)
    cells = np.unique(cells[((cells >= 0) & (cells < seen.shape)).all(axis=1)], axis=0)
    cells = cells[seen.state[tuple(cells.T)] == UNKNOWN]
    centers = seen.corner + (cells + 0.5) * seen.resolution
    away = np.maximum(np.abs(points[:, None] - centers) - 0.5 * seen.resolution, 0.0)
    centers = centers[np.linalg.norm(away, axis=-1).min(axis=0, initial=np.inf) < reach]
    return centers[:: 1 + len(centers) // MOST_CELLS]


def viewpoint(
    seen: SeenMap, sensor: Sensor, x: np.ndarray, cells: np.ndarray, keep: float, tried: list[np.ndarray]
) -> np.ndarray | None:
    """The place (3,), m, known to be free and not too far, from which the most of some cells (K, 3), m, can be seen.

    Args:
        x: the vehicle's state: it looks with the same yaw from there.
        keep: m that the place keeps from what isn't known to be free.
        tried: places near which none is sought.
    """
    middle, size = cells.mean(axis=0), 2 * seen.resolution
    ticks = [middle[i] + size * np.arange(-round(AROUND / size), round(AROUND / size) + 1) for i in range(3)]
    places = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    low, high = seen.box(keep)
    away = np.linalg.norm(places - middle, axis=1)
    places = places[((places >= low) & (places <= high)).all(axis=1) & (away >= NEAREST) & (away <= AROUND)]
    for place in tried:
        places = places[np.linalg.norm(places - place, axis=1) > AWAY]
    places = places[states(seen, places) == FREE]
    share = in_view(sensor, x, places, cells).mean(axis=1)
    cost = np.linalg.norm(places - x[:3], axis=1) - WORTH * share
    order = np.argsort(cost, kind="stable")[: 8 * MOST_PLACES]
    order = order[share[order] > 0]
    places = places[order][seen.gaps(places[order], keep, NOT_FREE) >= keep][:MOST_PLACES]
    if not len(places):
        return None
    shown = in_view(sensor, x, places, cells) & in_sight(seen, places, cells)
    share, around = shown.mean(axis=1), AROUND * ~straight(seen, x[:3], places, keep)
    cost = np.where(share > 0, np.linalg.norm(places - x[:3], axis=1) + around - WORTH * share, np.inf)
    best = int(cost.argmin())
    return places[best] if np.isfinite(cost[best]) else None


def in_view(sensor: Sensor, x: np.ndarray, places: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Whether cells (K, 3) are in view from places (P, 3), (P, K), of an upright vehicle with the yaw of state x."""
    yaw = np.array([x[6], 0.0, 0.0, x[9]])
    to = (cells - places[:, None]) @ turned(yaw if yaw.any() else np.array([1.0, 0.0, 0.0, 0.0]))
    return sensor.views(to) & (np.linalg.norm(to, axis=-1) <= sensor.range)


def in_sight(seen: SeenMap, places: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Whether straight lines from places (P, 3) to cells (K, 3) are known to be free up to near the cells, (P, K)."""
    to = cells - places[:, None]
    far = np.linalg.norm(to, axis=-1, keepdims=True)
    until = np.maximum(far - 3**0.5 * seen.resolution, 0.0) / np.maximum(far, 1e-9)
    count = int(np.ceil(far.max(initial=0.0) / (0.7 * seen.resolution))) + 1
    share = np.linspace(0.0, 1.0, count)[:, None, None, None] * until
    return np.all(states(seen, places[:, None] + share * to) == FREE, axis=0)


def straight(seen: SeenMap, position: np.ndarray, places: np.ndarray, keep: float) -> np.ndarray:
    """Whether straight ways from a position (3,) to places (P, 3) keep `keep`, m, after their first third, (P,)."""
    points = position + np.linspace(0.3, 1.0, 12)[:, None, None] * (places - position)
    return np.all((seen.gaps(points.reshape(-1, 3), keep, NOT_FREE) >= keep).reshape(12, -1), axis=0)
