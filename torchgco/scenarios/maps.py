"""Flights on the map in a file."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from torchgco.base.errors import InputError, shown
from torchgco.base.options import Seed, check_options, check_value
from torchgco.maps.distance import DistanceField, Unknown
from torchgco.maps.files import read, read_task, usual_outside
from torchgco.maps.grid import OccupancyGrid, coordinates
from torchgco.roadmap.shortest import shortest_way
from torchgco.scenarios import checks
from torchgco.scenarios.base import ENDS, MAX_DRAWS, End, Footing, Scenario, generator
from torchgco.scenarios.layouts import Layouts

VEHICLE_RADIUS, GOAL_RADIUS = 0.25, 0.3  # m, where neither the command nor the file says them
CLEAR = 1.2  # drawn places are as free as for a vehicle of this many radii
DRAWN_PACES = {2: 0.7, 3: 2.0}  # m/s, by the dimension of space
# Fields that `read` takes.
READ = "resolution", "radius", "origin", "height", "topic", "layer", "box", "solid", "outside"
ENDS_APART = 0.4  # share of the free space's diagonal that drawn starts and goals are apart, at least


@dataclass(frozen=True)
class MapFile(Scenario):
    """A map read from a file by `torchgco.maps.read`, at once; its layouts differ by start and goal.

    Starts and goals that neither the command nor an npz file gives are drawn: uniformly from the largest connected
    space that is free for the vehicle, at least 0.4 of its diagonal apart, else as far as can be. A body is free with
    all of its balls, turned as the vehicle's own start and goal are; connected is what a ball within it can reach.

    Args:
        path, resolution, radius, origin, height, topic, layer, box, solid, outside: see `read`.
        unknown: what unknown cells count as.
        start, goal: positions (d,), m.
        vehicle_radius, goal_radius: m; None: the file's, or 0.25 and 0.3.
        pace: mean speed for which horizons have room, m/s; None: 0.7 in the plane, 2 in space.
        stages: N, the same for all layouts; None: as long as the way takes at `pace`, in tens, and 5 s at least. Where
            no way leads through the map, the straight line counts.
        dt: s.

    Named by the file's stem; the dimension is the map's. Raises InputError where the file is missing or malformed
    (`scenario.path`), or a field is out of its range (`scenario.<field>`).
    """

    path: str | Path
    resolution: float | None = None
    radius: float | None = None
    origin: Any = None
    height: float | None = None
    topic: str | None = None
    layer: Any = None
    box: Any = None
    solid: bool | None = None
    unknown: Unknown = "occupied"
    outside: Unknown | None = None
    start: Any = None
    goal: Any = None
    vehicle_radius: checks.Length | None = None
    goal_radius: checks.Size | None = None
    pace: checks.Pace | None = None
    stages: checks.Stages | None = None
    dt: checks.TimeStep = 0.1
    name: str = field(init=False)
    map: DistanceField = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        def put(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        put("name", "map")
        check_options(self, "scenario")
        put("path", os.path.expanduser(self.path))
        put("outside", self.outside or usual_outside(self.path, self.height, "scenario"))
        source = read(self.path, field="scenario", **{key: getattr(self, key) for key in READ})
        put("map", DistanceField.of(source, self.unknown))
        put("name", Path(self.path).stem)
        task = read_task(Path(self.path)) | {
            key: getattr(self, key) for key in ("start", "goal") if getattr(self, key) is not None
        }
        for key in ("start", "goal"):
            put(key, None if key not in task else self._position(task[key], key))
        for key, default in (("vehicle_radius", VEHICLE_RADIUS), ("goal_radius", GOAL_RADIUS)):
            if getattr(self, key) is None:
                put(key, checks.scalar(key, task.get(key, default)))

    @property
    def dimension(self) -> int:
        """Dimension d of the map."""
        return self.map.d

    @property
    def available(self) -> int | None:
        """One layout where start and goal are given; None where some are drawn."""
        return None if self.start is None or self.goal is None else 1

    def draw(self, ids: Sequence[int], seed: int) -> Layouts:
        """Layouts `ids` under `seed`: each has the map, and its own start and goal where these are drawn.

        Raises:
            InputError: ids or seed are malformed, a given start isn't free while the goal is drawn, or no place is
                free for the vehicle.
        """
        numbers, seed = checks.indices(ids, "ids"), check_value(seed, Seed, "seed")
        ends = np.array([self._ends(generator(seed, int(number))) for number in numbers])
        stages = self.stages or np.array([self._stages_between(*pair) for pair in ends])
        none = np.empty((len(numbers), 0, self.dimension))
        return Layouts(
            centers=none, radii=none[..., 0], start=ends[:, 0], goal=ends[:, 1], vehicle_radius=self.vehicle_radius,
            goal_radius=self.goal_radius, dt=self.dt, stages=stages, map=self.map, name=self.name, ids=numbers,
        )  # fmt: skip

    def _position(self, value: Any, name: str) -> np.ndarray:
        point = coordinates(value, f"scenario.{name}")
        if point.shape != (self.dimension,) or not (np.abs(point) <= checks.TOO_LARGE).all():
            expected = f"{self.dimension} coordinates within {checks.TOO_LARGE:g} m, as the map is {self.dimension}-D"
            raise InputError(f"scenario.{name}", expected, shown(point.tolist()))
        source = self.map.source
        if self.outside == "occupied" and isinstance(source, OccupancyGrid) and not source.holds(point):
            expected = "a place on the map, around which all is occupied unless scenario.outside=free"
            raise InputError(f"scenario.{name}", expected, shown(point.tolist()))
        return point

    def _ends(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Start and goal (d,), the given ones as they are."""
        if self.start is not None and self.goal is not None:
            return self.start, self.goal
        fixed = self.goal if self.start is None else self.start
        ends: list[End] = [end for end in ENDS if getattr(self, end) is None]
        places = [self._free(end, fixed) for end in ends]
        apart = ENDS_APART * math.dist(places[-1].min(0), places[-1].max(0))
        for _ in range(MAX_DRAWS):
            *firsts, second = (each[rng.integers(len(each))] for each in places)
            first = firsts[0] if fixed is None else fixed
            if math.dist(first, second) >= apart:
                break
        else:
            second = places[-1][np.linalg.norm(places[-1] - first, axis=1).argmax()]
        return (first, second) if ends[-1] == "goal" else (second, first)

    def _stages_between(self, start: np.ndarray, goal: np.ndarray) -> int:
        way = shortest_way(self.map, self._vehicle.inner, start, goal)
        pace = DRAWN_PACES[self.dimension] if self.pace is None else self.pace
        return checks.stages_for(math.dist(start, goal) if way is None else way, pace, self.dt)

    def _free(self, end: End, near: np.ndarray | None) -> np.ndarray:
        """Places (P, d) of an end in the connected free space around `near`; in the largest one where that is None."""
        labels, free = self._spaces
        sizes = np.bincount(labels[free["start"] & free["goal"]], minlength=2)
        chosen = int(sizes[1:].argmax()) + 1
        if near is not None:
            node = np.rint((near - self.map.origin[0]) / self.map.spacing).astype(int)
            inside = ((node >= 0) & (node < labels.shape)).all()
            chosen = int(labels[tuple(node)]) if inside else 0
            if not chosen:
                name = "goal" if self.start is None else "start"
                raise InputError(f"scenario.{name}", "a place on the map that is free for the vehicle", near.tolist())
        places = np.argwhere((labels == chosen) & free[end])
        if not len(places):
            vehicle, field = f"a vehicle of radius {self.vehicle_radius:g} m", "vehicle_radius"
            if self.footing is not None:
                vehicle, field = f"the vehicle's body, turned as its {end} is", "path"
            expected = f"a map with a place that is free for {vehicle}"
            raise InputError(f"scenario.{field}", expected, f"none in {self.path}")
        return self.map.origin[0] + self.map.spacing * places

    @property
    def _vehicle(self) -> Footing:
        assert self.vehicle_radius is not None
        return self.footing or Footing.of_ball(self.vehicle_radius, self.dimension)

    @cached_property
    def _spaces(self) -> tuple[np.ndarray, dict[End, np.ndarray]]:
        """Numbers of the connected free spaces at the nodes, 0 where not free, and where each end is free."""
        from scipy.ndimage import label

        values, spacing, vehicle = self.map.values[0], self.map.spacing, self._vehicle
        free: dict[End, np.ndarray] = {end: vehicle.free(end, values, spacing, CLEAR, spacing) for end in ENDS}
        return label(values > CLEAR * vehicle.inner + spacing)[0], free
