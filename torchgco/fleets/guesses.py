"""Guesses that get vehicles out of each other's way: all bend to the same side, as on a roundabout, or one waits."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchgco.fleets.fleet import Fleet
from torchgco.fleets.plans import Plans

SIDES = 1.0, -1.0  # to the right, to the left


def bent(X: Tensor, position: slice, side: float, width: Tensor) -> Tensor:
    """Trajectories X (B, N+1, n) moved to a side of their ways, in the middle by `width` (B,), m, at the ends by 0.

    Args:
        side: 1 to the right of the straight way from the first to the last place, seen from above, -1 to the left.
    """
    p = X[..., position]
    way = p[:, -1] - p[:, 0]
    across = torch.zeros_like(way)
    across[:, 0], across[:, 1] = way[:, 1], -way[:, 0]
    across = across / across.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    gone = p.diff(dim=1).norm(dim=-1).cumsum(-1)
    share = torch.cat((torch.zeros_like(gone[:, :1]), gone), dim=1) / gone[:, -1:].clamp(min=1e-12)
    off = side * width.view(-1, 1, 1) * (math.pi * share).sin().unsqueeze(-1) * across.unsqueeze(1)
    moved = X.clone()
    moved[..., position] = p + off
    return moved


def widths(fleet: Fleet, conflicts: Tensor) -> Tensor:
    """By how much the vehicles in conflict (B, V) bend, (B, V), m; 0 of others.

    Balls that keep a distance from each other go round on a circle of as many times this distance over 2 pi.
    """
    many, apart = conflicts.sum(-1, keepdim=True), fleet.distances.amax(-1)
    return torch.where(conflicts, apart * (many / (2.0 * math.pi)).clamp(min=0.5), 0.0)


def late(X: Tensor, U: Tensor, stages: int) -> tuple[Tensor, Tensor]:
    """Trajectories X (B, N+1, n), U (B, N, m) that begin some stages later, and end where they are then."""
    held = (torch.cat((z[:, :1].expand(-1, stages, -1), z[:, : z.shape[1] - stages]), dim=1) for z in (X, U))
    return next(held), next(held)


def in_conflict(fleet: Fleet, plans: Plans) -> Tensor:
    """Which vehicles (B, V) come too close to another one along their plans, at the knots or between."""
    p = fleet.places(plans.X)
    found = torch.zeros(p.shape[:2], dtype=torch.bool)
    for i in range(fleet.V):
        for j in range(i):
            away = p[:, i] - p[:, j]
            near = (away.norm(dim=-1) - 0.5 * away.diff(dim=1).norm(dim=-1).amax(-1, keepdim=True)).amin(-1)
            close = near < fleet.distances[i, j]
            found[:, i] |= close
            found[:, j] |= close
    return found
