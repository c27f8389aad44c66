"""Geometry of boxes that may be turned, grown by a radius: distances of points and of straight segments from them.

Sides of length 0 make the box a rectangle, a segment or a point, and the grown box a capsule, for example.

Everything is computed coordinate by coordinate, in one order and with no operation but sums, products, quotients and
comparisons, apart from the last square root: roadmap/c/boxes.h does the same operations, and gets the same bits.
A point is given as its coordinates, a sequence of d tensors of one shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

Coordinates = Sequence[Tensor]


class Cuboids(NamedTuple):
    """K boxes of each of B problems, grown by their own radius and the vehicle's."""

    centers: Tensor  # (B, K, d), m
    axes: Tensor  # (B, K, d, d): row i is the direction of side i
    half_sizes: Tensor  # (B, K, d), m
    radius: Tensor  # (B, K), m; negative where a box is absent

    @property
    def here(self) -> Tensor:
        """Whether a box is present, (B, K) bool."""
        return self.radius >= 0

    @property
    def sizes(self) -> Tensor:
        """How deep the deepest point lies beneath the grown surface, (B, K), m; negative where absent."""
        return self.radius + self.half_sizes.amin(-1)

    def rows(self, index: Tensor | slice) -> Cuboids:
        """The boxes of the problems in `index`."""
        return Cuboids(*(part[index] for part in self))

    def cut(self, share: float) -> Cuboids:
        """The same boxes, with the radius reduced by this share."""
        return self._replace(radius=torch.where(self.here, (1.0 - share) * self.radius, self.radius))

    def local(self, v: Coordinates) -> list[Tensor]:
        """Coordinates along the sides of each box, (B, V, K) each, of vectors (B, V, 1) or (B, V, K)."""
        axes = self.axes.unsqueeze(1)
        return [reduce(torch.add, (axes[..., i, j] * v[j] for j in range(len(v)))) for i in range(len(v))]

    def seen_from(self, points: Tensor) -> list[Tensor]:
        """Coordinates along the sides of each box, from its centre, (B, V, K) each, of points (B, V, d)."""
        o = self.centers.unsqueeze(1)
        return self.local([points[..., None, j] - o[..., j] for j in range(points.shape[-1])])

    def halves(self) -> list[Tensor]:
        """Half the side lengths, d tensors (B, 1, K)."""
        return list(self.half_sizes.unsqueeze(1).unbind(-1))

    def squares(self, points: Tensor) -> Tensor:
        """Squared distances (B, V, K) of points (B, V, d) from the boxes before they are grown; 0 inside."""
        return _square(excess(self.seen_from(points), self.halves()))

    def squares_from_segments(self, a: Tensor, b: Tensor) -> Tensor:
        """Smallest squared distances (B, E, K) of the segments from a to b (B, E, d); 0 for those that enter a box."""
        begin, half = self.seen_from(a), self.halves()
        along = self.local([(b - a)[..., None, j] for j in range(a.shape[-1])])
        return _square(excess(_at(begin, along, nearest(begin, along, half)), half))

    def reach(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Lower and upper corner (B, d) around points (B, V, d) and the inflated boxes, made larger by half."""
        half = (self.axes.abs() * self.half_sizes.unsqueeze(-1)).sum(-2)
        wide, here = 1.5 * (half + self.radius.unsqueeze(-1)), self.here.unsqueeze(-1)
        low = torch.where(here, self.centers - wide, torch.inf)
        high = torch.where(here, self.centers + wide, -torch.inf)
        return torch.cat((points, low), dim=1).amin(1), torch.cat((points, high), dim=1).amax(1)


def join(parts: Sequence[Cuboids]) -> Cuboids | None:
    """All boxes of the same problems; None where there are none."""
    return Cuboids(*(torch.cat(columns, dim=1) for columns in zip(*parts, strict=True))) if parts else None


def excess(p: Coordinates, half: Coordinates) -> list[Tensor]:
    """The vector from the nearest point of a box to p, in the box's frame."""
    return [x - torch.minimum(torch.maximum(x, -h), h) for x, h in zip(p, half, strict=True)]


def signed_distance(p: Coordinates, half: Coordinates) -> Tensor:
    """Distance of p from a box's surface in the box's frame, m; inside minus the distance from the nearest side."""
    deepest = reduce(torch.maximum, (x.abs() - h for x, h in zip(p, half, strict=True)))
    outside = deepest > 0
    # The root of 0 has no slope: inside, where the root isn't used, it is taken of 1.
    return torch.where(outside, torch.where(outside, _square(excess(p, half)), 1.0).sqrt(), deepest)


def nearest(begin: Coordinates, along: Coordinates, half: Coordinates) -> Tensor:
    """The share of a segment at which it is nearest to a box, in the box's frame; of several, the first.

    The squared distance is convex and smooth in the share, and quadratic between the shares at which the segment passes
    the planes of the box's sides. Its slope brackets the minimum between two of these.
    """

    def slope(share: Tensor) -> Tensor:
        away = excess(_at(begin, along, share), half)
        return reduce(torch.add, (x * step for x, step in zip(away, along, strict=True)))

    low, high = torch.zeros_like(along[0] + begin[0]), torch.ones_like(along[0] + begin[0])
    falls, rises = slope(low), slope(high)
    for start, step, h in zip(begin, along, half, strict=True):
        for side in (-h, h):
            share = ((side - start) / torch.where(step == 0, 1.0, step)).clamp(0.0, 1.0)
            found = slope(share)
            left, right = (found < 0) & (share > low), (found >= 0) & (share < high)
            low, falls = torch.where(left, share, low), torch.where(left, found, falls)
            high, rises = torch.where(right, share, high), torch.where(right, found, rises)
    part = (-falls / (rises - falls).clamp(min=torch.finfo(low.dtype).tiny)).clamp(0.0, 1.0)
    return torch.where(falls < 0, low + (high - low) * part, low)


def segment_distance(begin: Coordinates, along: Coordinates, half: Coordinates) -> Tensor:
    """Smallest signed distance of a segment from a box's surface, in the box's frame."""
    outside = signed_distance(_at(begin, along, nearest(begin, along, half)), half)
    # Inside the box the distance is the largest of 2 d linear functions, smallest at an end or where two cross.
    shares = [torch.zeros_like(outside), torch.ones_like(outside)]
    sides = [(s * a, s * d, h) for a, d, h in zip(begin, along, half, strict=True) for s in (-1.0, 1.0)]
    for i, (a, d, h) in enumerate(sides):
        for other, change, width in sides[:i]:
            steep = d - change
            share = ((other - width) - (a - h)) / torch.where(steep == 0, 1.0, steep)
            shares.append(share.clamp(0.0, 1.0))
    within = reduce(torch.minimum, (signed_distance(_at(begin, along, share), half) for share in shares))
    return torch.minimum(outside, within)


def from_quaternions(turns: Tensor) -> Tensor:
    """The images (..., 3, 3), as rows, of the three axes under turns [w, x, y, z] (..., 4)."""
    w, x, y, z = turns.unbind(-1)
    first = (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y))
    second = (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x))
    third = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
    return torch.stack([torch.stack(row, dim=-1) for row in (first, second, third)], dim=-2)


def beside(boxes: Cuboids, start: Tensor, goal: Tensor, shells: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Points (B, C, d) around corners, edges and sides of the boxes, and whether each one's box is present (B, C).

    Along edges and sides a point lies where the straight line from start to goal (B, d) comes nearest.
    """
    half, level = boxes.halves(), _level(boxes, start, goal)
    points = []
    for shell in shells:
        off = (boxes.radius + (shell - 1.0) * boxes.sizes).unsqueeze(1)
        for signs in product((-1.0, 0.0, 1.0), repeat=len(half)):
            turned = sum(sign != 0 for sign in signs)
            if turned == 0:
                continue
            local = [
                sign * (h + off / turned**0.5) if sign else x for sign, h, x in zip(signs, half, level, strict=True)
            ]
            points.append(_world(boxes, local))
    return torch.cat(points, dim=1), boxes.here.repeat(1, len(points))


def between(
    boxes: Cuboids, start: Tensor, goal: Tensor, centers: Tensor, radii: Tensor, count: int
) -> tuple[Tensor, Tensor]:
    """Middles (B, C, d) of each box's gaps to the `count` nearest boxes and spheres each; whether each exists (B, C).

    Args:
        start, goal: (B, d), m.
        centers, radii: of spheres, (B, M, d) and (B, M), m; negative where absent.
    """
    (B, K), M = boxes.radius.shape, radii.shape[1]
    most = max(1, PAIRS // max(K * K, K * M, 1))
    parts = []
    for first in range(0, max(B, 1), most):
        rows = slice(first, first + most)
        parts.append(_gaps(boxes.rows(rows), start[rows], goal[rows], centers[rows], radii[rows], count))
    return torch.cat([points for points, _ in parts]), torch.cat([exists for _, exists in parts])


ROUNDS = 8  # projections from one box to the other and back; the two points converge to the nearest of both
PAIRS = 32768  # of boxes that are projected onto each other at once: their coordinates fit into the processor's cache


def _level(boxes: Cuboids, start: Tensor, goal: Tensor) -> list[Tensor]:
    """The point of each box that is nearest to the straight line from start to goal, (B, 1, K) along each side."""
    ends = start.unsqueeze(1), goal.unsqueeze(1)
    begin, half = boxes.seen_from(ends[0]), boxes.halves()
    along = boxes.local([(ends[1] - ends[0])[..., None, j] for j in range(start.shape[1])])
    pass_by = _at(begin, along, nearest(begin, along, half))
    return [torch.minimum(torch.maximum(x, -h), h) for x, h in zip(pass_by, half, strict=True)]


def _gaps(
    boxes: Cuboids, start: Tensor, goal: Tensor, centers: Tensor, radii: Tensor, count: int
) -> tuple[Tensor, Tensor]:
    """As `between`, for a few problems."""
    K = boxes.radius.shape[1]
    # Two trunks are equally near to each other all along: their gap is flown through where the straight line passes.
    thin = (boxes.half_sizes == 0).any(-1, keepdim=True)
    first = torch.where(thin, _world(boxes, _level(boxes, start, goal)), boxes.centers)
    other: Coordinates = [x.unsqueeze(2).expand(-1, -1, K) for x in first.unbind(-1)]  # (B, j, i): of box j, for box i
    own = other
    for _ in range(ROUNDS):
        before, own = own, _projected(boxes, other)  # of box i, for box j
        other = _swapped(_projected(boxes, _swapped(own)))
        if all(torch.equal(x, y) for x, y in zip(before, own, strict=True)):
            break  # further rounds would change nothing
    pairs = boxes.here.unsqueeze(1) & boxes.here.unsqueeze(2)
    pairs = pairs & ~torch.eye(K, dtype=torch.bool, device=centers.device)
    p, q = torch.stack(_swapped(own), dim=-1), torch.stack(_swapped(other), dim=-1)
    found = [_middles(p, q, boxes.radius.unsqueeze(2), boxes.radius.unsqueeze(1), pairs, count)]
    there = centers.unsqueeze(1).expand(-1, K, -1, -1)
    p = torch.stack(_swapped(_projected(boxes, centers.unsqueeze(2).unbind(-1))), dim=-1)
    here = boxes.here.unsqueeze(2) & (radii > 0).unsqueeze(1)
    found.append(_middles(p, there, boxes.radius.unsqueeze(2), radii.unsqueeze(1), here, count))
    return torch.cat([p for p, _ in found], dim=1), torch.cat([e for _, e in found], dim=1)


def _projected(boxes: Cuboids, points: Coordinates) -> list[Tensor]:
    """The nearest points of each box to points, coordinates (B, V, K) each."""
    o, axes = boxes.centers.unsqueeze(1), boxes.axes.unsqueeze(1)
    local = boxes.local([x - o[..., j] for j, x in enumerate(points)])
    held = [torch.minimum(torch.maximum(x, -h), h) for x, h in zip(local, boxes.halves(), strict=True)]
    d = len(held)
    return [o[..., j] + reduce(torch.add, (axes[..., i, j] * held[i] for i in range(d))) for j in range(d)]


def _swapped(points: Coordinates) -> list[Tensor]:
    """The same points (B, W, V) of pairs (B, V, W)."""
    return [x.mT for x in points]


def _middles(
    p: Tensor, q: Tensor, p_radius: Tensor, q_radius: Tensor, exists: Tensor, count: int
) -> tuple[Tensor, Tensor]:
    """Middles of the gaps between surfaces around p and q (B, K, V, d), of the nearest `count` of each k."""
    square = (q - p).square().sum(-1).masked_fill(~exists, torch.inf)
    near = square.sort(dim=-1, stable=True).indices[..., :count]
    share = 0.5 + 0.5 * (p_radius - q_radius) / square.sqrt().clamp(min=1e-12)
    middle = p + share.unsqueeze(-1) * (q - p)
    place = near.unsqueeze(-1).expand(*near.shape, p.shape[-1])
    taken = torch.isfinite(square.gather(-1, near))
    return torch.where(taken.unsqueeze(-1), middle.gather(2, place), p[:, :, :1]).flatten(1, 2), taken.flatten(1)


def _world(boxes: Cuboids, local: Coordinates) -> Tensor:
    """Points (B, K, d) from coordinates (B, 1, K) along the sides of each box."""
    held = torch.stack([x.squeeze(1) for x in local], dim=-1)
    return boxes.centers + (boxes.axes * held.unsqueeze(-1)).sum(-2)


def _at(begin: Coordinates, along: Coordinates, share: Tensor) -> list[Tensor]:
    return [start + share * step for start, step in zip(begin, along, strict=True)]


def _square(v: Coordinates) -> Tensor:
    return reduce(torch.add, (x * x for x in v))
