"""Floor plans as maps of cells: rooms with doors and furniture, and serpentine tracks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.options import INCREASING, Share, Within, check_options
from torchgco.maps.distance import DistanceField
from torchgco.maps.grid import OccupancyGrid
from torchgco.maps.ways import Ways
from torchgco.scenarios import checks
from torchgco.scenarios.base import Scenario
from torchgco.scenarios.layouts import Layouts
from torchgco.scenarios.plans import Canvas, rooms, track

PLANS = 50  # that are drawn for one layout, at most, until one has ends that are far enough apart
SURE = 1.1  # radii that the way from start to goal is free for
ENDS_CLEAR = 1.5  # radii that start and goal are away from all walls

Lanes = Annotated[tuple[Annotated[int, Within(2, 1000)], Annotated[int, Within(2, 1000)]], INCREASING]


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
            ends = np.array(track(rng, canvas, self.thickness, self.lane, self.lanes))
        else:
            rooms(rng, canvas, self.thickness, self.room, self.door, self.loops, self.furniture, self.piece)
        field = DistanceField.of(OccupancyGrid(canvas.occupied, np.zeros(2), self.resolution))
        ways = Ways.through(field, 0, SURE * self.vehicle_radius)
        free = np.flatnonzero(ways.distance.ravel() > ENDS_CLEAR * self.vehicle_radius)
        start = int(rng.choice(free)) if ends is None else ways.node(ends[0])
        far, _ = ways.costs(ways.places(start))
        if ends is None:
            there = free[np.isfinite(far[free]) & (far[free] >= self.apart)]
            goal = int(rng.choice(there)) if len(there) else start
        else:
            goal = ways.node(ends[1])
        reached = np.isfinite(far[goal]) and far[goal] >= self.apart
        return field, ways.places([start, goal]) if reached else None, float(far[goal])
