"""Shortest ways between spheres, over a graph of points: where to pass, not yet how to fly.

Points lie around every obstacle, midway between neighbours and, in a fixed low-discrepancy sequence, all over the
scene; each is joined to a few near ones where the straight line is free. Nothing is random. The search runs in C
(native/roadmap.c) or, where that can't serve, in PyTorch (guidance/search.py), and finds the same ways.
"""

from __future__ import annotations

from collections.abc import Callable
from ctypes import CDLL
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from torchgco.errors import InputError
from torchgco.guidance.search import Search
from torchgco.native import roadmap
from torchgco.native.roadmap import NativeSearch

AT_ONCE = 4  # problems that PyTorch searches together: memory holds the distances of all edges from all obstacles
PRIMES = (2, 3, 5)  # bases of the low-discrepancy sequence
FAR = -1e9  # the radius of an obstacle that isn't there


@dataclass(frozen=True)
class Scene:
    """What a way must lead through, B problems; m."""

    start: Tensor  # (B, d)
    goal: Tensor  # (B, d)
    centers: Tensor  # (B, M, d)
    distances: Tensor  # (B, M): r_obs + r_veh, FAR where absent
    toll: Callable[[Tensor, slice], Tensor]  # of points (B', V, d) of some problems: cost of a metre there, (B', V)


@dataclass(frozen=True)
class Roadmap:
    """How finely the ways are sought.

    Args:
        nodes: points beside obstacles that are kept: those of the shortest detours.
        spread: points all over the scene.
        neighbours, hubs: edges of a point, to the nearest of all and to the nearest of those spread.
        margin: distance from an obstacle, as a share of r_obs + r_veh, below which an edge costs more, up to double.
        slack: how deep a way may cut into an obstacle, as a share of r_obs + r_veh; below 0.05, which the judge bears
            between two knots. A gap that is closed by so little can be flown through.
        novelty: a further way pays so much more, as a share, where it is within r_obs + r_veh of a former one.

    Raises:
        InputError: a field out of its range.
    """

    nodes: int = 128
    spread: int = 64
    neighbours: int = 12
    hubs: int = 6
    margin: float = 0.15
    slack: float = 0.0
    novelty: float = 1.0

    def __post_init__(self) -> None:
        for name in ("nodes", "spread", "neighbours", "hubs"):
            if getattr(self, name) < 1:
                raise InputError(f"roadmap.{name}", "at least 1", getattr(self, name))
        if self.hubs > self.spread:
            raise InputError("roadmap.hubs", f"at most the {self.spread} points spread", self.hubs)
        if not self.margin > 0:
            raise InputError("roadmap.margin", "above 0", self.margin)
        if not 0 <= self.slack < 1:
            raise InputError("roadmap.slack", "at least 0 and below 1", self.slack)
        if not self.novelty >= 0:
            raise InputError("roadmap.novelty", "at least 0", self.novelty)

    def ways(self, scene: Scene, count: int = 1) -> tuple[Tensor, Tensor]:
        """Different ways, the cheapest first, the others each away from those before it where that isn't too dear.

        Returns:
            Corners (B, count, HOPS+1, d), the goal repeated at their ends; and whether there is a way (B,). Where there
            is none, the straight line.
        """
        library = roadmap.library_for(scene.centers)
        most = AT_ONCE if library is None else roadmap.AT_ONCE
        B = scene.start.shape[0]
        parts = [self._ways(scene, slice(i, i + most), count, library) for i in range(0, max(B, 1), most)]
        return torch.cat([way for way, _ in parts]), torch.cat([found for _, found in parts])

    def _ways(self, scene: Scene, rows: slice, count: int, library: CDLL | None) -> tuple[Tensor, Tensor]:
        start, goal, o, R = (t[rows] for t in (scene.start, scene.goal, scene.centers, scene.distances))
        R = torch.where(R > 0, (1.0 - self.slack) * R, R)
        search = Search(o, R, self.margin) if library is None else NativeSearch(library, o, R, self.margin)
        cube = halton(self.spread, o.shape[-1]).to(o)
        graph = search.graph(start, goal, cube, self.nodes, self.neighbours, self.hubs)
        price = scene.toll(graph.points, rows)
        ways, found = [], torch.ones_like(start[:, 0], dtype=torch.bool)
        for _ in range(count):
            way, string, arrives = search.cheapest(graph, price)
            found = found & arrives
            way = search.taut(way, string, scene.toll(string, rows))
            ways.append(way)
            price = search.raised(price, graph.points, way, 1.0 + self.novelty)
        return torch.stack(ways, dim=1), found


def points_along(way: Tensor, length: Tensor) -> Tensor:
    """Points (B, K, d) at arc lengths (B, K), m, of polylines (B, P, d)."""
    steps = (way[:, 1:] - way[:, :-1]).square().sum(-1).sqrt()
    reached = torch.cat((torch.zeros_like(steps[:, :1]), steps.cumsum(-1)), dim=1)
    right = torch.searchsorted(reached, length.contiguous(), right=True).clamp(1, way.shape[1] - 1)
    share = (length - reached.gather(1, right - 1)) / steps.gather(1, right - 1).clamp(min=1e-12)

    def corner(index: Tensor) -> Tensor:
        return way.gather(1, index.unsqueeze(-1).expand(-1, -1, way.shape[-1]))

    return torch.lerp(corner(right - 1), corner(right), share.clamp(0.0, 1.0).unsqueeze(-1))


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
