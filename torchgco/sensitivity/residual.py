"""The KKT conditions at a fixed solution, as functions of everything that the problem is made of.

They are computed by the problem's own functions with gradients recorded, so that no parameter has to be looked for:
autodiff leads to tensors in the parts, to those that functions capture, and to weights of modules.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.base.gradients import recording
from torchgco.problem.problem import Problem


@dataclass(frozen=True)
class Residual:
    """What is 0 at the solution, and the Lagrangian L = J + y' (step(x, u) - x') + lam' c."""

    start: Tensor  # (B, n): the given x_0
    x: Tensor  # (B, N+1, n): slopes of L by the states; 0 for a given start
    u: Tensor  # (B, N, m): and by the controls
    gaps: Tensor  # (B, N, n)
    rows: Tensor  # (B, R): c of all constraints
    lagrangian: Tensor  # (B,)

    def take(self, rows: Tensor) -> Residual:
        """That of the problems at `rows`, places or a mask."""
        return Residual(**{name: values[rows] for name, values in vars(self).items()})


def residual(problem: Problem, X: Tensor, U: Tensor, y: Tensor, lam: Tensor) -> Residual:
    """The residual at X (B, N+1, n), U (B, N, m) with costates y (B, N+1, n) and multipliers lam (B, R).

    The numbers of a given start are those of the problem; multipliers of rows that don't hold are 0.
    """
    with recording():
        states, U = X.detach().clone().requires_grad_(), U.detach().clone().requires_grad_()
        start = problem.x0
        first = start if problem.free_start is None else torch.where(problem.free_start, states[:, 0], start)
        Z = torch.cat((first.unsqueeze(1), states[:, 1:]), dim=1)
        gaps = problem.along.step(Z[:, :-1], U) - Z[:, 1:]
        rows = [constraint.value(Z, U).flatten(1) for constraint in problem.constraints]
        c = torch.cat([gaps.new_zeros(len(gaps), 0), *rows], dim=1)
        # Sums by problem, knots last: one over all axes would be split among threads by batch size.
        of_rows = torch.where(lam != 0, lam * c, 0.0).sum(-1)
        lagrangian = problem.cost.total(Z, U) + (y[:, 1:] * gaps).sum(-1).sum(-1) + of_rows
        by_x, by_u = torch.autograd.grad(lagrangian.sum(), (states, U), create_graph=True, materialize_grads=True)
        return Residual(start, by_x, by_u, gaps, c, lagrangian)
