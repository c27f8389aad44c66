"""The free space of maps as the search sees it: clearances at the nodes of a lattice, thinned out to blocks of nodes.

NumPy, one problem at a time. Each block is represented by its clearest node, so that a narrow door in a fine map is
known at a coarse lattice too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import convolve1d, label

from torchgco.maps.distance import FAR
from torchgco.maps.field import BoundField
from torchgco.obstacles.base import Solids

Array = NDArray[np.float64]

NEXT = 2  # nodes around start and goal from which a way may begin
KEPT = 8  # maps whose clearances are kept, the most recent ones, by field
AROUND = 2.0  # vehicle's radii, and at least so many spacings, that the lattice extends beyond a map
BESIDE = 1.3  # times as large as they are, spheres and boxes beside a map lie within the lattice
LARGEST = 2**24  # nodes of a lattice; one that would need more doesn't extend to start and goal


@dataclass(frozen=True, eq=False)
class Clearances:
    """Distances to contact at the nodes of one map for one vehicle, m, negative where it would touch."""

    values: NDArray[np.float32]

    @cached_property
    def rooms(self) -> NDArray[np.int32]:
        """Numbers of the connected regions of free nodes; 0 where blocked."""
        return np.asarray(label(self.values > 0, np.ones([3] * self.values.ndim))[0])

    @cached_property
    def marks(self) -> NDArray[np.int64]:
        """A node (M, d) of each connected region of blocked nodes."""
        regions = np.asarray(label(self.values < 0, np.ones([3] * self.values.ndim))[0])
        _, first = np.unique(regions, return_index=True)
        nodes = np.stack(np.unravel_index(first, regions.shape), axis=-1)
        return nodes[regions.flat[first] > 0]


@dataclass(frozen=True)
class Lattice:
    """Clearances of one problem.

    Args:
        map: the clearances of the finest map.
        origin: the first node, (d,), m.
        spacing: of the nodes, m.
        others: the other maps, of this problem alone.
        solids: spheres and boxes beside, of this problem alone.
    """

    map: Clearances
    origin: Array
    spacing: float
    others: tuple[BoundField, ...]
    solids: tuple[Solids, ...]

    @property
    def clearance(self) -> NDArray[np.float32]:
        """At the nodes."""
        return self.map.values

    @property
    def d(self) -> int:
        return len(self.origin)

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
        return np.minimum(np.maximum(nodes, 0), np.array(self.clearance.shape) - 1)

    def at(self, points: Array) -> Array:
        """Clearances (...) at the nodes nearest to points (..., d), and from spheres, boxes and other maps."""
        nodes = self.node(points)
        gap = self.clearance[tuple(nodes[..., i] for i in range(self.d))].astype(float)
        return np.minimum(gap, self.beside(points)) if self.solids or self.others else gap

    def beside(self, points: Array) -> Array:
        """Clearances (...) from all but the map."""
        gap = np.full(points.shape[:-1], np.inf)
        if not self.solids and not self.others:
            return gap
        p = torch.from_numpy(np.ascontiguousarray(points.reshape(1, -1, self.d)))
        for part in self.solids:
            away = part.signed_distance(p).masked_fill(part.absent.unsqueeze(1), torch.inf)
            gap = np.minimum(gap, away.amin(-1).numpy().reshape(gap.shape))
        for field in self.others:
            gap = np.minimum(gap, field.signed_distance(p, p.new_zeros(1))[..., 0].numpy().reshape(gap.shape))
        return gap

    def segments(self, a: Array, b: Array) -> Array:
        """Smallest clearances (E,) along segments from a to b (E, d), at steps of a spacing."""
        steps = int(np.ceil(np.linalg.norm(b - a, axis=-1).max(initial=0.0) / self.spacing)) + 1
        share = np.linspace(0.0, 1.0, steps + 1)[:, None, None]
        return self.at(a + share * (b - a)).min(0)

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
        points += [(part.centers[0] + side * BESIDE * reach)[here].numpy() for side in (-1.0, 1.0)]
    clearance, pad = _clearance(first, np.concatenate(points))
    origin = first.origins[0].numpy() - first.field.spacing * pad
    return Lattice(clearance, origin, first.field.spacing, tuple(others), present)


def _clearance(field: BoundField, points: Array) -> tuple[Clearances, NDArray[np.int64]]:
    """Clearances at the nodes of a field's map and around it, and how many nodes lie before its first one.

    Args:
        points: (P, d) that lie within, unless that takes too many nodes.
    """
    R, which = float(field.vehicle_radius[0]), int(field.which[0])
    h, shape = field.field.spacing, np.array(field.field.values.shape[1:])
    room = int(np.ceil(max(AROUND * R / h, AROUND)))
    low, high = np.full(len(shape), room), np.full(len(shape), room)
    reach = np.floor((points - field.origins[0].numpy()) / h)
    before, after = np.maximum(low, room - reach.min(0)), np.maximum(high, reach.max(0) + room - shape + 1)
    if np.prod(before + shape + after) <= max(LARGEST, np.prod(shape + 2.0 * room)):
        low, high = before.astype(int), after.astype(int)
    key = (which, R, *low, *high)
    kept = _kept.setdefault(field.field, {})
    if key not in kept:
        kept[key] = Clearances(_measured(field, which, R, low, high))
        while len(kept) > KEPT:
            del kept[next(iter(kept))]
    return kept[key], low


_kept: WeakKeyDictionary[Any, dict[tuple[float, ...], Clearances]] = WeakKeyDictionary()


def _measured(field: BoundField, which: int, R: float, low: Any, high: Any) -> NDArray[np.float32]:
    """What the constraint's own lookup gives at the nodes, and the same bound beyond them."""
    if bool(field.absent[0, 0]):
        return np.full(np.array(field.field.values.shape[1:]) + low + high, FAR, np.float32)
    distance, h = field.field.values[which], field.field.spacing
    core, limit = float(field.cores[0]), float(field.limits[0])
    if field.smooth:
        square = np.where(distance < core, core * (2 * distance - core), distance * distance)
        for axis in range(square.ndim):
            square = convolve1d(square, (0.125, 0.75, 0.125), axis, mode="nearest")
        square -= 0.25 * square.ndim * h * h
        near = (square + core * core) / (2 * core)
        distance = np.where(square < core * core, near, np.sqrt(np.maximum(square, core * core)))
    beyond = np.zeros([1] * distance.ndim)
    for axis, (before, after, size) in enumerate(zip(low, high, distance.shape, strict=True)):
        away = h * np.concatenate((np.arange(before, 0, -1), np.zeros(size), np.arange(1, after + 1)))
        beyond = beyond + (away * away).reshape([-1 if i == axis else 1 for i in range(distance.ndim)])
    padded = np.pad(distance, list(zip(low, high, strict=True)), mode="edge")
    padded = np.where(beyond > 0, np.sqrt(np.maximum(padded, 0.0) ** 2 + beyond), padded)
    return (padded - limit).astype(np.float32)


@dataclass(frozen=True)
class Blocks:
    """The clearest node of each block of nodes, and the edges between free neighbours."""

    nodes: NDArray[np.int64]  # (V, d)
    clearance: Array  # (V,)
    tails: NDArray[np.int64]  # (E,)
    heads: NDArray[np.int64]  # (E,)
    gaps: Array  # (E,): smallest clearances of the edges


def blocks_of(lattice: Lattice, most: int) -> Blocks:
    """Blocks of a lattice, `most` of them at most, that hold a free node."""
    size = max(1, int(np.ceil((lattice.clearance.size / most) ** (1.0 / lattice.d))))
    while np.prod([-(-n // size) for n in lattice.clearance.shape]) > most:
        size += 1
    nodes = _clearest(lattice.clearance, size)
    counts = nodes.shape[:-1]
    flat = nodes.reshape(-1, lattice.d)
    clear = lattice.clearance[tuple(flat.T)].astype(float)
    free = clear > 0
    clear[free] = np.minimum(clear[free], lattice.beside(lattice.position(flat[free])))
    free = clear > 0
    number = np.full(len(flat), -1)
    number[free] = np.arange(free.sum())
    number = number.reshape(counts)
    tails, heads = [], []
    for step in product((-1, 0, 1), repeat=lattice.d):
        if step <= (0,) * lattice.d:
            continue
        here = tuple(slice(max(0, -k), n - max(0, k)) for k, n in zip(step, counts, strict=True))
        there = tuple(slice(max(0, k), n - max(0, -k)) for k, n in zip(step, counts, strict=True))
        a, b = number[here].ravel(), number[there].ravel()
        both = (a >= 0) & (b >= 0)
        tails.append(a[both])
        heads.append(b[both])
    tail, head = np.concatenate(tails), np.concatenate(heads)
    gaps = _along(lattice, flat[free], clear[free], tail, head, size)
    open_ = gaps > 0
    return Blocks(flat[free], clear[free], tail[open_], head[open_], gaps[open_])


def _clearest(clearance: NDArray[np.float32], size: int) -> NDArray[np.int64]:
    """The clearest node of each block, (blocks along each axis, d)."""
    d = clearance.ndim
    if size == 1:
        return np.stack(np.indices(clearance.shape), axis=-1)
    counts = [-(-n // size) for n in clearance.shape]
    padded = np.pad(
        clearance, [(0, c * size - n) for c, n in zip(counts, clearance.shape, strict=True)], constant_values=-np.inf
    )
    split = padded.reshape([n for c in counts for n in (c, size)])
    split = split.transpose([2 * i for i in range(d)] + [2 * i + 1 for i in range(d)]).reshape(*counts, -1)
    # Of equally clear nodes the one next to the block's middle: far from obstacles blocks are evenly spaced then.
    middle = sum((x - 0.5 * (size - 1)) ** 2 for x in np.indices([size] * d)).ravel()
    within = np.stack(np.unravel_index((split - 1e-6 * middle.astype(np.float32)).argmax(-1), [size] * d), axis=-1)
    return np.stack(np.indices(counts), axis=-1) * size + within


def _along(
    lattice: Lattice,
    nodes: NDArray[np.int64],
    clear: Array,
    tail: NDArray[np.int64],
    head: NDArray[np.int64],
    size: int,
) -> Array:
    """Smallest clearances of edges between nodes, those that can't be near anything by their ends alone."""
    gaps = np.minimum(clear[tail], clear[head])
    if size == 1:
        return gaps
    long = lattice.spacing * np.linalg.norm(nodes[tail] - nodes[head], axis=1)
    unsure = np.flatnonzero(clear[tail] + clear[head] < 2.0 * long)
    a, b = lattice.position(nodes[tail[unsure]]), lattice.position(nodes[head[unsure]])
    gaps[unsure] = np.minimum(gaps[unsure], lattice.segments(a, b))
    return gaps
