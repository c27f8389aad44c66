"""The scale of a problem's cost: its unit, and a constant that would hide everything else."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchgco.constraints.bounds import Bounds
from torchgco.costs.base import Cost
from torchgco.dynamics.base import Dynamics

LEAST_UNIT = 1e-3  # share of the controls' curvature in the unit of cost
LEAST_COST = 1e-9  # share of the cost of staying at the start, as which a cost counts at least
BOUNDED, UNLIMITED = 3e-5, 1e-10  # controls that cost nothing: as shares of their bounds, of 1 at most; without bounds
NARROW = 0.1  # half the range of controls in units that may be too large for a cost to be tried by one of them
DWARFS = 100.0  # times the rest of the cost: a smaller constant leaves tests relative to the cost meaningful


class CostScale(NamedTuple):
    """One number per problem, (B,)."""

    unit: Tensor  # above 0
    constant: Tensor  # in the cost of a whole trajectory; 0 where it doesn't dwarf the rest
    size: Tensor  # as how much a whole trajectory's cost counts at least where a share of it is meant, above 0


def cost_scale(
    total: Tensor,
    curvatures: Tensor,
    changes: Tensor | None,
    stages: Tensor | None = None,
    bounds: Bounds | None = None,
) -> CostScale:
    """The mean cost per stage of staying at the start at rest, without its constant.

    A thousandth of the controls' mean curvature is added, of controls with narrow bounds times half their range
    squared; only this is left where the start is the goal.

    Args:
        total: the cost of staying at the start, (B,).
        curvatures: diagonals of its Hessians in the controls, (B, N, m).
        changes: by how much the cost changes elsewhere, (B,). Where `total` is over `DWARFS` times as large, all but
            the change is a constant. None: the cost has none.
        stages: how many of the N stages are a problem's own, (B,); None: all.
        bounds: of the controls; None: they have none.
    """
    (count, m), N = curvatures.shape[1:], curvatures.shape[1]
    if stages is not None:
        running = torch.arange(count, device=total.device) < stages.unsqueeze(-1)
        curvatures, N = torch.where(running.unsqueeze(-1), curvatures, 0.0), stages
    idle, sizes = torch.full_like(curvatures[:, 0], UNLIMITED), torch.ones_like(curvatures[:, 0])
    if bounds is not None:
        half = 0.5 * bounds.range
        idle = torch.where(half < torch.inf, BOUNDED * half.clamp(max=1.0), idle)
        sizes = torch.where(half < NARROW, half, sizes)
    # Contiguous and one axis at a time: the order of summation must not depend on the batch.
    steep, constant = curvatures.abs(), torch.zeros_like(total)
    curvature = (steep * sizes.square().unsqueeze(1)).contiguous().sum(-1).sum(-1) / (N * m)
    idly = (steep * idle.square().unsqueeze(1)).contiguous().sum(-1).sum(-1) / m
    least = LEAST_UNIT * curvature
    if changes is not None:
        rest = total.abs() - torch.maximum(changes, N * least)
        dwarfs = (rest > DWARFS * torch.maximum(changes, N * least)) & torch.isfinite(rest)
        constant = torch.where(dwarfs, total.sign() * rest, constant)
    rest = (total - constant).abs()
    unit, size = rest / N + least, LEAST_COST * rest + idly
    usable = (unit > 0) & (unit < torch.inf)
    size = torch.where(usable & (size > 0), size, LEAST_COST * torch.where(usable, unit * N, 1.0))
    return CostScale(torch.where(usable, unit, 1.0), constant, size)


def reach(dynamics: Dynamics, X: Tensor, bounds: Bounds | None) -> tuple[Tensor, Tensor]:
    """How far states and controls go from the start, (B, 1, n) and (B|1, 1, m), at least where a cost is tried.

    By one and by as much as they are; of controls with narrow bounds half their range, and of states then what a
    rollout with the controls there, or one unit away, reaches, where that is less: in small units a cost of one unit's
    change would hide every other.

    Args:
        X: states that stay at the start, (B, N+1, n).
    """
    far, controls = 1.0 + X[:, :1].abs(), X.new_ones(1, 1, dynamics.m)
    half = None if bounds is None else 0.5 * bounds.range
    if half is None or bounds is None or not bool((half < NARROW).any()):
        return far, controls
    narrow = (half < NARROW).unsqueeze(1)
    places = []
    for bound, side in ((bounds.lower, -1.0), (bounds.upper, 1.0)):
        x, u = X[:, 0], bound.flatten(1, -2).amax(1) if bound.dim() == 3 else bound
        u = torch.where(half < NARROW, u, side).expand(len(x), -1)
        for k in range(X.shape[1] - 1):
            x = dynamics.at(k).step(x, u)
            places.append((x - X[:, 0]).abs())
    reached = torch.stack(places).nan_to_num(0.0, 0.0, 0.0).amax(0).unsqueeze(1)
    far = torch.where(narrow.any(-1, keepdim=True) & (reached > 0), torch.minimum(reached, far), far)
    return far, torch.where(narrow, half.unsqueeze(1), controls)


def changes_of(
    cost: Cost,
    X: Tensor,
    U: Tensor,
    total: Tensor,
    goal: Tensor | None,
    position: slice | None,
    steps: tuple[Tensor, Tensor],
) -> Tensor:
    """The largest change (B,) of a cost between X (B, N+1, n), U (B, N, m) and a few other places.

    These are the origin, states and controls larger and smaller by `steps`, controls by as much as they are, too, and
    the goal (B, d).
    """
    step, by = steps
    # No two components change alike, so that differences of states change too.
    uneven = 1.0 + 0.3 * torch.arange(X.shape[-1], dtype=X.dtype, device=X.device).cos()
    move, turn = (uneven * step).expand_as(X), by + U.abs()
    places = [(torch.zeros_like(X), U), (X + move, U + turn), (X - move, U - turn)]
    if goal is not None and position is not None:
        there = X.clone()
        there[..., position] = goal.unsqueeze(1)
        places.append((there, U))
    changes = [(cost.total(*trajectory) - total).abs() for trajectory in places]
    return torch.stack(changes).nan_to_num(0.0, 0.0, 0.0).amax(0)


def savings(slopes: Tensor, curvatures: Tensor) -> Tensor:
    """How much of a cost a quadratic model could save, (B,), from slopes and curvatures (B, K, z) of each variable.

    A far goal of a quadratic cost is no constant, however far. Where the cost isn't convex in a variable, nothing is
    said: the changes of the cost elsewhere count there.
    """
    saved = torch.where(curvatures > 0, 0.5 * slopes.square() / curvatures, 0.0)
    return saved.nan_to_num(0.0, torch.finfo(slopes.dtype).max).contiguous().sum(-1).sum(-1)
