"""Geometry of boxes that may be turned, grown by a radius: distances of points and of straight segments from them.

Sides of length 0 make the box a rectangle, a segment or a point, and the grown box a capsule, for example.

Everything is computed coordinate by coordinate, in one order and with no operation but sums, products, quotients and
comparisons, apart from the last square root: C (native/c/box.h, roadmap/c) does the same, and gets the same bits. A
point is given as its coordinates, a sequence of d tensors of one shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

from torchgco.obstacles.base import Solids

Coordinates = Sequence[Tensor]
SEGMENTS_AT_ONCE = 1024  # of a segment and a box: what is computed of them fits into a processor's cache
BOX_SLACK = 1e-9  # share of lengths by which bounds are wider, more than rounding


@dataclass(frozen=True)
class Cuboids(Solids):
    """Boxes, grown by their own radius and the vehicle's."""

    axes: Tensor  # (B, M, d, d): row i is the direction of side i
    half_sizes: Tensor  # (B, M, d), m; 0 where absent

    @property
    def sizes(self) -> Tensor:
        return self.radii + self.half_sizes.amin(-1)

    @property
    def extent(self) -> Tensor:
        return (self.axes.abs() * self.half_sizes.unsqueeze(-1)).sum(-2)

    def local(self, v: Coordinates) -> list[Tensor]:
        """Coordinates along the sides of each box, (B, V, M) each, of vectors (B, V, 1) or (B, V, M)."""
        return _along(self.axes.unsqueeze(1), v)

    def seen_from(self, points: Tensor) -> list[Tensor]:
        """Coordinates along the sides of each box, from its centre, (B, V, M) each, of points (B, V, d)."""
        o = self.centers.unsqueeze(1)
        return self.local([points[..., None, j] - o[..., j] for j in range(points.shape[-1])])

    def halves(self) -> list[Tensor]:
        """Half the side lengths, d tensors (B, 1, M)."""
        return list(self.half_sizes.unsqueeze(1).unbind(-1))

    def signed_distance(self, points: Tensor) -> Tensor:
        return self.distance_at(self.seen_from(points))

    def distance_at(self, local: Coordinates) -> Tensor:
        """The same at coordinates (B, V, M) along the sides of each box."""
        return signed_distance(local, self.halves()) - self.radii.unsqueeze(1)

    def deeper(self, points: Tensor, than: Tensor) -> Tensor:
        # Most points lie outside of the bounds of most boxes.
        near, reach = ~self.absent.unsqueeze(1), self._reach()
        for k in range(points.shape[-1]):
            near = near & ((points[..., k, None] - self.centers[:, None, :, k]).abs() <= reach[:, None, :, k])
        i, v, j = near.nonzero(as_tuple=True)
        local = _along(self.axes[i, j], (points[i, v] - self.centers[i, j]).unbind(-1))
        deep = signed_distance(local, self.half_sizes[i, j].unbind(-1)) - self.radii[i, j] < -than[i]
        is_deeper = torch.zeros_like(points[..., 0], dtype=torch.bool)
        is_deeper[i[deep], v[deep]] = True
        return is_deeper

    def _reach(self) -> Tensor:
        """Half the side lengths (B, M, d) of boxes along the axes of space that hold the grown ones, m."""
        reach = self.extent + self.radii.unsqueeze(-1)
        return reach + BOX_SLACK * (reach + self.centers.abs())

    def apart(self, a: Tensor, b: Tensor) -> Tensor:
        """Lower bounds (B, V, M) of the distances of segments from a to b (B, V, d): along the axes of space, m."""
        reach, gaps = self._reach(), []
        for i in range(a.shape[-1]):
            middle, half = 0.5 * (a[..., i] + b[..., i]), 0.5 * (a[..., i] - b[..., i]).abs()
            gap = (middle.unsqueeze(-1) - self.centers[:, None, :, i]).abs()
            gaps.append(gap - half.unsqueeze(-1) - reach[:, None, :, i])
        return reduce(torch.maximum, gaps)

    def segment_distance(self, pairs: tuple[Tensor, Tensor, Tensor], a: Tensor, b: Tensor) -> Tensor:
        """Smallest signed distances (P,), m, of pairs (problem, segment, box) of segments from a to b (B, V, d)."""
        parts = zip(*(ends.split(SEGMENTS_AT_ONCE) for ends in pairs), strict=True)
        return torch.cat([self._segment_distance(i, e, j, a, b) for i, e, j in parts])

    def _segment_distance(self, i: Tensor, e: Tensor, j: Tensor, a: Tensor, b: Tensor) -> Tensor:
        o, axes, half = self.centers[i, j], self.axes[i, j], list(self.half_sizes[i, j].unbind(-1))
        begin, end = (_along(axes, (p[i, e] - o).unbind(-1)) for p in (a, b))
        along = [y - x for x, y in zip(begin, end, strict=True)]
        return segment_distance(begin, along, half) - self.radii[i, j]

    def normals(self, points: Tensor) -> Tensor:
        """Unit vectors (B, V, M, d) along which the distance grows: away from the box, inside to the nearest side.

        On a box with sides of length 0, such as the axis of a capsule, to a side across which its length is 0.
        """
        return self.normals_at(self.seen_from(points))

    def normals_at(self, local: Coordinates) -> Tensor:
        """The same at coordinates (B, V, M) along the sides of each box."""
        half = self.halves()
        away = torch.stack(excess(local, half), dim=-1)
        square = away.square().sum(-1, keepdim=True)
        outside = away / torch.where(square > 0, square, 1.0).sqrt()
        in_box = torch.stack(list(local), dim=-1)
        inner = in_box.abs() - torch.stack(half, dim=-1)
        # The first of the nearest sides; of two opposite sides at equal distance, the positive one.
        side = torch.nn.functional.one_hot(inner.argmax(-1), in_box.shape[-1]).to(in_box.dtype)
        inside = torch.where(in_box < 0, -side, side)
        normal = torch.where(square > 0, outside, inside)
        return (self.axes.unsqueeze(1) * normal.unsqueeze(-1)).sum(-2)


def excess(p: Coordinates, half: Coordinates) -> list[Tensor]:
    """The vector from the nearest point of a box to p, in the box's frame."""
    return [x - torch.minimum(torch.maximum(x, -h), h) for x, h in zip(p, half, strict=True)]


def signed_distance(p: Coordinates, half: Coordinates) -> Tensor:
    """Distance of p from a box's surface in the box's frame, m; inside minus the distance from the nearest side."""
    deepest = reduce(torch.maximum, (x.abs() - h for x, h in zip(p, half, strict=True)))
    outside = deepest > 0
    # The root of 0 has no slope: inside, where the root isn't used, it is taken of 1.
    square = reduce(torch.add, (x * x for x in excess(p, half)))
    return torch.where(outside, torch.where(outside, square, 1.0).sqrt(), deepest)


def nearest(begin: Coordinates, along: Coordinates, half: Coordinates) -> Tensor:
    """The share of a segment at which it is nearest to a box, in the box's frame; of several, the first.

    The squared distance is convex and smooth in the share, and quadratic between the shares at which the segment passes
    the planes of the box's sides. Its slope brackets the minimum between two of these.
    """
    like = along[0] + begin[0]
    shares = [torch.zeros_like(like), torch.ones_like(like)]
    for start, step, h in zip(begin, along, half, strict=True):
        for side in (-h, h):
            shares.append(((side - start) / torch.where(step == 0, 1.0, step)).clamp(0.0, 1.0))
    share = torch.stack(shares)
    away = excess(at_share(begin, along, share), half)
    slope = reduce(torch.add, (x * step for x, step in zip(away, along, strict=True)))
    low, high, *between = share.unbind(0)
    falls, rises, *slopes = slope.unbind(0)
    for share, incline in zip(between, slopes, strict=True):
        left, right = (incline < 0) & (share > low), (incline >= 0) & (share < high)
        low, falls = torch.where(left, share, low), torch.where(left, incline, falls)
        high, rises = torch.where(right, share, high), torch.where(right, incline, rises)
    fraction = (-falls / (rises - falls).clamp(min=torch.finfo(low.dtype).tiny)).clamp(0.0, 1.0)
    return torch.where(falls < 0, low + (high - low) * fraction, low)


def segment_distance(begin: Coordinates, along: Coordinates, half: Coordinates) -> Tensor:
    """Smallest signed distance of a segment from a box's surface, in the box's frame."""
    outside = nearest(begin, along, half)
    # Inside the box the distance is the largest of 2 d linear functions, smallest at an end or where two cross.
    shares = [outside, torch.zeros_like(outside), torch.ones_like(outside)]
    sides = [(s * a, s * d, h) for a, d, h in zip(begin, along, half, strict=True) for s in (-1.0, 1.0)]
    for i, (a, d, h) in enumerate(sides):
        for other, change, width in sides[:i]:
            steep = d - change
            share = ((other - width) - (a - h)) / torch.where(steep == 0, 1.0, steep)
            shares.append(share.clamp(0.0, 1.0))
    return signed_distance(at_share(begin, along, torch.stack(shares)), half).amin(0)


def from_quaternions(turns: Tensor) -> Tensor:
    """The images (..., 3, 3), as rows, of the three axes under turns [w, x, y, z] (..., 4)."""
    w, x, y, z = turns.unbind(-1)
    first = (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y))
    second = (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x))
    third = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
    return torch.stack([torch.stack(row, dim=-1) for row in (first, second, third)], dim=-2)


def at_share(begin: Coordinates, along: Coordinates, share: Tensor) -> list[Tensor]:
    """The point of a segment at this share of it."""
    return [start + share * step for start, step in zip(begin, along, strict=True)]


def _along(axes: Tensor, v: Coordinates) -> list[Tensor]:
    """Coordinates of vectors along the rows of axes (..., d, d)."""
    return [reduce(torch.add, (axes[..., i, j] * v[j] for j in range(len(v)))) for i in range(len(v))]
