"""What a vehicle in unknown space knows, the path that it seeks there, and the motion that its plans are to follow."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from torchgco.base import clock
from torchgco.exploration.explorer import Explorer
from torchgco.exploration.movers import Movers, Moving, nothing
from torchgco.exploration.reference import between, motion, swings, taut
from torchgco.exploration.sensing.cells import CellSearch
from torchgco.exploration.sensing.grid import SEEN_OCCUPIED, SeenMap
from torchgco.exploration.sensing.world import World
from torchgco.missions.log import SeenLog
from torchgco.obstacles.base import CONTACT_FACTOR

SEARCH_OPTIONS: dict[str, Any] = {"unseen": 1.0, "greed": 1.1, "stride": 2}
# Where no way is found, a search with less margin, then one over all cells: the share of the margin, and the stride.
CAUTION_LEVELS = (1.0, 2), (0.0, 2), (0.0, 1)
MOST_SEARCHED = 24_000  # cells that searches of a control period look at: 15 ms
SEARCHED = 2  # control periods after which a new search is due
HELD = 2.0  # s before a search with less margin, or a slow reference, ends
SPARE = 0.03  # m that a plan keeps beyond contact at least: it is tested at points, and flown with small errors
DRIFT = 0.01  # m by which a plan may come nearer while it is flown, as a vehicle isn't exactly where it should be
ARRIVES = 4.5  # cells between the end of a path and the goal, which is then joined to it
STAYED_WITHIN = 0.3  # m within which a vehicle has stayed in its place
PATH_POINTS_AHEAD = 4  # points of a path, of which the last is looked at where none is blocked
SLOW = 0.45  # factor on the speed of a slow reference; at 1 m/s^2 it still leaves a place within `patience`
PAUSE = 0.25  # s in one place after which a reference that no plan follows becomes slow, for `HELD`


@dataclass
class Scout:
    """What one vehicle knows, and where it goes.

    Args:
        goal: (3,), m; radius: of the vehicle, m; dt: control period, s; every: control periods between two scans.
        kinds: of cells that plans stay out of, as `SeenMap.gaps` takes them.
    """

    explorer: Explorer
    world: World
    seen: SeenMap
    search: CellSearch
    log: SeenLog
    goal: np.ndarray
    radius: float
    movers: Movers
    dt: float
    every: int
    kinds: int
    moving: Moving = field(default_factory=nothing)  # at this control step
    path: np.ndarray = field(default_factory=lambda: np.zeros((1, 3)))  # cells' centres, (K, 3), m
    corners: np.ndarray = field(default_factory=lambda: np.zeros((1, 3)))  # of its part that is known to be free
    waited: int = 0  # control periods near `place`
    place: np.ndarray = field(default_factory=lambda: np.full(3, np.inf))  # m
    level: int = 0  # of CAUTION_LEVELS
    since: int = 0  # control periods at this level
    slow: int = 0  # control periods for which the reference stays slow, in this place
    seconds: dict[str, float] = field(default_factory=dict)
    changed: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))
    scanned: bool = False  # in this control period
    arrives: bool = False  # whether the path leads to the goal
    age: int = 0  # control periods since the last search; 0: there was none

    @property
    def keep(self) -> float:
        """The distance, m, that plans keep from what isn't known to be free."""
        least, share = CONTACT_FACTOR * self.radius + SPARE + 2.0 * DRIFT, CAUTION_LEVELS[self.level][0]
        return share * max(least, self.radius + self.explorer.margin) + (1.0 - share) * least

    def seek(self, position: np.ndarray) -> None:
        """Find the path to the goal from a position (3,), m, and the part of it that is known to be free."""
        began = clock.seconds()
        self._search(position)
        keep = self.keep
        points = _halved(np.concatenate([position[None], self.path[1:]]))
        if np.linalg.norm(self.path[-1] - self.goal) <= ARRIVES * self.seen.resolution:
            points = np.concatenate([points, self.goal[None]])
        gaps = self.seen.gaps(points, keep + 0.05, self.kinds)
        blocked = np.flatnonzero((gaps < keep) & (np.arange(len(points)) > 3))
        free = points[: blocked[0] if len(blocked) else len(points)]
        self.corners = taut(free, lambda p: bool((self.seen.gaps(p, keep + 0.05, self.kinds)[1:] >= keep).all()))
        self._wait(position, points, gaps)
        self.seconds["search_seconds"] += clock.seconds() - began

    def _search(self, position: np.ndarray) -> None:
        """The path to the goal; where none is found, with less margin from now on, for a while.

        Scan and search take turns where there are periods without a scan: both in one would be the longest.
        """
        self.since += 1
        if self.scanned and 0 < self.age < SEARCHED and self.every > 1:
            self.age += 1
            self.path = _rest_of(self.path, position)
            return
        self.age = 1
        if self.level > 0 and self.since * self.dt >= HELD and self.search.pending is None:
            self.level, self.since = 0, 0
        left = MOST_SEARCHED
        while True:
            self.search.radius, self.search.stride = self.keep, CAUTION_LEVELS[self.level][1]
            self.search.limit = max(left, 1)
            result = self.search.path(position, self.goal)
            left -= self.search.expanded
            if result is None:
                self.path = _rest_of(self.path, position)
                return
            new, arrives = result
            self.path = self._steady(position, new) if arrives and self.arrives else new
            self.arrives = arrives
            if arrives or self.level + 1 == len(CAUTION_LEVELS):
                return
            self.level, self.since = self.level + 1, 0

    def _steady(self, position: np.ndarray, new: np.ndarray) -> np.ndarray:
        """Of two paths to the goal the one that is followed, unless it is lost, or a new one (K, 3) is cheaper."""
        former = _rest_of(self.path, position)
        gaps = self.seen.gaps(between(position, former[min(1, len(former) - 1)]), self.keep, SEEN_OCCUPIED)
        joins = bool((gaps >= gaps[0] - 0.5 * self.seen.resolution).all())
        joined = np.concatenate([position[None], former[1:]])
        costs = [self.search.cost(_halved(path)) for path in (joined, new)]
        return former if joins and costs[0] <= costs[1] else new

    def _wait(self, position: np.ndarray, points: np.ndarray, gaps: np.ndarray) -> None:
        """Count the periods in one place, and in the end look elsewhere.

        The way on may be cells that stay unknown, as no ray gets to them, or one that no plan can take.
        """
        if np.linalg.norm(position - self.place) > STAYED_WITHIN:
            self.place, self.waited, self.slow = position.copy(), 0, 0
        self.waited += self.search.pending is None
        if self.waited * self.dt >= self.explorer.patience:
            blocked = np.flatnonzero(gaps < self.keep)
            first = blocked[blocked > 0][:1]
            self.search.avoid(points[first[0] if len(first) else min(PATH_POINTS_AHEAD, len(points) - 1)], 1.0)
            self.waited = 0

    def motion(self, velocity: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities (count + 1, 3) along the free part, for plans that begin at a velocity (3,), m/s."""
        keep = self.keep
        swing = swings(self.corners, lambda p: self.seen.gaps(p, keep + 0.05, SEEN_OCCUPIED) >= keep)
        pace = self.explorer.pace.slower(SLOW if self.slow else 1.0)
        return motion(self.corners, velocity, pace, count, self.dt, swing)

    def slow_down(self, came_through: bool) -> None:
        """Make the reference of a vehicle in one place slow, where no plan comes through that follows it.

        Plans within the previous one's corridor do, but may lead nowhere: each of them may begin by hovering.
        """
        self.slow = max(0, self.slow - 1)
        if not came_through and self.slow == 0 and self.waited * self.dt >= PAUSE:
            self.slow, self.waited = round(HELD / self.dt), 0


def _halved(points: np.ndarray) -> np.ndarray:
    """The points (K, 3) of a path, and those midway between them."""
    halved = np.repeat(points, 2, axis=0)[:-1]
    halved[1::2] = 0.5 * (points[:-1] + points[1:])
    return halved


def _rest_of(path: np.ndarray, position: np.ndarray) -> np.ndarray:
    """A path (K, 3) from its point nearest to a position on, two points at least where it has them."""
    nearest = np.linalg.norm(path - position, axis=1).argmin()
    return path[min(nearest, len(path) - 2) :]
