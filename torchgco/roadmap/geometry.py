"""The geometry that the search works on: scenes of spheres, and points along polylines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

from torchgco.base.tree import take
from torchgco.obstacles.base import Inflated
from torchgco.obstacles.box_geometry import Cuboids, signed_distance
from torchgco.obstacles.spheres import FAR as FAR

AT_ONCE = 2**18  # distances between points and obstacles that are held at once


@dataclass(frozen=True)
class Scene:
    """Start, goal and obstacles of B problems; lengths in m."""

    start: Tensor  # (B, d)
    goal: Tensor  # (B, d)
    centers: Tensor  # (B, M, d)
    inflated_radii: Tensor  # (B, M): r_obs + r_veh, FAR where absent
    traversal_cost: Callable[[Tensor, Tensor], Tensor]  # per metre at points (B', V, d) of some problems, (B', V)
    boxes: Cuboids | None = None

    @property
    def sizes(self) -> Tensor:
        """The depth of each obstacle's deepest point beneath its surface, boxes last, (B, M'); negative: absent."""
        return self.inflated_radii if self.boxes is None else torch.cat((self.inflated_radii, self.boxes.sizes), dim=1)

    @property
    def middles(self) -> Tensor:
        """The centres of all obstacles, boxes last, (B, M', d)."""
        return self.centers if self.boxes is None else torch.cat((self.centers, self.boxes.centers), dim=1)

    @property
    def obstacles(self) -> Inflated:
        """The obstacles alone."""
        return Inflated(self.centers, self.inflated_radii, self.boxes)


def depth(obstacles: Inflated, points: Tensor) -> Tensor:
    """How deep points (B, V, d) lie beneath the surface of an obstacle, (B, V), m; negative outside of all."""
    B, V, count = *points.shape[:2], obstacles.centers.shape[1]
    count += 0 if obstacles.boxes is None else obstacles.boxes.radius.shape[1]
    parts = torch.arange(B, device=points.device).split(max(1, AT_ONCE // max(1, V * count)))
    return torch.cat([_depth(take(obstacles, rows), points[rows]) for rows in parts])


def _depth(obstacles: Inflated, points: Tensor) -> Tensor:
    apart = squares(points, obstacles.centers).sqrt_()
    within = (obstacles.inflated_radii.unsqueeze(1) - apart).amax(-1)
    boxes = obstacles.boxes
    if boxes is None:
        return within
    inside = boxes.radius.unsqueeze(1) - signed_distance(boxes.seen_from(points), boxes.halves())
    return torch.maximum(within, inside.masked_fill(~boxes.here.unsqueeze(1), -torch.inf).amax(-1))


def points_along(path: Tensor, length: Tensor) -> Tensor:
    """Points (B, K, d) at arc lengths (B, K), m, on polylines (B, P, d)."""
    steps = (path[:, 1:] - path[:, :-1]).square().sum(-1).sqrt()
    reached = torch.cat((torch.zeros_like(steps[:, :1]), steps.cumsum(-1)), dim=1)
    right = torch.searchsorted(reached, length.contiguous(), right=True).clamp(1, path.shape[1] - 1)
    share = (length - reached.gather(1, right - 1)) / steps.gather(1, right - 1).clamp(min=1e-12)

    def corner(index: Tensor) -> Tensor:
        return path.gather(1, index.unsqueeze(-1).expand(-1, -1, path.shape[-1]))

    return torch.lerp(corner(right - 1), corner(right), share.clamp(0.0, 1.0).unsqueeze(-1))


def squares_from_segments(points: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Squared distances (B, E, V) of points (B, V, d) from segments a to b (B, E, d)."""
    along = b - a
    inverse = 1.0 / along.square().sum(-1, keepdim=True).clamp(min=1e-12)
    # Coordinate by coordinate and in place: these are the largest arrays of the search.
    axes = [(along[..., i, None], points[:, None, :, i] - a[..., i, None]) for i in range(a.shape[-1])]
    share = reduce(torch.add, (toward * step for step, toward in axes)).mul_(inverse).clamp_(0.0, 1.0)
    return reduce(torch.add, (toward.sub_(share * step).square_() for step, toward in axes))


def squares(a: Tensor, b: Tensor) -> Tensor:
    """|a_i - b_j|^2 (B, V, W)."""
    return (a.unsqueeze(2) - b.unsqueeze(1)).square_().sum(-1)
