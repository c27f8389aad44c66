"""If even the shortest step fails: Gauss-Newton steps in states and controls together (multiple shooting).

Where the dynamics are unstable and the gains around an iterate don't stabilise them, rollouts diverge at every step
length. With the states as variables, and gaps between them that the linearised dynamics close, the steps lead to a
trajectory whose gains stabilise the dynamics.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.dynamics.rollout import closed_loop
from torchgco.ilqr.line_search import Rollouts
from torchgco.ilqr.riccati import backward
from torchgco.lagrangian.expansion import linearise
from torchgco.lagrangian.lagrangian import Lagrangian

LIFTED_STEPS = 20  # steps at most
GAIN = 1e-2  # share of L_M by which a rollout must lower it
LOST_BY = 1e6  # rollouts diverge where even the shortest step makes L_M this many times as large


def diverges(lagrangian: Lagrangian, X: Tensor, U: Tensor, merit: Tensor, G: Tensor, shortest: float) -> Tensor:
    """Whether even the shortest step along the gains G (N, B, m, n+1) makes L_M more than `LOST_BY` |merit|, (B,)."""
    value = lagrangian.value(*closed_loop(lagrangian.problem.dynamics, X, U, G, torch.full_like(merit, shortest)))[1]
    return ~(value <= LOST_BY * merit.abs())


def lifted_search(lagrangian: Lagrangian, X: Tensor, U: Tensor, merit: Tensor) -> Rollouts:
    """The first rollout that lowers L_M = merit (B,) by `GAIN`, from X (B, N+1, n), U (B, N, m); else not accepted."""
    none = torch.zeros_like(merit, dtype=torch.bool)
    rollouts = Rollouts(X.clone(), U.clone(), merit.clone(), merit.clone(), torch.ones_like(merit), none)
    rows = torch.arange(X.shape[0], device=X.device)
    for i in range(LIFTED_STEPS):
        if rows.numel() == 0:
            break
        subset, dynamics = lagrangian.take(rows), lagrangian.problem.dynamics.take(rows)
        n, F = X.shape[-1], linearise(subset.problem, X, U)
        F[:, :, :n, n] = (subset.problem.along.step(X[:, :-1], U) - X[:, 1:]).transpose(0, 1)
        step = backward(F, subset.expand(X, U), torch.zeros_like(X[:, 0, 0]))
        if i > 0:  # the first gains are those that failed
            _keep(rollouts, rows, subset, *closed_loop(dynamics, X, U, step.gains, torch.ones_like(X[:, 0, 0])))
        X, U = _linear_step(F, step.gains, X, U)
        going = ~rollouts.accepted[rows] & ~step.failed & torch.isfinite(X).flatten(1).all(-1)
        rows, X, U = rows[going], X[going], U[going]
    return rollouts


def _keep(rollouts: Rollouts, rows: Tensor, lagrangian: Lagrangian, X: Tensor, U: Tensor) -> None:
    """Write the trajectories with a low enough L_M into `rollouts`."""
    cost, value = lagrangian.value(X, U)
    low = torch.isfinite(value) & (value < rollouts.merit[rows] - GAIN * rollouts.merit[rows].abs())
    won = rows[low]
    for tensor, new in ((rollouts.X, X), (rollouts.U, U), (rollouts.cost, cost), (rollouts.merit, value)):
        tensor[won] = new[low]
    rollouts.accepted[won] = True


def _linear_step(F: Tensor, G: Tensor, X: Tensor, U: Tensor) -> tuple[Tensor, Tensor]:
    """States and controls after a full step of the linearised dynamics F (N, B, n+1, s) under the gains G."""
    n, unit = X.shape[-1], torch.ones_like(X[:, 0, :1])
    dx = torch.zeros_like(X[:, 0])
    new_X, new_U = [X[:, 0]], []
    for k in range(U.shape[1]):
        z = torch.cat((dx, unit), dim=-1).unsqueeze(-1)
        du = torch.bmm(G[k], z)
        dx = torch.bmm(F[k, :, :n], torch.cat((z, du), dim=1)).squeeze(-1)
        new_X.append(X[:, k + 1] + dx)
        new_U.append(U[:, k] + du.squeeze(-1))
    return torch.stack(new_X, dim=1), torch.stack(new_U, dim=1)
