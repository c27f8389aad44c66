"""Shortest paths over a graph, one problem at a time: Dijkstra with a heap, distances by dense sampling."""

from __future__ import annotations

import heapq
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def segment_gap(a: Array, b: Array, centers: Array, distances: Array, samples: int = 4001) -> float:
    """Smallest distance of the segment a to b from all spheres, by sampling it."""
    points = a + np.linspace(0, 1, samples)[:, None] * (b - a)
    return float((np.linalg.norm(points[:, None] - centers, axis=-1) - distances).min())


def cheapest_cost(edges: dict[int, dict[int, float]], start: int, goal: int) -> float:
    """Cost of the cheapest path from start to goal; infinite where there is none."""
    best, heap = {start: 0.0}, [(0.0, start)]
    while heap:
        cost, node = heapq.heappop(heap)
        if node == goal:
            return cost
        for other, price in edges[node].items():
            if cost + price < best.get(other, np.inf):
                best[other] = cost + price
                heapq.heappush(heap, (cost + price, other))
    return np.inf


def path_length(path: Array) -> float:
    """Length of a polyline (P, d)."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=-1).sum())


def point_along(path: Array, length: float) -> Array:
    """The point at one arc length from the start of a polyline."""
    for a, b in pairwise(path):
        step = float(np.linalg.norm(b - a))
        if length <= step and step > 0:
            return a + length / step * (b - a)
        length -= step
    return path[-1]
