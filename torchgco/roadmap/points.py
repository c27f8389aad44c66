"""The points of a graph that lie around obstacles, and midway between each and its nearest ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from itertools import product

import torch
from torch import Tensor

from torchgco.base.tree import take
from torchgco.obstacles.base import TINY, Solids
from torchgco.obstacles.box_geometry import Coordinates, Cuboids, at_share, nearest

CIRCLE = 8  # points of a circle
SHELLS = {2: (1.05, 1.3), 3: (1.15,)}  # radii of the circles of points around a sphere, by the number of coordinates
MIDWAY = 4  # nearest neighbours of an obstacle: each gap to one gets a point
PROJECTIONS = 8  # projections from one box to the other and back; the two points converge to the nearest of both
PAIRS = 32768  # of boxes that are projected onto each other at once: their coordinates fit into the processor's cache


def directions(start: Tensor, goal: Tensor) -> Tensor:
    """Unit vectors (B, CIRCLE, d): all around in the plane, across the line from start to goal (B, d) in space."""
    angle = torch.arange(CIRCLE, dtype=start.dtype, device=start.device).view(-1, 1) * (2.0 * math.pi / CIRCLE)
    cos, sin = angle.cos(), angle.sin()
    if start.shape[1] == 2:
        return torch.cat((cos, sin), dim=-1).expand(start.shape[0], -1, -1)
    along = goal - start
    first = torch.linalg.cross(along, along.new_tensor((0.0, 0.0, 1.0)).expand_as(along))
    straight_up = first.square().sum(-1, keepdim=True) < TINY
    first = _unit(torch.where(straight_up, along.new_tensor((1.0, 0.0, 0.0)), first)).unsqueeze(1)
    return cos * first + sin * _unit(torch.linalg.cross(along.unsqueeze(1), first))


def of_boxes(boxes: Cuboids, spheres: Solids, start: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
    """Points (B, C, d) around boxes, and midway to spheres and other boxes; and whether each exists (B, C)."""
    parts = around_boxes(boxes, start, goal, SHELLS[start.shape[1]]), between_boxes(boxes, spheres, start, goal)
    points, exists = zip(*parts, strict=True)
    return torch.cat(points, dim=1), torch.cat(exists, dim=1)


def around_boxes(boxes: Cuboids, start: Tensor, goal: Tensor, shells: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Points (B, C, d) around corners, edges and sides of the boxes, and whether each one's box is present (B, C).

    Along edges and sides a point lies where the straight line from start to goal (B, d) comes nearest.
    """
    half, level = boxes.halves(), _level(boxes, start, goal)
    points = []
    for shell in shells:
        off = (boxes.radii + (shell - 1.0) * boxes.sizes).unsqueeze(1)
        for signs in product((-1.0, 0.0, 1.0), repeat=len(half)):
            turned = sum(sign != 0 for sign in signs)
            if turned == 0:
                continue
            local = [
                sign * (h + off / turned**0.5) if sign else x for sign, h, x in zip(signs, half, level, strict=True)
            ]
            points.append(_world(boxes, local))
    return torch.cat(points, dim=1), (~boxes.absent).repeat(1, len(points))


def between_boxes(boxes: Cuboids, spheres: Solids, start: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
    """Middles (B, C, d) of each box's gaps to the nearest boxes and spheres, and whether each exists (B, C)."""
    (B, K), M = boxes.radii.shape, spheres.radii.shape[1]
    most = max(1, PAIRS // max(K * K, K * M, 1))
    parts = []
    for first in range(0, max(B, 1), most):
        rows = slice(first, first + most)
        parts.append(_gaps(take(boxes, rows), take(spheres, rows), start[rows], goal[rows]))
    return torch.cat([points for points, _ in parts]), torch.cat([exists for _, exists in parts])


def _gaps(boxes: Cuboids, spheres: Solids, start: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
    """As `between_boxes`, for a few problems."""
    K = boxes.radii.shape[1]
    # Two trunks are equally near to each other all along: their gap is flown through where the straight line passes.
    thin = (boxes.half_sizes == 0).any(-1, keepdim=True)
    first = torch.where(thin, _world(boxes, _level(boxes, start, goal)), boxes.centers)
    other: Coordinates = [x.unsqueeze(2).expand(-1, -1, K) for x in first.unbind(-1)]  # (B, j, i): of box j, for box i
    own = other
    for _ in range(PROJECTIONS):
        before, own = own, _projected(boxes, other)  # of box i, for box j
        other = _swapped(_projected(boxes, _swapped(own)))
        if all(torch.equal(x, y) for x, y in zip(before, own, strict=True)):
            break  # further rounds would change nothing
    p, q = torch.stack(_swapped(own), dim=-1), torch.stack(_swapped(other), dim=-1)
    found = [_middles(p, q, boxes.radii.unsqueeze(2), boxes.radii.unsqueeze(1), _pairs(boxes))]
    there = spheres.centers.unsqueeze(1).expand(-1, K, -1, -1)
    p = torch.stack(_swapped(_projected(boxes, spheres.centers.unsqueeze(2).unbind(-1))), dim=-1)
    both = ~(boxes.absent.unsqueeze(2) | spheres.absent.unsqueeze(1))
    found.append(_middles(p, there, boxes.radii.unsqueeze(2), spheres.radii.unsqueeze(1), both))
    return torch.cat([p for p, _ in found], dim=1), torch.cat([e for _, e in found], dim=1)


def _middles(p: Tensor, q: Tensor, p_radius: Tensor, q_radius: Tensor, exists: Tensor) -> tuple[Tensor, Tensor]:
    """Middles of the gaps between surfaces around p and q (B, K, V, d), of the `MIDWAY` nearest of each k."""
    square = (q - p).square().sum(-1).masked_fill(~exists, torch.inf)
    near = square.sort(dim=-1, stable=True).indices[..., :MIDWAY]
    share = 0.5 + 0.5 * (p_radius - q_radius) / square.sqrt().clamp(min=TINY)
    middle = p + share.unsqueeze(-1) * (q - p)
    place = near.unsqueeze(-1).expand(*near.shape, p.shape[-1])
    return middle.gather(2, place).flatten(1, 2), torch.isfinite(square.gather(-1, near)).flatten(1)


def _pairs(solids: Solids) -> Tensor:
    """Whether two solids are present and not the same, (B, M, M)."""
    here = ~solids.absent
    return here.unsqueeze(1) & here.unsqueeze(2) & ~torch.eye(here.shape[1], dtype=torch.bool, device=here.device)


def _level(boxes: Cuboids, start: Tensor, goal: Tensor) -> list[Tensor]:
    """The point of each box that is nearest to the straight line from start to goal, (B, 1, M) along each side."""
    ends = start.unsqueeze(1), goal.unsqueeze(1)
    begin, half = boxes.seen_from(ends[0]), boxes.halves()
    along = boxes.local([(ends[1] - ends[0])[..., None, j] for j in range(start.shape[1])])
    return _within(at_share(begin, along, nearest(begin, along, half)), half)


def _projected(boxes: Cuboids, points: Coordinates) -> list[Tensor]:
    """The nearest points of each box to points, coordinates (B, V, M) each."""
    o, axes = boxes.centers.unsqueeze(1), boxes.axes.unsqueeze(1)
    held = _within(boxes.local([x - o[..., j] for j, x in enumerate(points)]), boxes.halves())
    d = len(held)
    return [o[..., j] + reduce(torch.add, (axes[..., i, j] * held[i] for i in range(d))) for j in range(d)]


def _within(local: Coordinates, half: Coordinates) -> list[Tensor]:
    """The nearest point of a box, in its frame."""
    return [torch.minimum(torch.maximum(x, -h), h) for x, h in zip(local, half, strict=True)]


def _swapped(points: Coordinates) -> list[Tensor]:
    """The same points (B, W, V) of pairs (B, V, W)."""
    return [x.mT for x in points]


def _world(boxes: Cuboids, local: Coordinates) -> Tensor:
    """Points (B, M, d) from coordinates (B, 1, M) along the sides of each box."""
    held = torch.stack([x.squeeze(1) for x in local], dim=-1)
    return boxes.centers + (boxes.axes * held.unsqueeze(-1)).sum(-2)


def _unit(v: Tensor) -> Tensor:
    return v / v.square().sum(-1, keepdim=True).sqrt().clamp(min=TINY)
