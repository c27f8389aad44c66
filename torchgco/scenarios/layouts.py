"""Obstacle layouts, as scenarios draw them and layout files hold them, with their map among the arrays.

L layouts, M spheres and K boxes each, d the dimension of space (2 or 3). A layout with fewer of them is padded with
rows of NaN. Lengths in metres, times in seconds.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.files import read_arrays, write_whole
from torchgco.base.memory import free_memory
from torchgco.base.options import check_value
from torchgco.maps.distance import DistanceField
from torchgco.maps.grid import OccupancyGrid, PointCloud
from torchgco.scenarios import checks

GRID = ("map_occupied", "map_origin", "map_resolution")
CLOUD = ("map_points", "map_radius")
MAP_ARRAYS = (*GRID, *CLOUD, "map_unknown")


def map_arrays(field: DistanceField) -> dict[str, np.ndarray]:
    """What a field is of, by the names of a file: the cells or the points, and what unknown cells count as."""
    source = field.source
    if isinstance(source, OccupancyGrid):
        values = (source.occupied, source.origin, source.resolution)
        return {name: np.asarray(value) for name, value in zip(GRID, values, strict=True)} | {
            "map_unknown": np.array(field.unknown)
        }
    return {name: np.asarray(value) for name, value in zip(CLOUD, (source.points, source.radius), strict=True)}


def map_of(arrays: Mapping[str, np.ndarray]) -> DistanceField | None:
    """The field of the map among these arrays; None where there is none.

    Raises:
        InputError: arrays of a map of which some are missing or malformed, named `layouts.<array>`.
    """
    stored = [name for name in MAP_ARRAYS if name in arrays]
    if not stored:
        return None
    kind = CLOUD if "map_points" in arrays else GRID
    if missing := [name for name in kind if name not in arrays]:
        raise InputError(f"layouts.{missing[0]}", f"this array beside {stored[0]}", "none")
    values = [arrays[name] for name in kind]
    if kind is CLOUD:
        return DistanceField.of(PointCloud(*values))
    unknown = arrays.get("map_unknown", np.array("occupied"))
    return DistanceField.of(OccupancyGrid(*values), str(unknown))  # type: ignore[arg-type]


# Arrays of a file, in the order of the fields of Layouts. `layout` holds the ids, if they are not 0..L-1.
REQUIRED = ("centers", "radii")
SPHERES = (*REQUIRED, "velocities")
CONTROLS = ("control_lower", "control_upper")
BOXES = ("box_centers", "box_half_sizes", "box_rotations", "box_radii")
SINES = ("box_amplitudes", "box_rates", "box_phases")
GATES = ("gate_centers", "gate_radii")
TIME = "free_time"
BINDS = "goal_required"
NAMED_ARRAYS = (*SPHERES, *BOXES, *SINES, *GATES, "start", "goal", *checks.SCALARS, *CONTROLS, TIME, BINDS, "best_cost")
IDS = "layout"
SHARED = tuple(name for name in checks.SCALARS if name != "stages")  # numbers that all layouts share


@dataclass(frozen=True, eq=False)
class Layouts:
    """A batch of obstacle layouts, with start, goal and other parts of the task where known.

    Args:
        centers: (L, M, d) m, rows of NaN where an obstacle is absent.
        radii: (L, M) m, NaN where absent.
        velocities: (L, M, d) m/s, constant, or None if nothing moves.
        start, goal: (L, n) states, given as (n,) or (L, n), positions first; or positions alone, (d,) or (L, d), where
            the vehicle rests; or None. Of fleets with an axis of V vehicles before the last, (V, n) or (L, V, n).
        vehicle_radius, goal_radius, dt: m, m, s; each one number for all layouts, or None.
        apart: what the centres of any two vehicles keep from each other, m: the layouts are of fleets; or None.
        stages: N, one number for all layouts, or (L,) where they differ, or None.
        control_lower, control_upper: (m,) in the units of the inputs, infinite or None where unbounded; or None.
        best_cost: (L,) J_var of the best solution known, NaN where none is, or None.
        box_centers, box_half_sizes: (L, K, d) m, rows of NaN where a box is absent, or None if there are none; half the
            sides' lengths.
        box_rotations: (L, K) rad in the plane, (L, K, 4) unit quaternions [w, x, y, z] in space: from the sides to the
            axes of space, NaN where absent; None: sides along the axes.
        box_radii: (L, K) m by which boxes are rounded outwards, NaN where absent; None: sharp boxes. Where above 0,
            half sides may be 0: a capsule has one side above 0.
        box_amplitudes, box_rates, box_phases: (L, K, S, d) m, rad/s and rad of S sines along each axis: at time t a box
            is at box_centers + sum_s amplitudes sin(rates t + phases). NaN where absent, or None if all boxes rest.
        gate_centers, gate_radii: (L, G, d) and (L, G) m, balls that the position passes in this order, NaN behind the
            last of a layout with fewer; or None. They divide the stages into legs of about as many.
        free_time: (3,) least and most length of a stage, as multiples of dt, and the cost of a second: the duration is
            free, of each leg by itself, and time is the cost; or None.
        goal_required: whether the goal is a constraint also where the time is given; None: where it is free alone.
        map: the distance field of a map that all layouts share, or of L grids of the same size, one for each; or None.
            In a file: the arrays `map_occupied`, `map_origin` and `map_resolution`, or `map_points` and `map_radius`,
            and `map_unknown`.
        name: of the family, or the stem of the file.
        ids: (L,) int64, index of each layout in its file or generator; 0..L-1 unless given.

    Arrays are copied on construction. Raises InputError naming `layouts.<field>`.
    """

    centers: np.ndarray
    radii: np.ndarray
    velocities: np.ndarray | None = None
    start: np.ndarray | None = None
    goal: np.ndarray | None = None
    vehicle_radius: float | None = None
    goal_radius: float | None = None
    dt: float | None = None
    apart: float | None = None
    stages: int | np.ndarray | None = None
    control_lower: np.ndarray | None = None
    control_upper: np.ndarray | None = None
    best_cost: np.ndarray | None = None
    box_centers: np.ndarray | None = None
    box_half_sizes: np.ndarray | None = None
    box_rotations: np.ndarray | None = None
    box_radii: np.ndarray | None = None
    box_amplitudes: np.ndarray | None = None
    box_rates: np.ndarray | None = None
    box_phases: np.ndarray | None = None
    gate_centers: np.ndarray | None = None
    gate_radii: np.ndarray | None = None
    free_time: np.ndarray | None = None
    goal_required: bool | None = None
    map: DistanceField | None = None
    name: str = "layouts"
    ids: np.ndarray = field(default_factory=lambda: np.empty(0, np.int64))  # empty stands for 0..L-1

    def __post_init__(self) -> None:
        centers, radii = checks.obstacles(self.centers, self.radii)
        moving = checks.velocities(self.velocities, centers)
        boxes = checks.boxes(self.box_centers, self.box_half_sizes, self.box_rotations, self.box_radii, centers)
        checked: dict[str, Any] = {"centers": centers, "radii": radii, "velocities": moving}
        checked |= zip(BOXES, boxes, strict=True)
        checked |= zip(SINES, checks.sines([getattr(self, name) for name in SINES], boxes[0]), strict=True)
        checked |= zip(GATES, checks.gates(self.gate_centers, self.gate_radii, centers), strict=True)
        checked |= {TIME: checks.free_time(self.free_time, moving), BINDS: checks.required(self.goal_required)}
        checked |= {
            name: checks.states(getattr(self, name), f"layouts.{name}", centers, self.apart is not None)
            for name in ("start", "goal")
        }
        checked |= {name: checks.scalar(name, getattr(self, name)) for name in SHARED}
        checked |= zip(CONTROLS, checks.control_bounds(self.control_lower, self.control_upper), strict=True)
        checked |= {"stages": checks.stages(self.stages, len(centers)), "ids": checks.ids(self.ids, len(centers))}
        checked |= {"best_cost": checks.best_cost(self.best_cost, len(centers))}
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "map", self._checked_map())
        self._check_ends()
        check_value(self.name, str, "layouts.name")

    def _check_ends(self) -> None:
        """Raise where start and goal are of other vehicles, or of other fleets."""
        start, goal = self.start, self.goal
        if start is None or goal is None:
            if self.apart is not None:
                raise InputError("layouts.start", "start and goal of each vehicle, as apart is given", "none")
            return
        if len({start.shape[-1], goal.shape[-1]} - {self.dimension}) > 1:
            raise InputError("layouts.goal", f"n = {start.shape[-1]} as start has", goal.shape[-1])
        if start.shape[:-1] != goal.shape[:-1]:
            raise InputError("layouts.goal", f"{start.shape[1]} vehicles as start has", goal.shape[1])

    @property
    def vehicles(self) -> int | None:
        """V, of fleets; else None."""
        return None if self.apart is None or self.start is None else self.start.shape[1]

    def of_vehicle(self, v: int) -> Layouts:
        """The layouts of fleets as one of their vehicles has them, without the others."""
        assert self.start is not None and self.goal is not None
        return replace(self, start=self.start[:, v], goal=self.goal[:, v], apart=None)

    def _checked_map(self) -> DistanceField | None:
        field, count = self.map, len(self.centers)
        if field is None:
            return None
        of_each = field.batch is not None and isinstance(field.source, OccupancyGrid) and field.batch == count
        if field.d != self.dimension or not (of_each or field.batch is None):
            expected = f"one map for all, {self.dimension}-D as centers, or a grid for each of the {count} layouts"
            raise InputError("layouts.map", expected, f"{'a' if field.batch is None else field.batch} {field.d}-D")
        return field.single(0) if count == 1 else field

    def alike(self) -> list[np.ndarray]:
        """The places of layouts with as many stages and gates, (L',) each: they can be solved together as one batch."""
        if not isinstance(self.stages, np.ndarray) and self.gate_counts is None:
            return [np.arange(self.count)]
        stages = np.broadcast_to(0 if self.stages is None else self.stages, self.count)
        gates = np.zeros(self.count, np.int64) if self.gate_counts is None else self.gate_counts
        kinds, of_each = np.unique(np.column_stack((stages, gates)), axis=0, return_inverse=True)
        return [np.flatnonzero(of_each.ravel() == kind) for kind in range(len(kinds))]

    def together(self, most: int | None = None) -> list[np.ndarray]:
        """The places of layouts that a batch of problems can hold, at most so many: those with as many gates."""
        counts = np.zeros(self.count, np.int64) if self.gate_counts is None else self.gate_counts
        kinds = [np.flatnonzero(counts == count) for count in np.unique(counts)]
        if self.free_time is not None or self.vehicles is not None:
            kinds = self.alike()
        size = most or self.count
        return [group[first : first + size] for group in kinds for first in range(0, len(group), size)]

    @property
    def gate_counts(self) -> np.ndarray | None:
        """How many gates each layout has, (L,); None where none has any."""
        return None if self.gate_radii is None else (~np.isnan(self.gate_radii)).sum(axis=1)

    @property
    def count(self) -> int:
        """L, the number of layouts."""
        return self.centers.shape[0]

    @property
    def dimension(self) -> int:
        """d, 2 or 3."""
        return self.centers.shape[2]

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays that a file of these layouts holds, by name, without those that are None."""
        arrays = {name: np.asarray(getattr(self, name)) for name in NAMED_ARRAYS if getattr(self, name) is not None}
        arrays |= {} if self.map is None else map_arrays(self.map)
        if not np.array_equal(self.ids, np.arange(self.count)):
            arrays[IDS] = self.ids
        return arrays

    def __eq__(self, other: object) -> bool:
        """Same name, same ids and the same arrays; an absent obstacle (NaN) equals an absent one."""
        if not isinstance(other, Layouts):
            return NotImplemented
        mine, theirs = self.arrays(), other.arrays()
        return (
            self.name == other.name
            and mine.keys() == theirs.keys()
            and all(_equal(mine[name], theirs[name]) for name in mine)
        )

    def take(self, indices: Sequence[int] | np.ndarray) -> Layouts:
        """The layouts at `indices`, positions 0..L-1 in any order; InputError if one lies outside."""
        index = checks.indices(indices, "layouts.take")
        if index.max() >= self.count:
            raise InputError("layouts.take", f"positions in 0..{self.count - 1}", int(index.max()))
        rows = (*SPHERES, *BOXES, *SINES, *GATES, "start", "goal", "best_cost", "ids")
        arrays = {name: getattr(self, name) for name in rows if getattr(self, name) is not None}
        arrays = {name: value[index] for name, value in arrays.items()}
        if isinstance(self.stages, np.ndarray):
            arrays["stages"] = self.stages[index]
        return replace(self, map=None if self.map is None else self.map.take(index), **arrays)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the arrays to `path` (npz): all of it or, if interrupted, nothing."""
        write_whole(path, lambda file: np.savez_compressed(file, **self.arrays()))  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: str | os.PathLike[str], room: float = math.inf, limit: str = "of free memory") -> Layouts:
        """The layouts of a file, named by its stem.

        Args:
            room, limit: bytes of memory that the arrays may take at most, and what errors say of them.

        Raises InputError: `scenario.path` if there is no readable npz file, `layouts.<array>` if an array is
        missing, unknown or malformed.
        """
        free = free_memory()
        limit = limit if room < free else "of free memory"
        arrays = read_arrays(path, "scenario.path", "a layout file", room=min(room, free), limit=limit)
        path = Path(path)
        arrays = _without_spheres(arrays) | arrays
        for name in REQUIRED:
            if name not in arrays:
                raise InputError(f"layouts.{name}", f"this array in {path}", f"only {sorted(arrays)}")
        known = (*NAMED_ARRAYS, *MAP_ARRAYS, IDS)
        for name in arrays:
            if name not in known:
                raise InputError(f"layouts.{name}", f"only {', '.join(known)}", f"this one in {path}")
        ids = arrays.pop(IDS, np.empty(0, np.int64))
        there = {name: arrays.pop(name) for name in MAP_ARRAYS if name in arrays}
        return cls(**arrays, map=map_of(there), name=path.stem, ids=ids)  # type: ignore[arg-type]


def _equal(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two arrays hold the same; NaN equals NaN."""
    return np.array_equal(a, b, equal_nan=a.dtype.kind == b.dtype.kind == "f")


def _without_spheres(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays of no spheres for a file that holds boxes alone; none for other files."""
    shape = arrays["box_centers"].shape if "box_centers" in arrays else ()
    if len(shape) != 3 or any(name in arrays for name in REQUIRED):
        return {}
    return {"centers": np.empty((shape[0], 0, shape[2])), "radii": np.empty((shape[0], 0))}


def concatenate(parts: Sequence[Layouts]) -> Layouts:
    """One batch of all layouts in `parts`, in order, padded to the largest number of obstacles.

    Spheres rest in parts without velocities, and best_cost is NaN in parts without one. Raises InputError
    where the parts differ in what a batch shares: dimension, lengths of states, scalars, control bounds.
    """
    if not isinstance(parts, Sequence) or not all(isinstance(part, Layouts) for part in parts):
        raise InputError("layouts", "a list of Layouts", repr(parts))
    if not parts:
        raise InputError("layouts", "at least one part to concatenate", "none")
    _same("dimension", [part.dimension for part in parts])
    shared = {name: _same(name, [getattr(part, name) for part in parts]) for name in (*SHARED, *CONTROLS, TIME, BINDS)}
    for name in ("start", "goal"):
        _same(name, [None if (states := getattr(part, name)) is None else states.shape[1:] for part in parts])
    return Layouts(
        **_joined(parts, SPHERES),
        **_joined(parts, (*BOXES, *SINES)),
        **_joined(parts, GATES),
        **{name: _joined_rows(parts, name) for name in ("start", "goal", "best_cost")},
        **shared,
        stages=_joined_stages(parts),
        map=_joined_map(parts),
        name="+".join(dict.fromkeys(part.name for part in parts)),
        ids=np.concatenate([part.ids for part in parts]),
    )


def _joined(parts: Sequence[Layouts], names: Sequence[str]) -> dict[str, Any]:
    """Arrays of the obstacles or gates of all parts, NaN where a part has fewer; without those that no part has.

    Args:
        names: of arrays with the same rows; the first holds their places.
    """
    counts = [0 if (places := getattr(batch, names[0])) is None else places.shape[1] for batch in parts]
    joined = {}
    for name in names if max(counts) or names == SPHERES else ():
        arrays = [getattr(batch, name) for batch in parts]
        if all(value is None for value in arrays):
            continue
        rows = zip(parts, counts, arrays, strict=True)
        arrays = [_unmoved(name, batch, count) if value is None else value for batch, count, value in rows]
        if name in SINES:  # as many for each
            most = max(value.shape[2] for value in arrays)
            arrays = [np.pad(value, [(0, 0), (0, 0), (0, most - value.shape[2]), (0, 0)]) for value in arrays]
        behind = [[(0, 0), (0, max(counts) - value.shape[1]), (0, 0), (0, 0)][: value.ndim] for value in arrays]
        padded = [np.pad(value, by, constant_values=np.nan) for value, by in zip(arrays, behind, strict=True)]
        joined[name] = np.concatenate(padded)
    return joined


def _unmoved(name: str, batch: Layouts, count: int) -> np.ndarray:
    """What an array that a part lacks would hold of `count` obstacles: they are at rest, sharp and not turned."""
    if name in SINES:
        return np.zeros((batch.count, count, 0, batch.dimension))
    if name == "box_rotations" and batch.dimension == 3:
        return np.tile((1.0, 0.0, 0.0, 0.0), (batch.count, count, 1))
    flat = name in ("box_rotations", "box_radii", "gate_radii")
    return np.zeros((batch.count, count) if flat else (batch.count, count, batch.dimension))


def _joined_rows(parts: Sequence[Layouts], name: str) -> np.ndarray | None:
    """An array with a row per layout, NaN in parts without it; None where no part has it."""
    arrays = [getattr(batch, name) for batch in parts]
    if all(value is None for value in arrays):
        return None
    return np.concatenate(
        [np.full(batch.count, np.nan) if x is None else x for batch, x in zip(parts, arrays, strict=True)]
    )


def _joined_stages(parts: Sequence[Layouts]) -> np.ndarray | None:
    """The stages of all layouts, (L,); None where no part has any."""
    if any(batch.stages is None for batch in parts):
        return _same("stages", [batch.stages for batch in parts])
    return np.concatenate([np.broadcast_to(np.asarray(batch.stages), batch.count) for batch in parts])


def _joined_map(parts: Sequence[Layouts]) -> DistanceField | None:
    """The map that all parts share, or the maps of all layouts."""
    maps: list[Any] = [batch.map for batch in parts]
    if all(m is maps[0] for m in maps):
        shared = maps[0] is None or maps[0].batch is None or len(parts) == 1
        return maps[0] if shared else DistanceField.joined(maps)
    maps = [m for m in maps if m is not None]
    if len(maps) < len(parts):
        raise InputError("layouts.map", "the same in all parts", "none in some")
    every = [[m] if m.batch is not None else [m] * batch.count for m, batch in zip(maps, parts, strict=True)]
    return DistanceField.joined([m for group in every for m in group])


def _same(name: str, values: list[Any]) -> Any:
    """The one value that all parts hold."""
    first = values[0]
    for value in values[1:]:
        if (value is None) != (first is None) or not np.array_equal(value, first):
            raise InputError(f"layouts.{name}", "the same in all parts", f"{first} and {value}")
    return first
