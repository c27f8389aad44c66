"""solve: one call with sensible parts, for notebooks and first steps."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchgco.guidance.detour import Detour
from torchgco.guidance.gco import GCO
from torchgco.guidance.mppi import MPPI
from torchgco.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.ilqr import ILQR
from torchgco.solvers.line_search import LineSearch


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
        U0 = warm.U if warm is not None else _at_rest(problem)
    if solver is None:
        solver = default_solver(guided=bool(problem.geometric))
    multipliers = None if warm is None else warm.multipliers
    return solver.solve(problem, U0, seed=seed, ids=ids, warm=multipliers)


def default_solver(guided: bool = True) -> AugmentedLagrangian:
    """What `solve` takes where no solver is given: the settings of the config `gco` that depend on no vehicle."""
    sampler = MPPI(samples=256, covariance=None, rounds=16, knots=8, decay=0.9, linger=1.0, elite=5)
    return AugmentedLagrangian(
        inner=ILQR(tolerance=1e-2, max_iterations=20, line_search=LineSearch(accept_last=False)),
        guidance=GCO(sampler=sampler, adopt=True, patience=4, detour=Detour()) if guided else None,
        max_outer_iterations=20,
        grow_when_feasible=False,
        cost_tolerance=1e-3,
        hold_factor=2.0,
        attempts=3,
        arrival=0.09,
        clip=True,
    )


def _at_rest(problem: Problem) -> Tensor:
    like = torch.zeros(problem.B, problem.N, problem.m, dtype=problem.x0.dtype, device=problem.x0.device)
    return problem.cost.rest_controls(like)
