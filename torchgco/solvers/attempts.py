"""Other paths in place of the iterate: taken from guidance, and tried again from where the first one was caught."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchgco.lagrangian import Lagrangian, Multipliers
from torchgco.native.dispatch import open_loop, value
from torchgco.problem import Problem
from torchgco.shapes import copied, put, take
from torchgco.solution import Solution
from torchgco.solvers.state import Advice, Iterate, OuterLoop, State
from torchgco.status import Status


def has_arrived(problem: Problem, path: Iterate | Solution, share: float, limit: float) -> Tensor:
    """Whether a feasible path has come to the goal (B,): within `share` of the distance from the start."""
    goal, at = problem.cost.goal(problem.x0), problem.dynamics.position
    if goal is None or at is None:
        return torch.zeros_like(path.violation, dtype=torch.bool)
    last, first = ((x - goal)[:, at].square().sum(-1).sqrt() for x in (path.X[:, -1], problem.x0))
    return (path.violation <= limit) & (last <= share * first)


def try_again(s: State, rows: Tensor, problem: Problem, duals: Multipliers, status: Tensor, solver: OuterLoop) -> None:
    """Back to the caught path for elements that have ended an attempt and have another left (in place)."""
    left = (s.attempt[rows] > 0) & (s.attempt[rows] < solver.attempts)
    if solver.arrival is not None and not solver.thorough:
        left &= ~has_arrived(problem, take(s.best, rows), solver.arrival, solver.violation_tolerance)
    again = ((status[rows] != Status.RUNNING) & left).nonzero().flatten()
    if again.numel() == 0:
        return
    place = rows[again]
    origin = take(s.origin, place)
    s.X, s.U = s.X.clone(), s.U.clone()
    s.X[place], s.U[place] = origin.X, origin.U
    put(duals, again, origin.duals)
    s.attempt[place] += 1
    s.since[place] = s.outer[place]
    s.led[place] = False
    s.last_cost[place] = torch.inf
    status[place] = Status.RUNNING


def go_on_from(
    s: State, rows: Tensor, problem: Problem, advice: Advice, duals: Multipliers, solver: OuterLoop
) -> Multipliers:
    """Put the advised controls in place of the iterate where they are taken, and return multipliers for it.

    The old ones belong to the path that is left: they start again at zero. The penalty must keep the solver from
    falling back, so it is raised to what was advised, or until the path that is left costs more than the one taken.
    """
    taken = advice.taken.nonzero().flatten()
    if taken.numel() == 0:
        return duals
    part, place = problem.take(taken), rows[taken]
    old_X, old_U = s.X[place], s.U[place]
    first = (s.attempt[place] == 0).nonzero().flatten()
    left = Iterate(old_X, old_U, take(duals, taken), s.cost[place], s.best.violation[place])
    put(s.origin, place[first], take(left, first))
    s.attempt[place[first]] = 1
    U = advice.U[taken]
    X = open_loop(part, U)
    fresh = Multipliers(tuple(torch.zeros_like(lam[taken]) for lam in duals.lam), torch.ones_like(duals.mu[taken]))
    cost, merit = value(Lagrangian(part, fresh, None, True), old_X, old_U)
    gain = (part.cost.total(X, U) - cost).clamp(min=0.0) / (merit - cost).clamp(min=1e-12)
    keeping = solver.hold_factor * gain
    if advice.duals is not None:
        given = take(advice.duals, taken)
        s.led[place] = ~torch.isnan(given.mu)
        keeping = torch.where(s.led[place], given.mu, keeping)
        fresh = replace(fresh, lam=given.lam)  # zero where the penalty is the solver's own
    mu = torch.maximum(duals.mu[taken], keeping).clamp(max=solver.penalty_max)
    held = copied(duals)
    put(held, taken, replace(fresh, mu=mu))
    s.X, s.U = s.X.clone(), s.U.clone()
    s.X[place], s.U[place] = X, U
    return held
