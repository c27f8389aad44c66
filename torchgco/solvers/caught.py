"""Where a trajectory is caught: F_k and J (Equations 53, 54), and the end of its solve there."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.base.draws import DrawKey
from torchgco.lagrangian.penalties import GuideRegion
from torchgco.problem.problem import Problem
from torchgco.solvers.contracts import Advice


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


class StopWhenCaught:
    """Guidance that ends the solve of a problem whose trajectory is caught between obstacles."""

    def __init__(self, single_contact_after: int | None) -> None:
        self.single_contact_after = single_contact_after

    def suited(self, problem: Problem) -> StopWhenCaught:
        """This guidance, which serves any problem."""
        return self

    def start(self, problem: Problem, X: Tensor) -> None:
        """No penalty."""

    def update(self, problem: Problem, X: Tensor, U: Tensor, penalty: GuideRegion | None, key: DrawKey) -> Advice:
        """Stop where a knot is caught."""
        return Advice(None, stop=caught_knots(problem, X, U, key.outer, self.single_contact_after).any(-1))
