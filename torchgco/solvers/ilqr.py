"""iLQR, the local solver (Algorithm 2): its options, and an inner solve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchgco.base.options import Count, NonNegative
from torchgco.base.status import STALLED, Status
from torchgco.base.tree import Rows, put, take
from torchgco.ilqr.line_search import LineSearch
from torchgco.ilqr.step import Descent
from torchgco.kernels import kernels_of, measured
from torchgco.lagrangian.lagrangian import InnerState, Iterate, Lagrangian, Multipliers, PassEnd, SolveEnd
from torchgco.native.kept_problem import KeptDescent
from torchgco.obstacles.base import ADMITTED
from torchgco.problem.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers.contracts import Call, Solver
from torchgco.solvers.ending import start_status
from torchgco.solvers.session import Session


@dataclass(frozen=True)
class ILQR(Solver, named="ilqr"):
    """Iterative LQR: expansions, backward pass, line search, until L_M no longer falls.

    Used alone, it makes one inner solve; constraints count only through the multipliers and penalties of a warm start,
    which stay fixed.

    Args:
        as_printed: the algorithm as the paper prints it: costs in their own units, the last step of a line search is
            accepted even if L_M rises, and the inner solve ends with the first failed search. Otherwise costs are in
            units of `Problem.cost_unit`, so that scaling all weights changes no iterate, no step raises L_M, and a
            failed line search raises mu_r (Levenberg-Marquardt).
        tolerance: an inner solve has converged where actual and expected change of L_M are at most this share of it;
            as printed: where the actual change is below it, in units of cost.
        max_iterations: inner limit.
        line_search: how step lengths are chosen.

    Raises:
        InputError: a field out of its range.
    """

    as_printed: bool = False
    tolerance: NonNegative = 1e-6
    max_iterations: Count = 50
    line_search: LineSearch = LineSearch()

    @cached_property
    def descent(self) -> Descent:
        """The options as kernels read them."""
        return Descent(self.line_search, self.tolerance, self.max_iterations, self.as_printed)

    def run(self, call: Call) -> Solution:
        """One inner solve of a checked call."""
        session = Session(call, self.as_printed)
        problem, warm = session.call.problem, session.call.warm
        fixed = Multipliers.zero(problem, 0.0) if warm is None else warm
        lagrangian = Lagrangian(problem, fixed, None, phr=False)
        late = None if call.deadline is None else lambda: call.late
        s, status = descend(self, lagrangian, session.call.U0, start_is_clear=problem.start_is_clear, late=late)
        end = Iterate(s.X, s.U, fixed, s.cost, measured(problem, s.X, s.U))
        # Multipliers are fixed: a trajectory that has converged and isn't feasible stays so.
        done = (status == Status.MAX_ITERATIONS) & (s.inner < self.max_iterations)
        status = torch.where(done, STALLED, status)
        none = torch.zeros_like(status)
        ended = SolveEnd(end, end, status, s.iterations, (s.iterations > 0).long(), none)
        return session.finished(ended, ADMITTED)


def descend(
    inner: ILQR,
    lagrangian: Lagrangian,
    U: Tensor,
    start_is_clear: Tensor | None = None,
    late: Callable[[], bool] | None = None,
) -> tuple[InnerState, Tensor]:
    """One inner solve of each problem from controls U (B, N, m); returns the end states and the statuses (B,).

    A problem whose L_M isn't finite, or whose `start_is_clear` (B,) is False, stays as it starts. Tolerances are in the
    units of the problem's cost.

    Args:
        late: whether the time is over, asked before each iteration; with `start_is_clear`.
    """
    problem, kernels = lagrangian.problem, kernels_of(lagrangian.problem)
    rows = torch.arange(problem.B, device=U.device)
    none = (torch.zeros_like(rows) for _ in range(3))
    if kernels.compiled and start_is_clear is None:
        X, cost, merit = (U.new_empty(problem.B, *shape) for shape in ((problem.N + 1, problem.n), (), ()))
        X[:, 0] = problem.x0
        whole = InnerState(rows, X, U.clone(), cost, merit, torch.zeros_like(cost), *none)
        status = _status(kernels.descend(lagrangian, whole, inner.descent, inner.max_iterations, begins=True))
    else:
        X, cost, merit = kernels.begun(lagrangian, U)
        whole = InnerState(rows, X, U.clone(), cost, merit.clone(), torch.zeros_like(cost), *none)
        status = start_status(X, merit, start_is_clear)
    running, going, limit = whole, status == Status.RUNNING, inner.max_iterations if late is None else 1
    while (stay := going.nonzero().flatten()).numel() > 0:
        if late is not None and late():
            status[running.rows[stay]] = Status.TIME_LIMIT
            break
        if stay.numel() < going.numel():
            running, lagrangian = take(running, stay), lagrangian.take(stay)
        kernels = kernels_of(lagrangian.problem)
        now = _status(kernels.descend(lagrangian, running, inner.descent, limit))
        status[running.rows], going = now, now == Status.RUNNING
        if running is not whole:
            put(whole, running.rows, running)
    return whole, status


def _status(end: PassEnd) -> Tensor:
    """Why inner solves end, (B,); RUNNING where they don't."""
    reason = torch.where(end.stuck, int(Status.LINE_SEARCH_FAILED), int(Status.MAX_ITERATIONS))
    return torch.where(end.ended, reason, end.status)


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
        subset = self.problem.take(index)
        return self if subset is self.problem else RepeatedDescent(self.inner, subset.renewed())

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
        end, _ = descend(self.inner, Lagrangian(problem, multipliers, None, not self.inner.as_printed), U)
        return end.X, end.U, measured(problem, end.X, end.U)
