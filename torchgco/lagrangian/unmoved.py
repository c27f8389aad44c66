"""Whether violated rows are what they are whatever the controls, or near these."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.base.autodiff import gradients
from torchgco.base.draws import scattered
from torchgco.dynamics.rollout import open_loop
from torchgco.problem.problem import Problem

CHANGE_SIZES = 0.1, 1.0, 10.0, 1e3  # of changes of the controls, beside their own size and one


def unmoved(problem: Problem, X: Tensor, U: Tensor, tolerance: float) -> Tensor:
    """Whether rows are violated by more than `tolerance`, and all of these keep their values for other controls, (B,).

    Small and large changes of the controls are tried, of one sign and of both: a row may be flat where it is violated,
    and not elsewhere. Never where a part of the start is free.

    Args:
        X, U: (B, N+1, n), (B, N, m).
    """
    problem = problem.held_at(X[:, 0])
    kept, broken, later = torch.ones(problem.B, dtype=torch.bool, device=X.device), False, False
    rows = [(row, row.value(X, U), row.violation(X, U) > tolerance) for row in problem.constraints]
    for row, _, bad in rows:
        knots = torch.arange(problem.N + 1, device=X.device)[row.knots]
        broken = broken | bad.flatten(1).any(-1)
        later = later or bool(bad[:, knots > 0].any())
    wave = scattered(U[0])
    for way in (wave, torch.ones_like(wave), -torch.ones_like(wave)):
        for size in CHANGE_SIZES:
            other = U + size * (1.0 + U.abs()) * way
            # Rows of the first knot ask for no rollout.
            there = open_loop(problem.dynamics, problem.x0, other) if later else X
            for row, before, bad in rows:
                now = row.value(there, other)
                kept &= ~((now != before) & torch.isfinite(now) & bad).flatten(1).any(-1)
    if problem.free_start is not None:
        kept &= ~problem.free_start.any(-1)
    return kept & broken


def without_slope(problem: Problem, X: Tensor, U: Tensor, tolerance: float) -> Tensor:
    """Whether rows are violated by more than `tolerance`, and none of these has a slope at X, U, (B,).

    A comparison, a sign or a rounding has none: no step by derivatives lowers such a row.
    """
    s = problem.n + 1 + problem.m
    H = X.new_zeros(*X.shape[:2], s, s)
    broken = sloped = torch.zeros_like(X[:, 0, 0], dtype=torch.bool)
    for constraint in problem.constraints:
        bad = constraint.violation(X, U) > tolerance
        violated = bad.flatten(1).any(-1)
        if not bool(violated.any()):
            continue
        broken, push = broken | violated, bad.to(X.dtype) * constraint.value(X, U)
        if constraint.joins_knots:  # no block of a knot has its slopes
            along = gradients(lambda x, u, constraint=constraint, push=push: push * constraint.value(x, u), X, U)
            sloped = sloped | torch.cat([slope.flatten(1) for slope in along], dim=-1).ne(0).any(-1)
        else:
            constraint.accumulate(X, U, push, bad.to(X.dtype), H)
    return broken & ~sloped & (H == 0).flatten(1).all(-1)
