"""Inner solves of the same problems, again and again: their numbers are written in place in between."""

from __future__ import annotations

from functools import cached_property

from torch import Tensor

from torchgco.base.tree import Rows
from torchgco.kernels import kernels_of, measured
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers
from torchgco.native.kept_descent import KeptDescent
from torchgco.problem.problem import Problem
from torchgco.solvers.ilqr import ILQR, descend


class RepeatedDescent:
    """`descend` for problems that stay packed in C, where C serves them. One thread calls it at a time.

    Args:
        inner: iLQR.
        problem: of torchgco's own parts, with tensors that nobody else holds. The start, and the references of a
            quadratic cost, count as soon as they are written in place; other numbers after `refresh`.
    """

    def __init__(self, inner: ILQR, problem: Problem) -> None:
        self.inner, self.problem = inner, problem

    @cached_property
    def _kept(self) -> KeptDescent | None:
        """Packed at the first solve, as many a subset never has one; None where PyTorch's kernels serve."""
        return kernels_of(self.problem).kept_descent(self.problem, self.inner.descent, not self.inner.as_printed)

    def take(self, index: Rows) -> RepeatedDescent:
        """The same for the problems in `index`."""
        part = self.problem.take(index)
        return self if part is self.problem else RepeatedDescent(self.inner, part.renewed())

    def refresh(self, i: int) -> None:
        """The numbers of constraint i have been written."""
        kept = vars(self).get("_kept")
        if kept is not None:
            kept.refresh_constraint(i)

    def solve(self, U: Tensor, multipliers: Multipliers) -> tuple[Tensor, Tensor, Tensor]:
        """States X (B, N+1, n), controls (B, N, m) of one inner solve from controls U, and their violation (B,)."""
        kept = self._kept
        if kept is not None and kept.solve(U, multipliers):
            return kept.X, kept.U.clone(), kept.violation()
        problem = self.problem.renewed()  # whose numbers are others than those that it was packed with
        found, _ = descend(self.inner, Lagrangian(problem, multipliers, None, not self.inner.as_printed), U)
        return found.X, found.U, measured(problem, found.X, found.U)
