"""solve: one call with a default solver, for notebooks and first steps."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchgco.presets import gco
from torchgco.problem import Problem
from torchgco.solution import Solution


def solve(
    problem: Problem,
    U0: Tensor | None = None,
    solver: Any = None,
    seed: int = 0,
    ids: Tensor | None = None,
    warm: Solution | None = None,
    max_seconds: float | None = None,
) -> Solution:
    """Solve every problem of the batch.

    Args:
        problem: B problems.
        U0: initial controls (B, N, m). Default: those of `warm`, else the cost's reference, else zero.
        solver: default: `presets.gco`, the settings of the configuration `gco`.
        seed, ids: the key of the random draws; ids are int64 (B,), by default 0..B-1.
        warm: an earlier solution of problems of this form: the solve starts from its multipliers and, without U0, from
            its controls.
        max_seconds: time after which the best trajectories so far are returned; see `Solver.solve`.

    Raises:
        InputError: U0, ids or warm don't fit the problem.
    """
    if U0 is None:
        U0 = warm.U if warm is not None else _at_rest(problem)
    if solver is None:
        solver = gco(problem)
    multipliers = None if warm is None else warm.multipliers
    return solver.solve(problem, U0, seed=seed, ids=ids, warm=multipliers, max_seconds=max_seconds)


def _at_rest(problem: Problem) -> Tensor:
    like = torch.zeros(problem.B, problem.N, problem.m, dtype=problem.x0.dtype, device=problem.x0.device)
    return problem.cost.rest_controls(like)
