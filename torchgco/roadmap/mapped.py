"""Short paths through the free space of maps: over blocks of a lattice from start to goal, drawn taut.

One search from either end gives the cheapest way through every block. In the plane the cheapest one of each homotopy
class becomes a path; in space those that are cheapest nearby, on stretches where both searches agree. One problem at a
time; nothing is random.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import cached_property, partial

import numpy as np
import scipy
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchgco.base.shapes import CPU, computing_on
from torchgco.base.tree import moved, take
from torchgco.maps.ways import length
from torchgco.roadmap.cheapest import DIVERSITY, HOPS
from torchgco.roadmap.geometry import Inflated, Scene
from torchgco.roadmap.lattice import Array, Blocks, Lattice, blocks_of, lattice_of, sampled, tightened_by_c
from torchgco.roadmap.native_maps import library_for

# The most cells of a search, the clearance of free ones in spacings of the nodes, and whether free ones are merged; of
# further searches where there is no path yet. Through gaps with less clearance than the nodes are apart no trajectory
# may fit between its knots.
SEARCHES = ((2**18, 0.5, True), (2**18, 0.5, False), (2**18, 0.0, False), (2**21, 0.0, False))
CLOSE_UNITS = 0.5  # of closeness: within so many units an edge costs up to double
LEAST_PRICE = 1e-6  # of the price: no edge may cost nothing
MOST_EXPENSIVE = 2.0  # times as expensive as the cheapest one other paths may be
TRIED = 3  # candidates per path in space that are drawn taut, and compared with those before
COMPARED = 32  # points of a path that are compared
PRICE_SAMPLES = 16  # along each axis, at which the price is evaluated
WINDOW = np.arange(-2, 3)  # blocks next to start and goal at which ways begin
TAUT_ROUNDS = 4  # of drawing taut, at most, and the gain in length, as a share, below which there is no further one
LITTLE = 1e-3
WINDOWS = (8, 16, 64, 10**6)  # points ahead that are looked at together
POINTS = 96  # of a path that is drawn taut
LEAST_SEGMENTS = 10  # segments, at least, of a path that keeps off others, which it would be drawn onto
PATH_STEPS = 0.5  # units between points at which it is looked for what is near a path
MAPPED_ROUNDING = 1e-9  # m
REGION_SEED = 0x5DEECE66D  # seed of the numbers that stand for blocked regions

Price = Callable[[Array], Array]  # per metre at points (V, d)
Search = Callable[[Lattice, Array, Price, float, float], list[Array]]  # with the vehicle's radius and the unit, m


def paths_in_maps(scene: Scene, count: int, overlap: float) -> tuple[Tensor, Tensor]:
    """As `Roadmap.paths`, over blocks of a lattice: of maps, or of nodes among spheres and boxes."""
    return in_each(scene, count, overlap, partial(paths, count=count, corners=HOPS + 1))


def in_each(scene: Scene, count: int, overlap: float, search: Search) -> tuple[Tensor, Tensor]:
    """The paths (B, count, HOPS+1, d) that a search of each problem finds, and whether it finds any, (B,)."""
    corners = scene.straight(HOPS, count)
    found = torch.zeros_like(corners[:, 0, 0, 0], dtype=torch.bool)
    for b in range(len(corners)):
        for k, path in enumerate(in_one(scene, b, overlap, search)):
            corners[b, k, : len(path)] = corners.new_tensor(path)
            if k == 0:
                corners[b, 1:], found[b] = corners[b, :1], True  # the first stands in for those that there aren't
    return corners, found


def in_one(scene: Scene, b: int, overlap: float, search: Search) -> list[Array]:
    """What a search of the problem at place b finds."""
    one = scene.take(torch.tensor([b], device=scene.start.device)).on_cpu()
    obstacles = one.obstacles.reduced(overlap)

    def price(points: Array) -> Array:
        return one.traversal_cost(torch.from_numpy(points)[None], torch.tensor([0]))[0].numpy()

    ends = torch.cat((one.start, one.goal)).numpy()
    with computing_on(CPU):
        if obstacles.maps:
            lattice, radius = lattice_of(obstacles.maps, obstacles.kinds, ends), obstacles.maps[0].vehicle_radius
        else:
            lattice = sampled(obstacles.kinds, ends)
            radius = lattice.spacing
        return search(lattice, ends, price, float(radius), float(obstacles.largest))


def sweep_alike(paths: Tensor, obstacles: Inflated) -> Tensor:
    """Whether paths (B, K, P, 2) wind around every blocked region of the maps by the same angle, (B, K, K)."""
    same = torch.ones(*paths.shape[:2], paths.shape[1], dtype=torch.bool, device=paths.device)
    if library_for(paths.shape[-1]) is None:
        return same  # nothing was found: all are the straight line
    for b, some in enumerate(paths.double().cpu().numpy()):
        own = moved(take(obstacles, torch.tensor([b], device=paths.device)), CPU)
        for field in own.maps:
            with computing_on(CPU):
                lattice = lattice_of([field], [], some[0, [0, -1]])
                angles = [swept(lattice, path) for path in some]
            sums = torch.tensor(angles, device=paths.device)
            same[b] &= sums.unsqueeze(0) == sums.unsqueeze(1)
    return same


class Ways:
    """The cheapest ways from start and goal over all blocks of a lattice.

    Args:
        ends: start and goal, (2, d), m.
        price: per metre.
        margin: m; closer to obstacles than this a way costs up to double.
        least: clearance, m, above which a block is free.

    Attributes:
        least: clearance, m, of what begins or ends at start and goal.
    """

    def __init__(self, blocks: Blocks, ends: Array, price: Price, margin: float, least: float) -> None:
        self.blocks, self.ends, self.points = blocks, ends, blocks.points
        self.free_above = least
        # An end may be nearer to the map than the constraint admits.
        self.least = min(0.0, *blocks.lattice.at(ends)) - MAPPED_ROUNDING
        close = 1.0 + (np.clip(1.0 - blocks.clearance / margin, 0.0, 1.0) if margin > 0.0 else 0.0)  # 0: no obstacles
        rate = _smoothed(price, self.points, blocks.counts)
        usable = (blocks.clearance > least) & np.isfinite(rate)
        self.weight = np.where(usable, np.maximum(rate, 0.0) * close + LEAST_PRICE, np.inf)
        self.costs, self.seeds = np.empty((2, len(self.weight))), list[tuple[NDArray[np.int64], Array]]()
        self.before = np.empty((2, len(self.weight)), np.int32)
        for i, end in enumerate(ends):
            seeds = self._seen(end, usable)
            apart = np.linalg.norm(self.points[seeds] - end, axis=1)
            self.seeds.append((seeds, apart * self.weight[seeds]))
            self.costs[i], self.before[i] = blocks.costs(self.weight, *self.seeds[i])

    @property
    def total(self) -> Array:
        """The cost of the cheapest way from start to goal through each block, (V,)."""
        return self.costs.sum(0)

    def _seen(self, end: Array, usable: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Free blocks that are seen from start or goal, or else the nearest one."""
        blocks, lattice = self.blocks, self.blocks.lattice
        axes = [np.unique(np.clip(int(i * lattice.spacing / blocks.step) + WINDOW, 0, n - 1))
                for i, n in zip(lattice.node(end), blocks.counts, strict=False)]  # fmt: skip
        cells = np.ravel_multi_index(np.meshgrid(*axes, indexing="ij"), blocks.counts[: lattice.d]).ravel()
        near = np.unique(blocks.block[cells]).astype(np.int64)
        near = near[near >= 0]
        near = near[usable[near]]
        a = np.broadcast_to(end, self.points[near].shape)
        seen = near[lattice.see(a, self.points[near], np.full(len(near), self.least))]
        if len(seen) == 0 and len(near) > 0:
            seen = near[[np.linalg.norm(self.points[near] - end, axis=1).argmin()]]
        return seen

    def taut(self, block: int) -> Array:
        """The way through a block, drawn taut."""
        return tightened(self.blocks.lattice, self.path(block), self.least)

    def beside(self, raised: Array) -> Array:
        """The cheapest way where prices are raised, with corners left out that are near."""
        way = self.blocks.another(raised, *self.seeds[0], self.costs[1], self.before[1])
        path = np.concatenate((self.ends[:1], self.points[way], self.ends[1:]))
        return tightened(self.blocks.lattice, path, self.least, length(path) / LEAST_SEGMENTS)

    def near(self, path: Array, unit: float) -> NDArray[np.int64]:
        """The blocks nearer than `unit`, m, to a path, which is looked at in steps."""
        lists = self.tree.query_ball_point(_dense(path, PATH_STEPS * unit), unit)
        return np.unique(np.concatenate([np.asarray(some, np.int64) for some in lists]))

    @cached_property
    def tree(self) -> scipy.spatial.cKDTree:
        """Of the blocks' clearest nodes."""
        return scipy.spatial.cKDTree(self.points)

    def path(self, block: int) -> Array:
        """The way from start to goal (P, d) through a block."""
        ways = [[block], [block]]
        for way, before in zip(ways, self.before, strict=True):
            while before[way[-1]] >= 0:
                way.append(int(before[way[-1]]))
        return np.concatenate((self.ends[:1], self.points[ways[0][::-1] + ways[1][1:]], self.ends[1:]))


def _smoothed(price: Price, points: Array, counts: tuple[int, ...]) -> Array:
    """Prices (V,) at points, interpolated between a few of them: costs are smooth, and may be expensive to evaluate."""
    low, high, d = points.min(0), points.max(0), points.shape[1]
    sizes = [min(n + 1, PRICE_SAMPLES) for n in counts[:d]]
    axes = [np.linspace(a, b, n) for a, b, n in zip(low, high, sizes, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = price(grid.reshape(-1, d)).reshape(sizes)
    share = (points - low) / np.maximum(high - low, MAPPED_ROUNDING) * (np.array(sizes) - 1)
    return scipy.ndimage.map_coordinates(values, share.T, order=1, mode="nearest")


def paths(
    lattice: Lattice, ends: Array, price: Price, radius: float, unit: float, count: int, corners: int
) -> list[Array]:
    """Up to `count` taut paths (P, d), P <= corners, between two points (2, d), the cheapest first."""
    ways = ways_of(lattice, ends, price, radius, CLOSE_UNITS * unit)
    if ways is None:
        return []
    if lattice.d == 2:  # the cheapest way of each homotopy class
        found = [ways.taut(v) for v in itertools.islice(one_of_each_class(ways).values(), count)]
    else:
        found = _in_space(ways, count, unit)
    return [path for path in found if len(path) <= corners]


def ways_of(lattice: Lattice, ends: Array, price: Price, radius: float, margin: float) -> Ways | None:
    """The ways of the first search that finds any; None where none does, and without a compiler."""
    if library_for(lattice.d) is None:
        return None
    for number, (most, share, merged) in enumerate(SEARCHES):
        if number == 1 and not lattice.may_join(ends):
            return None
        least = share * lattice.spacing
        blocks = blocks_of(lattice, radius, most, least, merged and lattice.d == 3)
        if len(blocks.nodes) == 0:
            continue
        ways = Ways(blocks, ends, price, margin, least)
        if np.isfinite(ways.total).any():
            return ways
    return None


def one_of_each_class(ways: Ways) -> dict[int, int]:
    """Blocks on the cheapest way of each homotopy class in the plane, by what the class sweeps, the cheapest first.

    Of each class that leads through one block on the cheapest ways from both ends.
    """
    total = ways.total
    live = np.flatnonzero(np.isfinite(total))
    sums = [_swept_on_the_way(ways, i) for i in (0, 1)]
    kind = (sums[0] - sums[1])[live]
    order = np.argsort(total[live], kind="stable")
    _, first = np.unique(kind[order], return_index=True)
    chosen = order[np.sort(first)]
    chosen = chosen[total[live[chosen]] <= MOST_EXPENSIVE * total[live[chosen[0]]]]
    return dict(zip(kind[chosen].tolist(), live[chosen].tolist(), strict=True))


def _in_space(ways: Ways, count: int, unit: float) -> list[Array]:
    """The cheapest way, and others that are cheapest nearby and lead elsewhere.

    Where the cheapest ways from start and from goal agree on a stretch of blocks, the way along it is the cheapest
    between its neighbours; the longest of these plateaus are ways around obstacles.
    """
    total, onward = ways.total, ways.before[1]
    own = np.arange(len(total))
    ahead = np.where(onward >= 0, onward, own)
    agree = (onward >= 0) & (ways.before[0][ahead] == own) & np.isfinite(total)
    end = np.where(agree, ahead, own)
    while (end[end] != end).any():
        end = end[end]
    first = np.where(agree, ways.costs[0], np.inf)
    begins = np.full(len(total), np.inf)
    np.minimum.at(begins, end, first)
    ends = np.flatnonzero(np.isfinite(begins))
    best = float(total.min())
    shares = (ways.costs[0][ends] - begins[ends]) / best
    ends, shares = ends[total[ends] <= MOST_EXPENSIVE * best], shares[total[ends] <= MOST_EXPENSIVE * best]
    order = np.argsort(total[ends] / best - shares, kind="stable")[: TRIED * count]
    found = [ways.taut(int(total.argmin()))]
    for v in ends[order]:
        if len(found) == count:
            break
        path = ways.taut(int(v))
        points = even(path, COMPARED)
        if all(_apart(points, other) > unit for other in found):
            found.append(path)
    return found + _beside(ways, found, count - len(found), unit)


def _beside(ways: Ways, found: list[Array], count: int, unit: float) -> list[Array]:
    """Up to `count` further paths: the cheapest where prices near all paths before are raised."""
    weight, others = ways.weight.copy(), list[Array]()
    for path in found if count > 0 else ():
        weight[ways.near(path, unit)] *= 1.0 + DIVERSITY
    for _ in range(count):
        path = ways.beside(weight)
        weight[ways.near(path, unit)] *= 1.0 + DIVERSITY
        points = even(path, COMPARED)
        if all(_apart(points, other) > unit for other in (*found, *others)):
            others.append(path)
    return others


def even(path: Array, count: int) -> Array:
    """Points (count, d) at equal shares of a path's length."""
    along = np.concatenate(([0.0], np.sqrt((np.diff(path, axis=0) ** 2).sum(1)).cumsum()))
    share = np.linspace(0.0, along[-1], count)
    return np.stack([np.interp(share, along, x) for x in path.T], axis=1)


def _apart(points: Array, other: Array) -> float:
    """The largest distance of points (P, d) from a path, m."""
    a, along = other[:-1], np.diff(other, axis=0)
    toward = points[:, None] - a
    share = (toward * along).sum(-1) / np.maximum((along * along).sum(-1), MAPPED_ROUNDING)
    gap = toward - np.clip(share, 0.0, 1.0)[..., None] * along
    return float(np.sqrt((gap * gap).sum(-1).min(1).max()))


# Homotopy classes -------------------------------------------------------------------------------------------------


def keys(count: int) -> NDArray[np.int64]:
    """Numbers that stand for blocked regions: sums of different ones differ but by rarest chance."""
    return np.random.default_rng(REGION_SEED).integers(-(2**62), 2**62, count, dtype=np.int64)


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


def _swept_on_the_way(ways: Ways, end: int) -> NDArray[np.int64]:
    """The same of the cheapest ways from start (0) or goal (1) to all blocks, (V,)."""
    before, lattice = ways.before[end], ways.blocks.lattice
    parent = np.where(before >= 0, before, np.arange(len(before)))
    u = (ways.points - lattice.origin) / lattice.spacing
    total = _crossings(lattice, u[parent], u)
    # The way begins at the end itself.
    roots = np.flatnonzero((before < 0) & np.isfinite(ways.costs[end]))
    begin = np.broadcast_to((ways.ends[end] - lattice.origin) / lattice.spacing, u[roots].shape)
    first = np.zeros_like(total)
    first[roots] = _crossings(lattice, begin, u[roots])
    while (parent[parent] != parent).any():  # each round doubles the length of the ways that are summed
        total, parent = total + total[parent], parent[parent]
    return total + first[parent]


def _crossings(lattice: Lattice, a: Array, b: Array) -> NDArray[np.int64]:
    """Sums of the numbers of regions whose rays short segments from a to b (E, 2) cross, in steps of the lattice."""
    marks, columns = lattice.marks, lattice.shape
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


def tightened(lattice: Lattice, path: Array, least: float, reach: float = np.inf) -> Array:
    """A path drawn taut within its homotopy class: corners that aren't needed are left out, from either end in turn.

    Args:
        least: clearance of its first and its last segment, m.
        reach: the longest segment, m: with one, corners are left out once.
    """
    rounds = TAUT_ROUNDS if reach == np.inf else 0
    if lattice.alone:
        return tightened_by_c(lattice, path, least, reach, POINTS, rounds, LITTLE)
    path = _shortcut(lattice, path, least, reach)
    step = max(2.0 * lattice.spacing, length(path) / POINTS)
    for _ in range(rounds):
        before = length(path)
        path = _shortcut(lattice, _dense(path, step)[::-1], least)[::-1]
        path = _shortcut(lattice, _dense(path, step), least)
        if length(path) > (1.0 - LITTLE) * before:
            break
    return path


def _dense(path: Array, step: float) -> Array:
    """The same path with points at most a step apart."""
    parts = [path[:1]]
    for a, b in itertools.pairwise(path):
        count = max(1, int(np.ceil(np.linalg.norm(b - a) / step)))
        parts.append(a + np.linspace(0.0, 1.0, count + 1)[1:, None] * (b - a))
    return np.concatenate(parts)


def _shortcut(lattice: Lattice, path: Array, least: float, reach: float = np.inf) -> Array:
    """From each kept corner straight on to the last point that it sees, and all points before it.

    The path is bent through the triangles between, which are free: it stays in its homotopy class.
    """
    kept, i, last = [0], 0, len(path) - 1
    while i < last:
        far = i
        for window in WINDOWS:
            ahead = np.arange(far + 1, min(far + window, last) + 1)
            beside_end = (ahead == last) | (i == 0)
            a = np.broadcast_to(path[i], path[ahead].shape)
            hidden = ~lattice.see(a, path[ahead], np.where(beside_end, least, 0.0))
            hidden |= (np.linalg.norm(path[ahead] - path[i], axis=1) > reach) & (ahead > i + 1)
            far = int(ahead[hidden.argmax()]) - 1 if hidden.any() else int(ahead[-1])
            if hidden.any() or far == last:
                break
        i = max(i + 1, far)
        kept.append(i)
    return path[kept]
