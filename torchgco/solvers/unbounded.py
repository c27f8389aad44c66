"""Problems without an optimum: costs that fall without end."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.native.dispatch import cost_unit, measured, open_loop
from torchgco.problem.problem import Problem

# Falls of the cost from that of the guess, as multiples of the size of that cost plus the cost unit of all stages.
DEEP = 1e6  # a fall that asks for a closer look
BOTTOMLESS = 1e20  # one that needs none: IPOPT's diverging_iterates_tol
FARTHER = 10.0, 1e3, 1e6  # times the way from the guess, for that look
GROWING = 1e-3  # controls that moved by less than this share of the largest move stay where they are


def falls_without_end(
    problem: Problem, U0: Tensor, X: Tensor, U: Tensor, cost: Tensor, violation: Tensor, tolerance: float
) -> Tensor:
    """Whether the cost (B,) of feasible trajectories X (B, N+1, n), U (B, N, m) falls without end, (B,) bool.

    It does where it lies deep below that of the guess U0 (B, N, m), and falls as fast again where the controls that
    have moved most go on in their directions, at no violation. That is tested, for a large fall may also be a reward
    that ends, such as one at wide bounds.
    """
    unit = problem.N * cost_unit(problem)
    found = (cost < -DEEP * unit) & (violation <= tolerance)
    rows = found.nonzero().flatten()
    if rows.numel() == 0:
        return found
    held, U0, U, cost, unit = problem.take(rows).held_at(X[rows, 0]), U0[rows], U[rows], cost[rows], unit[rows]
    before = held.cost.total(open_loop(held, U0), U0)
    fall, size = before - cost, before.abs() + unit
    move = U - U0
    large = move.abs() >= GROWING * move.abs().flatten(1).amax(-1).view(-1, 1, 1)
    goes_on = torch.ones_like(rows, dtype=torch.bool)
    for times in FARTHER:
        beyond = U + torch.where(large, (times - 1) * move, 0.0)
        path = open_loop(held, beyond)
        goes_on &= before - held.cost.total(path, beyond) >= 0.5 * times * fall
        goes_on &= measured(held, path, beyond) <= tolerance
    found[rows] = (fall >= BOTTOMLESS * size) | ((fall >= DEEP * size) & goes_on)
    return found
