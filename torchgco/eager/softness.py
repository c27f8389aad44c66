"""Rows that hold as equalities give way more where units are small.

Their stiffness, 1 / delta_c in the interior point, is added to the curvature of the cost, of which rounding would leave
nothing where that is many times smaller. The cost lets a row give way by about J^2 times how far it lets a variable
move; of that, a small share is enough.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.eager.model import Derivatives, Model


def gives_of(model: Model, at: Derivatives, curvature: Tensor, share: Tensor, rows: Tensor) -> Tensor:
    """By how much more than others rows are to give way, at least 1 (b, R).

    Args:
        curvature: that of the cost by each variable, (b, N+1, S), at least 0.
        share: of what the cost lets them give way, (b,).
        rows: which are asked for, (b, R) bool; the others have 1.
    """
    gives = torch.ones_like(rows, dtype=curvature.dtype)
    if not bool(rows.any()):
        return gives
    moves = _freedom(at.F, curvature, model.problem.free_start)
    for part in at.slopes:
        own = rows[:, part.place.rows]
        if bool(own.any()):
            squares, by = part.squares(moves)  # (b, K, p, v)
            least = torch.where(squares * by > 0.0, squares * by, torch.inf).amin(-1).flatten(1)
            found = (share.unsqueeze(-1) * least).clamp(min=1.0)
            gives[:, part.place.rows] = torch.where(own & torch.isfinite(found), found, 1.0)
    return gives


def costs_of(F: Tensor, curvature: Tensor) -> list[Tensor]:
    """What it costs to move the variables of each knot, (b, S), with all they lead to; from the last, (b, n), on.

    Args:
        F: slopes of the dynamics (b, N, n, S).
        curvature: of the cost by each variable, (b, N+1, S), at least 0.
    """
    n, N = F.shape[-2], F.shape[1]
    costs = [curvature[:, N, :n]]
    for k in range(N - 1, -1, -1):
        after = costs[-1][:, :n].unsqueeze(-1)
        costs.append(curvature[:, k] + (F[:, k].square().mT @ after).squeeze(-1))
    return costs


def _freedom(F: Tensor, curvature: Tensor, free: Tensor | None) -> Tensor:
    """How far the cost lets the variables of each knot move, squared, (b, N+1, S): the inverse of its curvature.

    Of controls that of all they lead to; of states, no farther than what controls lead to them. Products of different
    variables don't count, so this is right but for a factor. Variables that cost nothing have 0.
    """
    n, N = F.shape[-2], F.shape[1]
    squares, costs = F.square(), costs_of(F, curvature)
    inverse = lambda h: torch.where(h > 0.0, 1.0 / h, 0.0)
    start = inverse(costs[-1][:, :n])
    moved = torch.zeros_like(start) if free is None else torch.where(free, start, 0.0)
    found = []
    for k in range(N):
        z = costs[N - k]
        bound = torch.where(z[:, :n] > 0.0, 1.0 / z[:, :n], torch.inf)
        z = torch.cat((torch.minimum(moved, bound), inverse(z[:, n:])), dim=-1)
        found.append(z)
        moved = (squares[:, k] @ z.unsqueeze(-1)).squeeze(-1)
    last = torch.minimum(moved, torch.where(costs[0] > 0.0, 1.0 / costs[0], torch.inf))
    found.append(torch.nn.functional.pad(last, (0, curvature.shape[-1] - n)))
    return torch.stack(found, dim=1)
