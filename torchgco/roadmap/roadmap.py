"""Short paths between spheres and boxes over a graph of points, leg by leg through gates; searches can go on.

Points lie around every obstacle, midway between neighbours and, in a fixed low-discrepancy sequence, all over the
scene; each is joined to a few near ones where the straight line is free. Nothing is random. C searches (c/cheapest.c),
in double precision on the CPU wherever the problems lie; without a compiler no paths are found.
"""

from __future__ import annotations

from collections.abc import Hashable
from copy import copy
from ctypes import CDLL
from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from torchgco.base.options import AtLeast, Below, check_options
from torchgco.base.shapes import CPU, computing_on
from torchgco.base.tree import take
from torchgco.roadmap import cheapest
from torchgco.roadmap.cheapest import DIVERSITY, HOPS, Graph, GraphSearch
from torchgco.roadmap.geometry import Inflated, Scene, length, points_along
from torchgco.roadmap.mapped import paths_in_maps
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


NODES = 128  # points around obstacles: those of the shortest detours
# A second search has more points, where the first had no places for all of them and found no path, or only a long one
# (in distances from start to goal): the points next to the straight line take all places, before any lies in the gaps
# that lead through a wood or at the ends of a wall.
MANY_NODES = 1024
LONG = 1.25
MANY_NEIGHBOURS = 96  # in the second search: two doors of a maze lie farther apart than the points around each
NEIGHBOURS, HALTON_NEIGHBOURS = 12, 6  # edges of a point to its nearest of all points and of the Halton points
MARGIN = 0.15  # distance from an obstacle, in largest inflated radii, below which an edge costs up to double
PRIMES = (2, 3, 5)  # bases of the low-discrepancy sequence


@dataclass(frozen=True)
class Roadmap:
    """A graph of points around obstacles, and the cheapest paths over it.

    Args:
        num_halton: points of a Halton sequence all over the scene, added to `NODES` points around the obstacles; none
            are needed among maps.
        max_overlap: allowed penetration of a path into an obstacle, as a share of the inflated radius. Keep it below
            0.05, which the judge accepts between two knots. A gap closed by no more than this can be flown through.

    Raises:
        InputError: a field out of its range.
    """

    num_halton: Annotated[int, AtLeast(HALTON_NEIGHBOURS)] = 64
    max_overlap: Annotated[float, AtLeast(0), Below(1)] = 0.0

    def __post_init__(self) -> None:
        check_options(self, "roadmap")

    def paths(
        self, scene: Scene, count: int = 1, rows: Tensor | None = None, known: Known | None = None
    ) -> tuple[Tensor, Tensor]:
        """Different paths, the cheapest first; each further one avoids those before it unless that costs too much.

        Args:
            rows: problems (B',) of the scene, ascending; None: all.
            known: of searches in this scene before, with which this one goes on; None: of none.

        Returns:
            Corners (B', count, HOPS+1, d), m, the goal repeated at their ends, or the straight line where there is no
            path; and whether there is a path (B',).
        """
        if scene.obstacles.maps:
            return paths_in_maps(scene if rows is None else scene.take(rows), count, self.max_overlap)
        with computing_on(CPU):
            corners, found = self._paths(scene.on_cpu(), count, None if rows is None else rows.cpu(), known or Known())
        return corners.to(scene.start), found.to(scene.start.device)

    def _paths(self, scene: Scene, count: int, rows: Tensor | None, known: Known) -> tuple[Tensor, Tensor]:
        """The same without maps, on the CPU in double precision."""
        B, d = scene.start.shape
        rows = torch.arange(B) if rows is None else rows
        corners, found = scene.straight(HOPS, count)[rows], torch.zeros_like(rows, dtype=torch.bool)
        library = cheapest.library_for(d, scene.obstacles.boxes is not None)
        if library is None:
            return corners, found
        place, most = torch.full((B,), -1), cheapest.SEARCHES_AT_ONCE
        place[rows] = torch.arange(rows.numel())
        for first in range(0, B, most):
            some = rows[(rows >= first) & (rows < first + most)]
            for course in self._courses(scene, some, first, count, library, known):
                corners[place[course.rows]] = torch.stack(course.paths[:count], dim=1)
                found[place[course.rows]] = course.found
        if not bool(found.all()):
            some = (scene.obstacles.sizes > 0.0).any(-1) & (scene.start != scene.goal).any(-1)
            low, high = scene.obstacles.region(scene.start, scene.goal)
            some &= torch.isfinite(high - low).all(-1)  # else no lattice covers it
            lost = (~found & some[rows]).nonzero().flatten()
            if lost.numel() > 0:
                corners[lost], found[lost] = paths_in_maps(scene.take(rows[lost]), count, self.max_overlap)
        return corners, found

    def repeats(self, other: Roadmap, scene: Scene) -> bool:
        """Whether another search finds the same paths: those among maps need no points all over the scene."""
        return bool(scene.obstacles.maps) and self.max_overlap == other.max_overlap

    def _courses(self, scene: Scene, rows: Tensor, group: int, count: int, library: CDLL, known: Known) -> list[Course]:
        """Courses with `count` paths, or more, of the problems in `rows`, which are of one group."""
        if rows.numel() == 0:
            return []
        before = known.courses((self, group), rows)
        courses = before or self._begun(scene, rows, group, library, known)
        for course in courses:
            course.go_on(count)
        if before is None:
            known.keep((self, group), courses)
        return courses

    def _begun(self, scene: Scene, rows: Tensor, group: int, library: CDLL, known: Known) -> list[Course]:
        """Courses with one path of the problems in `rows`, some of them over more points."""

        def begin(rows: Tensor, nodes: int, neighbours: int) -> Course:
            start, goal = scene.start[rows], scene.goal[rows]
            obstacles = take(scene.obstacles, rows).reduced(self.max_overlap)
            search = GraphSearch(library, obstacles, MARGIN)
            cube = halton(self.num_halton, start.shape[-1]).to(start)
            beside = known.beside((self.max_overlap, group), rows, obstacles, scene)
            graph = search.graph(start, goal, cube, nodes, neighbours, HALTON_NEIGHBOURS, beside)
            course = Course(scene, rows, search, graph, 1.0 + DIVERSITY)
            course.go_on(1)
            return course

        first = begin(rows, NODES, NEIGHBOURS)
        straight = length(torch.stack((scene.start[rows], scene.goal[rows]), dim=1))
        again = (~first.found | (length(first.paths[0]) > LONG * straight)).nonzero().flatten()
        is_full = first.graph.points.shape[1] == 2 + self.num_halton + NODES
        if not is_full or again.numel() == 0:
            return [first]
        second = begin(rows[again], MANY_NODES, MANY_NEIGHBOURS)
        stays = torch.ones_like(first.found)
        stays[again[second.found]] = False
        return [first.among(rows[stays]), second.among(rows[~stays])]


@cache
def halton(count: int, dimension: int) -> Tensor:
    """The first points (count, dimension) of Halton's sequence in the unit cube, 1-based."""
    columns = []
    for base in PRIMES[:dimension]:
        digits, share, column = torch.arange(1, count + 1), 1.0, torch.zeros(count, dtype=torch.float64)
        while bool((digits > 0).any()):
            share /= base
            column += share * (digits % base)
            digits = digits // base
        columns.append(column)
    return torch.stack(columns, dim=-1)


def paths_through(roadmap: Roadmap, scene: Scene, count: int, rows: Tensor, known: Known) -> tuple[Tensor, Tensor]:
    """`roadmap.paths`, and through the gates of a scene that has some.

    Of the paths of each leg the first ones follow each other, and so do the second ones: corners
    (B', count, (G+1) (HOPS+1), d), and whether there is a path along every leg (B',).
    """
    if scene.gates is None:
        return roadmap.paths(scene, count, rows, known)
    stops = torch.cat((scene.start.unsqueeze(1), scene.gates, scene.goal.unsqueeze(1)), dim=1)
    legs = [
        roadmap.paths(replace(scene, start=stops[:, g], goal=stops[:, g + 1], gates=None), count, rows)
        for g in range(stops.shape[1] - 1)
    ]
    corners, found = zip(*legs, strict=True)
    return torch.cat(corners, dim=2), torch.stack(found).all(0)


def timed(path: Tensor, places: Tensor, stages: Tensor, N: int) -> Tensor:
    """Positions (R, N+1, d) on paths (R, P, d) of G + 1 legs, which are at gate g at the knots places (R, G).

    They move slowly at both ends, and rest at the last from knot `stages` (R,) on, which need not be whole.
    """
    legs = places.shape[1] + 1
    along = torch.cat((torch.zeros_like(path[:, :1, 0]), path.diff(dim=1).norm(dim=-1).cumsum(-1)), dim=1)
    corners = path.shape[1] // legs
    reached = torch.cat((torch.zeros_like(along[:, :1]), along[:, corners - 1 :: corners]), dim=1)  # (R, G+2)
    knots = torch.cat((torch.zeros_like(places[:, :1]), places, stages.unsqueeze(-1)), dim=1).to(path)
    k = torch.arange(N + 1, dtype=path.dtype, device=path.device).expand(len(path), -1)
    knots, k = (
        share.square() * (3.0 - 2.0 * share) for share in ((t / knots[:, -1:]).clamp(max=1.0) for t in (knots, k))
    )
    right = torch.searchsorted(knots.contiguous(), k.contiguous(), right=True).clamp(1, legs)
    first, last = knots.gather(1, right - 1), knots.gather(1, right)
    share = ((k - first) / (last - first).clamp(min=1e-12)).clamp(0.0, 1.0)
    return points_along(path, torch.lerp(reached.gather(1, right - 1), reached.gather(1, right), share))
