"""Solutions with derivatives: the solve has run on numbers, and what follows it is recorded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchgco.base.differentiability import Differentiability as Why
from torchgco.base.errors import InputError
from torchgco.base.gradients import asks, is_forward, not_recording, recording
from torchgco.base.options import Positive, check_value
from torchgco.base.shapes import MISTAKES, computing_on
from torchgco.base.tree import copied, is_users
from torchgco.kernels import current, open_loop
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.problem.horizons import for_solvers
from torchgco.problem.in_time import factors_in, factors_of, states_in_time, times_of
from torchgco.problem.problem import Problem
from torchgco.sensitivity.function import Solved, System
from torchgco.sensitivity.points import Points, gains_of, points_of
from torchgco.sensitivity.residual import Residual, residual
from torchgco.solution import Solution
from torchgco.solvers.timing import lifted_multipliers

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
    if not any(map(is_users, (problem.dynamics, problem.cost, *problem.constraints))):
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
