"""Distances from segments and boxes as the judge and the certificate measure them, apart from those of the solvers."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.obstacles.boxes import BoundBoxes
from torchgco.obstacles.oscillating import BoundOscillatingBoxes

SHRINKAGES = 70  # each shrinks a segment by a third


def segment_distance(a: Tensor, b: Tensor) -> Tensor:
    """Distance (...) of the origin from the segment between a and b (..., d)."""
    along = b - a
    length = along.square().sum(-1)
    share = (-(a * along).sum(-1) / length.clamp(min=torch.finfo(a.dtype).tiny)).clamp(0.0, 1.0)
    return (a + share.unsqueeze(-1) * along).norm(dim=-1)


def box_distance(boxes: BoundBoxes, p: Tensor) -> Tensor:
    """Signed distances (B, K, M) of points p (B, K, d) from the boxes before rounding, m; absent ones count too."""
    away = p.unsqueeze(2) - boxes.centers.unsqueeze(1)
    return _distance((boxes.axes.unsqueeze(1) @ away.unsqueeze(-1)).squeeze(-1), boxes.half_sizes.unsqueeze(1))


def box_segment_distance(boxes: BoundBoxes, p: Tensor, within: Tensor) -> Tensor:
    """Lower bounds (B, K-1, M) of the signed distances along the straight segments between points p (B, K, d), m.

    Bounds below `within` (m, broadcast to (B, K-1, M)) are close, others may be loose: the distance changes no faster
    than the point moves, so those at the ends bound it between them, which suffices for most pairs.
    """
    ends = box_distance(boxes, p)
    along = p.diff(dim=1)
    least = 0.5 * (ends[:, :-1] + ends[:, 1:] - along.norm(dim=-1, keepdim=True))
    i, k, j = (least < within).nonzero(as_tuple=True)
    least[i, k, j] = closest(boxes.axes[i, j], boxes.centers[i, j], boxes.half_sizes[i, j], p[i, k], along[i, k])
    return least


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


def oscillating_distances(swings: BoundOscillatingBoxes, p: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distances (B, K, M) of points p (B, K, d) at the times k dt from boxes before rounding, and lower bounds
    (B, K-1, M) of those along the straight ways between them, m, close beneath the full surface; absent ones count too.

    Seen from a box, the way between two knots leaves its chord by at most dt^2 / 8 of the box's acceleration.
    """
    boxes, away, strongest = swings.boxes, [], []
    t = swings.dt * torch.arange(p.shape[1], dtype=p.dtype, device=p.device).view(1, -1, 1)
    for i in range(p.shape[-1]):
        place, most = boxes.centers[..., i].unsqueeze(1), torch.zeros_like(boxes.centers[..., i])
        for s in range(swings.amplitudes.shape[2]):
            amplitude, rate, phase = (
                part[:, :, s, i].unsqueeze(1) for part in (swings.amplitudes, swings.rates, swings.phases)
            )
            place = place + amplitude * torch.sin(rate * t + phase)
            most = most + (amplitude.abs() * rate**2).squeeze(1)
        away.append(p[..., i].unsqueeze(2) - place)
        strongest.append(most)
    off, bulge = torch.stack(away, dim=-1), swings.dt**2 / 8.0 * torch.stack(strongest, dim=-1).norm(dim=-1)
    ends = _distance((boxes.axes.unsqueeze(1) @ off.unsqueeze(-1)).squeeze(-1), boxes.half_sizes.unsqueeze(1))
    along = off.diff(dim=1)
    least = 0.5 * (ends[:, :-1] + ends[:, 1:] - along.norm(dim=-1))
    near = (least - boxes.inflated_radii.unsqueeze(1)).masked_fill(boxes.absent.unsqueeze(1), torch.inf)
    known = (ends - boxes.inflated_radii.unsqueeze(1)).masked_fill(boxes.absent.unsqueeze(1), torch.inf)
    within = (known.flatten(1).amin(-1) + boxes.inflated_radii.amax(-1) + bulge.amax(-1)).clamp(min=0.0)
    i, k, j = ((near < within.view(-1, 1, 1)) & (along != 0).any(-1)).nonzero(as_tuple=True)
    if i.numel() > 0:
        origin = torch.zeros_like(off[i, k, j])
        least[i, k, j] = closest(boxes.axes[i, j], origin, boxes.half_sizes[i, j], off[i, k, j], along[i, k, j])
    return ends, least - bulge.unsqueeze(1)


def _distance(local: Tensor, half: Tensor) -> Tensor:
    """Signed distances (...) of points in the axes of their boxes (..., d)."""
    over = local.abs() - half
    return over.clamp(min=0.0).norm(dim=-1) + over.amax(-1).clamp(max=0.0)
