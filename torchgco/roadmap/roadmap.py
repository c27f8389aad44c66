"""Short paths between spheres and boxes over a graph of points: geometry alone, without time or controls.

Points lie around every obstacle, midway between neighbours and, in a fixed low-discrepancy sequence, all over the
scene; each is joined to a few near ones where the straight line is free. Nothing is random. C searches (c/cheapest.c),
in double precision on the CPU wherever the problems lie; without a compiler no paths are found.
"""

from __future__ import annotations

from ctypes import CDLL
from dataclasses import dataclass
from functools import cache
from typing import Annotated

import torch
from torch import Tensor

from torchgco.base.options import AtLeast, Below, check_options
from torchgco.base.shapes import CPU, computing_on
from torchgco.base.tree import take
from torchgco.roadmap import cheapest
from torchgco.roadmap.cheapest import DIVERSITY, HOPS, GraphSearch
from torchgco.roadmap.geometry import Scene, length
from torchgco.roadmap.known import Course, Known
from torchgco.roadmap.mapped import paths_in_maps

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
