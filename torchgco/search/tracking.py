"""The guide of a tracked candidate: target positions along its path, and the penalty that pulls knots there."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.lagrangian.penalties import GuidePath, GuideRegion, Penalty
from torchgco.roadmap.geometry import Inflated, length, points_along

CUT = 0.5  # depth in mean inflated radii; averaged corners that cut deeper into an obstacle are averaged less
HALVINGS = 3  # of the share of the horizon over which they are averaged
SAMPLES = 64  # points of a path at which its depth is measured, about


def travel(path: Tensor, depart: float, arrive: Tensor, smoothing: float, N: int) -> Tensor:
    """Positions on paths (B, P, d) at every knot, (B, N+1, d): smooth start and stop, corners averaged.

    Args:
        depart, arrive: shares of the horizon at which the start is left and the goal is reached; arrive (B,).
        smoothing: share of the horizon over which corners are averaged.
    """
    share = torch.arange(N + 1, dtype=path.dtype, device=path.device) / N
    share = ((share - depart) / (arrive.unsqueeze(-1) - depart)).clamp(0.0, 1.0)
    share = share.square() * (3.0 - 2.0 * share)
    center = points_along(path, share * length(path).unsqueeze(-1))
    reach = int(0.5 * smoothing * N)
    if reach == 0:
        return center
    padded = torch.cat((center[:, :1].expand(-1, reach, -1), center, center[:, -1:].expand(-1, reach, -1)), dim=1)
    return padded.unfold(1, 2 * reach + 1, 1).mean(-1)


def followed(
    path: Tensor, depart: float, arrive: Tensor, smoothing: float, N: int, obstacles: Inflated, R: Tensor
) -> Tensor:
    """As `travel`, but corners are averaged less where the average would cut deep into an obstacle.

    Between the trunks of a dense wood, a path that is averaged over seconds leads through the trunks.

    Args:
        path: those of B problems one after the other, (B K, P, d).
        R: mean inflated radius (B,), m.
    """
    center, B = travel(path, depart, arrive, smoothing, N), R.shape[0]
    for _ in range(HALVINGS if B > 0 else 0):
        points = center[:, :: max(1, N // SAMPLES)]
        deepest = obstacles.depth(points.reshape(B, -1, points.shape[-1])).view(B, -1, points.shape[1]).amax(-1)
        deep = deepest > CUT * R.unsqueeze(-1)
        if not bool(deep.any()):
            break
        smoothing *= 0.5
        center = torch.where(deep.view(-1, 1, 1), travel(path, depart, arrive, smoothing, N), center)
    return center


def attraction(
    center: Tensor, path: Tensor, position: slice, R: Tensor, stiffness: Tensor, tube: float | None
) -> Penalty:
    """The penalty that attracts knots to `center` (B, N+1, d) on paths (B, P, d): a tube, or without one a spring.

    Args:
        R: mean inflated radius (B,), m.
        stiffness: (B,) in q0 / (R^4 L^2), with L the distance from start to goal.
        tube: radius as a share of R.
    """
    length2 = (path[:, -1] - path[:, 0]).square().sum(-1)
    spring = stiffness * R.pow(4) / length2.clamp(min=1e-12)
    if tube is None:
        return GuidePath(center, spring, position)
    radius = tube * R
    # Near its surface the tube is as stiff as a spring of 4 weight radius^2.
    weight = spring / (4.0 * radius.square()).clamp(min=1e-12)
    return GuideRegion(center, radius.unsqueeze(-1).repeat(1, center.shape[1]), weight, position)
