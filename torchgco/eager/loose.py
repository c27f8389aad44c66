"""Multipliers to begin with, of bounds whose variables the cost hardly holds.

Those of the central path, mu / s, are tiny at a bound far away. Where the cost has curvature, it holds a step back; in
a linear programme, and with tiny weights, nothing else does: steps leave the bounds a hundredfold, and as little of
them is taken, iterations grow with the horizon. The cost is scaled to a steepest slope of 1, so there multipliers begin
at 1, as in IPOPT. Elsewhere they don't: at a far obstacle 1 would bend the model for nothing.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.eager.model import Model
from torchgco.eager.softness import costs_of
from torchgco.eager.state import Kinds, State, adjoin


def hold_loose(kinds: Kinds, model: Model, t: State, curvature: Tensor) -> None:
    """Multipliers of bounds are 1 where moving their variable through the slack changes the cost's slope by too little.

    What moving it leads to counts, too, and a slack as 1 at least: at a bound nearby small slacks hold a step. In
    place, with costates that fit.

    Args:
        curvature: that of the cost by each variable, (b, N+1, S), at least 0.
    """
    bounds = [group for group in model.groups if group.is_bound]
    if not bounds:
        return
    at, n, free = model.slopes(t.X, t.U), kinds.n, model.problem.free_start
    last, *others = costs_of(at.F, curvature)
    costs = torch.stack((*others[::-1], torch.nn.functional.pad(last, (0, curvature.shape[-1] - n))), dim=1)
    moves = torch.ones_like(costs, dtype=torch.bool)
    moves[:, 0, :n] = False if free is None else free  # nothing moves a given start
    inside = kinds.inside(t)
    for group in bounds:
        variables, z = torch.cat(group.variables(n)), group.place.of(t.z)
        of, can = (values[:, group.place.knots][..., variables] for values in (costs, moves))
        loose = group.place.of(inside) & can & (of * group.place.of(t.s).clamp(min=1.0) <= kinds.how.held)
        z[loose] = 1.0
    adjoin(kinds, at, t)
