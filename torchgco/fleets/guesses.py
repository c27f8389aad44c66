"""Guesses that get vehicles out of each other's way: all bend to the same side, as on a roundabout."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchgco.fleets.among import SOLVER, Among
from torchgco.fleets.fleet import Fleet
from torchgco.fleets.plans import Plans

TINY = 1e-9  # share of a way
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


def aside(fleet: Fleet, forms: Sequence[Among], rows: Tensor, alone: Plans, side: float) -> Plans:
    """All vehicles in conflict on one side of the middles of their ways, as on a roundabout.

    Each goes around a ball in the middle of its way, alone. It begins with a bent line, on which all vehicles in
    conflict are equally far at all times, as far as they are in the mean when they are alone.

    Args:
        forms: of the fleet's vehicles.
        rows: which fleets these are, (b,).
        alone: plans of these, of vehicles alone.
    """
    conflicts = in_conflict(fleet, alone)
    wide, p = widths(fleet, conflicts), fleet.places(alone.X)
    way = p[:, :, -1:] - p[:, :, :1]
    length = way.square().sum(-1).clamp(min=1e-12)
    share = ((p - p[:, :, :1]) * way).sum(-1) / length
    many = conflicts.sum(1, keepdim=True).clamp(min=1)
    common = torch.where(conflicts.unsqueeze(-1), share, 0.0).sum(1) / many  # (b, N+1)
    plans, b = alone.take(torch.arange(len(rows))), len(rows)
    for among, (_, whose) in zip(forms, fleet.forms, strict=True):
        own, X = torch.cat([place * fleet.B + rows for place in range(len(whose))]), []
        for v in whose:
            straight = alone.X[v].clone()
            straight[..., fleet.members[v].position] = p[:, v, :1] + common.unsqueeze(-1) * way[:, v]
            X.append(bent(straight, fleet.members[v].position, side, wide[:, v]))
        middle = torch.cat([p[:, v, :1] + 0.5 * way[:, v] for v in whose]).unsqueeze(2).repeat(1, fleet.N + 1, 1, 1)
        radii = torch.cat([torch.where(conflicts[:, v], wide[:, v], torch.nan) for v in whose]).unsqueeze(-1)
        middle = torch.where(radii.isnan()[:, None, :, None], torch.nan, middle)
        found = SOLVER.solve(among.at(own, middle, radii), torch.cat([alone.U[v] for v in whose]), X0=torch.cat(X))
        for place, v in enumerate(whose):
            at = place * b + torch.arange(b)
            plans.set(v, torch.arange(b), found, at)
            plans.iterations[:, v] += found.iterations[at]
    return together(fleet, plans, conflicts)


def together(fleet: Fleet, plans: Plans, conflicts: Tensor) -> Plans:
    """Plans slowed down such that vehicles in conflict (b, V) are equally far on their ways, as far as the last one."""
    p = fleet.places(plans.X)
    way = p[:, :, -1:] - p[:, :, :1]
    share = ((p - p[:, :, :1]) * way).sum(-1) / way.square().sum(-1).clamp(min=1e-12)
    share = share.cummax(-1).values.clamp(0.0, 1.0)
    last = torch.where(conflicts.unsqueeze(-1), share, torch.inf).amin(1)
    kept = plans.take(torch.arange(len(p)))
    for v in range(fleet.V):
        own = share[:, v] + TINY * torch.arange(fleet.N + 1)  # rises
        k = torch.searchsorted(own, last).clamp(1, fleet.N)
        before, after = own.gather(1, k - 1), own.gather(1, k)
        part = ((last - before) / (after - before)).clamp(0.0, 1.0).unsqueeze(-1)
        at = lambda k, x=plans.X[v]: x.gather(1, k.unsqueeze(-1).expand(-1, -1, x.shape[-1]))
        moved = at(k - 1) * (1.0 - part) + at(k) * part
        kept.X[v] = torch.where(conflicts[:, v].view(-1, 1, 1), moved, plans.X[v])
    return kept


def in_conflict(fleet: Fleet, plans: Plans) -> Tensor:
    """Which vehicles (B, V) come too close to another one along their plans, at the knots or between."""
    p, (i, j) = fleet.places(plans.X), fleet.pairs_kept
    away = p[:, i] - p[:, j]
    near = (away.norm(dim=-1) - 0.5 * away.diff(dim=2).norm(dim=-1).amax(-1, keepdim=True)).amin(-1)
    close = (near < fleet.distances[i, j]).long()
    count = close.new_zeros(p.shape[:2]).index_add(1, i, close).index_add(1, j, close)
    return count > 0
