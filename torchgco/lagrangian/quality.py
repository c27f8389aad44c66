"""How good a trajectory is: its violation, whether it has arrived, and which of two is better."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from torchgco.constraints.base import Constraint
from torchgco.obstacles.base import ADMITTED
from torchgco.problem.goal import RADIUS_SHARE
from torchgco.problem.problem import Problem

GOAL_TOLERANCE = RADIUS_SHARE  # share of the distance from start to goal


class Rated(Protocol):
    """A trajectory with its cost and violation, (B, ...)."""

    @property
    def X(self) -> Tensor: ...
    @property
    def cost(self) -> Tensor: ...
    @property
    def violation(self) -> Tensor: ...


def violation(constraints: Sequence[Constraint], X: Tensor, U: Tensor) -> Tensor:
    """The largest violation (B,): lengths in metres, all else in the units of its constraint."""
    worst = X.new_zeros(X.shape[0])
    for constraint in constraints:
        worst = torch.maximum(worst, constraint.worst(X, U))
    return worst


def is_better(cost: Tensor, worst: Tensor, old_cost: Tensor, old_worst: Tensor, limit: float | Tensor) -> Tensor:
    """Whether a trajectory is better than an old one, (B,).

    Feasible is better than infeasible; of two feasible ones the cheaper, of two infeasible ones the less violated. What
    has a cost or a violation that isn't finite is worse than all that have none.
    """
    sound, old_sound = (torch.isfinite(c) & torch.isfinite(v) for c, v in ((cost, worst), (old_cost, old_worst)))
    fits, old_fits = (worst <= limit) & sound, (old_worst <= limit) & old_sound
    less = (worst < old_worst) | (sound & ~old_sound)
    return (fits & (~old_fits | (cost < old_cost))) | (~fits & ~old_fits & less & (sound | ~old_sound))


def goal_tolerance(problem: Problem) -> Tensor | None:
    """The distance from the goal within which a solver counts a trajectory as arrived, (B,), m; None without a goal.

    The smaller of the goal's radius and `GOAL_TOLERANCE` times the distance from the start: a solver that stopped at
    the edge of a large goal would return trajectories that a few more iterations make cheaper. A required goal's rows
    say what arrives: all that keeps them, as far as trajectories that count as feasible do.
    """
    return problem.derive_rows("goal tolerance", _goal_tolerance)  # many steps of a solve ask for it


def _goal_tolerance(problem: Problem) -> Tensor | None:
    goal = problem.goal
    if goal is None:
        return None
    if goal.required:
        return goal.radius + ADMITTED
    near = GOAL_TOLERANCE * goal.distance(problem.x0[:, problem.position])
    return near if goal.assumed else torch.minimum(goal.radius, near)


def has_arrived(problem: Problem, X: Tensor, tolerances: float = 1.0) -> Tensor:
    """Whether X (B, N+1, n) ends within `tolerances` goal tolerances of the goal, (B,) bool; False without a goal."""
    near = goal_tolerance(problem)
    if near is None or problem.goal is None:
        return torch.zeros_like(X[:, 0, 0], dtype=torch.bool)
    return problem.goal.distance(X[:, -1, problem.position]) <= (near if tolerances == 1.0 else tolerances * near)


def ranks_arrival(problem: Problem) -> bool:
    """Whether arriving counts before the cost: at a goal that was stated.

    One derived from the cost says no more of what is wanted than the cost itself.
    """
    return problem.goal is not None and not problem.goal.assumed


def outside_goal(problem: Problem, X: Tensor) -> Tensor:
    """Whether states (B, N+1, n) end outside the ball of a stated goal, (B,) bool; NaN doesn't."""
    if problem.goal is None or problem.goal.assumed:
        return torch.zeros_like(X[:, 0, 0], dtype=torch.bool)
    return problem.goal.distance(X[:, -1, problem.position]) > problem.goal.radius + ADMITTED


def leaves_goal(problem: Problem, new: Tensor, old: Tensor) -> Tensor:
    """Whether states (B, N+1, n) end away from a stated goal at which old ones have arrived, (B,) bool."""
    if not ranks_arrival(problem):
        return torch.zeros_like(new[:, 0, 0], dtype=torch.bool)
    return has_arrived(problem, old) & ~has_arrived(problem, new)


def arrive_alike(problem: Problem, new: Tensor, old: Tensor) -> Tensor:
    """Whether both of two states (B, N+1, n) have arrived at a stated goal, or neither, (B,) bool."""
    if not ranks_arrival(problem):
        return torch.ones_like(new[:, 0, 0], dtype=torch.bool)
    return has_arrived(problem, old) == has_arrived(problem, new)


def is_preferred(problem: Problem, new: Rated, old: Rated, limit: float | Tensor, by_arrival: bool = True) -> Tensor:
    """Whether a trajectory should replace an old one, (B,) bool: feasible arrival at a stated goal counts first, then
    `is_better`."""
    better = is_better(new.cost, new.violation, old.cost, old.violation, limit)
    if not by_arrival or not ranks_arrival(problem):
        return better
    arrived, before = ((path.violation <= limit) & has_arrived(problem, path.X) for path in (new, old))
    return torch.where(arrived == before, better, arrived)
