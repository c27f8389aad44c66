"""Distances as the judge and the certificate measure them, by code that no solver shares.

A trajectory's distances are a pair: at its knots, (B, K, M), and lower bounds along the straight ways between them,
(B, K - 1, M), from full surfaces, m, infinite where an obstacle is absent. Bounds are close where they are the smallest
of a problem, where bodies may touch and where they are below 0; others may be loose.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchgco.constraints.base import TOUCH

Distances = tuple[Tensor, Tensor]
SHRINKAGES = 70  # each shrinks a segment by a third


def segment_distance(a: Tensor, b: Tensor) -> Tensor:
    """Distance (...) of the origin from the segment between a and b (..., d)."""
    along = b - a
    length = along.square().sum(-1)
    share = (-(a * along).sum(-1) / length.clamp(min=torch.finfo(a.dtype).tiny)).clamp(0.0, 1.0)
    return (a + share.unsqueeze(-1) * along).norm(dim=-1)


def sphere_distances(relative: Tensor, radii: Tensor, absent: Tensor) -> Distances:
    """Of spheres with full radii (B, M), from places (B, K, M, d) relative to their centres."""

    def nearest(i: Tensor, k: Tensor, j: Tensor) -> Tensor:
        return segment_distance(relative[i, k, j], relative[i, k + 1, j]) - radii[i, j]

    ends = relative.norm(dim=-1) - radii.unsqueeze(1)
    return along_ways(ends, relative, TOUCH * radii, absent, nearest)


def box_distances(boxes: Any, away: Tensor, bulge: Tensor | None = None) -> Distances:
    """Of boxes, `BoundBoxes`, from places (B, K, M, d) relative to their centres, whose ways may leave their straight
    lines by a `bulge` (B, M), m."""
    radii = boxes.inflated_radii
    local = (boxes.axes.unsqueeze(1) @ away.unsqueeze(-1)).squeeze(-1)

    def nearest(i: Tensor, k: Tensor, j: Tensor) -> Tensor:
        a, along = away[i, k, j], away[i, k + 1, j] - away[i, k, j]
        return closest(boxes.axes[i, j], torch.zeros_like(a), boxes.half_sizes[i, j], a, along) - radii[i, j]

    ends = _distance(local, boxes.half_sizes.unsqueeze(1)) - radii.unsqueeze(1)
    return along_ways(ends, away, TOUCH * radii, boxes.absent, nearest, bulge)


def along_ways(
    ends: Tensor,
    away: Tensor,
    depths: Tensor,
    absent: Tensor,
    nearest: Callable[[Tensor, Tensor, Tensor], Tensor],
    bulge: Tensor | None = None,
) -> Distances:
    """Distances of bodies from places, and between them along straight ways, of which only those near are measured.

    Args:
        ends: (B, K, M), m, of places `away` (B, K, M, d) relative to the bodies, of any number where `absent` (B, M).
        depths: (B, M), m, beneath the full surfaces at which bodies touch.
        nearest: close lower bounds (P,) along the ways from places k to k + 1, of problems i and bodies j, (P,) each.
        bulge: (B, M), m, by which ways may leave their straight lines.
    """
    ends = ends.masked_fill(absent.unsqueeze(1), torch.inf)
    # The distance changes no faster than a point moves.
    ways = 0.5 * (ends[:, :-1] + ends[:, 1:] - away.diff(dim=1).norm(dim=-1))
    i, k, j = _near(ends, ways, depths, bulge)
    ways[i, k, j] = nearest(i, k, j)
    return ends, ways if bulge is None else ways - bulge.unsqueeze(1)


def _near(ends: Tensor, bounds: Tensor, depths: Tensor, bulge: Tensor | None) -> tuple[Tensor, ...]:
    """Which ways (B, K-1, M) may be the nearest, or touch, by their lower bounds."""
    if ends.numel() == 0:
        return bounds.nonzero(as_tuple=True)
    most = depths.amax(-1) + (0.0 if bulge is None else bulge.amax(-1))
    close = (ends.flatten(1).amin(-1) + most).clamp(min=0.0)
    return (bounds < close.view(-1, 1, 1)).nonzero(as_tuple=True)


def closest(axes: Tensor, center: Tensor, half: Tensor, a: Tensor, along: Tensor) -> Tensor:
    """Close lower bounds (P,) of the distances from boxes, one each, along the segments from a to a + along (P, d).

    The signed distance from a convex body is a convex function along a segment: comparing it at two points shows which
    third can be dropped. The returned value lies below the smallest distance by at most the length of the remaining
    piece.
    """
    a, along = (axes @ (a - center).unsqueeze(-1)).squeeze(-1), (axes @ along.unsqueeze(-1)).squeeze(-1)
    low = torch.zeros_like(a[:, :1])
    high = torch.ones_like(low)
    for _ in range(SHRINKAGES):
        left, right = low + (high - low) / 3, high - (high - low) / 3
        falls = (_distance(a + left * along, half) > _distance(a + right * along, half)).unsqueeze(-1)
        low, high = torch.where(falls, left, low), torch.where(falls, high, right)
    middle = 0.5 * (low + high)
    return _distance(a + middle * along, half) - (high - low).squeeze(-1) * along.norm(dim=-1)


def _distance(local: Tensor, half: Tensor) -> Tensor:
    """Signed distances (...) of points in the axes of their boxes (..., d)."""
    over = local.abs() - half
    return over.clamp(min=0.0).norm(dim=-1) + over.amax(-1).clamp(max=0.0)
