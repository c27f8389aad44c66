"""Solutions in the form that solvers work on, where a free time or carried numbers are states, and the way back."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchgco.kernels import current
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.problem.carried import carried_of
from torchgco.problem.horizons import for_solvers
from torchgco.problem.in_time import factors_in, factors_of, states_in_time, times_of
from torchgco.problem.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers.timing import lifted_multipliers


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
        carried, X, U = carried_of(problem), solution.X, solution.U
        X = X if carried is None else torch.cat((X, carried.along(X, U)), dim=-1)
    return whole, replace(solution, X=X.contiguous(), U=U.contiguous(), multipliers=multipliers)


def for_user(problem: Problem, found: Solution, K: Tensor) -> Solution:
    """The same solution in the user's states and controls, with the times where these are free; gradients go along.

    Args:
        problem: the user's.
        K: its gains.
    """
    if found.X.shape[-1] == problem.n and problem.time is None:
        return found
    lam = found.multipliers.lam[: len(problem.constraints)]
    parts = {"X": found.X[..., : problem.n], "U": found.U[..., : problem.m], "K": K}
    times = None if problem.time is None else times_of(problem, factors_in(problem, found.X))
    return replace(found, **parts, multipliers=Multipliers(lam, found.multipliers.mu), times=times)
