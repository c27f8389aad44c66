"""Short paths between spheres and boxes over a graph of points: geometry alone, without time or controls.

Points lie around every obstacle, midway between neighbours and, in a fixed low-discrepancy sequence, all over the
scene; each is joined to a few near ones where the straight line is free. Nothing is random. The search runs in C
(native/roadmap_paths.c) or, where that can't serve, in PyTorch (search/graph.py), with the same result.
"""

from __future__ import annotations

from ctypes import CDLL
from dataclasses import dataclass
from functools import cache
from typing import Annotated

import torch
from torch import Tensor

from torchgco.native import roadmap
from torchgco.native.roadmap import Graph, NativeSearch
from torchgco.options import AtLeast, Below, check_options
from torchgco.search.geometry import Scene
from torchgco.search.graph import Search

AT_ONCE = 4  # problems that PyTorch searches together: memory holds the distances of all edges from all obstacles
NODES = 128  # points around obstacles: those of the shortest detours
# Points of a second search, where there is no path between more than NODES obstacles: a wall that is given as a row of
# discs takes all places of the first search, before its ends get any.
MANY_NODES = 2048
NEIGHBOURS, HALTON_NEIGHBOURS = 12, 6  # edges of a point to its nearest of all points and of the Halton points
MARGIN = 0.15  # distance from an obstacle, in largest inflated radii, below which an edge costs up to double
DIVERSITY = 1.0  # extra cost of later paths, as a share, within the largest inflated radius of an earlier path
PRIMES = (2, 3, 5)  # bases of the low-discrepancy sequence


@dataclass(frozen=True)
class Roadmap:
    """A graph of points around obstacles, and the cheapest paths over it.

    Args:
        num_halton: points of a Halton sequence all over the scene, added to `NODES` points around the obstacles.
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
        library = roadmap.library_for(scene.centers, scene.boxes is not None)
        most = AT_ONCE if library is None else roadmap.AT_ONCE
        B = scene.start.shape[0]
        parts = [self._paths(scene, slice(i, i + most), count, library) for i in range(0, max(B, 1), most)]
        return torch.cat([path for path, _ in parts]), torch.cat([found for _, found in parts])

    def _paths(self, scene: Scene, rows: slice, count: int, library: CDLL | None) -> tuple[Tensor, Tensor]:
        start, goal, o, R = (t[rows] for t in (scene.start, scene.goal, scene.centers, scene.inflated_radii))
        R = torch.where(R > 0, (1.0 - self.max_overlap) * R, R)
        boxes = None if scene.boxes is None else scene.boxes.rows(rows).cut(self.max_overlap)
        search = Search(o, R, MARGIN, boxes) if library is None else NativeSearch(library, o, R, MARGIN, boxes)
        cube = halton(self.num_halton, o.shape[-1]).to(o)

        def cheapest(nodes: int) -> tuple[Tensor, Tensor]:
            graph = search.graph(start, goal, cube, nodes, NEIGHBOURS, HALTON_NEIGHBOURS)
            return self._cheapest(search, graph, scene, rows, count)

        paths, found = cheapest(NODES)
        again = ~found & ((R > 0).sum(-1) > NODES)
        if bool(again.any()):
            more, arrives = cheapest(MANY_NODES)
            paths, found = torch.where(again.view(-1, 1, 1, 1), more, paths), torch.where(again, arrives, found)
        return paths, found

    def _cheapest(
        self, search: Search | NativeSearch, graph: Graph, scene: Scene, rows: slice, count: int
    ) -> tuple[Tensor, Tensor]:
        """Paths (B', count, HOPS+1, d) over a graph of the problems in `rows`, and where there are any (B',)."""
        price = scene.traversal_cost(graph.points, rows)
        paths, found = [], torch.ones(graph.points.shape[0], dtype=torch.bool, device=graph.points.device)
        for _ in range(count):
            path, string, arrives = search.cheapest(graph, price)
            found = found & arrives
            path = search.taut(path, string, scene.traversal_cost(string, rows))
            paths.append(path)
            price = search.raised(price, graph.points, path, 1.0 + DIVERSITY)
        return torch.stack(paths, dim=1), found


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
