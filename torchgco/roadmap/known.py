"""Searches for paths that can go on: further paths of the same problems need neither new graphs nor new points."""

from __future__ import annotations

from collections.abc import Hashable
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchgco.base.tree import take
from torchgco.roadmap.cheapest import Graph, GraphSearch
from torchgco.roadmap.geometry import Inflated, Scene
from torchgco.roadmap.points import of_boxes

BYTES_KEPT = 2**26  # bytes of graphs and points that are kept for later searches in a scene


class Course:
    """Paths over the graphs of some problems, found one after the other; each avoids those before it.

    Args:
        rows: the problems (B',) of the scene.
        factor: of the price of points near a path, for those after it.
    """

    def __init__(self, scene: Scene, rows: Tensor, search: GraphSearch, graph: Graph, factor: float) -> None:
        self.scene, self.rows, self.search, self.graph, self.factor = scene, rows, search, graph, factor
        self.price = scene.traversal_cost(graph.points, rows)  # (B', V)
        self.paths: list[Tensor] = []  # corners (B', HOPS+1, d) of each
        self.found = torch.zeros_like(rows, dtype=torch.bool)

    def go_on(self, count: int) -> None:
        """Find paths until there are `count`; a later one that has too many edges is the first."""
        while len(self.paths) < count:
            if self.paths:
                self.price = self.search.raised(self.price, self.graph.points, self.paths[-1], self.factor)
            path, string, arrives = self.search.cheapest(self.graph, self.price)
            path = self.search.taut(path, string, self.scene.traversal_cost(string, self.rows))
            if self.paths:
                path = torch.where(arrives.view(-1, 1, 1), path, self.paths[0])
            else:
                self.found = arrives
            self.paths.append(path)

    def among(self, rows: Tensor) -> Course:
        """The same of those problems that are in `rows`."""
        at = torch.isin(self.rows, rows).nonzero().flatten()
        if at.numel() == self.rows.numel():
            return self
        some = copy(self)
        some.rows = self.rows[at]
        some.search = replace(self.search, obstacles=take(self.search.obstacles, at))
        some.graph, some.price, some.found = take((self.graph, self.price, self.found), at)
        some.paths = [path[at] for path in self.paths]
        return some


class Points(NamedTuple):
    """Points around the boxes of some problems of a scene."""

    rows: Tensor  # (B',), ascending
    points: Tensor  # (B', C, d)
    exists: Tensor  # (B', C)


class Known:
    """What searches in a scene have found, for later ones in it."""

    def __init__(self) -> None:
        self._courses: dict[Hashable, list[Course]] = {}
        self._points: dict[Hashable, Points] = {}
        self._size = 0

    def courses(self, key: Hashable, rows: Tensor) -> list[Course] | None:
        """The courses of the problems in `rows`; None where some are unknown."""
        found = [course.among(rows) for course in self._courses.get(key, [])]
        return found if sum(course.rows.numel() for course in found) == rows.numel() else None

    def keep(self, key: Hashable, courses: list[Course]) -> None:
        """Keep courses, as long as there is room."""
        if self._fits(sum(part.nbytes for course in courses for part in course.graph)):
            self._courses[key] = courses

    def beside(self, key: Hashable, rows: Tensor, obstacles: Inflated, scene: Scene) -> tuple[Tensor, Tensor] | None:
        """Points (B', C, d) around the boxes of problems `rows`, ascending, and which exist; None without boxes."""
        if obstacles.boxes is None:
            return None
        known = self._points.get(key)
        if known is not None and bool(torch.isin(rows, known.rows).all()):
            at = torch.searchsorted(known.rows, rows)
            return known.points[at], known.exists[at]
        points, exists = of_boxes(obstacles.boxes, obstacles.spheres, scene.start[rows], scene.goal[rows])
        if self._fits(points.nbytes):
            self._points[key] = Points(rows, points, exists)
        return points, exists

    def _fits(self, size: int) -> bool:
        fits = self._size + size <= BYTES_KEPT
        self._size += size if fits else 0
        return fits
