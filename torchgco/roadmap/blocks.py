"""Blocks of a lattice's nodes, each represented by its clearest node, and the cheapest ways over them.

A narrow door in a fine map is so known at a coarser grid, too. Where all is free, cells of that grid are joined to
larger blocks. The search runs in C (c/lattice.c) or, where there is no compiler, in NumPy and SciPy; both find ways of
the same cost, but may choose others of the same cost.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchgco.maps.ways import neighbours
from torchgco.roadmap.clearances import Clearances
from torchgco.roadmap.lattice import Array, Lattice
from torchgco.roadmap.native_maps import SURE_SPACINGS, WAY_PARTS, Graph, String, Sweep, library_for

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
        library = library_for(self.lattice.d)
        if library is None:
            return self._by_scipy(weight, seeds, seed_costs)
        cost, before, _ = self._swept(library, weight, seeds, seed_costs)
        return cost, before

    def another(
        self, weight: Array, seeds: NDArray[np.int64], seed_costs: Array, ahead: Array, onward: NDArray[np.int32]
    ) -> list[int]:
        """The blocks of the cheapest way from some blocks to the goal, where prices have been raised.

        Args:
            ahead: costs (V,) of the cheapest ways to the goal before.
            onward: the next block (V,) on them, -1 where they end.
        """
        library = library_for(self.lattice.d)
        if library is None:
            cost, before = self._by_scipy(weight, seeds, seed_costs)
            end = int(np.where(onward < 0, cost + ahead, np.inf).argmin())
        else:
            goal = {"ahead": _tensor(ahead), "onward": _tensor(onward)}
            _, before, end = self._swept(library, weight, seeds, seed_costs, **goal)
        way = [end]
        while before[way[-1]] >= 0:
            way.append(int(before[way[-1]]))
        return way[::-1]

    def _swept(
        self, library: ctypes.CDLL, weight: Array, seeds: NDArray[np.int64], seed_costs: Array, **goal: torch.Tensor
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
        if not library.tgco_sweep(ctypes.byref(sweep)):
            raise MemoryError("native kernels: no memory")
        return cost.numpy(), before.numpy(), sweep.end

    def _joined(self, a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether the segments between blocks (E,) are nowhere deep in an obstacle; as in C."""
        start, end = self.nodes[a], self.nodes[b]
        long = self.lattice.spacing * np.linalg.norm(end - start, axis=1)
        sure = self.own[a].astype(float) + self.own[b] - long > 0
        parts = WAY_PARTS * np.maximum(self.layers[a], self.layers[b]).astype(np.int64)[:, None]
        shallow = np.ones(len(a), bool)
        for part in range(1, 2 * WAY_PARTS):
            middle = (start * (parts - part) + end * part + parts // 2) // parts
            shallow &= (part >= parts[:, 0]) | (self.lattice.map.at(middle) > -BENEATH_CONTACT * self.radius)
        return sure | shallow

    def _by_scipy(self, weight: Array, seeds: NDArray[np.int64], seed_costs: Array) -> tuple[Array, NDArray[np.int32]]:
        from scipy.sparse import csr_matrix
        from scipy.sparse.csgraph import dijkstra

        V, number = len(weight), self.block.reshape(self.counts)
        pairs = []
        for _, here, there in neighbours(self.counts):
            both = np.stack((number[here].ravel(), number[there].ravel()))
            pairs.append(np.sort(both[:, (both[0] != both[1]) & (both >= 0).all(0)], axis=0))
        a, b = np.unique(np.concatenate(pairs, axis=1), axis=1).astype(np.int64)
        known = np.isfinite(weight[a]) & np.isfinite(weight[b])
        a, b = a[known], b[known]
        known = self._joined(a, b)
        a, b = a[known], b[known]
        middle = (self.first + 0.5 * self.layers[:, None])[:, : self.lattice.d]
        long = self.step * np.linalg.norm(middle[b] - middle[a], axis=1)
        tail, head = np.concatenate((np.full(len(seeds), V), a)), np.concatenate((seeds, b))
        length = np.concatenate((np.maximum(seed_costs, 1e-300), 0.5 * long * (weight[a] + weight[b])))
        graph = csr_matrix((length, (tail, head)), shape=(V + 1, V + 1))
        cost, before = dijkstra(graph, directed=False, indices=V, return_predecessors=True)
        return cost[:V], np.where((before[:V] == V) | (before[:V] < 0), -1, before[:V]).astype(np.int32)


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
    library = library_for(d)
    if library is None:
        return _by_numpy(clearances, counts, size, least, merged, tie)
    cells = int(np.prod(counts))
    block, first, node = (torch.empty(n, dtype=torch.int32) for n in (cells, 3 * cells, 3 * cells))
    layers, clearance = torch.empty(cells, dtype=torch.bool), torch.empty(cells, dtype=torch.float32)
    graph = Graph(
        map=clearances.native, cells=torch.tensor(counts), side=size, merged=int(merged), least=least,
        tie=_tensor(tie), block=block, first=first, node=node, layers=layers, clearance=clearance, blocks=0,
    )  # fmt: skip
    library.tgco_blocks(ctypes.byref(graph))
    V = graph.blocks
    held = first.view(-1, 3)[:V], layers.view(torch.uint8)[:V], node.view(-1, 3)[:V], clearance[:V]
    return (tuple(counts), block.numpy(), *(part.clone().numpy() for part in held))


def _by_numpy(
    clearances: Clearances, counts: list[int], size: int, least: float, merged: bool, tie: NDArray[np.float32]
) -> tuple[Any, ...]:
    """As tgco_blocks."""
    d = clearances.d
    nodes, clear = _clearest(clearances, counts[:d], size, tie)
    number = np.arange(len(clear)).reshape(counts)
    cells = np.stack(np.unravel_index(number.ravel(), counts), axis=-1)
    free = clear > least
    into = np.where(free, number.ravel(), -1)  # the cell that stands for each cell's block
    layers, stands = np.ones(len(clear), np.uint8), np.arange(len(clear))
    if merged:
        pairs = number[tuple(slice(0, n - n % 2) for n in counts[:d])]
        split = pairs.reshape([n for count in pairs.shape[:d] for n in (count // 2, 2)])
        groups = split.transpose([2 * i for i in range(d)] + [2 * i + 1 for i in range(d)]).reshape(-1, 2**d)
        best = np.take_along_axis(groups, clear[groups].argmax(1)[:, None], axis=1)
        apart = clearances.spacing * np.linalg.norm(nodes[groups] - nodes[best], axis=-1)
        whole = free[groups].all(1) & (clear[groups].astype(float) + clear[best] - apart > 0).all(1)
        into[groups[whole]] = groups[whole][:, :1]
        layers[groups[whole, 0]], stands[groups[whole, 0]] = 2, best[whole, 0]
    kept, block = np.unique(into[into >= 0], return_inverse=True)
    numbers = np.full(len(clear), -1, np.int32)
    numbers[into >= 0] = block
    room = np.zeros((len(kept), 3), np.int32)
    room[:, :d] = nodes[stands[kept]]
    return tuple(counts), numbers, cells[kept].astype(np.int32), layers[kept], room, clear[stands[kept]]


def _clearest(
    clearances: Clearances, counts: list[int], size: int, tie: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The clearest node of each cell, (cells, d), and its clearance; by the field's distances where that is sure."""
    d = clearances.d
    every = np.moveaxis(np.indices(clearances.size.tolist()), 0, -1)
    beyond = [(0, c * size - n) for c, n in zip(counts, clearances.size, strict=True)]

    def split(values: NDArray[Any]) -> NDArray[np.float32]:
        padded = np.pad(values.astype(np.float32), beyond, constant_values=-np.inf)
        parts = padded.reshape([n for c in counts for n in (c, size)])
        return parts.transpose([2 * i for i in range(d)] + [2 * i + 1 for i in range(d)]).reshape(-1, size**d)

    raw, fine = split(clearances.raw(every)), split(clearances.everywhere)
    own = tie.ravel()
    rough, exact = (raw - own).argmax(1), np.where(raw > 0, fine - own, -np.inf).argmax(1)
    most = np.take_along_axis(raw, rough[:, None], axis=1)[:, 0]
    near = (most > 0) & (most < SURE_SPACINGS * clearances.spacing)
    place = np.where(near, exact, rough)
    clear = np.where(near, np.take_along_axis(fine, exact[:, None], axis=1)[:, 0], most)
    within = np.stack(np.unravel_index(place, [size] * d), axis=-1)
    first = np.stack(np.unravel_index(np.arange(len(place)), counts), axis=-1)
    return first * size + within, clear


def _tensor(values: Any) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values))


def tightened_by_c(
    lattice: Lattice, path: Array, least: float, reach: float, parts: int, rounds: int, little: float
) -> Array | None:
    """A path (P, d) drawn taut; None where C can't serve. See `mapped.tightened`."""
    library = library_for(lattice.d) if lattice.alone else None
    if library is None:
        return None
    room = parts + len(path) + 2
    taut = torch.empty(room, lattice.d, dtype=torch.float64)
    string = String(
        map=lattice.map.native, origin=_tensor(lattice.origin), path=_tensor(path), points=len(path), least=least,
        reach=reach, parts=parts, rounds=rounds, little=little, taut=taut, room=room,
    )  # fmt: skip
    count = library.tgco_tighten(ctypes.byref(string))
    if count == 0:
        raise MemoryError("native kernels: no memory")
    return taut[:count].numpy()
