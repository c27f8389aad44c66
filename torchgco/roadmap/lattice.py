"""The free space of maps as the search sees it: nodes of a lattice, and blocks of them with their cheapest ways.

A narrow door in a fine map is so known at a coarser grid, too. Where all is free, cells of that grid are joined to
larger blocks. C makes the blocks and searches (c/lattice.c).
"""

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
from torchgco.roadmap.native_maps import Graph, String, Sweep, call

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


BLOCK_SIDE = 0.8  # of a cell, in vehicle's radii, where that takes no more cells than admitted
BENEATH_CONTACT = 0.2  # vehicle's radii beneath contact that the way between two blocks may lead
NODE_TIE = 1e-6  # m: so much less clear a node counts, per squared step from the middle of its cell


@dataclass(frozen=True, eq=False)
class Blocks:
    """The free blocks of a lattice, V, and the cells (X, Y, Z) that they are made of; Z is 1 in the plane."""

    lattice: Lattice
    counts: tuple[int, ...]  # of cells
    side: int  # of a cell, in spacings of the nodes
    block: NDArray[np.int32]  # (X Y Z): the block of each cell, -1 where there is none
    first: NDArray[np.int32]  # (V, 3): its first cell
    layers: NDArray[np.uint8]  # (V,): cells along its side, 1 or 2
    room: NDArray[np.int32]  # (V, 3): its clearest node
    clearance: Array  # (V,): there, m; from what is beside the map, too
    own: NDArray[np.float32]  # (V,): from the map alone
    radius: float  # vehicle's, m

    @property
    def nodes(self) -> NDArray[np.int64]:
        """The clearest nodes, (V, d)."""
        return self.room[:, : self.lattice.d].astype(np.int64)

    @property
    def step(self) -> float:
        """The side of a cell, m."""
        return self.side * self.lattice.spacing

    @property
    def points(self) -> Array:
        """Where the clearest nodes are, (V, d), m."""
        return self.lattice.position(self.nodes)

    def costs(self, weight: Array, seeds: NDArray[np.int64], seed_costs: Array) -> tuple[Array, NDArray[np.int32]]:
        """Costs (V,) of the cheapest ways from some blocks to all, and the blocks before, -1 where there is none.

        Args:
            weight: per metre at the blocks (V,), infinite where blocked.
            seeds, seed_costs: blocks (S,) at which ways begin, and what they cost up to there.
        """
        cost, before, _ = self._swept(weight, seeds, seed_costs)
        return cost, before

    def another(
        self, weight: Array, seeds: NDArray[np.int64], seed_costs: Array, ahead: Array, onward: NDArray[np.int32]
    ) -> list[int]:
        """The blocks of the cheapest way from some blocks to the goal, where prices have been raised.

        Args:
            ahead: costs (V,) of the cheapest ways to the goal before.
            onward: the next block (V,) on them, -1 where they end.
        """
        goal = {"ahead": _tensor(ahead), "onward": _tensor(onward)}
        _, before, end = self._swept(weight, seeds, seed_costs, **goal)
        way = [end]
        while before[way[-1]] >= 0:
            way.append(int(before[way[-1]]))
        return way[::-1]

    def _swept(
        self, weight: Array, seeds: NDArray[np.int64], seed_costs: Array, **goal: torch.Tensor
    ) -> tuple[Array, NDArray[np.int32], int]:
        cost, before = torch.empty(len(weight), dtype=torch.float64), torch.empty(len(weight), dtype=torch.int32)
        graph = Graph(
            map=self.lattice.map.native, cells=torch.tensor(self.counts), side=self.side, blocks=len(weight),
            block=_tensor(self.block), first=_tensor(self.first), node=_tensor(self.room),
            layers=_tensor(self.layers).view(torch.bool), clearance=_tensor(self.own),
        )  # fmt: skip
        sweep = Sweep(
            graph=graph, weight=_tensor(weight), seed=_tensor(seeds.astype(np.int64)), seed_cost=_tensor(seed_costs),
            seeds=len(seeds), deepest=-BENEATH_CONTACT * self.radius, cost=cost, before=before, end=-1, **goal,
        )  # fmt: skip
        if not call("tgco_sweep", self.lattice.d, sweep):
            raise MemoryError("native kernels: no memory")
        return cost.numpy(), before.numpy(), sweep.end


def blocks_of(lattice: Lattice, radius: float, most: int, least: float = 0.0, merged: bool = True) -> Blocks:
    """Blocks of a lattice for a vehicle of this radius, m, from at most `most` cells.

    Args:
        least: clearance, m, above which a block is free.
        merged: whether cells become one block where that is free for sure.
    """
    size = max(1, round(BLOCK_SIDE * radius / lattice.spacing))
    while np.prod([-(-n // size) for n in lattice.shape], dtype=float) > most:
        size += 1
    merged = merged and lattice.alone
    key = ("blocks", size, least, merged)
    if key not in lattice.map.kept:
        lattice.map.kept[key] = _blocks(lattice.map, size, least, merged)
    counts, block, first, layers, room, own = lattice.map.kept[key]
    clear = own.astype(float)
    if not lattice.alone:
        clear = np.minimum(clear, lattice.beside(lattice.position(room[:, : lattice.d].astype(np.int64))))
    return Blocks(lattice, counts, size, block, first, layers, room, clear, own, radius)


def _blocks(clearances: Clearances, size: int, least: float, merged: bool) -> tuple[Any, ...]:
    """Cells along each axis, and the parts of `Blocks` that the map alone decides."""
    d = clearances.d
    counts = [1, 1, 1]
    counts[:d] = [-(-int(n) // size) for n in clearances.size]
    middle = ((np.indices([size] * d) - 0.5 * (size - 1)) ** 2).sum(0)
    # Of equally clear nodes the one next to the cell's middle: far from obstacles blocks are evenly spaced then.
    tie = (NODE_TIE * middle).astype(np.float32)
    cells = int(np.prod(counts))
    block, first, node = (torch.empty(n, dtype=torch.int32) for n in (cells, 3 * cells, 3 * cells))
    layers, clearance = torch.empty(cells, dtype=torch.bool), torch.empty(cells, dtype=torch.float32)
    graph = Graph(
        map=clearances.native, cells=torch.tensor(counts), side=size, merged=int(merged), least=least,
        tie=_tensor(tie), block=block, first=first, node=node, layers=layers, clearance=clearance, blocks=0,
    )  # fmt: skip
    call("tgco_blocks", d, graph)
    V = graph.blocks
    held = first.view(-1, 3)[:V], layers.view(torch.uint8)[:V], node.view(-1, 3)[:V], clearance[:V]
    return (tuple(counts), block.numpy(), *(part.clone().numpy() for part in held))


def _tensor(values: Any) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values))


def tightened_by_c(
    lattice: Lattice, path: Array, least: float, reach: float, parts: int, rounds: int, little: float
) -> Array:
    """A path (P, d) drawn taut in a lattice of the map alone; see `mapped.tightened`."""
    room = parts + len(path) + 2
    taut = torch.empty(room, lattice.d, dtype=torch.float64)
    string = String(
        map=lattice.map.native, origin=_tensor(lattice.origin), path=_tensor(path), points=len(path), least=least,
        reach=reach, parts=parts, rounds=rounds, little=little, taut=taut, room=room,
    )  # fmt: skip
    count = call("tgco_tighten", lattice.d, string)
    if count == 0:
        raise MemoryError("native kernels: no memory")
    return taut[:count].numpy()
