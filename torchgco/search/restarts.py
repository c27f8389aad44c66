"""Other paths in place of the iterate: taken from guidance, and tried again from where the first one was caught."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchgco.constraints.guides import GuideRegion
from torchgco.lagrangian import Lagrangian, Multipliers
from torchgco.native.dispatch import cost_unit, open_loop, value
from torchgco.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers.state import Advice, Iterate, OuterLoop, State
from torchgco.status import Status
from torchgco.tree import copied, put, take

CLOSE = 2.0  # times the distance that counts as having arrived: paths that end nearer are drawn to the goal at last
WITHIN = 0.95  # share of that distance to which they are drawn
STIFF = 1e3  # weight of that, in units of cost per radius^4


def has_arrived(problem: Problem, path: Iterate | Solution, share: float, limit: float) -> Tensor:
    """Whether a feasible path has come to the goal (B,): within `share` of the distance from the start."""
    goal, at = problem.cost.goal(problem.x0), problem.dynamics.position
    if goal is None or at is None:
        return torch.zeros_like(path.violation, dtype=torch.bool)
    last, first = ((x - goal)[:, at].square().sum(-1).sqrt() for x in (path.X[:, -1], problem.x0))
    return (path.violation <= limit) & (last <= share * first)


def try_again(s: State, rows: Tensor, problem: Problem, duals: Multipliers, status: Tensor, solver: OuterLoop) -> None:
    """Another attempt for elements that have ended one and haven't arrived (in place).

    Further plans are tried from the caught path. Where none is left, and the best path ends close to the goal, the last
    attempt goes on from there with the end drawn to the goal. A path that was never caught is left as it is.
    """
    ended = status[rows] != Status.RUNNING
    tried, best = s.attempt[rows], take(s.best, rows)
    missing = torch.ones_like(ended)
    if solver.arrival is not None:
        missing = ~has_arrived(problem, best, solver.arrival, solver.violation_tolerance)
    left = (tried > 0) & (tried < solver.attempts) & (missing | solver.thorough)
    _start(s, rows, duals, status, ended & left, take(s.origin, rows))
    if solver.arrival is None or not isinstance(s.guide, GuideRegion):
        return
    near = has_arrived(problem, best, CLOSE * solver.arrival, solver.violation_tolerance)
    last = ended & ~left & missing & near & (tried > 0) & (tried <= solver.attempts)
    if not bool(last.any()):
        return
    place = _start(s, rows, duals, status, last, best)
    s.attempt[place] = solver.attempts + 1
    s.led[place] = True
    part = problem.take(last.nonzero().flatten())
    put(s.guide, place, _goal_region(part, take(s.guide, place), solver.arrival))


def _start(s: State, rows: Tensor, duals: Multipliers, status: Tensor, chosen: Tensor, path: Iterate) -> Tensor:
    """Begin an attempt of the elements `chosen` (B',) of `rows` from a path each; returns where they are."""
    again = chosen.nonzero().flatten()
    place = rows[again]
    if again.numel() > 0:
        begin = take(path, again)
        s.X, s.U = s.X.clone(), s.U.clone()
        s.X[place], s.U[place] = begin.X, begin.U
        put(duals, again, begin.duals)
        s.attempt[place] += 1
        s.since[place] = s.outer[place]
        s.led[place] = False
        s.last_cost[place] = torch.inf
        status[place] = Status.RUNNING
    return place


def _goal_region(problem: Problem, guide: GuideRegion, arrival: float) -> GuideRegion:
    """A ball around the goal for the last knot, a little smaller than what counts as having arrived."""
    goal, at = problem.cost.goal(problem.x0), guide.position
    assert goal is not None
    size = WITHIN * arrival * (problem.x0 - goal)[:, at].square().sum(-1).sqrt()
    radius = torch.full_like(guide.radius, torch.inf)
    radius[:, -1] = size
    center = goal[:, None, at].expand_as(guide.center)
    return replace(guide, center=center, radius=radius, weight=STIFF * cost_unit(problem) / size.pow(4))


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
