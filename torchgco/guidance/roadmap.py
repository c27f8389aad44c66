"""Shortest ways between spheres, over a graph of points: where to pass, not yet how to fly.

Points lie around every obstacle, midway between neighbours and, in a fixed low-discrepancy sequence, all over the
scene; each is joined to a few near ones where the straight line is free. Nothing is random, and all problems of a batch
are searched at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.shapes import InputError

AT_ONCE = 4  # problems searched together: the distances of all edges from all obstacles are what memory must hold
HOPS = 32  # edges of a way, at most
CLASS = 8  # ways are drawn taut together with those of as many eights of edges
NEIGHBOURS = 4  # obstacles whose gap to another is given a point
PRIMES = (2, 3, 5)  # bases of the low-discrepancy sequence
FAR = -1e9  # the radius of an obstacle that isn't there


@dataclass(frozen=True)
class Scene:
    """What a way must lead through, B problems; m."""

    start: Tensor  # (B, d)
    goal: Tensor  # (B, d)
    centers: Tensor  # (B, M, d)
    distances: Tensor  # (B, M): r_obs + r_veh, FAR where absent
    toll: Callable[[Tensor, Tensor], Tensor]  # of points (B', V, d) and problem rows (B',): cost of a metre there


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
            Corners (B, count, HOPS+1, d), the goal repeated at their ends; and whether there is a way (B,).
        """
        parts = [self._ways(scene, rows, count) for rows in torch.arange(scene.start.shape[0]).split(AT_ONCE)]
        return torch.cat([way for way, _ in parts]), torch.cat([found for _, found in parts])

    def _ways(self, scene: Scene, rows: Tensor, count: int) -> tuple[Tensor, Tensor]:
        rows = rows.to(scene.start.device)
        start, goal, o, R = (t[rows] for t in (scene.start, scene.goal, scene.centers, scene.distances))
        R = torch.where(R > 0, (1.0 - self.slack) * R, R)
        points, free = self._points(start, goal, o, R)
        apart = _distances(points, points).masked_fill(~free.unsqueeze(1), torch.inf)
        apart.diagonal(dim1=1, dim2=2).fill_(torch.inf)
        to_goal = torch.ones_like(apart[..., :1], dtype=torch.int64)
        near = (
            apart.topk(min(self.neighbours, apart.shape[2]), largest=False).indices,
            apart[..., : 2 + self.spread].topk(self.hubs, largest=False).indices,
        )
        near = torch.cat((*near, to_goal), dim=-1)
        price, lengths = scene.toll(points, rows), self._lengths(points, near, o, R)
        reach = R.amax(-1, keepdim=True)
        ways, found = [], torch.ones_like(rows, dtype=torch.bool)
        for _ in range(count):
            way, arrives = _cheapest(points, near, lengths, price)
            found = found & arrives
            way = self._taut(way, scene, rows, o, R)
            ways.append(way)
            price = torch.where(_apart_from(points, way) < reach, (1.0 + self.novelty) * price, price)
        return torch.stack(ways, dim=1), found

    def _taut(self, way: Tensor, scene: Scene, rows: Tensor, o: Tensor, R: Tensor) -> Tensor:
        """The same once more over a way's own corners and what lies between them, all joined: a taut string."""
        # All corners are joined to all: ways of few corners aren't to pay for the rare ones of many.
        edges = (way != way[:, -1:]).any(-1).sum(-1)
        taut = way.clone()
        for most in range(CLASS, HOPS + 1, CLASS):
            part = ((edges > most - CLASS) & (edges <= most)).nonzero().flatten()
            if part.numel() > 0:
                taut[part] = self._tightened(way[part, : most + 1], scene, rows[part], o[part], R[part])
        return taut

    def _tightened(self, way: Tensor, scene: Scene, rows: Tensor, o: Tensor, R: Tensor) -> Tensor:
        between = torch.stack((way[:, 1:-1], 0.5 * (way[:, 1:-1] + way[:, 2:])), dim=2).flatten(1, 2)
        middle = torch.cat((way[:, :1], way[:, -1:], 0.5 * (way[:, :1] + way[:, 1:2]), between), dim=1)
        everyone = torch.arange(middle.shape[1], device=o.device).expand(*middle.shape[:2], -1)
        lengths = self._lengths(middle, everyone, o, R)
        taut, arrives = _cheapest(middle, everyone, lengths, scene.toll(middle, rows))
        rest = way[:, -1:].expand(-1, HOPS + 1 - way.shape[1], -1)
        return torch.where(arrives.view(-1, 1, 1), taut, torch.cat((way, rest), dim=1))

    def _points(self, start: Tensor, goal: Tensor, o: Tensor, R: Tensor) -> tuple[Tensor, Tensor]:
        """Start, goal, spread and obstacle points (B, V, d), and which of them are free."""
        near = torch.cat((_around(start, goal, o, R), _midway(o, R)), dim=1)
        low, high = torch.minimum(start, goal), torch.maximum(start, goal)
        reach = 1.5 * R.clamp(min=0.0).unsqueeze(-1)
        here = (R > 0).unsqueeze(-1)
        low = torch.minimum(low, torch.where(here, o - reach, low.unsqueeze(1)).amin(1)).unsqueeze(1)
        high = torch.maximum(high, torch.where(here, o + reach, high.unsqueeze(1)).amax(1)).unsqueeze(1)
        spread = low + halton(self.spread, o.shape[-1]).to(o) * (high - low)
        detour = _distances(near, start.unsqueeze(1))[..., 0] + _distances(near, goal.unsqueeze(1))[..., 0]
        detour = detour.masked_fill(~_is_free(near, o, R), torch.inf)
        best = detour.topk(min(self.nodes, detour.shape[1]), largest=False)
        kept = near.gather(1, best.indices.unsqueeze(-1).expand(-1, -1, o.shape[-1]))
        ends = torch.stack((start, goal), dim=1)
        free = (torch.ones_like(ends[..., 0], dtype=torch.bool), _is_free(spread, o, R), torch.isfinite(best.values))
        return torch.cat((ends, spread, kept), dim=1), torch.cat(free, dim=1)

    def _lengths(self, points: Tensor, near: Tensor, o: Tensor, R: Tensor) -> Tensor:
        """Lengths (B, V, k) of the edges to the points `near`, more close to an obstacle, infinite through one."""
        B, V, k = near.shape
        a = points.unsqueeze(2).expand(-1, -1, k, -1).flatten(1, 2)
        b = points.gather(1, near.flatten(1).unsqueeze(-1).expand(-1, -1, points.shape[-1]))
        gap = segment_gaps(a, b, o, R).view(B, V, k)
        length = (b - a).square().sum(-1).sqrt().view(B, V, k)
        # No edge is free of charge: ways would turn in circles among points that coincide.
        length = length + 1e-6 * (points[:, 1] - points[:, 0]).square().sum(-1).sqrt().view(-1, 1, 1)
        margin = self.margin * R.amax(-1).clamp(min=1e-9).view(-1, 1, 1)
        close = 1.0 + ((margin - gap) / margin).clamp(0.0, 1.0)
        return torch.where(gap > 0, length * close, torch.inf)


def _cheapest(points: Tensor, near: Tensor, lengths: Tensor, price: Tensor) -> tuple[Tensor, Tensor]:
    """The way from point 0 to point 1 over edges to the points `near` (B, V, k), by relaxing all edges at once."""
    edges = lengths * 0.5 * (price.unsqueeze(-1) + price.gather(1, near.flatten(1)).view(near.shape))
    cost = torch.full_like(price, torch.inf)
    cost[:, 1] = 0.0
    through = edges + cost.gather(1, near.flatten(1)).view(near.shape)
    for _ in range(HOPS):
        before, cost = cost, torch.minimum(cost, through.amin(-1))
        if torch.equal(before, cost):
            break  # nor would further rounds change anything
        through = edges + cost.gather(1, near.flatten(1)).view(near.shape)
    following = near.gather(2, through.argmin(-1, keepdim=True)).squeeze(-1)
    following[:, 1] = 1
    stops = [torch.zeros_like(following[:, :1])]
    for _ in range(HOPS):
        stops.append(following.gather(1, stops[-1]))
    way = points.gather(1, torch.cat(stops, dim=1).unsqueeze(-1).expand(-1, -1, points.shape[-1]))
    return way, torch.isfinite(cost[:, 0]) & (stops[-1][:, 0] == 1)


def _apart_from(points: Tensor, way: Tensor) -> Tensor:
    """Distance (B, V) of points from a polyline (B, P, d)."""
    a, b = way[:, None, :-1], way[:, None, 1:]
    along, toward = b - a, points.unsqueeze(2) - a
    share = (along * toward).sum(-1) / along.square().sum(-1).clamp(min=1e-12)
    return toward.sub_(share.clamp(0.0, 1.0).unsqueeze(-1) * along).square_().sum(-1).amin(-1).sqrt()


def segment_gaps(a: Tensor, b: Tensor, centers: Tensor, distances: Tensor) -> Tensor:
    """Smallest distance (B, E) of the segments a to b (B, E, d) from spheres of radius `distances` (B, M)."""
    along, toward = b - a, centers.mT
    length = along.square().sum(-1, keepdim=True).clamp(min=1e-12)
    # In place: these are the largest arrays of the search, and new pages would cost more than what is done in them.
    lead = torch.bmm(along, toward).sub_((a * along).sum(-1, keepdim=True))  # (o - a)'(b - a)
    share = (lead / length).clamp_(0.0, 1.0)
    square = a.square().sum(-1, keepdim=True) + centers.square().sum(-1).unsqueeze(1)
    square.sub_(torch.bmm(a, toward).mul_(2.0))
    square.add_((share * length).sub_(lead.mul_(2.0)).mul_(share))
    return square.clamp_(min=0.0).sqrt_().sub_(distances.unsqueeze(1)).amin(-1)


def points_along(way: Tensor, length: Tensor) -> Tensor:
    """Points (B, K, d) at arc lengths (B, K), m, of polylines (B, P, d)."""
    steps = (way[:, 1:] - way[:, :-1]).square().sum(-1).sqrt()
    reached = torch.cat((torch.zeros_like(steps[:, :1]), steps.cumsum(-1)), dim=1)
    right = torch.searchsorted(reached, length.contiguous(), right=True).clamp(1, way.shape[1] - 1)
    share = (length - reached.gather(1, right - 1)) / steps.gather(1, right - 1).clamp(min=1e-12)

    def corner(index: Tensor) -> Tensor:
        return way.gather(1, index.unsqueeze(-1).expand(-1, -1, way.shape[-1]))

    return torch.lerp(corner(right - 1), corner(right), share.clamp(0.0, 1.0).unsqueeze(-1))


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


def _around(start: Tensor, goal: Tensor, o: Tensor, R: Tensor) -> Tensor:
    """Eight points around each sphere: in the plane, or across the way from start to goal."""
    angle = torch.arange(8, dtype=o.dtype, device=o.device) * (math.pi / 4)
    cos, sin = angle.cos().view(1, -1, 1), angle.sin().view(1, -1, 1)
    if o.shape[-1] == 2:
        rays, shells = torch.cat((cos, sin), dim=-1), (1.05, 1.3)
    else:
        along = goal - start
        first = torch.linalg.cross(along, along.new_tensor((0.0, 0.0, 1.0)).expand_as(along))
        straight_up = first.square().sum(-1, keepdim=True) < 1e-12
        first = _unit(torch.where(straight_up, along.new_tensor((1.0, 0.0, 0.0)), first)).unsqueeze(1)
        second = _unit(torch.linalg.cross(along.unsqueeze(1), first))
        rays, shells = cos * first + sin * second, (1.15,)
    return torch.cat(
        [(o.unsqueeze(2) + (s * R)[..., None, None] * rays.unsqueeze(1)).flatten(1, 2) for s in shells], dim=1
    )


def _midway(o: Tensor, R: Tensor) -> Tensor:
    """The middle of the gap between each sphere and its nearest ones."""
    B, M, d = o.shape
    if M < 2:
        return o[:, :0]
    apart = _distances(o, o).masked_fill((R <= 0).unsqueeze(1), torch.inf)
    apart.diagonal(dim1=1, dim2=2).fill_(torch.inf)
    near = apart.topk(min(NEIGHBOURS, M - 1), largest=False).indices.flatten(1)
    other = o.gather(1, near.unsqueeze(-1).expand(-1, -1, d)).view(B, M, -1, d) - o.unsqueeze(2)
    length = other.square().sum(-1, keepdim=True).sqrt()
    middle = 0.5 * (length + R[..., None, None] - R.gather(1, near).view(B, M, -1, 1))
    return (o.unsqueeze(2) + other / length.clamp(min=1e-12) * middle).flatten(1, 2)


def _is_free(points: Tensor, o: Tensor, R: Tensor) -> Tensor:
    """Whether points (B, V, d) are clear of all spheres, by a thousandth of the largest."""
    gap = (_distances(points, o) - R.unsqueeze(1)).amin(-1)
    return gap > 0.001 * R.amax(-1, keepdim=True)


def _distances(a: Tensor, b: Tensor) -> Tensor:
    """|a_i - b_j| (B, V, W)."""
    return (a.unsqueeze(2) - b.unsqueeze(1)).square_().sum(-1).sqrt_()


def _unit(v: Tensor) -> Tensor:
    return v / v.square().sum(-1, keepdim=True).sqrt().clamp(min=1e-12)
