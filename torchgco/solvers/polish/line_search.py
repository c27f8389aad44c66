"""The line search of a polish: an exact penalty as merit, and second-order corrections of refused steps."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchgco.dynamics.rollout import open_loop
from torchgco.problem.problem import Problem
from torchgco.solvers.polish.condensed import Condensed

SMALLEST_STEP = 1e-3  # step length at which the line search gives up
CORRECTIONS = 2  # of a refused step, at each step length
DEPENDENT = 1e-9  # share of the largest singular value below which active rows count as dependent
MERIT_NOISE = 1e-12  # rounding of a merit, as a share of it


def merit(problem: Problem, X: Tensor, U: Tensor, weight: float) -> float:
    """J_var + weight |violated rows|_1: exact where the weight is above every multiplier."""
    total = problem.cost.total(X, U)
    for constraint in problem.constraints:
        c = constraint.value(X, U)
        total = total + weight * (c.abs() if constraint.sense == "equality" else c.clamp(min=0.0)).sum()
    return float(total)


def descend(model: Condensed, step: Tensor, lam: Tensor, weight: float) -> tuple[Tensor, Tensor] | None:
    """States and controls (1, ...) along the step (v,) that lower the merit; None where no step length does.

    Where a step is refused, its second-order correction is tried as well: the curvature of constraints and dynamics
    violates the active rows again, and would shorten the steps near an optimum to nothing (the Maratos effect).
    """
    problem, U, alpha = model.problem, model.U, 1.0
    before = merit(problem, model.X, U, weight)
    most = before + MERIT_NOISE * (1.0 + abs(before))
    correction: Callable[[Tensor, Tensor, float], Tensor] | None = None
    while alpha >= SMALLEST_STEP:
        trial = U + alpha * step.view_as(U)
        for tries in range(1 + CORRECTIONS):
            states = open_loop(problem.dynamics, problem.x0, trial)
            if merit(problem, states, trial, weight) <= most:
                return states, trial
            if tries == CORRECTIONS or not bool(torch.isfinite(states).all()):
                break
            correction = correction or _correction(model, lam)
            trial = trial + correction(states, trial, 1.0 - alpha).view_as(U)
        alpha *= 0.5
    return None


def _correction(model: Condensed, lam: Tensor) -> Callable[[Tensor, Tensor, float], Tensor]:
    """The least change (v,) of controls that brings the active rows of a trial to a share of their present values."""
    rows = (((lam != 0) | model.equality) & (model.slopes.abs().amax(-1) > 0)).nonzero().flatten()
    inverse = torch.linalg.pinv(model.dense(rows), rtol=DEPENDENT)

    def change(X: Tensor, U: Tensor, share: float) -> Tensor:
        if rows.numel() == 0:
            return torch.zeros_like(model.gradient)
        c = torch.cat([constraint.value(X, U).flatten() for constraint in model.problem.constraints])
        return inverse @ (share * model.c[rows] - c[rows])

    return change
