"""What a loop flies where no solve gives a plan: the plan before moved on, or a way to rest, by the rows of now."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchgco.constraints.base import Constraint
from torchgco.constraints.bounds import rates_of
from torchgco.constraints.norms import within_norms
from torchgco.kernels import current, followed, measured, open_loop, path_clearance
from torchgco.lagrangian.quality import has_arrived, ranks_arrival, violation
from torchgco.obstacles.base import ADMITTED
from torchgco.problem.horizons import for_solvers
from torchgco.problem.problem import Problem
from torchgco.receding.plan import Plan
from torchgco.receding.stopping import clamped, limits, stopping


class Held(NamedTuple):
    """Trajectories that can be flown, (b, ...)."""

    X: Tensor  # (b, N+1, n)
    U: Tensor  # (b, N, m)
    K: Tensor  # (b, N, m, n): feedback of the plan before; 0 of others
    feasible: Tensor  # (b,) bool: whether they keep all constraints but that of a required goal
    is_before: Tensor  # (b,) bool: the plan before with its feedback


def held(problem: Problem, plan: Plan | None, now: float) -> Held:
    """For each problem the plan before, as it goes on from the measured state, or what comes to rest where that fails.

    Args:
        problem: from the states that are measured `now`, s, and with the numbers of now.
        plan: of these problems, or None.
    """
    whole, before = current(for_solvers(problem)), None
    best: Held | None = None
    if plan is not None:
        later = plan.moved_to(now)
        before, K = later.U, later.K
        lifted = rates_of(problem.constraints) is not None  # feedback could break the bounds of rates
        own = whole if whole.n == problem.n else current(problem)  # feedback is on the problem's own states
        ways = [before] if lifted else [followed(own, later.X, before, K)[1], before]
        best = _best(problem, whole, torch.stack(ways, dim=1), K, len(ways) - 1)
    for mixed in (False, True):
        if best is None:
            stops = stopping(problem, None)
            assert stops is not None
            best = _best(problem, whole, stops)
            continue
        left = (~best.feasible).nonzero().flatten()
        if left.numel() == 0:
            break
        stops = stopping(problem.take(left), None if before is None else before[left], mixed)
        if stops is None:
            break
        ways = torch.cat((best.U[left].unsqueeze(1), stops), dim=1)
        other = _best(problem.take(left), whole.take(left), ways, best.K[left], 1)
        other.is_before.logical_and_(best.is_before[left])
        for kept, new in zip(best, other, strict=True):
            kept[left] = new
    return best


def better(problem: Problem, kept: Held, U: Tensor) -> Held:
    """What is held, or the controls (b, N, m) of a solve that failed, within their bounds, where these are better.

    A plan before that is feasible stays.
    """
    whole = current(for_solvers(problem))
    U = torch.where((kept.is_before & kept.feasible).view(-1, 1, 1), kept.U, U)
    best = _best(problem, whole, torch.stack((kept.U, U), dim=1), kept.K, 1)
    return best._replace(is_before=best.is_before & kept.is_before)


def within(problem: Problem, U: Tensor) -> Tensor:
    """Controls (B, N, m) within the bounds of controls, of their rates, norms and cones."""
    if rates_of(problem.constraints) is None:
        bounds = problem.control_bounds
        U = U.nan_to_num() if bounds is None else clamped(U, *bounds.over(problem.N))
    else:
        U, limits_at, u = U.clone(), limits(problem), U[:, 0]
        for k in range(problem.N):
            u = U[:, k] = clamped(U[:, k], *limits_at(torch.full((problem.B,), k), u))
    return within_norms(U, problem.constraints)


def _best(problem: Problem, whole: Problem, U: Tensor, K: Tensor | None = None, count: int = 0) -> Held:
    """The best of candidates U (B, C, N, m), the first `count` of which are the plan before with its feedback K.

    Feasible arrival at a stated goal counts first, then the cost of what is feasible. Of what isn't, the least violated
    counts, and of those that differ by less than what is admitted the one that is out of it soonest.
    """
    B, C = U.shape[:2]
    each = torch.arange(B).repeat_interleave(C)
    many, stated = whole.take(each), problem.take(each)
    U = within(stated, U.flatten(0, 1))
    X = open_loop(many, U)
    worst, cost = _violation(many, X, U), many.cost.total(X, U).nan_to_num(torch.inf)
    fits = (worst <= ADMITTED) & torch.isfinite(X).flatten(1).all(-1)
    fits &= path_clearance(many, X, U) >= 0  # NaN, of states that aren't finite, isn't
    arrives = fits & has_arrived(stated, X[..., : problem.n]) if ranks_arrival(stated) else fits
    near = (worst.view(B, C) <= worst.view(B, C).amin(1, keepdim=True) + ADMITTED).flatten()
    rank = torch.where(arrives, 0, torch.where(fits, 1, torch.where(near, 2, 3))).view(B, C)
    value = cost if bool(fits.view(B, C).any(1).all()) else torch.where(fits, cost, _sum_of_violations(many, X, U))
    chosen = value.view(B, C).masked_fill(rank > rank.amin(1, keepdim=True), torch.inf).argmin(1)
    rows = torch.arange(B) * C + chosen
    fed = chosen < count
    gains = U.new_zeros(B, problem.N, problem.m, problem.n)
    if K is not None:
        gains[fed] = K[fed]
    return Held(X[rows, :, : problem.n].clone(), U[rows], gains, fits[rows], fed)


def _violation(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """The largest violation (B,) of all constraints but a required goal: what comes to rest doesn't reach it."""
    parts = _but_goal(problem)
    if len(parts) == len(problem.constraints):
        return measured(problem, X, U).nan_to_num(torch.inf)
    return violation(parts, X, U).nan_to_num(torch.inf)


def _sum_of_violations(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """The sum (B,) over the same constraints and their knots."""
    rows = [constraint.violation(X, U) for constraint in _but_goal(problem)]
    return sum((v.amax(-1).sum(-1) for v in rows if v.shape[-1] > 0), X.new_zeros(len(X))).nan_to_num(torch.inf)


def _but_goal(problem: Problem) -> list[Constraint]:
    return [constraint for constraint in problem.constraints if not constraint.bare.is_goal]
