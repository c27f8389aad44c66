"""The search of the roadmap in C (c/cheapest.c): each step is one call for all problems of a batch.

Of paths that cost the same the first is taken, whatever compiler made the library: ties are broken by the lowest index,
and no comparison depends on rounding. Sums have a fixed order, clearance and nearness are compared as squares, and
detours and costs that differ by rounding alone are equal.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from torchgco.native.declarations import Header, Structure
from torchgco.native.engine import run
from torchgco.obstacles.base import TINY, marked
from torchgco.obstacles.box_geometry import Cuboids
from torchgco.roadmap.geometry import Inflated
from torchgco.roadmap.native_maps import C, library_of
from torchgco.roadmap.points import CIRCLE, MIDWAY, SHELLS, directions, of_boxes

HOPS = 64  # edges of a path, at most
DIVERSITY = 1.0  # extra cost of later paths, as a share, next to an earlier one
LEAST_GAP = 0.001  # smallest gap between a point and all obstacles, as a share of the largest r_obs + r_veh
TIE = 1e-12  # share of the cost by which equally cheap paths may differ
EDGE_COST = 1e-6  # share of the distance from start to goal that is added to every edge: no edge may cost nothing
UNIT = 1e-9  # m: the margin's unit is at least this
SEARCHES_AT_ONCE = 64  # problems searched together
GROUP = 4  # of them, at least so many by each thread
BLOCK, EDGES_AT_ONCE = 32, 8  # edges measured side by side; of those near a box, so many at once

Beside: TypeAlias = tuple[Tensor, Tensor] | None  # points around boxes (B, C, d), and whether each exists (B, C)


class Graph(NamedTuple):
    """Points and the edges that lead from each to some others."""

    points: Tensor  # (B, V, d): start, goal and others; m
    ends: Tensor  # (B, V, K): the points at which edges end
    lengths: Tensor  # (B, V, K), m: infinite where there is no edge


class Arguments(Structure): ...


SEARCH_HEADER = Header((C / "cheapest.h").read_text())
SEARCH_HEADER.declare(Arguments)


@dataclass(frozen=True)
class GraphSearch:
    """Graphs between obstacles and the cheapest paths over them, B problems on the CPU in float64.

    Args:
        library: of `library_for`.
        obstacles: spheres and boxes.
        margin: distance from an obstacle, as a share of the largest size, below which an edge costs more.
    """

    library: ctypes.CDLL
    obstacles: Inflated
    margin: float

    def graph(
        self, start: Tensor, goal: Tensor, cube: Tensor, nodes: int, neighbours: int, hubs: int, beside: Beside = None
    ) -> Graph:
        """Points, each joined to its nearest of all points, its nearest of the spread points, and the goal.

        Args:
            start, goal: points 0 and 1, (B, d).
            cube: points (spread, d) in the unit cube, spread over the box that start, goal and obstacles fill.
            nodes: number of free points around obstacles that are added, those of the shortest detours. Unused places
                lie at the start, without edges.
            neighbours, hubs: edges of a point to its nearest of all points and of the spread points.
            beside: `points.of_boxes`, where it is known.
        """
        (B, d), (spheres, boxes, _) = start.shape, self.obstacles
        M = spheres.radii.shape[1]
        rays, shell = directions(start, goal), start.new_tensor(SHELLS[d])
        count, more = M * (CIRCLE * len(shell) + min(MIDWAY, M)), {}
        reach = torch.stack(self.obstacles.region(start, goal), dim=1)
        if boxes is not None:
            more["beside"], more["exists"] = beside or of_boxes(boxes, spheres, start, goal)
            count += more["beside"].shape[1]
        V, K = 2 + len(cube) + min(nodes, count), neighbours + hubs + 1
        made = Graph(start.new_empty(B, V, d), torch.empty(B, V, K, dtype=torch.int32), start.new_empty(B, V, K))
        self._run(
            "tgco_graph",
            {"start": start, "goal": goal, "reach": reach, "cube": cube, "rays": rays, "shell": shell, **more},
            {"nodes": made.points, "ends": made.ends, "lengths": made.lengths},
            spread=len(cube), candidates=count, points=V, edges=K, neighbours=neighbours, hubs=hubs, directions=CIRCLE,
            shells=len(shell), midway=MIDWAY, extras=more["beside"].shape[1] if more else 0,
        )  # fmt: skip
        return made

    def cheapest(self, graph: Graph, price: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The cheapest paths from point 0 to point 1, by Bellman and Ford's algorithm on all edges at once.

        Args:
            price: cost per metre at the points, (B, V).

        Returns:
            Corners (B, HOPS+1, d), the goal repeated at their ends; the straight line where no path has at most HOPS
            edges. Points (B, 2 HOPS + 1, d): start, goal, then in turn the middles of the edges and the other corners.
            Whether there is a path (B,).
        """
        (B, V, K), p, P = graph.ends.shape, graph.points, HOPS + 1
        path, string = p.new_empty(B, P, p.shape[2]), p.new_empty(B, 2 * P - 1, p.shape[2])
        arrives, ends = torch.zeros(B, dtype=torch.bool), graph.ends.to(torch.int32)
        self._run(
            "tgco_cheapest",
            {"nodes": graph.points, "ends": ends, "lengths": graph.lengths, "price": price.to(p).expand(B, V)},
            {"path": path, "string": string, "arrives": arrives}, points=V, edges=K,
        )  # fmt: skip
        return path, string, arrives

    def taut(self, path: Tensor, string: Tensor, price: Tensor) -> Tensor:
        """The cheapest path over a path's own corners and the points between them, all joined: a taut string.

        Args:
            path: corners (B, HOPS+1, d).
            string: the points that `cheapest` returned with it, (B, 2 HOPS + 1, d).
            price: cost per metre at the points of `string`, (B, 2 HOPS + 1).
        """
        tight = path.clone()
        self._run("tgco_taut", {"string": string, "cost": price.to(path).expand(string.shape[:2])}, {"path": tight})
        return tight

    def raised(self, price: Tensor, points: Tensor, path: Tensor, factor: float) -> Tensor:
        """Prices (B, V) times a factor at points that are nearer to a path than the largest radius."""
        price = price.to(points).expand(points.shape[:2]).clone(memory_format=torch.contiguous_format)
        self._run("tgco_raise", {"nodes": points, "path": path}, {"price": price}, points=price.shape[1], factor=factor)
        return price

    def _run(self, name: str, read: dict[str, Tensor], written: dict[str, Tensor], **numbers: float) -> None:
        """Call a function of the library on all problems, by as many threads as PyTorch uses."""
        contiguous = {field: tensor.contiguous() for field, tensor in read.items()}
        arguments = self._shared.fill({**contiguous, **written, **numbers}, copied=True)
        run(getattr(self.library, name), self.obstacles.spheres.radii.shape[0], GROUP, arguments)

    @cached_property
    def _shared(self) -> Arguments:
        """The arguments of all calls: the obstacles, and constants."""
        spheres, boxes, _ = self.obstacles
        M, more = spheres.radii.shape[1], {}
        if boxes is not None:
            more = {"boxes": boxes.radii.shape[1], "box": _numbers(boxes), "largest": boxes.sizes.amax(-1).contiguous()}
        return Arguments(
            spheres=M, corners=HOPS + 1, margin=self.margin, clear=LEAST_GAP, least=EDGE_COST, tie=TIE,
            centers=spheres.centers.contiguous(), distances=marked(spheres.radii, spheres.absent).contiguous(), **more,
        )  # fmt: skip


def _numbers(boxes: Cuboids) -> Tensor:
    """The numbers that C reads per box, (B, K, ...): centre, directions of its sides, half their lengths, radius."""
    parts = boxes.centers, boxes.axes.flatten(-2), boxes.half_sizes, marked(boxes.radii, boxes.absent).unsqueeze(-1)
    return torch.cat(parts, dim=-1)


def library_for(dimension: int, boxes: bool = False) -> ctypes.CDLL | None:
    """The library for spheres in space of this dimension, and boxes; None where there is none, see `library_of`."""
    # Without boxes their code is left out, so that it can't change how the spheres' code is compiled.
    constants = {
        "DIM": dimension, "BOXES": int(boxes), "TINY": TINY, "SMALL": UNIT, "BLOCK": BLOCK, "REAL": "double",
        "LANES": EDGES_AT_ONCE,
    }  # fmt: skip
    return library_of("cheapest.c", SEARCH_HEADER, constants, "no paths are sought")
