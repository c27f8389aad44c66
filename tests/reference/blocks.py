"""Blocks of a lattice and the cheapest ways over them, by NumPy and SciPy."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from torchgco.maps.ways import neighbours
from torchgco.roadmap.clearances import Clearances
from torchgco.roadmap.lattice import BENEATH_CONTACT, NODE_TIE, Array, Blocks, Lattice
from torchgco.roadmap.native_maps import SURE_SPACINGS, WAY_PARTS


def joined(blocks: Blocks, a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether the segments between blocks (E,) are nowhere deep in an obstacle."""
    start, end = blocks.nodes[a], blocks.nodes[b]
    long = blocks.lattice.spacing * np.linalg.norm(end - start, axis=1)
    sure = blocks.own[a].astype(float) + blocks.own[b] - long > 0
    parts = WAY_PARTS * np.maximum(blocks.layers[a], blocks.layers[b]).astype(np.int64)[:, None]
    shallow = np.ones(len(a), bool)
    for part in range(1, 2 * WAY_PARTS):
        middle = (start * (parts - part) + end * part + parts // 2) // parts
        shallow &= (part >= parts[:, 0]) | (blocks.lattice.map.at(middle) > -BENEATH_CONTACT * blocks.radius)
    return sure | shallow


class PlainBlocks(Blocks):
    """Blocks over which SciPy finds the cheapest ways."""

    def costs(self, weight: Array, seeds: NDArray[np.int64], seed_costs: Array) -> tuple[Array, NDArray[np.int32]]:
        return by_scipy(self, weight, seeds, seed_costs)


def plain_blocks(lattice: Lattice, made: Blocks, least: float, merged: bool) -> PlainBlocks:
    """The blocks of a lattice of a map alone, of as many cells as `made` has, for the same vehicle."""
    middle = ((np.indices([made.side] * lattice.d) - 0.5 * (made.side - 1)) ** 2).sum(0)
    tie = (NODE_TIE * middle).astype(np.float32)
    counts, block, first, layers, room, own = by_numpy(lattice.map, list(made.counts), made.side, least, merged, tie)
    return PlainBlocks(lattice, counts, made.side, block, first, layers, room, own.astype(float), own, made.radius)


def by_scipy(
    blocks: Blocks, weight: Array, seeds: NDArray[np.int64], seed_costs: Array
) -> tuple[Array, NDArray[np.int32]]:
    """As `Blocks.costs`."""
    V, number = len(weight), blocks.block.reshape(blocks.counts)
    pairs = []
    for _, here, there in neighbours(blocks.counts):
        both = np.stack((number[here].ravel(), number[there].ravel()))
        pairs.append(np.sort(both[:, (both[0] != both[1]) & (both >= 0).all(0)], axis=0))
    a, b = np.unique(np.concatenate(pairs, axis=1), axis=1).astype(np.int64)
    known = np.isfinite(weight[a]) & np.isfinite(weight[b])
    a, b = a[known], b[known]
    known = joined(blocks, a, b)
    a, b = a[known], b[known]
    middle = (blocks.first + 0.5 * blocks.layers[:, None])[:, : blocks.lattice.d]
    long = blocks.step * np.linalg.norm(middle[b] - middle[a], axis=1)
    tail, head = np.concatenate((np.full(len(seeds), V), a)), np.concatenate((seeds, b))
    length = np.concatenate((np.maximum(seed_costs, 1e-300), 0.5 * long * (weight[a] + weight[b])))
    graph = csr_matrix((length, (tail, head)), shape=(V + 1, V + 1))
    cost, before = dijkstra(graph, directed=False, indices=V, return_predecessors=True)
    return cost[:V], np.where((before[:V] == V) | (before[:V] < 0), -1, before[:V]).astype(np.int32)


def by_numpy(
    clearances: Clearances, counts: list[int], size: int, least: float, merged: bool, tie: NDArray[np.float32]
) -> tuple[Any, ...]:
    """What `_blocks` makes, numbered in another order."""
    d = clearances.d
    nodes, clear = clearest(clearances, counts[:d], size, tie)
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


def clearest(
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

    coarse, fine = split(raw(clearances, every)), split(clearances.everywhere)
    own = tie.ravel()
    rough, exact = (coarse - own).argmax(1), np.where(coarse > 0, fine - own, -np.inf).argmax(1)
    most = np.take_along_axis(coarse, rough[:, None], axis=1)[:, 0]
    near = (most > 0) & (most < SURE_SPACINGS * clearances.spacing)
    place = np.where(near, exact, rough)
    clear = np.where(near, np.take_along_axis(fine, exact[:, None], axis=1)[:, 0], most)
    within = np.stack(np.unravel_index(place, [size] * d), axis=-1)
    first = np.stack(np.unravel_index(np.arange(len(place)), counts), axis=-1)
    return first * size + within, clear


def everywhere(clearances: Clearances) -> NDArray[np.float32]:
    """Clearances at all nodes, each by itself."""
    nodes = np.moveaxis(np.indices(clearances.size.tolist()), 0, -1)
    return clearances.at(nodes).astype(np.float32)


def raw(clearances: Clearances, nodes: NDArray[np.int64]) -> Array:
    """Clearances (...) at nodes (..., d) by the field's distances themselves, m: no less than `Clearances.at`."""
    place = nodes - clearances.low
    held = np.clip(place, 0, np.array(clearances.values.shape) - 1)
    beyond = ((place - held) ** 2).sum(-1) * clearances.spacing**2
    distance = clearances.values[tuple(np.moveaxis(held, -1, 0))].astype(float)
    return np.where(beyond > 0, np.sqrt(np.maximum(distance, 0.0) ** 2 + beyond), distance) - clearances.limit
