"""Short paths between spheres and boxes over a graph of points: geometry alone, without time or controls.

Points lie around every obstacle, midway between neighbours and, in a fixed low-discrepancy sequence, all over the
scene; each is joined to a few near ones where the straight line is free. Nothing is random. The search runs in C
(c/search.c) or, where that can't serve, in PyTorch (search.py), with the same result.
"""

from __future__ import annotations

from ctypes import CDLL
from dataclasses import dataclass
from functools import cache
from typing import Annotated

import torch
from torch import Tensor

from torchgco.base.options import AtLeast, Below, check_options
from torchgco.base.tree import take
from torchgco.roadmap import native as roadmap
from torchgco.roadmap.geometry import Scene, length
from torchgco.roadmap.mapped import paths_in_maps
from torchgco.roadmap.native import NativeSearch
from torchgco.roadmap.search import TorchSearch

PROBLEMS_AT_ONCE = 4  # problems searched together by PyTorch: memory holds distances of all edges from all obstacles
NODES = 128  # points around obstacles: those of the shortest detours
# A second search has more points, where the first had no places for all of them and found no path, or only a long one
# (in distances from start to goal): the points next to the straight line take all places, before any lies in the gaps
# that lead through a wood or at the ends of a wall.
MANY_NODES = 1024
LONG = 1.25
MANY_NEIGHBOURS = 96  # in the second search: two doors of a maze lie farther apart than the points around each
NEIGHBOURS, HALTON_NEIGHBOURS = 12, 6  # edges of a point to its nearest of all points and of the Halton points
MARGIN = 0.15  # distance from an obstacle, in largest inflated radii, below which an edge costs up to double
DIVERSITY = 1.0  # extra cost of later paths, as a share, within the largest inflated radius of an earlier path
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

    def paths(self, scene: Scene, count: int = 1) -> tuple[Tensor, Tensor]:
        """Different paths, the cheapest first; each further one avoids those before it unless that costs too much.

        Returns:
            Corners (B, count, HOPS+1, d), m, the goal repeated at their ends, or the straight line where there is no
            path; and whether there is a path (B,).
        """
        if scene.obstacles.maps:
            return paths_in_maps(scene, count, self.max_overlap)
        library = roadmap.library_for(scene.start, scene.obstacles.boxes is not None)
        most = PROBLEMS_AT_ONCE if library is None else roadmap.PROBLEMS_AT_ONCE
        everyone = torch.arange(scene.start.shape[0], device=scene.start.device)
        parts = [self._paths(scene, rows, count, library) for rows in everyone.split(most)]
        return torch.cat([path for path, _ in parts]), torch.cat([found for _, found in parts])

    def repeats(self, other: Roadmap, scene: Scene) -> bool:
        """Whether another search finds the same paths: those among maps need no points all over the scene."""
        return bool(scene.obstacles.maps) and self.max_overlap == other.max_overlap

    def _paths(self, scene: Scene, rows: Tensor, count: int, library: CDLL | None) -> tuple[Tensor, Tensor]:
        """Paths of the problems in `rows`; see `paths`."""
        paths, found, is_full = self._search(scene, rows, count, library, NODES, NEIGHBOURS)
        straight = length(torch.stack((scene.start[rows], scene.goal[rows]), dim=1))
        again = (~found | (length(paths[:, 0]) > LONG * straight)).nonzero().flatten()
        if is_full and again.numel() > 0:
            more, arrives, _ = self._search(scene, rows[again], count, library, MANY_NODES, MANY_NEIGHBOURS)
            paths[again[arrives]], found[again[arrives]] = more[arrives], True
        return paths, found

    def _search(
        self, scene: Scene, rows: Tensor, count: int, library: CDLL | None, nodes: int, neighbours: int
    ) -> tuple[Tensor, Tensor, bool]:
        """Paths (B', count, HOPS+1, d) over a graph of the problems in `rows`, where there are any (B'), and whether
        there were as many points around obstacles as the graph takes."""
        start, goal = scene.start[rows], scene.goal[rows]
        obstacles = take(scene.obstacles, rows).reduced(self.max_overlap)
        search = TorchSearch(obstacles, MARGIN) if library is None else NativeSearch(library, obstacles, MARGIN)
        cube = halton(self.num_halton, start.shape[-1]).to(start)
        graph = search.graph(start, goal, cube, nodes, neighbours, HALTON_NEIGHBOURS)
        price = scene.traversal_cost(graph.points, rows)
        paths: list[Tensor] = []
        for _ in range(count):
            path, string, arrives = search.cheapest(graph, price)
            path = search.taut(path, string, scene.traversal_cost(string, rows))
            if not paths:
                found = arrives
            else:  # a later path may have too many edges: the first stands in for it
                path = torch.where(arrives.view(-1, 1, 1), path, paths[0])
            paths.append(path)
            price = search.raised(price, graph.points, path, 1.0 + DIVERSITY)
        return torch.stack(paths, dim=1), found, graph.points.shape[1] == 2 + len(cube) + nodes


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
