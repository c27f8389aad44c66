"""Distances from boxes as the judge and the certificate measure them: no code is shared with the solvers."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.constraints.boxes import BoundBoxes

ROUNDS = 70  # each shrinks a segment by a third


def box_distance(boxes: BoundBoxes, p: Tensor) -> Tensor:
    """Signed distances (B, K, M) of points p (B, K, d) from the boxes before rounding, m; absent ones count too."""
    return _distance(boxes, p.unsqueeze(2))


def box_segment_distance(boxes: BoundBoxes, p: Tensor) -> Tensor:
    """Lower bounds (B, K-1, M) of the signed distances along the straight segments between points p (B, K, d), m.

    The signed distance from a convex body is a convex function along a segment: comparing it at two points shows which
    third can be dropped. The distance changes no faster than the point moves, so the returned value lies below the
    smallest distance by at most the length of the remaining piece.
    """
    a, along = p[:, :-1].unsqueeze(2), p.diff(dim=1).unsqueeze(2)  # (B, K-1, 1, d)
    low = torch.zeros(*a.shape[:2], boxes.centers.shape[1], dtype=p.dtype, device=p.device)
    high = torch.ones_like(low)
    for _ in range(ROUNDS):
        left, right = low + (high - low) / 3, high - (high - low) / 3
        falls = _distance(boxes, a + left.unsqueeze(-1) * along) > _distance(boxes, a + right.unsqueeze(-1) * along)
        low, high = torch.where(falls, left, low), torch.where(falls, high, right)
    middle = 0.5 * (low + high)
    return _distance(boxes, a + middle.unsqueeze(-1) * along) - (high - low) * along.norm(dim=-1)


def _distance(boxes: BoundBoxes, p: Tensor) -> Tensor:
    """Signed distances (B, K, M) of points p (B, K, M or 1, d)."""
    local = (boxes.axes.unsqueeze(1) @ (p - boxes.centers.unsqueeze(1)).unsqueeze(-1)).squeeze(-1)
    over = local.abs() - boxes.half_sizes.unsqueeze(1)
    return over.clamp(min=0.0).norm(dim=-1) + over.amax(-1).clamp(max=0.0)
