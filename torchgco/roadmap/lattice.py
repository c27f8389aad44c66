"""The free space of maps as the search sees it: clearances at the nodes of a lattice, one problem at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import NDArray

from torchgco.maps.field import BoundField
from torchgco.obstacles.base import Solids
from torchgco.roadmap.clearances import Clearances

Array = NDArray[np.float64]

NEXT = 2  # nodes around start and goal from which a way may begin
MAPS_KEPT = 8  # maps whose clearances are kept, the most recent ones, by field
LATTICE_REACH = 2.0  # vehicle's radii, and at least so many spacings, that the lattice extends beyond a map
BESIDE_MAP = 1.3  # times as large as they are, spheres and boxes beside a map lie within the lattice
LATTICE_NODES = 2**24  # nodes of a lattice; one that would need more doesn't extend to start and goal
SAMPLED = {2: 2**16, 3: 2**18}  # nodes of a lattice among spheres and boxes, about, by the dimension of space


@dataclass(frozen=True)
class Lattice:
    """Clearances of one problem.

    Args:
        map: the clearances of the finest map.
        origin: the first node, (d,), m.
        others: the other maps, of this problem alone.
        solids: spheres and boxes beside, of this problem alone.
    """

    map: Clearances
    origin: Array
    others: tuple[BoundField, ...]
    solids: tuple[Solids, ...]

    @property
    def spacing(self) -> float:
        """Of the nodes, m."""
        return self.map.spacing

    @property
    def shape(self) -> tuple[int, ...]:
        """Nodes along each axis."""
        return tuple(self.map.size.tolist())

    @property
    def d(self) -> int:
        return len(self.origin)

    @property
    def alone(self) -> bool:
        """Whether the map is all that there is."""
        return not self.solids and not self.others

    def may_join(self, ends: Array) -> bool:
        """Whether free nodes next to two points (2, d) are connected; what is beside the map may still part them."""
        rooms = []
        for node in self.node(ends):
            near = tuple(slice(max(0, i - NEXT), i + NEXT + 1) for i in node)
            rooms.append(set(np.unique(self.map.rooms[near]).tolist()) - {0})
        return bool(rooms[0] & rooms[1])

    def position(self, nodes: NDArray[np.int64]) -> Array:
        """Where nodes (..., d) are, m."""
        return self.origin + self.spacing * nodes

    def node(self, points: Array) -> NDArray[np.int64]:
        """The nodes (..., d) nearest to points, held within the lattice."""
        nodes = np.rint((points - self.origin) * (1.0 / self.spacing)).astype(np.int64)
        return np.minimum(np.maximum(nodes, 0), self.map.size - 1)

    def at(self, points: Array) -> Array:
        """Clearances (...) at the nodes nearest to points (..., d), and from spheres, boxes and other maps."""
        gap = self.map.at(self.node(points))
        return gap if self.alone else np.minimum(gap, self.beside(points))

    def beside(self, points: Array) -> Array:
        """Clearances (...) from all but the map."""
        gap = np.full(points.shape[:-1], np.inf)
        if self.alone:
            return gap
        p = torch.from_numpy(np.ascontiguousarray(points.reshape(1, -1, self.d)))
        for part in self.solids:
            away = part.signed_distance(p).masked_fill(part.absent.unsqueeze(1), torch.inf)
            gap = np.minimum(gap, away.amin(-1).numpy().reshape(gap.shape))
        for field in self.others:
            gap = np.minimum(gap, field.signed_distance(p, p.new_zeros(1))[..., 0].numpy().reshape(gap.shape))
        return gap

    def see(self, a: Array, b: Array, least: Array) -> NDArray[np.bool_]:
        """Whether all clearances along segments from a to b (E, d) are above `least` (E,).

        The clearance changes no faster than the point moves: where it is large, steps are.
        """
        along = b - a
        long = np.linalg.norm(along, axis=-1)
        seen, at = np.ones(len(a), bool), np.zeros(len(a))
        rest = np.arange(len(a))
        while len(rest) > 0:
            share = at[rest] / np.maximum(long[rest], 1e-12)
            over = self.at(a[rest] + share[:, None] * along[rest]) - least[rest]
            seen[rest] = over > 0
            going = (over > 0) & (at[rest] < long[rest])
            rest, over = rest[going], over[going]
            at[rest] = np.minimum(at[rest] + np.maximum(over - self.spacing, self.spacing), long[rest])
        return seen

    @cached_property
    def marks(self) -> NDArray[np.int64]:
        """A node of each blocked region of a map in the plane, and the nodes next to the middles of what is beside."""
        found = [self.map.marks]
        for part in self.solids:
            found.append(self.node(part.centers[0][~part.absent[0]].numpy()))
        return np.concatenate(found).astype(np.int64)


def lattice_of(fields: Sequence[BoundField], solids: Sequence[Solids], ends: Array) -> Lattice:
    """The clearances of one problem among maps, with spheres and boxes beside, for a way between two points (2, d)."""
    first, *others = (field for field in sorted(fields, key=lambda one: -one.field.values[0].size))
    present = tuple(part for part in solids if not bool(part.absent.all()))
    points = [ends]
    for part in present:
        here, reach = ~part.absent[0], part.extent[0] + part.radii[0].unsqueeze(-1)
        points += [(part.centers[0] + side * BESIDE_MAP * reach)[here].numpy() for side in (-1.0, 1.0)]
    clearances = _clearances(first, np.concatenate(points))
    origin = np.asarray(first.origins[0].numpy() - first.field.spacing * clearances.low, np.float64)
    return Lattice(clearances, origin, tuple(others), present)


def sampled(solids: Sequence[Solids], ends: Array) -> Lattice:
    """The clearances of one problem at the nodes of a lattice around spheres and boxes and two points (2, d).

    No clearance counts as more than twice the largest size, or four spacings.
    """
    d, each = ends.shape[1], [one for part in solids for one in _each(part)]
    reaches = [(one.centers[0, 0].numpy(), (one.extent[0, 0] + one.radii[0, 0]).numpy()) for one in each]
    points = np.concatenate([ends, *((center - reach, center + reach) for center, reach in reaches)])
    wide = np.ptp(points, axis=0)
    count = lambda spacing: np.ceil(wide / spacing + 2.0 * LATTICE_REACH).astype(int) + 1
    spacing = float(wide.max()) / SAMPLED[d] ** (1.0 / d)
    while np.prod(count(0.9 * spacing), dtype=float) <= SAMPLED[d]:  # where space is flat or long
        spacing *= 0.9
    origin, size = points.min(0) - LATTICE_REACH * spacing, count(spacing)
    most = max([4.0 * spacing, *(2.0 * float(one.sizes[0, 0]) for one in each)])
    values = np.full(size, most, np.float32)
    for one, (center, reach) in zip(each, reaches, strict=True):
        low, high = (np.rint((center + side * (reach + most) - origin) / spacing).astype(int) for side in (-1.0, 1.0))
        near = tuple(slice(max(0, a), b + 1) for a, b in zip(low, high, strict=True))
        nodes = np.stack(
            np.meshgrid(*(np.arange(n)[own] for n, own in zip(size, near, strict=True)), indexing="ij"), -1
        )
        away = one.signed_distance(torch.from_numpy(origin + spacing * nodes.reshape(1, -1, d)))
        np.minimum(values[near], away.numpy().reshape(nodes.shape[:-1]), out=values[near])
    return Lattice(Clearances(values, np.zeros(d, int), size, spacing, 0.0, 0.0, False), origin, (), ())


def _each(part: Solids) -> list[Solids]:
    """The obstacles of one problem that are there, one by one."""
    return [
        type(part)(*(own[:, j : j + 1] for own in vars(part).values()))
        for j in (~part.absent[0]).nonzero().flatten().tolist()
    ]


def _clearances(field: BoundField, points: Array) -> Clearances:
    """Clearances at the nodes of a field's map and around it, so that points (P, d) lie within.

    They don't where that would take too many nodes.
    """
    R, which = float(field.vehicle_radius[0]), int(field.which[0])
    h, shape = field.field.spacing, np.array(field.field.values.shape[1:])
    room = int(np.ceil(max(LATTICE_REACH * R / h, LATTICE_REACH)))
    low, high = np.full(len(shape), room), np.full(len(shape), room)
    reach = np.floor((points - field.origins[0].numpy()) / h)
    before, after = np.maximum(low, room - reach.min(0)), np.maximum(high, reach.max(0) + room - shape + 1)
    if np.prod(before + shape + after) <= max(LATTICE_NODES, np.prod(shape + 2.0 * room)):
        low, high = before.astype(int), after.astype(int)
    key = (which, R, field.smooth, *low, *high)
    kept = _kept.setdefault(field.field, {})
    if key not in kept:
        values, smooth = field.field.values[which], field.smooth and not bool(field.absent[0, 0])
        numbers = float(field.cores[0]), float(field.limits[0])
        kept[key] = Clearances(values, low, low + shape + high, h, *numbers, smooth)
        while len(kept) > MAPS_KEPT:
            del kept[next(iter(kept))]
    return kept[key]


_kept: WeakKeyDictionary[Any, dict[tuple[float, ...], Clearances]] = WeakKeyDictionary()
