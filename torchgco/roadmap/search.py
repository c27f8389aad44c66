"""The search of the roadmap in PyTorch: the counterpart of c/paths.c for every device and precision.

Both return the same paths, even where several cost the same. Ties are broken by the lowest index, and no comparison
depends on rounding: sums have a fixed order (there is no matrix product), clearance and nearness are compared as
squares (PyTorch's square roots are not always correctly rounded), and detours and costs that differ by rounding alone
are equal.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.obstacles.box_geometry import Cuboids
from torchgco.roadmap.geometry import squares, squares_from_segments
from torchgco.roadmap.native import CLEAR, HOPS, LEAST, MIDWAY, RAYS, SHELLS, TIE, Graph, around_boxes, directions

CLASS = 8  # paths are drawn taut in groups: those of up to 8 edges, of up to 16, ...


@dataclass(frozen=True)
class Search:
    """Graphs between spheres and the cheapest paths over them, B problems.

    Args:
        o: centres (B, M, d), m.
        R: radii (B, M), m; negative where there is no sphere.
        margin: distance from a sphere, as a share of the largest radius, below which an edge costs more.
        boxes: further obstacles.
    """

    o: Tensor
    R: Tensor
    margin: float
    boxes: Cuboids | None = None

    @property
    def largest(self) -> Tensor:
        """The largest radius, or size of a box, (B, 1)."""
        return (self.R if self.boxes is None else torch.cat((self.R, self.boxes.sizes), dim=1)).amax(-1, keepdim=True)

    def graph(self, start: Tensor, goal: Tensor, cube: Tensor, nodes: int, neighbours: int, hubs: int) -> Graph:
        """Points, each joined to its nearest of all points, its nearest of the spread points, and the goal.

        Args:
            start, goal: points 0 and 1, (B, d).
            cube: points (spread, d) in the unit cube, spread over the box that start, goal and spheres fill.
            nodes: number of free points around spheres that are added, those of the shortest detours. Unused places
                lie at the start, without edges.
            neighbours, hubs: edges of a point to its nearest of all points and of the spread points.
        """
        given = torch.cat((torch.stack((start, goal), dim=1), self._spread(start, goal, cube)), dim=1)
        kept, taken = self._beside(start, goal, nodes)
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
        for _ in range(HOPS):
            before, cost = cost, torch.minimum(cost, through.amin(-1))
            if torch.equal(before, cost):
                break  # further rounds would change nothing
            through = edges + _rows(cost, ends)
        best = through.amin(-1, keepdim=True)
        first = (through <= best + TIE * best.abs()).to(torch.uint8).argmax(-1, keepdim=True)
        following = ends.gather(2, first).squeeze(-1)
        following[:, 1] = 1
        stops = [torch.zeros_like(following[:, :1])]
        for _ in range(HOPS):
            stops.append(following.gather(1, stops[-1]))
        arrives = torch.isfinite(cost[:, 0]) & (stops[-1][:, 0] == 1)
        straight = torch.ones_like(stops[0]).expand(-1, HOPS + 1).clone()
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
        for most in range(CLASS, HOPS + 1, CLASS):
            part = ((edges > most - CLASS) & (edges <= most)).nonzero().flatten()
            if part.numel() > 0:
                boxes = None if self.boxes is None else self.boxes.rows(part)
                search, points = Search(self.o[part], self.R[part], self.margin, boxes), string[part, : 2 * most + 1]
                everyone = torch.arange(2 * most + 1, device=path.device).expand(*points.shape[:2], -1)
                graph = Graph(points, everyone, search._lengths(points, everyone))
                shorter, _, arrives = search.cheapest(graph, price[part, : 2 * most + 1])
                taut[part] = torch.where(arrives.view(-1, 1, 1), shorter, path[part])
        return taut

    def raised(self, price: Tensor, points: Tensor, path: Tensor, factor: float) -> Tensor:
        """Prices (B, V) times a factor at points that are nearer to a path than the largest radius."""
        apart = squares_from_segments(points, path[:, :-1], path[:, 1:]).amin(1)
        return torch.where(apart < _signed_square(self.largest), factor * price, price)

    def _spread(self, start: Tensor, goal: Tensor, cube: Tensor) -> Tensor:
        """Points (B, spread, d) all over the box that start, goal and spheres fill."""
        reach, here = 1.5 * self.R.unsqueeze(-1), (self.R > 0).unsqueeze(-1)
        low, high = torch.minimum(start, goal), torch.maximum(start, goal)
        low = torch.minimum(low, torch.where(here, self.o - reach, low.unsqueeze(1)).amin(1)).unsqueeze(1)
        high = torch.maximum(high, torch.where(here, self.o + reach, high.unsqueeze(1)).amax(1)).unsqueeze(1)
        if self.boxes is not None:
            low, high = (end.unsqueeze(1) for end in self.boxes.reach(torch.cat((low, high), dim=1)))
        return low + cube * (high - low)

    def _beside(self, start: Tensor, goal: Tensor, nodes: int) -> tuple[Tensor, Tensor]:
        """Free points around the spheres and between them (B, nodes, d), and which places are taken (B, nodes)."""
        (around, first), (midway, second) = self._around(start, goal), self._midway()
        points, exists = torch.cat((around, midway), dim=1), torch.cat((first, second), dim=1)
        if self.boxes is not None:
            more, third = around_boxes(self.boxes, self.o, self.R, start, goal)
            points, exists = torch.cat((points, more), dim=1), torch.cat((exists, third), dim=1)
        detour = squares(points, torch.stack((start, goal), dim=1)).sqrt_().sum(-1)
        detour = torch.where(exists & self._is_free(points), detour, torch.inf).to(torch.float32)
        best = _lowest(detour, nodes)
        taken = torch.isfinite(detour.gather(1, best))
        return torch.where(taken.unsqueeze(-1), _rows(points, best), start.unsqueeze(1)), taken

    def _around(self, start: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Points (B, C, d) on circles around each sphere, and whether the sphere is present (B, C)."""
        rays = directions(start, goal).unsqueeze(1)
        shells = SHELLS[start.shape[1]]
        points = [(self.o.unsqueeze(2) + (s * self.R)[..., None, None] * rays).flatten(1, 2) for s in shells]
        return torch.cat(points, dim=1), (self.R > 0).repeat_interleave(RAYS, dim=1).repeat(1, len(shells))

    def _midway(self) -> tuple[Tensor, Tensor]:
        """The middles (B, C, d) of the gaps between spheres and their nearest, and whether both are present (B, C)."""
        o, R = self.o, self.R
        apart = squares(o, o).masked_fill(~((R > 0).unsqueeze(1) & (R > 0).unsqueeze(2)), torch.inf)
        apart.diagonal(dim1=1, dim2=2).fill_(torch.inf)
        near = _lowest(apart, MIDWAY)
        step = _rows(o, near) - o.unsqueeze(2)
        length = step.square().sum(-1).sqrt().clamp(min=1e-12)
        share = 0.5 + 0.5 * ((R.unsqueeze(-1) - _rows(R, near)) / length)
        points = (o.unsqueeze(2) + share.unsqueeze(-1) * step).flatten(1, 2)
        return points, torch.isfinite(apart.gather(2, near)).flatten(1)

    def _is_free(self, points: Tensor) -> Tensor:
        """Whether points (B, V, d) are clear of all spheres by CLEAR times the largest radius."""
        least = self.R + CLEAR * self.largest
        free = (squares(points, self.o) > _signed_square(least).unsqueeze(1)).all(-1)
        if self.boxes is None:
            return free
        least = self.boxes.radius + CLEAR * self.largest
        return free & (self.boxes.squares(points) > _signed_square(least).unsqueeze(1)).all(-1)

    def _lengths(self, points: Tensor, ends: Tensor) -> Tensor:
        """Lengths (B, V, K) of the edges to the points `ends`, raised close to an obstacle, infinite through one."""
        a = points.unsqueeze(2).expand(-1, -1, ends.shape[2], -1).flatten(1, 2)
        b = _rows(points, ends.flatten(1))
        away = squares_from_segments(self.o, a, b)
        free = (away > _signed_square(self.R).unsqueeze(1)).all(-1).view(ends.shape)
        gap = away.sqrt_().sub_(self.R.unsqueeze(1)).amin(-1).view(ends.shape)
        if self.boxes is not None:
            away = self.boxes.squares_from_segments(a, b)
            free = free & (away > _signed_square(self.boxes.radius).unsqueeze(1)).all(-1).view(ends.shape)
            gap = torch.minimum(gap, away.sqrt_().sub_(self.boxes.radius.unsqueeze(1)).amin(-1).view(ends.shape))
        length = (b - a).square().sum(-1).sqrt().view(ends.shape)
        # Every edge costs something: otherwise paths could circle among points that coincide.
        length = length + LEAST * (points[:, 1] - points[:, 0]).square().sum(-1).sqrt().view(-1, 1, 1)
        margin = self.margin * self.largest.clamp(min=1e-9).view(-1, 1, 1)
        close = 1.0 + ((margin - gap) / margin).clamp(0.0, 1.0)
        return torch.where(free, length * close, torch.inf)


def _lowest(values: Tensor, count: int) -> Tensor:
    """Indices (..., count) of the lowest values in ascending order; of equal values the first."""
    return values.sort(dim=-1, stable=True).indices[..., :count]


def _rows(values: Tensor, index: Tensor) -> Tensor:
    """values[b, index[b, ...]] for values (B, V) or (B, V, d)."""
    flat = index.flatten(1)
    if values.dim() == 2:
        return values.gather(1, flat).view(index.shape)
    return values.gather(1, flat.unsqueeze(-1).expand(-1, -1, values.shape[-1])).view(*index.shape, values.shape[-1])


def _signed_square(x: Tensor) -> Tensor:
    """x |x|: a distance is below x where its square is below this, also for negative x."""
    return x * x.abs()
