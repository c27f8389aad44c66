"""Floor plans as maps of cells: rooms by recursive division, furniture in them, and serpentine tracks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from torchgco.base.errors import InputError
from torchgco.base.options import INCREASING, Share, Within, check_options
from torchgco.maps.distance import DistanceField
from torchgco.maps.grid import OccupancyGrid
from torchgco.maps.ways import Ways
from torchgco.scenarios import checks
from torchgco.scenarios.base import ENDS, Footing, Scenario
from torchgco.scenarios.layouts import Layouts

PLANS = 50  # that are drawn for one layout, at most, until one has ends that are far enough apart
SURE = 1.1  # radii that the way from start to goal is free for
ENDS_CLEAR = 1.5  # radii that start and goal are away from all walls
RIM = 0.4  # m of solid around a plan
LEAST_FILLED = 0.6  # share of the space that a plan of rooms fills along each axis, at least
LONGER = 0.8  # probability that a room is divided across its longer side
WHOLE = 5.0  # squares of the least width: a room as large as so many is divided for sure, smaller ones more seldom
WALL_TRIES = 10  # places that are tried for a wall
JAMB = 0.2  # m of wall on either side of a door
OFF = 0.3  # m that furniture keeps off doors
TURNED = 0.5  # probability that a piece of furniture stands at an angle
TURNS = 0.3  # share of a lane's length by which its ends differ

Array = NDArray[np.float64]
Lanes = Annotated[tuple[Annotated[int, Within(2, 1000)], Annotated[int, Within(2, 1000)]], INCREASING]


@dataclass(frozen=True, eq=False)
class Canvas:
    """Cells of a plan, all of them solid at first.

    Args:
        occupied: (X, Y) bool; drawn into.
        resolution: side of a cell, m; the first one has its lowest corner at 0.
    """

    occupied: NDArray[np.bool_]
    resolution: float

    @classmethod
    def of(cls, size: Sequence[float], resolution: float) -> Canvas:
        """Solid cells on an area (2,), m."""
        return cls(np.ones([max(1, round(side / resolution)) for side in size], bool), resolution)

    @property
    def size(self) -> Array:
        """(2,), m."""
        return self.resolution * np.array(self.occupied.shape, float)

    @cached_property
    def centers(self) -> Array:
        """Of the cells, (X, Y, 2), m."""
        axes = (self.resolution * (np.arange(n) + 0.5) for n in self.occupied.shape)
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)

    def fill(self, low: Array, high: Array, solid: bool) -> None:
        """Make the cells with centres in a box solid, or free."""
        self.occupied[((self.centers >= low) & (self.centers < high)).all(-1)] = solid


@dataclass(frozen=True, kw_only=True)
class Floors(Scenario):
    """Rooms with doors and furniture, or a serpentine track, as a map of its own for each layout.

    A plan of rooms fills a part of `size`. It is divided again and again, for the most part across the longer side, by
    walls of any thickness in `thickness` (its logarithm is uniform), each with a door, some with two. Pieces of
    furniture, half of them turned, keep off the doors. A track is a lane that turns back several times, with square or
    round corners. All around is solid. A plan without ends whose way is as long as `apart`, for a vehicle of 1.1 times
    the radius and by a search over the cells, is drawn again. Starts and goals are positions; the vehicle rests there.

    Args:
        size: of the map along x and y, m.
        resolution: side of a cell, m.
        tracks: share of the layouts that are tracks.
        thickness: [least, largest] of walls, m.
        room: least width of a room, m.
        door: [least, largest] width, m.
        loops: share of walls with a second door.
        furniture: pieces per m^2, expected.
        piece: [least, largest] side of a piece, m.
        lane: [least, largest] width of a track's lanes, m.
        lanes: [least, largest] number of them; fewer where they don't fit.
        apart: length of the way from start to goal, m, at least.
        pace: horizons are as long as the way takes at this mean speed, m/s.
        stages: N, the same for all layouts; None: by the way and `pace`, in tens, and 5 s at least.
        vehicle_radius, goal_radius: m.
        dt: s.

    Raises:
        InputError: a field out of its range, doors or lanes that the vehicle can't be sure to pass, a size without room
            for rooms or tracks (`scenario.<field>`); on `draw`: none of 50 plans has such a way (`scenario.apart`).
    """

    shares_map = False

    name: str = "floors"
    size: tuple[checks.Size, checks.Size] = (20.0, 14.0)
    resolution: checks.Size = 0.1
    tracks: Share = 0.25
    thickness: checks.Sizes = (0.1, 1.6)
    room: checks.Size = 2.4
    door: checks.Sizes = (1.0, 1.6)
    loops: Share = 0.3
    furniture: checks.Density = 0.08
    piece: checks.Sizes = (0.3, 1.4)
    lane: checks.Sizes = (1.1, 2.0)
    lanes: Lanes = (3, 5)
    apart: checks.Length = 10.0
    pace: checks.Pace = 0.7
    stages: checks.Stages | None = None
    vehicle_radius: checks.Length = 0.25
    goal_radius: checks.Size = 0.3
    dt: checks.TimeStep = 0.1

    def __post_init__(self) -> None:
        check_options(self, "scenario")
        for field in ("size", "thickness", "door", "piece", "lane"):
            object.__setattr__(self, field, checks.plain(getattr(self, field)))
        object.__setattr__(self, "lanes", tuple(map(int, self.lanes)))
        passable = 2.0 * SURE * self.vehicle_radius + 4.0 * self.resolution  # whatever the cells round away
        for field in ("door", "lane"):
            if getattr(self, field)[0] < passable:
                expected = f"widths of at least {passable:g} m, for the vehicle and four cells"
                raise InputError(f"scenario.{field}", expected, getattr(self, field))
        if self.room < self.door[1] + 2.0 * self.thickness[0]:
            raise InputError("scenario.room", f"more than the widest door, {self.door[1]:g} m", self.room)
        needed = 2.0 * max(self.room, self.lane[1], 1.0)
        if min(self.size) < needed:
            raise InputError("scenario.size", f"at least {needed:g} m along each axis", self.size)

    @property
    def dimension(self) -> int:
        """2."""
        return 2

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        for _ in range(PLANS):
            field, ends, far = self._plan(rng)
            if ends is not None:
                return self._layout(field, ends, far)
        expected = f"a way that a plan of {self.size[0]:g} x {self.size[1]:g} m has"
        raise InputError("scenario.apart", expected, f"{self.apart:g} m, which none of {PLANS} plans has")

    def _layout(self, field: DistanceField, ends: np.ndarray, far: float) -> Layouts:
        stages = self.stages or checks.stages_for(far, self.pace, self.dt)
        none = np.empty((1, 0, 2))
        return Layouts(
            centers=none, radii=none[..., 0], start=ends[:1], goal=ends[1:], vehicle_radius=self.vehicle_radius,
            goal_radius=self.goal_radius, dt=self.dt, stages=stages, map=field,
        )  # fmt: skip

    def _plan(self, rng: np.random.Generator) -> tuple[DistanceField, np.ndarray | None, float]:
        """A plan's distances, start and goal (2, 2), None where none are far enough apart, and the way between, m."""
        canvas, ends = Canvas.of(self.size, self.resolution), None
        if rng.uniform() < self.tracks:
            ends = np.array(self.draw_track(rng, canvas))
        else:
            self.draw_rooms(rng, canvas)
        field = DistanceField.of(OccupancyGrid(canvas.occupied, np.zeros(2), self.resolution))
        vehicle = self.footing or Footing.of_ball(self.vehicle_radius, 2)
        ways = Ways.through(field, 0, SURE * vehicle.inner)
        clear = ENDS_CLEAR if ends is None else SURE
        starts, goals = (vehicle.free(end, ways.distance, ways.spacing, clear).ravel() for end in ENDS)
        if not starts.any():
            return field, None, 0.0
        start = int(rng.choice(np.flatnonzero(starts))) if ends is None else ways.node(ends[0])
        far, _ = ways.costs(ways.places(start))
        if ends is None:
            there = np.flatnonzero(goals & np.isfinite(far) & (far >= self.apart))
            goal = int(rng.choice(there)) if len(there) else start
        else:
            goal = ways.node(ends[1])
        reached = np.isfinite(far[goal]) and far[goal] >= self.apart and starts[start] and goals[goal]
        return field, ways.places([start, goal]) if reached else None, float(far[goal])

    def draw_rooms(self, rng: np.random.Generator, canvas: Canvas) -> None:
        """Draw rooms."""
        low = np.full(2, RIM)
        high = low + rng.uniform(LEAST_FILLED, 1.0, 2) * (canvas.size - 2 * RIM)
        canvas.fill(low, high, False)
        openings: list[tuple[Array, Array]] = []
        left = [(low, high)]
        while left:
            first, last = left.pop()
            if rng.uniform() > np.prod(last - first) / (WHOLE * self.room**2):
                continue
            wall = self._wall(rng, first, last, openings)
            if wall is None:
                continue
            axis, begin, end = wall
            canvas.fill(begin, end, True)
            for _ in range(1 + (rng.uniform() < self.loops)):
                opening = self._door(rng, axis, begin, end)
                canvas.fill(*opening, False)
                openings.append(opening)
            lower_end, upper_begin = last.copy(), first.copy()
            lower_end[axis], upper_begin[axis] = begin[axis], end[axis]
            left += [(first, lower_end), (upper_begin, last)]
        for _ in range(rng.poisson(self.furniture * float(np.prod(high - low)))):
            self._piece(rng, canvas, low, high, openings)

    def _thick(self, rng: np.random.Generator) -> float:
        """A thickness of walls, m."""
        return math.exp(rng.uniform(math.log(self.thickness[0]), math.log(self.thickness[1])))

    def _wall(
        self, rng: np.random.Generator, low: Array, high: Array, openings: list[tuple[Array, Array]]
    ) -> tuple[int, Array, Array] | None:
        """The axis across which a room is divided, and the corners of the wall; None where no place was found.

        A wall doesn't end at a door.
        """
        for _ in range(WALL_TRIES):
            longer = int(np.argmax(high - low))
            axis = longer if rng.uniform() < LONGER else 1 - longer
            thick = self._thick(rng)
            if high[axis] - low[axis] < 2 * self.room + thick or (high - low)[1 - axis] < self.door[1] + 2 * JAMB:
                continue
            begin, end = low.copy(), high.copy()
            begin[axis] = rng.uniform(low[axis] + self.room, high[axis] - self.room - thick)
            end[axis] = begin[axis] + thick
            beyond = np.full(2, JAMB)
            beyond[1 - axis] = self.thickness[1]  # openings in the walls that it ends at
            if not any(((begin - beyond < b) & (a < end + beyond)).all() for a, b in openings):
                return axis, begin, end
        return None

    def _door(self, rng: np.random.Generator, axis: int, begin: Array, end: Array) -> tuple[Array, Array]:
        """The corners of an opening in a wall."""
        low, high, across = begin.copy(), end.copy(), 1 - axis
        wide = rng.uniform(self.door[0], self.door[1])
        low[across] = rng.uniform(begin[across] + JAMB, end[across] - JAMB - wide)
        high[across] = low[across] + wide
        return low, high

    def _piece(
        self, rng: np.random.Generator, canvas: Canvas, low: Array, high: Array, openings: list[tuple[Array, Array]]
    ) -> None:
        """Draw a piece of furniture, unless it would stand at a door."""
        center, half = rng.uniform(low, high), 0.5 * rng.uniform(self.piece[0], self.piece[1], 2)
        angle = rng.uniform(0.0, math.pi) if rng.uniform() < TURNED else 0.0
        reach = float(np.hypot(*half)) + OFF
        for a, b in openings:
            if np.linalg.norm(np.maximum(np.maximum(a - center, center - b), 0.0)) < reach:
                return
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        inside = (np.abs((canvas.centers - center) @ turn) < half).all(-1)
        canvas.occupied[inside] = True

    def draw_track(self, rng: np.random.Generator, canvas: Canvas) -> tuple[Array, Array]:
        """Draw a lane that turns back several times; returns its two ends (2,), m."""
        size = canvas.size - 2 * RIM
        along = int(rng.integers(2))  # the axis of the lanes
        wide = rng.uniform(self.lane[0], self.lane[1])
        pitch = wide + self._thick(rng)
        most = 1 + int((size[1 - along] - wide) / pitch)
        count = max(1, min(int(rng.integers(self.lanes[0], self.lanes[1] + 1)), most))
        reach = rng.uniform(LEAST_FILLED, 1.0) * size[along] - wide
        across = RIM + 0.5 * wide + pitch * np.arange(count)
        ends = RIM + 0.5 * wide + reach * rng.uniform(0.0, TURNS, count + 1)  # of lane i: at i and i + 1
        ends[1::2] = 2 * RIM + wide + reach - ends[1::2]
        corners = np.empty((2 * count, 2))
        corners[:, 1 - along] = across.repeat(2)
        corners[0::2, along], corners[1::2, along] = ends[:-1], ends[1:]
        norm = np.inf if rng.uniform() < 0.5 else 2  # square corners, or round ones
        for a, b in pairwise(corners):
            near = np.clip(canvas.centers, np.minimum(a, b), np.maximum(a, b))
            canvas.occupied[np.linalg.norm(canvas.centers - near, norm, axis=-1) <= 0.5 * wide] = False
        return corners[0], corners[-1]
