"""The search of the roadmap in PyTorch: every distance of every edge, and Bellman and Ford's algorithm on all at once.

It returns the paths of c/cheapest.c, even where several cost the same.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import reduce
from unittest.mock import patch

import torch
from torch import Tensor

from torchgco.base.tree import take
from torchgco.obstacles.base import TINY, Solids
from torchgco.obstacles.box_geometry import Cuboids, at_share, excess, nearest
from torchgco.roadmap import cheapest, points
from torchgco.roadmap.cheapest import Beside, Graph
from torchgco.roadmap.geometry import Inflated
from torchgco.roadmap.points import directions, of_boxes

CLASS = 8  # paths are drawn taut in groups: those of up to 8 edges, of up to 16, ...


@dataclass(frozen=True)
class TorchSearch:
    """Graphs between obstacles and the cheapest paths over them, B problems.

    Args:
        obstacles: spheres and boxes.
        margin: distance from an obstacle, as a share of the largest size, below which an edge costs more.
    """

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
        low, high = (end.unsqueeze(1) for end in self.obstacles.region(start, goal))
        given = torch.cat((torch.stack((start, goal), dim=1), low + cube * (high - low)), dim=1)
        kept, taken = self._beside(start, goal, nodes, beside)
        points, free = torch.cat((given, kept), dim=1), torch.cat((self._is_free(given), taken), dim=1)
        free[:, :2] = True
        apart = squares(points, points).masked_fill(~free.unsqueeze(1), torch.inf)
        apart.diagonal(dim1=1, dim2=2).fill_(torch.inf)
        near = _lowest(apart, neighbours), _lowest(apart[..., : 2 + len(cube)], hubs)
        ends = torch.cat((*near, torch.ones_like(near[0][..., :1])), dim=-1)  # point 1 is the goal
        joined = free.unsqueeze(-1) & torch.isfinite(apart.gather(2, ends))
        joined[..., -1] = free
        return Graph(points, ends, torch.where(joined, self._lengths(points, ends), torch.inf))

    def cheapest(self, graph: Graph, price: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The cheapest paths from point 0 to point 1, by Bellman and Ford's algorithm on all edges at once.

        Args:
            price: cost per metre at the points, (B, V).

        Returns:
            Corners (B, HOPS+1, d), the goal repeated at their ends; the straight line where no path has at most HOPS
            edges. Points (B, 2 HOPS + 1, d): start, goal, then in turn the middles of the edges and the other corners.
            Whether there is a path (B,).
        """
        points, ends, lengths = graph
        edges = lengths * 0.5 * (price.unsqueeze(-1) + _rows(price, ends))
        edges = torch.where(edges < torch.inf, edges, torch.inf)  # a price of NaN removes the edge
        cost = torch.full_like(price, torch.inf)
        cost[:, 1] = 0.0
        through = edges + _rows(cost, ends)
        for _ in range(cheapest.HOPS):
            before, cost = cost, torch.minimum(cost, through.amin(-1))
            if torch.equal(before, cost):
                break  # further rounds would change nothing
            through = edges + _rows(cost, ends)
        best = through.amin(-1, keepdim=True)
        first = (through <= best + cheapest.TIE * best.abs()).to(torch.uint8).argmax(-1, keepdim=True)
        following = ends.gather(2, first).squeeze(-1)
        following[:, 1] = 1
        stops = [torch.zeros_like(following[:, :1])]
        for _ in range(cheapest.HOPS):
            stops.append(following.gather(1, stops[-1]))
        arrives = torch.isfinite(cost[:, 0]) & (stops[-1][:, 0] == 1)
        straight = torch.ones_like(stops[0]).expand(-1, cheapest.HOPS + 1).clone()
        straight[:, 0] = 0
        path = _rows(points, torch.where(arrives.unsqueeze(-1), torch.cat(stops, dim=1), straight))
        between = torch.stack((0.5 * (path[:, :-1] + path[:, 1:]), path[:, 1:]), dim=2).flatten(1, 2)
        return path, torch.cat((path[:, :1], path[:, -1:], between[:, :-1]), dim=1), arrives

    def taut(self, path: Tensor, string: Tensor, price: Tensor) -> Tensor:
        """The cheapest path over a path's own corners and the points between them, all joined: a taut string.

        Args:
            path: corners (B, HOPS+1, d).
            string: the points that `cheapest` returned with it, (B, 2 HOPS + 1, d).
            price: cost per metre at the points of `string`, (B, 2 HOPS + 1).
        """
        # All corners are joined to all, and paths grouped by length: short paths shouldn't pay for rare long ones.
        edges = (path != path[:, -1:]).any(-1).sum(-1)
        taut = path.clone()
        for most in range(CLASS, cheapest.HOPS + 1, CLASS):
            part = ((edges > most - CLASS) & (edges <= most)).nonzero().flatten()
            if part.numel() > 0:
                search = replace(self, obstacles=take(self.obstacles, part))
                points = string[part, : 2 * most + 1]
                everyone = torch.arange(2 * most + 1, device=path.device).expand(*points.shape[:2], -1)
                graph = Graph(points, everyone, search._lengths(points, everyone))
                shorter, _, arrives = search.cheapest(graph, price[part, : 2 * most + 1])
                taut[part] = torch.where(arrives.view(-1, 1, 1), shorter, path[part])
        return taut

    def raised(self, price: Tensor, points: Tensor, path: Tensor, factor: float) -> Tensor:
        """Prices (B, V) times a factor at points that are nearer to a path than the largest radius."""
        apart = squares_from_segments(points, path[:, :-1], path[:, 1:]).amin(1)
        return torch.where(apart < _signed_square(self.obstacles.largest), factor * price, price)

    def _beside(self, start: Tensor, goal: Tensor, nodes: int, beside: Beside) -> tuple[Tensor, Tensor]:
        """Free points around the obstacles and between them (B, nodes, d), and which places are taken (B, nodes)."""
        spheres, boxes, _ = self.obstacles
        parts = [around_spheres(spheres, start, goal), between_spheres(spheres)]
        if boxes is not None:
            parts.append(beside or of_boxes(boxes, spheres, start, goal))
        points, exists = (torch.cat(part, dim=1) for part in zip(*parts, strict=True))
        detour = squares(points, torch.stack((start, goal), dim=1)).sqrt_().sum(-1)
        detour = torch.where(exists & self._is_free(points), detour, torch.inf).to(torch.float32)
        best = _lowest(detour, nodes)
        taken = torch.isfinite(detour.gather(1, best))
        return torch.where(taken.unsqueeze(-1), _rows(points, best), start.unsqueeze(1)), taken

    def _is_free(self, points: Tensor) -> Tensor:
        """Whether points (B, V, d) are clear of all obstacles by LEAST_GAP times the largest size."""
        gap = cheapest.LEAST_GAP * self.obstacles.largest
        return torch.stack([_outside(part, _squares(part, points), gap) for part in self.obstacles.kinds]).all(0)

    def _lengths(self, points: Tensor, ends: Tensor) -> Tensor:
        """Lengths (B, V, K) of the edges to the points `ends`, raised close to an obstacle, infinite through one."""
        a = points.unsqueeze(2).expand(-1, -1, ends.shape[2], -1).flatten(1, 2)
        b = _rows(points, ends.flatten(1))
        free, gap = torch.ones_like(ends, dtype=torch.bool), torch.full_like(a[..., 0], torch.inf).view(ends.shape)
        for part in self.obstacles.kinds:
            away = _squares_from_segments(part, a, b)
            free = free & _outside(part, away).view(ends.shape)
            left = away.sqrt_().sub_(part.radii.unsqueeze(1)).masked_fill_(part.absent.unsqueeze(1), torch.inf)
            gap = torch.minimum(gap, left.amin(-1).view(ends.shape))
        length = (b - a).square().sum(-1).sqrt().view(ends.shape)
        # Every edge costs something: otherwise paths could circle among points that coincide.
        length = length + cheapest.EDGE_COST * (points[:, 1] - points[:, 0]).square().sum(-1).sqrt().view(-1, 1, 1)
        margin = self.margin * self.obstacles.largest.clamp(min=cheapest.UNIT).view(-1, 1, 1)
        close = 1.0 + ((margin - gap) / margin).clamp(0.0, 1.0)
        return torch.where(free, length * close, torch.inf)


@contextmanager
def searched_by_torch() -> Iterator[None]:
    """Within, roadmaps search by PyTorch."""
    with patch("torchgco.roadmap.roadmap.GraphSearch", lambda library, *words: TorchSearch(*words)):
        yield


def _lowest(values: Tensor, count: int) -> Tensor:
    """Indices (..., count) of the lowest values in ascending order; of equal values the first."""
    return values.sort(dim=-1, stable=True).indices[..., :count]


def _rows(values: Tensor, index: Tensor) -> Tensor:
    """values[b, index[b, ...]] for values (B, V) or (B, V, d)."""
    flat = index.flatten(1)
    if values.dim() == 2:
        return values.gather(1, flat).view(index.shape)
    return values.gather(1, flat.unsqueeze(-1).expand(-1, -1, values.shape[-1])).view(*index.shape, values.shape[-1])


def _outside(part: Solids, away: Tensor, gap: Tensor | float = 0.0) -> Tensor:
    """Whether squared distances (B, V, M) from solids are over their radii and a gap (B, 1), of all of them (B, V)."""
    return ((away > _signed_square(part.radii + gap).unsqueeze(1)) | part.absent.unsqueeze(1)).all(-1)


def _signed_square(x: Tensor) -> Tensor:
    """x |x|: a distance is below x where its square is below this, also for negative x."""
    return x * x.abs()


def around_spheres(spheres: Solids, start: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
    """Points (B, C, d) on circles around each sphere, and whether the sphere is present (B, C)."""
    rays, shells = directions(start, goal).unsqueeze(1), points.SHELLS[start.shape[1]]
    o, R = spheres.centers.unsqueeze(2), spheres.radii
    around = [(o + (shell * R)[..., None, None] * rays).flatten(1, 2) for shell in shells]
    return torch.cat(around, dim=1), (~spheres.absent).repeat_interleave(points.CIRCLE, dim=1).repeat(1, len(shells))


def between_spheres(spheres: Solids) -> tuple[Tensor, Tensor]:
    """The middles (B, C, d) of the gaps between spheres and their nearest, and whether both are present (B, C)."""
    M, o, R = spheres.radii.shape[1], spheres.centers, spheres.radii
    ends = o.unsqueeze(2).expand(-1, -1, M, -1), o.unsqueeze(1).expand(-1, M, -1, -1)
    return points._middles(*ends, R.unsqueeze(2), R.unsqueeze(1), points._pairs(spheres))


def squares(a: Tensor, b: Tensor) -> Tensor:
    """|a_i - b_j|^2 (B, V, W) of points (B, V, d), (B, W, d)."""
    return (a.unsqueeze(2) - b.unsqueeze(1)).square().sum(-1)


def _squares(part: Solids, p: Tensor) -> Tensor:
    """Squared distances (B, V, M) of points (B, V, d) from solids before they are grown; 0 inside."""
    if not isinstance(part, Cuboids):
        return squares(p, part.centers)
    return sum(x * x for x in excess(part.seen_from(p), part.halves()))


def _squares_from_segments(part: Solids, a: Tensor, b: Tensor) -> Tensor:
    """Smallest squared distances (B, E, M) of the segments from a to b (B, E, d); 0 for those that enter."""
    if not isinstance(part, Cuboids):
        return squares_from_segments(part.centers, a, b)
    begin, half = part.seen_from(a), part.halves()
    along = part.local([(b - a)[..., None, j] for j in range(a.shape[-1])])
    return sum(x * x for x in excess(at_share(begin, along, nearest(begin, along, half)), half))


def squares_from_segments(points: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Squared distances (B, E, V) of points (B, V, d) from segments a to b (B, E, d)."""
    along = b - a
    inverse = 1.0 / along.square().sum(-1, keepdim=True).clamp(min=TINY)
    # Coordinate by coordinate and in place: these are the largest arrays of the search.
    axes = [(along[..., i, None], points[:, None, :, i] - a[..., i, None]) for i in range(a.shape[-1])]
    share = reduce(torch.add, (toward * step for step, toward in axes)).mul_(inverse).clamp_(0.0, 1.0)
    return reduce(torch.add, (toward.sub_(share * step).square_() for step, toward in axes))
