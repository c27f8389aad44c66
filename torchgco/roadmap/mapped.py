"""Short paths through the free space of maps: over a lattice from start to goal, drawn taut.

In the plane one search from either end gives the cheapest path through every node, and their homotopy classes: the
cheapest node of each class is the way of a path. In space the price of what lies next to the paths so far is raised, as
around spheres and boxes (roadmap.py). NumPy and SciPy, one problem at a time; nothing is random.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from torchgco.base.tree import take
from torchgco.roadmap.geometry import Inflated, Scene
from torchgco.roadmap.lattice import Array, Blocks, Lattice, blocks_of, lattice_of
from torchgco.roadmap.search import HOPS

BLOCKS = (2**13, 2**16, 2**20)  # of a first search, and of further ones where there is no path yet
MARGIN = 0.5  # vehicle's radii within which an edge costs up to double
LONGEST = 2.0  # times as dear as the cheapest one other paths in the plane may be
ROUNDS = 4  # of drawing taut, at most, and the gain in length, as a share, below which there is no further one
LITTLE = 1e-3
WINDOWS = (8, 16, 64, 10**6)  # points ahead that are looked at together
POINTS = 96  # of a path that is drawn taut
ENDS = 64  # blocks to which start and goal are joined, the nearest that they see
KEY = 0x5DEECE66D  # seed of the numbers that stand for blocked regions

Price = Callable[[Array], Array]  # per metre at points (V, d)


def paths_in_maps(scene: Scene, count: int, overlap: float) -> tuple[Tensor, Tensor]:
    """As `Roadmap.paths`, where there are maps among the obstacles."""
    start, goal = scene.start, scene.goal
    corners = torch.stack((start, goal), dim=1)[:, [0, *[1] * HOPS]].unsqueeze(1).repeat(1, count, 1, 1)
    found = torch.zeros_like(start[:, 0], dtype=torch.bool)
    for b in range(len(start)):
        row = torch.tensor([b], device=start.device)
        obstacles = take(scene.obstacles, row).reduced(overlap)

        def price(points: Array, row: Tensor = row) -> Array:
            return scene.traversal_cost(start.new_tensor(points)[None], row)[0].double().cpu().numpy()

        ends = torch.stack((start[b], goal[b])).double().cpu().numpy()
        lattice = lattice_of(obstacles.maps, obstacles.kinds, ends)
        for k, path in enumerate(paths(lattice, ends, price, count, float(obstacles.largest), HOPS + 1)):
            corners[b, k, : len(path)] = start.new_tensor(path)
            if k == 0:
                corners[b, 1:], found[b] = corners[b, :1], True  # the first stands in for those that there aren't
    return corners, found


def sweep_alike(paths: Tensor, obstacles: Inflated) -> Tensor:
    """Whether paths (B, K, P, 2) wind around every blocked region of the maps by the same angle, (B, K, K)."""
    same = torch.ones(*paths.shape[:2], paths.shape[1], dtype=torch.bool, device=paths.device)
    for b, some in enumerate(paths.double().cpu().numpy()):
        own = take(obstacles, torch.tensor([b], device=paths.device))
        for field in own.maps:
            lattice = lattice_of([field], [], some[0, [0, -1]])
            sums = torch.tensor([swept(lattice, path) for path in some], device=paths.device)
            same[b] &= sums.unsqueeze(0) == sums.unsqueeze(1)
    return same


class Ways:
    """The cheapest ways from a start over the blocks of a lattice, and those from a goal.

    Args:
        ends: start and goal, (2, d), m.
        price: per metre.
        unit: m, of closeness to obstacles.
    """

    def __init__(self, lattice: Lattice, blocks: Blocks, ends: Array, price: Price, unit: float) -> None:
        self.lattice, self.ends = lattice, ends
        V = len(blocks.nodes)
        self.points = np.concatenate((lattice.position(blocks.nodes), ends))
        tails, heads, gaps = [blocks.tails], [blocks.heads], [blocks.gaps]
        for i, end in enumerate(ends):
            near, gap = self._seen(end, self.points[:V])
            tails.append(np.full(len(near), V + i))
            heads.append(near)
            gaps.append(gap)
        self.tail, self.head, gap = np.concatenate(tails), np.concatenate(heads), np.concatenate(gaps)
        close = 1.0 + np.clip(1.0 - gap / (MARGIN * unit), 0.0, 1.0)
        self.lengths = np.linalg.norm(self.points[self.tail] - self.points[self.head], axis=1) * close + 1e-12
        self.price = price(self.points)
        self.start, self.goal = V, V + 1

    def _seen(self, end: Array, points: Array) -> tuple[NDArray[np.int64], Array]:
        """The nearest points that are seen from start or goal, and the clearances on the way."""
        away = np.linalg.norm(points - end, axis=1)
        near = np.argsort(away, kind="stable")[:ENDS]
        gaps = self.lattice.segments(np.broadcast_to(end, points[near].shape), points[near])
        # An end may be a little nearer to the map than the constraint admits: the way leads out of there.
        seen = gaps > min(0.0, float(self.lattice.at(end[None])[0]) - 1e-9)
        return near[seen], np.maximum(gaps[seen], 0.0)

    def costs(self, sources: list[int], raised: Array | float = 1.0) -> tuple[Array, NDArray[np.int32]]:
        """Costs of the cheapest ways from some points to all, and the points before, (sources, V)."""
        price = self.price * raised
        weight = self.lengths * 0.5 * (price[self.tail] + price[self.head])
        usable = np.isfinite(weight)
        pairs, n = (self.tail[usable], self.head[usable]), len(self.points)
        graph = csr_matrix((weight[usable], pairs), shape=(n, n))
        return dijkstra(graph, directed=False, indices=sources, return_predecessors=True)

    def traced(self, before: NDArray[np.int32], node: int) -> list[int]:
        """The points from a node back to where its way begins."""
        way = [node]
        while before[way[-1]] >= 0:
            way.append(int(before[way[-1]]))
        return way


def paths(lattice: Lattice, ends: Array, price: Price, count: int, unit: float, corners: int) -> list[Array]:
    """Up to `count` taut paths (P, d), P <= corners, between two points (2, d), the cheapest first."""
    if not lattice.may_join(ends):
        return []
    for most in BLOCKS:
        ways = Ways(lattice, blocks_of(lattice, most), ends, price, unit)
        found = _in_the_plane(ways, count) if lattice.d == 2 else _in_space(ways, count, unit)
        if found or most >= lattice.clearance.size:
            break
    taut = [tightened(lattice, path) for path in found]
    return [path for path in taut if len(path) <= corners]


def _in_the_plane(ways: Ways, count: int) -> list[Array]:
    """The cheapest way of each homotopy class that leads through one node on the cheapest ways from both ends."""
    costs, before = ways.costs([ways.start, ways.goal])
    total = costs.sum(0)
    live = np.flatnonzero(np.isfinite(total))
    if not np.isfinite(total[ways.goal]):
        return []
    swept = [_swept_on_the_way(ways, part) for part in before]
    kind = (swept[0] - swept[1])[live]
    order = np.argsort(total[live], kind="stable")
    _, first = np.unique(kind[order], return_index=True)
    chosen = live[order[np.sort(first)[:count]]]
    chosen = chosen[total[chosen] <= LONGEST * total[ways.goal]]
    return [ways.points[ways.traced(before[0], v)[::-1] + ways.traced(before[1], v)[1:]] for v in chosen]


def _in_space(ways: Ways, count: int, unit: float) -> list[Array]:
    """The cheapest way, and others for which what lies next to those before costs double."""
    found, raised = [], np.ones(len(ways.points))
    for _ in range(count):
        costs, before = ways.costs([ways.start], raised)
        if not np.isfinite(costs[0, ways.goal]):
            break
        path = ways.points[ways.traced(before[0], ways.goal)[::-1]]
        found.append(path)
        raised[_nearest(ways.points, path) < unit] *= 2.0
    return found


def _nearest(points: Array, path: Array) -> Array:
    """Distances (V,) of points from the corners of a path, which are dense."""
    from scipy.spatial import cKDTree

    return cKDTree(path).query(points)[0]


# Homotopy classes -------------------------------------------------------------------------------------------------


def keys(count: int) -> NDArray[np.int64]:
    """Numbers that stand for blocked regions: sums of different ones differ but by rarest chance."""
    return np.random.default_rng(KEY).integers(-(2**62), 2**62, count, dtype=np.int64)


def swept(lattice: Lattice, path: Array) -> int:
    """What a path (P, 2) in the plane sweeps: the sum of the numbers of the regions that it passes above, with a sign.

    Paths between the same ends have the same sum where they wind around every region by the same angle: each passes a
    ray upwards from the region's mark as often, counted with signs.
    """
    u = (path - lattice.origin) / lattice.spacing
    a, b = u[:-1, None], u[1:, None]
    marks = lattice.marks
    right = (a[..., 0] < marks[:, 0]) & (b[..., 0] >= marks[:, 0])
    left = (b[..., 0] < marks[:, 0]) & (a[..., 0] >= marks[:, 0])
    width = np.where(right | left, b[..., 0] - a[..., 0], 1.0)
    height = a[..., 1] + (marks[:, 0] - a[..., 0]) / width * (b[..., 1] - a[..., 1])
    above = height > marks[:, 1]
    times = ((right & above).astype(np.int64) - (left & above)).sum(0)
    return int((times * keys(len(marks))).sum())


def _swept_on_the_way(ways: Ways, before: NDArray[np.int32]) -> NDArray[np.int64]:
    """The same of the cheapest ways from one end to all points (V,)."""
    parent = np.where(before >= 0, before, np.arange(len(before)))
    u = (ways.points - ways.lattice.origin) / ways.lattice.spacing
    total = _crossings(ways.lattice, u[parent], u)
    while (parent[parent] != parent).any():  # each round doubles the length of the ways that are summed
        total, parent = total + total[parent], parent[parent]
    return total


def _crossings(lattice: Lattice, a: Array, b: Array) -> NDArray[np.int64]:
    """Sums of the numbers of regions whose rays short segments from a to b (E, 2) cross, in steps of the lattice."""
    marks, columns = lattice.marks, lattice.clearance.shape
    below = np.zeros((columns[0], columns[1] + 1), np.int64)
    np.add.at(below, (marks[:, 0], marks[:, 1] + 1), keys(len(marks)))
    below = below.cumsum(axis=1)  # [column, row]: of the marks below a row
    low, high = np.minimum(a[:, 0], b[:, 0]), np.maximum(a[:, 0], b[:, 0])
    width = np.where(high > low, b[:, 0] - a[:, 0], 1.0)
    total = np.zeros(len(a), np.int64)
    first = np.floor(low).astype(int) + 1  # columns in (low, high]
    for step in range(int((np.floor(high) - first).max(initial=-1)) + 1):
        column = first + step
        crossed = (column <= high) & (column >= 0) & (column < columns[0])
        height = a[:, 1] + (column - a[:, 0]) / width * (b[:, 1] - a[:, 1])
        row = np.clip(np.ceil(height), 0, columns[1]).astype(int)  # marks strictly below the height
        total += np.where(crossed, below[np.where(crossed, column, 0), row], 0)
    return np.where(b[:, 0] >= a[:, 0], total, -total)


# Taut strings -----------------------------------------------------------------------------------------------------


def tightened(lattice: Lattice, path: Array) -> Array:
    """A path drawn taut within its homotopy class: corners that aren't needed are left out, from either end in turn."""
    path = _shortcut(lattice, path)
    step = max(2.0 * lattice.spacing, length(path) / POINTS)
    for _ in range(ROUNDS):
        before = length(path)
        path = _shortcut(lattice, _dense(path, step)[::-1])[::-1]
        path = _shortcut(lattice, _dense(path, step))
        if length(path) > (1.0 - LITTLE) * before:
            break
    return path


def length(path: Array) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def _dense(path: Array, step: float) -> Array:
    """The same path with points at most a step apart."""
    parts = [path[:1]]
    for a, b in itertools.pairwise(path):
        count = max(1, int(np.ceil(np.linalg.norm(b - a) / step)))
        parts.append(a + np.linspace(0.0, 1.0, count + 1)[1:, None] * (b - a))
    return np.concatenate(parts)


def _shortcut(lattice: Lattice, path: Array) -> Array:
    """From each kept corner straight on to the last point that it sees, and all points before it.

    The path is bent through the triangles between, which are free: it stays in its homotopy class.
    """
    kept, i, last = [0], 0, len(path) - 1
    least = min(0.0, *lattice.at(path[[0, -1]])) - 1e-9
    while i < last:
        far = i
        for window in WINDOWS:
            ahead = np.arange(far + 1, min(far + window, last) + 1)
            beside_end = (ahead == last) | (i == 0)
            a = np.broadcast_to(path[i], path[ahead].shape)
            hidden = ~lattice.see(a, path[ahead], np.where(beside_end, least, 0.0))
            far = int(ahead[hidden.argmax()]) - 1 if hidden.any() else int(ahead[-1])
            if hidden.any() or far == last:
                break
        i = max(i + 1, far)
        kept.append(i)
    return path[kept]
