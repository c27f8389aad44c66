"""Blocks of a lattice's nodes, each represented by its clearest node, and the cheapest ways over them.

A narrow door in a fine map is so known at a coarser grid, too. The search runs in C (c/lattice.c) or, where there is no
compiler, in SciPy; both find ways of the same cost, but may choose others of the same cost.
"""

from __future__ import annotations

import ctypes
import functools
import warnings
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from torchgco.native.compiler import Compiler, NativeError, find_compiler
from torchgco.native.declarations import Structure, fields, head, load
from torchgco.native.dispatch import EagerWarning
from torchgco.native.kernels import native
from torchgco.roadmap.lattice import Array, Lattice

SIDE = 0.8  # of a block, in vehicle's radii, where that takes no more blocks than admitted
DEEP = 0.2  # vehicle's radii beneath contact that the way between two blocks may lead
PARTS = 4  # of it, between which it is looked at
SOURCE = Path(__file__).parent / "c" / "lattice.c"


class Sweep(Structure):
    declared = (
        ("const int64_t *", "blocks size"),  # (3): along each axis, and nodes
        ("const float *", "clearance"),  # at the nodes
        ("const int32_t *", "node"),  # (blocks, 3): of each block
        ("const double *", "weight"),  # (blocks): price per metre, infinite where blocked
        ("const int64_t *", "seed"),  # (seeds): blocks at which ways begin
        ("const double *", "seed_cost"),
        ("int64_t", "seeds"),
        ("double", "step spacing least"),  # sides of blocks, of nodes; the clearance that joins two blocks, m
        ("double *", "cost"),  # (blocks)
        ("int32_t *", "before"),  # (blocks)
    )
    _fields_ = fields(declared)


class String(Structure):
    declared = (
        ("const int64_t *", "size"),  # (DIM): nodes
        ("const float *", "clearance"),
        ("const double *", "origin path"),  # (DIM), (points, DIM)
        ("int64_t", "points"),
        ("double", "inverse least"),  # of the spacing; the clearance of segments at either end
        ("uint8_t *", "corner"),  # (points): which of them are kept
    )
    _fields_ = fields(declared)


@dataclass(frozen=True, eq=False)
class Blocks:
    """Blocks (X, Y, Z) of a lattice; Z is 1 in the plane. V is the number of all, in the order of their indices."""

    lattice: Lattice
    counts: tuple[int, ...]
    step: float  # side of a block, m
    nodes: NDArray[np.int64]  # (V, d): the clearest node of each
    clearance: Array  # (V,), m
    radius: float  # vehicle's, m

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
        cost, before = torch.empty(len(weight), dtype=torch.float64), torch.empty(len(weight), dtype=torch.int32)
        room, size = np.zeros((len(self.nodes), 3), np.int32), np.ones(3, np.int64)
        room[:, : self.lattice.d], size[: self.lattice.d] = self.nodes, self.lattice.clearance.shape
        done = library.tgco_sweep(ctypes.byref(Sweep(
            blocks=torch.tensor(self.counts), size=torch.from_numpy(size), node=torch.from_numpy(room),
            clearance=torch.from_numpy(self.lattice.clearance), weight=torch.from_numpy(weight),
            seed=torch.from_numpy(seeds.astype(np.int64)), seed_cost=torch.from_numpy(seed_costs), seeds=len(seeds),
            step=self.step, spacing=self.lattice.spacing, least=-DEEP * self.radius, cost=cost, before=before,
        )))  # fmt: skip
        if not done:
            raise MemoryError("native kernels: no memory")
        return cost.numpy(), before.numpy()

    def _joined(self, a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether the segments between blocks (E,) are nowhere deep in an obstacle; as in C."""
        clearance, start, end = self.lattice.clearance, self.nodes[a], self.nodes[b]
        long = self.lattice.spacing * np.linalg.norm(end - start, axis=1)
        sure = clearance[tuple(start.T)] + clearance[tuple(end.T)] - long > 0
        shallow = np.ones(len(a), bool)
        for part in range(1, PARTS):
            middle = (start * (PARTS - part) + end * part + PARTS // 2) // PARTS
            shallow &= clearance[tuple(middle.T)] > -DEEP * self.radius
        return sure | shallow

    def _by_scipy(self, weight: Array, seeds: NDArray[np.int64], seed_costs: Array) -> tuple[Array, NDArray[np.int32]]:
        from scipy.sparse import csr_matrix
        from scipy.sparse.csgraph import dijkstra

        V, number = len(weight), np.arange(len(weight)).reshape(self.counts)
        tails, heads, lengths = [np.full(len(seeds), V)], [seeds], [np.maximum(seed_costs, 1e-300)]
        for move in product((-1, 0, 1), repeat=3):
            if move <= (0, 0, 0):
                continue
            axes = list(zip(move, self.counts, strict=True))
            here = tuple(slice(max(0, -k), n - max(0, k)) for k, n in axes)
            there = tuple(slice(max(0, k), n - max(0, -k)) for k, n in axes)
            a, b = number[here].ravel(), number[there].ravel()
            known = np.isfinite(weight[a]) & np.isfinite(weight[b])
            a, b = a[known], b[known]
            known = self._joined(a, b)
            tails.append(a[known])
            heads.append(b[known])
            long = self.step * float(np.linalg.norm(move))
            lengths.append(0.5 * long * (weight[a] + weight[b])[known])
        tail, head, length = map(np.concatenate, (tails, heads, lengths))
        graph = csr_matrix((length, (tail, head)), shape=(V + 1, V + 1))
        cost, before = dijkstra(graph, directed=False, indices=V, return_predecessors=True)
        return cost[:V], np.where((before[:V] == V) | (before[:V] < 0), -1, before[:V]).astype(np.int32)


def blocks_of(lattice: Lattice, radius: float, most: int) -> Blocks:
    """Blocks of a lattice for a vehicle of this radius, m; `most` of them at most."""
    size = max(1, round(SIDE * radius / lattice.spacing))
    while np.prod([-(-n // size) for n in lattice.clearance.shape], dtype=float) > most:
        size += 1
    nodes = _clearest(lattice.clearance, size)
    flat = nodes.reshape(-1, lattice.d)
    clear = lattice.clearance[tuple(flat.T)].astype(float)
    if lattice.solids or lattice.others:
        free = clear > 0
        clear[free] = np.minimum(clear[free], lattice.beside(lattice.position(flat[free])))
    return Blocks(lattice, (*nodes.shape[:-1], 1)[:3], size * lattice.spacing, flat, clear, radius)


def _clearest(clearance: NDArray[np.float32], size: int) -> NDArray[np.int64]:
    """The clearest node of each block, (blocks along each axis, d)."""
    d = clearance.ndim
    if size == 1:
        return np.stack(list(np.indices(clearance.shape)), axis=-1)
    counts = [-(-n // size) for n in clearance.shape]
    beyond = [(0, c * size - n) for c, n in zip(counts, clearance.shape, strict=True)]
    padded = np.pad(clearance, beyond, constant_values=-np.inf)
    split = padded.reshape([n for c in counts for n in (c, size)])
    split = split.transpose([2 * i for i in range(d)] + [2 * i + 1 for i in range(d)]).reshape(*counts, -1)
    # Of equally clear nodes the one next to the block's middle: far from obstacles blocks are evenly spaced then.
    middle = ((np.indices([size] * d) - 0.5 * (size - 1)) ** 2).sum(0).ravel()
    within = np.stack(np.unravel_index((split - 1e-6 * middle.astype(np.float32)).argmax(-1), [size] * d), axis=-1)
    return np.stack(list(np.indices(counts)), axis=-1) * size + within


def shortcut(lattice: Lattice, path: Array, least: float) -> NDArray[np.bool_] | None:
    """Which points of a path (P, d) are kept as corners; None where C can't serve. See `mapped.tightened`."""
    library = None if lattice.solids or lattice.others else library_for(lattice.d)
    if library is None:
        return None
    kept = torch.empty(len(path), dtype=torch.bool)
    library.tgco_shortcut(ctypes.byref(String(
        size=torch.tensor(lattice.clearance.shape), clearance=torch.from_numpy(lattice.clearance),
        origin=torch.from_numpy(lattice.origin), path=torch.from_numpy(np.ascontiguousarray(path)), points=len(path),
        inverse=1.0 / lattice.spacing, least=least, corner=kept,
    )))  # fmt: skip
    return kept.numpy()


def library_for(d: int) -> ctypes.CDLL | None:
    """The library for space of this dimension; None without a compiler, or where the process uses PyTorch's kernels."""
    compiler = find_compiler()
    return None if compiler is None or not native() else _library(d, compiler)


@functools.cache
def _library(d: int, compiler: Compiler) -> ctypes.CDLL | None:
    try:
        structures = [Sweep, String]
        return load(f"{head(structures, [], {'DIM': d, 'PARTS': PARTS})}\n{SOURCE.read_text()}", structures)
    except NativeError as error:
        warnings.warn(f"paths in maps are sought by SciPy: {str(error).splitlines()[0]}", EagerWarning, stacklevel=3)
        return None
