"""Whether violated rows are what they are whatever the controls, or near these."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.base.draws import scattered
from torchgco.constraints.bounds import RateBounds
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
    rows = [(part, part.value(X, U), part.violation(X, U) > tolerance) for part in problem.constraints]
    for part, _, bad in rows:
        knots = torch.arange(problem.N + 1, device=X.device)[part.knots]
        broken = broken | bad.flatten(1).any(-1)
        later = later or bool(bad[:, knots > 0].any())
    wave = scattered(U[0])
    for way in (wave, torch.ones_like(wave), -torch.ones_like(wave)):
        for size in CHANGE_SIZES:
            other = U + size * (1.0 + U.abs()) * way
            # Rows of the first knot ask for no rollout.
            there = open_loop(problem.dynamics, problem.x0, other) if later else X
            for part, before, bad in rows:
                now = part.value(there, other)
                kept &= ~((now != before) & torch.isfinite(now) & bad).flatten(1).any(-1)
    if problem.free_start is not None:
        kept &= ~problem.free_start.any(-1)
    return kept & broken


def without_slope(problem: Problem, X: Tensor, U: Tensor, tolerance: float) -> Tensor:
    """Whether rows are violated by more than `tolerance`, and none of these has a slope at X, U, (B,).

    A comparison, a sign or a rounding has none: no step by derivatives lowers such a row. Bounds on rates have one.
    """
    s = problem.n + 1 + problem.m
    H = X.new_zeros(*X.shape[:2], s, s)
    broken = sloped = torch.zeros_like(X[:, 0, 0], dtype=torch.bool)
    for part in problem.constraints:
        bad = part.violation(X, U) > tolerance
        some = bad.flatten(1).any(-1)
        broken = broken | some
        if isinstance(part, RateBounds):  # rows of two knots
            sloped = sloped | some
        elif bool(some.any()):
            part.accumulate(X, U, bad.to(X.dtype) * part.value(X, U), bad.to(X.dtype), H)
    return broken & ~sloped & (H == 0).flatten(1).all(-1)
