"""What a solution becomes when its problem changes a little: to first order, without a solve."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchgco.base.differentiability import Differentiability as Why
from torchgco.base.errors import InputError
from torchgco.base.shapes import computing_on
from torchgco.base.status import Status
from torchgco.explaining.account import Account
from torchgco.kernels import current, followed, measured
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.obstacles.base import ADMITTED
from torchgco.problem.horizons import for_solvers
from torchgco.problem.problem import Problem, current_problem
from torchgco.sensitivity.attach import refuse_forms
from torchgco.sensitivity.function import System
from torchgco.sensitivity.points import Points, gains_of, points_of
from torchgco.sensitivity.residual import Residual, residual
from torchgco.solution import Solution
from torchgco.solvers.ending import judged_between

CROSSED = 1e-6  # by more than this a row that didn't hold is violated (the interior point's violation_tolerance)


def predicted(solution: Solution, changed: Problem, problem: Problem | None = None) -> Solution:
    """The solution of a problem that has changed a little, to first order: one step of Newton's method on its KKT
    conditions, with the rows that hold as they were, and the rollout that tracks where this leads.

    It costs a linear solve instead of iterations (Fiacco 1983); its error is of second order in the change. Whatever
    the problem is made of may have changed: starts, obstacles, weights, models.

    Args:
        solution: of the problem before.
        changed: the problem as it is now, of the same form.
        problem: as it was; None: the one that the solution knows.

    Returns:
        X, U, multipliers, cost and violation of the changed problem, FEASIBLE where the violation is at most 1e-3 and
        INFEASIBLE elsewhere; a solve may begin with it (`warm=`). `differentiable` says where the prediction holds,
        and `why_not` why it doesn't: ROWS_CHANGE where a row begins or ceases to hold on the way, and the reasons of
        the solution itself, where the controls are those of before.

    Raises:
        InputError: a problem of another form, one in float32 or with horizons per problem, a free time or rows of two
            knots, or a solution that no longer knows its problem.
    """
    changed = current_problem(changed)
    before = problem if problem is not None else solution.account and solution.account.problem
    if before is None:
        raise InputError("problem", "the problem that was solved", "a solution that no longer knows it")
    if solution.account is not None and solution.account.smoothing:
        raise InputError("solution", "one without smoothing", "one with it")
    if current_problem(before) is not before:
        expected = "another problem: numbers of the one that was solved have been changed in place"
        raise InputError("changed", expected, "the changed one itself")
    for each in (before, changed):
        refuse_forms(each, "a prediction")
        if for_solvers(each) is not each:
            expected = "a problem with one horizon, a fixed time and no rows of two knots, for a prediction"
            got = "rows of two knots" if each.time is None else "a free time"
            raise InputError("problem", expected, got if each.horizon is None else "horizons per problem")
    was, now = ((each.B, each.N, each.n, each.m, each.row_shapes) for each in (before, changed))
    if was != now:
        raise InputError("changed", f"a problem with B, N, n, m, rows as before, {was}", now)
    with torch.no_grad(), computing_on(changed.x0.device):
        points = points_of(current(before), solution.detach())
        live = changed.grown(points.growth) if bool((points.growth > 0).any()) else changed
        of = residual(live, points.solution.X, points.solution.U, points.costates, points.lam)
        return _stepped(changed, points, of)


def _stepped(problem: Problem, points: Points, of: Residual) -> Solution:
    """The points one step further."""
    old, holds = points.solution, points.reason == Why.DIFFERENTIABLE
    system = System(points.problem, old.X, old.U, old.multipliers.lam, points.active, K=gains_of(points.problem, old))
    x, u, _, v = (z[0].detach() for z in system.solve(*(z.detach()[None] for z in (of.x, of.u, of.gaps, of.rows))))
    holds &= torch.isfinite(x).flatten(1).all(-1) & torch.isfinite(u).flatten(1).all(-1)
    keep = holds.view(-1, 1, 1)
    moved = old.X + torch.where(keep, x, 0.0)
    X = torch.cat((problem.start_in(moved[:, 0]).unsqueeze(1), moved[:, 1:]), dim=1)
    X, U = followed(problem, X, old.U + torch.where(keep, u, 0.0), old.K)
    lam = points.lam + torch.where(holds.unsqueeze(-1) & points.active, v, 0.0)
    reason = torch.where(_rows_change(problem, points, X, U, lam) & holds, int(Why.ROWS_CHANGE), points.reason)
    worst = measured(problem, X, U)
    status = torch.where(worst <= ADMITTED, int(Status.FEASIBLE), int(Status.INFEASIBLE))
    status = judged_between(problem, X, U, status)
    sizes = [rows[0].numel() for rows in old.multipliers.lam]
    parts = zip(lam.split(sizes, dim=1), old.multipliers.lam, strict=True)
    none = torch.zeros_like(old.iterations)
    return replace(
        old, X=X, U=U, multipliers=Multipliers(tuple(new.view_as(was) for new, was in parts), old.multipliers.mu),
        cost=problem.cost.total(X, U), violation=worst, status=status, reason=reason, iterations=none,
        outer_iterations=none, guided=none, account=Account(problem),
    )  # fmt: skip


def _rows_change(problem: Problem, points: Points, X: Tensor, U: Tensor, lam: Tensor) -> Tensor:
    """Where an inequality that held pulls now, or one that didn't hold is violated, (B,) bool."""
    change, sizes = torch.zeros(problem.B, dtype=torch.bool, device=X.device), [0]
    for constraint in problem.constraints:
        c = constraint.value(X, U).flatten(1)
        rows = slice(sizes[-1], sizes[-1] + c.shape[1])
        sizes.append(rows.stop)
        if constraint.sense == "inequality":
            active = points.active[:, rows]
            change |= (torch.where(active, -lam[:, rows], c - CROSSED) > 0).any(-1)
    return change
