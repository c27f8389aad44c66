"""Blocks of a lattice's nodes, each represented by its clearest node, and the cheapest ways over them.

A narrow door in a fine map is so known at a coarser grid, too. Where all is free, cells of that grid are joined to
larger blocks. C makes the blocks and searches (c/lattice.c).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchgco.roadmap.clearances import Clearances
from torchgco.roadmap.lattice import Array, Lattice
from torchgco.roadmap.native_maps import Graph, String, Sweep, call

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
