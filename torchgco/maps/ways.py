"""The shortest way over the nodes of a grid: Dijkstra's algorithm between neighbours, diagonal ones too."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchgco.maps.distance import DistanceField

Array = NDArray[np.float64]

WAY_STEP = 0.5  # radii of the vehicle between nodes, at most: a gap of a radius more than its width has nodes inside
SPOTS = 2**21  # of a grid, at most, about: a search of as many takes seconds


@dataclass(frozen=True, eq=False)
class Ways:
    """Ways of a vehicle over a grid of distances.

    Two neighbours are joined where a straight line between them is free for the vehicle: the distance from obstacles
    changes no faster than the point moves, so it is nowhere smaller than half of the sum of both ends' distances less
    their own distance. An edge costs its length, times up to 1 + `weight` within `near` of contact.

    Args:
        distance: from obstacles at the nodes, (X, Y[, Z]), m; lower bounds of the true ones, or these.
        origin: the first node, (d,), m.
        spacing: of the nodes, m.
        radius: of the vehicle, m; below 0 a way may lead through obstacles as deep.
        near: distance from contact, m, within which edges cost more.
        weight: of closeness to obstacles.
    """

    distance: Array
    origin: Array
    spacing: float
    radius: float
    near: float = 0.0
    weight: float = 0.0

    @classmethod
    def through(cls, field: DistanceField, which: int, radius: float) -> Ways:
        """Ways through a map, over every so many of its nodes that steps are half a radius, or as `SPOTS` allows.

        Args:
            which: the number of the map.
        """
        values = field.values[which]
        stride = max(1, int(WAY_STEP * radius / field.spacing), int(np.ceil((values.size / SPOTS) ** (1.0 / field.d))))
        coarse = values[(slice(None, None, stride),) * field.d].astype(np.float64)
        return cls(coarse, field.origin[which], stride * field.spacing, radius)

    def node(self, point: Any) -> int:
        """The number of the node nearest to a point (d,), m, among those that the vehicle may be at, within two steps.

        The nearest of all where none of these is free.
        """
        nearest = np.rint((np.asarray(point, float) - self.origin) / self.spacing).astype(int)
        low, high = (np.clip(nearest + by, 0, np.array(self.distance.shape) - 1) for by in (-2, 2))
        near = np.stack(np.meshgrid(*map(np.arange, low, high + 1), indexing="ij"), -1).reshape(-1, len(low))
        apart = np.linalg.norm(self.origin + self.spacing * near - point, axis=1)
        free = self.distance[tuple(near.T)] > self.radius
        chosen = near[np.where(free, apart, np.inf).argmin()] if free.any() else near[apart.argmin()]
        return int(np.ravel_multi_index(tuple(chosen), self.distance.shape))

    def places(self, nodes: Any) -> Array:
        """Where nodes are, (..., d), m."""
        return self.origin + self.spacing * np.stack(np.unravel_index(nodes, self.distance.shape), -1)

    def costs(self, start: Any) -> tuple[Array, NDArray[np.int32]]:
        """Costs (V,) of the cheapest ways from a point (d,) to all nodes, infinite where there is none.

        And the node before each on its way, below 0 where there is none.
        """
        from scipy.sparse.csgraph import dijkstra

        paths = dijkstra(self.edges, directed=False, indices=self.node(start), return_predecessors=True)
        return paths[0], paths[1]

    def way(self, start: Any, goal: Any) -> Array | None:
        """The cheapest way (P, d), m, from start to goal (d,), both included; None where there is none."""
        costs, before = self.costs(start)
        nodes = [self.node(goal)]
        if not np.isfinite(costs[nodes[0]]):
            return None
        while before[nodes[-1]] >= 0:
            nodes.append(int(before[nodes[-1]]))
        return np.concatenate(([start], self.places(np.array(nodes[::-1])), [goal]))

    @cached_property
    def edges(self) -> Any:
        """The costs of steps between neighbours, each once, as a sparse matrix (V, V)."""
        from scipy.sparse import csr_matrix

        shape = self.distance.shape
        numbers = np.arange(self.distance.size, dtype=np.int32).reshape(shape)
        rate = 1.0 + self.weight * np.clip(1.0 - (self.distance - self.radius) / max(self.near, 1e-9), 0.0, 1.0)
        rows, columns, costs = [], [], []
        for step, a, b in neighbours(shape):
            long = self.spacing * float(np.linalg.norm(step))
            free = self.distance[a] + self.distance[b] - long > 2.0 * self.radius
            rows.append(numbers[a][free])
            columns.append(numbers[b][free])
            costs.append(0.5 * long * (rate[a][free] + rate[b][free]))
        ends = np.concatenate(rows), np.concatenate(columns)
        return csr_matrix((np.concatenate(costs), ends), (self.distance.size,) * 2)


def neighbours(shape: Sequence[int]) -> Iterator[tuple[tuple[int, ...], tuple[slice, ...], tuple[slice, ...]]]:
    """The steps between neighbours in an array, diagonal ones too, each once; where they begin, and where they end."""
    for step in product((-1, 0, 1), repeat=len(shape)):
        if step > (0,) * len(shape):
            begin, end = ([max(0, sign * s) for s in step] for sign in (-1, 1))
            slices = lambda low, high: tuple(slice(i, n - j) for i, j, n in zip(low, high, shape, strict=True))
            yield step, slices(begin, end), slices(end, begin)


def length(way: Array) -> float:
    """The length of a way (P, d), m."""
    return float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
