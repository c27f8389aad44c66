"""How good a trajectory is: its violation, whether it has arrived, and which of two is better."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from torchgco.problem import Problem

GOAL_TOLERANCE = 0.09  # share of the distance from start to goal within which a trajectory has arrived


class Rated(Protocol):
    """A trajectory with its cost and violation, (B, ...)."""

    @property
    def X(self) -> Tensor: ...
    @property
    def cost(self) -> Tensor: ...
    @property
    def violation(self) -> Tensor: ...


def violation(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """The largest violation (B,): lengths in metres, all else in the units of its constraint."""
    worst = X.new_zeros(X.shape[0])
    for constraint in problem.constraints:
        worst = torch.maximum(worst, constraint.worst(X, U))
    return worst


def is_better(cost: Tensor, worst: Tensor, old_cost: Tensor, old_worst: Tensor, limit: float) -> Tensor:
    """Whether a trajectory is better than an old one (B,): feasible before infeasible, then cost, then violation."""
    fits, old_fits = worst <= limit, old_worst <= limit
    return (fits & (~old_fits | (cost < old_cost))) | (~fits & ~old_fits & (worst < old_worst))


def has_arrived(problem: Problem, X: Tensor, tolerances: float = 1.0) -> Tensor:
    """Whether trajectories X (B, N+1, n) end within so many goal tolerances of the goal, (B,); False without a goal."""
    goal, at = problem.cost.goal(problem.x0), problem.dynamics.position
    if goal is None or at is None:
        return torch.zeros_like(X[:, 0, 0], dtype=torch.bool)
    last, first = ((x - goal)[:, at].square().sum(-1).sqrt() for x in (X[:, -1], problem.x0))
    return last <= tolerances * GOAL_TOLERANCE * first


def is_preferred(problem: Problem, new: Rated, old: Rated, limit: float, by_arrival: bool = True) -> Tensor:
    """Whether a trajectory is to be kept in place of an old one (B,): arrival first, then `is_better`."""
    better = is_better(new.cost, new.violation, old.cost, old.violation, limit)
    if not by_arrival:
        return better
    arrived, before = ((path.violation <= limit) & has_arrived(problem, path.X) for path in (new, old))
    return torch.where(arrived == before, better, arrived)
