"""Where a trajectory is caught: F_k and J (Equations 53, 54)."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.problem.problem import Problem


def active_counts(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """|F_k| (B, N+1): rows of geometric constraints with c > 0 at every knot."""
    counts = torch.zeros(X.shape[:2], dtype=torch.int64, device=X.device)
    for constraint in problem.geometric:
        counts[:, constraint.knots] += (constraint.value(X, U) > 0).sum(-1)
    return counts


def caught_knots(
    problem: Problem, X: Tensor, U: Tensor, outer: Tensor | None = None, single_contact_after: int | None = None
) -> Tensor:
    """J (B, N+1) bool: knots with |F_k| >= 2, the given start and the unguided end left out.

    A single active sphere is left to its gradient; the gradients of two can cancel. But a sphere hit at its centre has
    no gradient to the side: from the outer iteration `single_contact_after` on, a single one counts.

    Args:
        outer: outer iterations of each problem so far (B,).
    """
    least = torch.full_like(X[:, :1, 0], 2)
    if outer is not None and single_contact_after is not None:
        least = torch.where(outer >= single_contact_after, 1, 2).unsqueeze(-1)
    caught = active_counts(problem, X, U) >= least
    caught[:, 0] = caught[:, -1] = False
    return caught
