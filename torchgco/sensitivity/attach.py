"""Solutions with derivatives: what follows a solve is recorded, and what becomes of it when its problem changes.

They are computed by the problem's own functions with gradients recorded, so that no parameter has to be looked for:
autodiff leads to tensors in the parts, to those that functions capture, and to weights of modules.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchgco.base.errors import InputError
from torchgco.base.gradients import asks, is_forward, not_recording, recording
from torchgco.base.options import Positive, check_value
from torchgco.base.shapes import MISTAKES, computing_on
from torchgco.base.status import Differentiability as Why
from torchgco.base.status import Status
from torchgco.base.tree import copied, is_users
from torchgco.explaining.explain import Account
from torchgco.kernels import current, followed, measured, open_loop
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.obstacles.base import ADMITTED
from torchgco.problem.horizons import for_solvers
from torchgco.problem.in_time import factors_in, factors_of, states_in_time, times_of
from torchgco.problem.problem import Problem, current_problem
from torchgco.sensitivity.points import Points, Solved, System, gains_of, points_of
from torchgco.solution import Solution
from torchgco.solvers.ending import judged_between
from torchgco.solvers.timing import lifted_multipliers


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


EXACT_STEP = 1e-7  # share of 1 + the largest state or control that the step to the exact minimum may be
EXACT_COSTATES = 1e-5  # share of the largest costate by which that step may change one


def asks_for_gradients(problem: Problem, in_solve: Problem | None = None) -> bool:
    """Whether gradients are recorded, and a tensor asks for them in the problem, or one that its functions capture; or
    one of these has a tangent of forward mode.

    Args:
        in_solve: the `current` problem, which keeps what its functions capture as long as their code.

    Raises:
        InputError: they can't be served.
    """
    if not (torch.is_grad_enabled() or is_forward()) or torch.is_inference_mode_enabled() or problem.B == 0:
        return False
    if not (problem.given is not None and problem.given.asks):
        if in_solve is None or is_forward():
            captures = _captures(problem)
        else:
            captures = in_solve.derive("captures", lambda: _captures(in_solve))
        if not captures:
            return False
    refuse_forms(problem, "tensors in it that ask for gradients (or torch.no_grad())")
    return True


def check_smoothing(problem: Problem, smoothing: Any) -> float:
    """The smoothing, 0 where none is asked for.

    Raises:
        InputError: not a number above 0, or of a form of problems that isn't served.
    """
    if smoothing is None:
        return 0.0
    value = check_value(smoothing, Positive, "smoothing")
    refuse_forms(problem, "smoothing")
    return value if problem.B > 0 else 0.0


def refuse_forms(problem: Problem, what: str) -> None:
    """Raise InputError for forms of problems that have no derivatives here, of which `what` asks for them."""
    if problem.x0.dtype != torch.float64:
        raise InputError("problem", f"a problem in float64, for {what}", problem.x0.dtype)


def _captures(problem: Problem) -> bool:
    """Whether values of users' functions lead to tensors that ask for gradients, as those of the first problem show."""
    if not problem.users:
        return False
    single = problem.take(slice(0, 1))
    model, (X, U) = single.along, (z.detach() for z in single.at_rest)
    uses: list[tuple[object, Callable[[], Tensor]]] = [
        (single.dynamics, lambda: (model.field if model.is_integrated else model.step)(X[:, :-1], U)),
        (single.cost, lambda: single.cost.total(X, U)),
        *((row, lambda row=row: row.value(X, U)) for row in single.constraints),
    ]
    with computing_on(single.x0.device), recording():  # a user's function may make tensors, too
        return any(is_users(part) and asks(value()) for part, value in uses)


def attached(
    asked: Problem, problem: Problem, solution: Solution, smoothing: float = 0.0, records: bool = True
) -> Solution:
    """The solution with X, U, costs and multipliers as functions of all that asks for gradients.

    Where a problem's solution has no derivatives, these are constants: their gradients are 0.

    Args:
        asked: the problems as they were made, which know what asks for gradients.
        problem: the same, with what a solver keeps of them.
        smoothing: mu in units of the cost: the solution is that of the barrier problem; 0: the solver's own.
        records: whether anything asks for gradients; else all are numbers.
    """
    with computing_on(problem.x0.device):
        points = points_of(*for_systems(problem, solution), smoothing)
    checks = not torch.is_inference_mode_enabled()  # where nothing can be recorded, to know the step that is left
    account = solution.account.smoothed(smoothing) if solution.account is not None and smoothing else solution.account
    known = {"trace": solution.trace, "search": solution.search, "account": account, "reason": points.reason}
    result = replace(points.solution, **known)
    rows = (points.reason == Why.DIFFERENTIABLE).nonzero().flatten()
    if not checks or (rows.numel() == 0 and not records):
        return for_user(problem, result, solution.K)
    with recording():
        subset = points.take(rows)
        try:  # where no problem is left, gradients are those of none: 0
            live = _live(asked, subset, rows)
            found_at = residual(live, subset.solution.X, subset.solution.U, subset.costates, subset.lam)
        except MISTAKES:
            if rows.numel() > 0:
                raise
            return for_user(problem, _constant(result), solution.K)  # a user's function that takes no empty batch
        near = _are_exact(subset, found_at)
        if not bool(near.all()):
            points.reason[rows[~near]] = int(Why.NOT_STATIONARY)
            rows, subset, found_at = rows[near], subset.take(near.nonzero().flatten()), found_at.take(near)
            live = live.take(near.nonzero().flatten())
        if records:
            result = _with_values(result, rows, _values(live, subset, found_at))
        return for_user(problem, result, solution.K)


def _constant(solution: Solution) -> Solution:
    """The solution of functions that take no empty batch: losses of it can be differentiated, by no other tensor."""
    lam = tuple(z.requires_grad_() for z in solution.multipliers.lam)
    for z in (solution.X, solution.U, solution.cost):
        z.requires_grad_()
    return replace(solution, multipliers=Multipliers(lam, solution.multipliers.mu))


def _live(problem: Problem, points: Points, rows: Tensor) -> Problem:
    """The problems `rows` with gradients recorded, and obstacles grown as at their points."""
    live = for_solvers(problem.recorded()).take(rows)
    return live.grown(points.growth) if bool((points.growth > 0).any()) else live


def _are_exact(here: Points, of: Residual) -> Tensor:
    """Whether the step (B,) from the points to where the conditions hold to first order is small, and a number."""
    with not_recording():
        c = of.rows if here.gap is None else of.rows + here.gap
        x, u, y, _ = (z[0].abs() for z in _system(here).solve(of.x[None], of.u[None], of.gaps[None], c[None]))
        size = 1.0 + torch.maximum(here.solution.X.abs().flatten(1).amax(-1), here.solution.U.abs().flatten(1).amax(-1))
        step = torch.maximum(x.flatten(1).amax(-1), u.flatten(1).amax(-1))
        largest = here.costates.abs().flatten(1).amax(-1)
        return (step <= EXACT_STEP * size) & (y.flatten(1).amax(-1) <= EXACT_COSTATES * largest)


def _system(points: Points) -> System:
    end = points.solution
    problem = points.problem
    if problem.cost.kernel == "quadratic":
        # Its numbers may be the user's own tensors, which a step of an optimizer changes before `backward`.
        problem = problem._with({"cost": copied(problem.cost)}, problem.known)
    return System(problem, end.X, end.U, end.multipliers.lam, points.active, points.give, gains_of(problem, end))


def _values(live: Problem, points: Points, of: Residual) -> tuple[Tensor, ...]:
    """X, U, multipliers (B, R) and costs of the points, which lead to the residual of their problems `live`."""
    solution, multipliers = points.solution, points.solution.multipliers.lam
    flat = torch.cat([solution.X.new_zeros(len(solution), 0), *(lam.flatten(1) for lam in multipliers)], dim=1)
    values = solution.X, solution.U, flat, solution.cost
    X, U, lam, cost = Solved.apply(_system(points), values, of.x, of.u, of.gaps, of.rows, of.lagrangian)
    start = of.start if live.free_start is None else torch.where(live.free_start, X[:, 0], of.start)
    X = torch.cat((start.unsqueeze(1), X[:, 1:]), dim=1)
    if points.give is not None and len(solution) > 0:
        cost = live.cost.total(X, U)  # no minimum of the cost, so no envelope
    return X, U, lam, cost


def _with_values(whole: Solution, rows: Tensor, values: tuple[Tensor, ...]) -> Solution:
    """The solution with these in its problems `rows`."""
    X, U, lam, cost = values
    lams, parts = whole.multipliers.lam, lam.split([old[0].numel() for old in whole.multipliers.lam], dim=1)
    multipliers = tuple(_written(old, rows, new.view(-1, *old.shape[1:])) for old, new in zip(lams, parts, strict=True))
    return replace(
        whole, X=_written(whole.X, rows, X), U=_written(whole.U, rows, U), cost=_written(whole.cost, rows, cost),
        multipliers=Multipliers(multipliers, whole.multipliers.mu),
    )  # fmt: skip


def _written(values: Tensor, rows: Tensor, new: Tensor) -> Tensor:
    """`values` (B, ...) with `new` in some rows."""
    return new if len(rows) == len(values) else values.index_copy(0, rows, new)


def for_systems(problem: Problem, solution: Solution) -> tuple[Problem, Solution]:
    """The problem in the form that solvers work on, with its solution; both themselves where they are one already."""
    whole = for_solvers(problem)
    if whole is problem:
        return current(problem), solution
    whole, multipliers = current(whole), solution.multipliers
    if problem.time is not None:
        X, U = states_in_time(problem, solution.X, solution.U, factors_of(problem, solution.times))
        multipliers = lifted_multipliers(problem, whole, multipliers)
    else:
        begun = whole.guessing(pad(solution.X[:, 0], (0, whole.n - problem.n)))
        X, U = torch.cat((solution.X, open_loop(begun, solution.U)[..., problem.n :]), dim=-1), solution.U
    return whole, replace(solution, X=X.contiguous(), U=U.contiguous(), multipliers=multipliers)


def for_user(problem: Problem, solution: Solution, K: Tensor) -> Solution:
    """The same solution in the user's states and controls, with the times where these are free; gradients go along.

    Args:
        problem: the user's.
        K: its gains.
    """
    if solution.X.shape[-1] == problem.n and problem.time is None:
        return solution
    lam = solution.multipliers.lam[: len(problem.constraints)]
    parts = {"X": solution.X[..., : problem.n], "U": solution.U[..., : problem.m], "K": K}
    times = None if problem.time is None else times_of(problem, factors_in(problem, solution.X))
    return replace(solution, **parts, multipliers=Multipliers(lam, solution.multipliers.mu), times=times)


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
