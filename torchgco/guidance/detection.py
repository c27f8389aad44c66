"""Where a trajectory is caught: F_k and J (Equations 53, 54)."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.problem import Problem


def active_counts(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """|F_k| (B, N+1): rows of geometric constraints with c > 0 at every knot."""
    counts = torch.zeros(X.shape[:2], dtype=torch.int64, device=X.device)
    for constraint in problem.geometric:
        counts[:, constraint.knots] += (constraint.value(X, U) > 0).sum(-1)
    return counts


def caught_knots(problem: Problem, X: Tensor, U: Tensor, least: int = 2) -> Tensor:
    """J (B, N+1) bool: knots with |F_k| >= `least`, the given start and the unguided end left out.

    One active sphere is left to the gradient; the gradients of two can cancel.
    """
    caught = active_counts(problem, X, U) >= least
    caught[:, 0] = caught[:, -1] = False
    return caught
