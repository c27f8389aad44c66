"""solve: one call with sensible parts, for notebooks and first steps."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchgco.costs.quadratic import BoundQuadratic
from torchgco.guidance.gco import GCO
from torchgco.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian


def solve(
    problem: Problem,
    U0: Tensor | None = None,
    solver: Any = None,
    seed: int = 0,
    ids: Tensor | None = None,
    warm: Solution | None = None,
) -> Solution:
    """Solve every problem of the batch.

    Args:
        problem: B problems.
        U0: initial controls (B, N, m). Default: those of `warm`, else the cost's reference, else zero.
        solver: default: the augmented Lagrangian, guided where there are obstacles.
        seed, ids: key the random draws (int64 (B,), default 0..B-1).
        warm: a former solution of problems of this form; its controls and multipliers are where the solve starts.

    Raises:
        InputError: U0, ids or warm don't fit the problem.
    """
    if U0 is None:
        U0 = warm.U if warm is not None else _reference_controls(problem)
    if solver is None:
        solver = default_solver(guided=bool(problem.geometric))
    multipliers = None if warm is None else warm.multipliers
    return solver.solve(problem, U0, seed=seed, ids=ids, warm=multipliers)


def default_solver(guided: bool = True) -> AugmentedLagrangian:
    """What `solve` takes where no solver is given."""
    return AugmentedLagrangian(guidance=GCO() if guided else None)


def _reference_controls(problem: Problem) -> Tensor:
    if isinstance(problem.cost, BoundQuadratic):
        return problem.cost.u_ref.expand(problem.B, problem.N, problem.m).contiguous()
    return torch.zeros(problem.B, problem.N, problem.m, dtype=problem.x0.dtype, device=problem.x0.device)
