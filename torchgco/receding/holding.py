"""What a loop flies where no solve gives a plan: the plan before moved on, or a way to rest by the rows of now.

At every stage the controls change as least squares ask for, as far as their bounds let them. What doesn't change the
speed stays as a candidate has it: at rest, as in the plan before, or at a share of its bounds, such as a rate of turn.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from torchgco.constraints.base import Constraint
from torchgco.constraints.bounds import bounds_of, rates_of
from torchgco.constraints.norms import within_norms
from torchgco.dynamics.base import INTEGRATORS, Dynamics
from torchgco.kernels import current, followed, measured, open_loop, path_clearance
from torchgco.lagrangian.quality import has_arrived, ranks_arrival, violation
from torchgco.obstacles.base import ADMITTED
from torchgco.problem.horizons import for_solvers
from torchgco.problem.problem import Problem
from torchgco.receding.plan import Plan

SHARES = -1.0, -0.5, 0.5, 1.0  # of the way from a control at rest to its lower and its upper bound
MOST_TOGETHER = 4  # controls, of which all ends of the bounds are combined: 16 candidates
MOST_MIXED = 2  # controls, of which all other shares are combined, too: 12 candidates
BRAKES_AFTER = 0.0, 0.125, 0.25  # of the horizon, after which candidates begin to brake
# Of the horizon, in which a vehicle that has to tilt first loses most of its speed: it has four of these.
TILTS_WITHIN = 0.25
PROBE = 1e-4  # of a control's range: by how much a difference moves it
# Of the squares' sum: no direction counts in which the speed changes by less than their square root.
SMALLEST_SQUARE = 1e-9
Limits = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]  # of stages, after the controls of those before


def stopping(problem: Problem, before: Tensor | None, mixed: bool = False) -> Tensor | None:
    """Controls (B, C, N, m) of candidates that come to rest; None: there are none.

    Args:
        problem: as users give it, of a fixed time.
        before: controls (B, N, m) of the plan before, moved on; None: none.
        mixed: further ones, which have some controls at their bounds beside others half-way, as to speed up in a bend.
    """
    rest = problem.cost.rest_controls(problem.x0.new_zeros(problem.B, problem.N, problem.m))
    if mixed and (problem.control_bounds is None or not 1 < problem.m <= MOST_MIXED):
        return None
    bases, delays = _candidates(problem, rest, before, mixed)
    U, rests = _braked(problem, rest, bases, delays, 0.0)
    left = (~rests.any(1)).nonzero().flatten()
    if left.numel() == 0 or not problem.dynamics.is_integrated:
        return U
    ahead = TILTS_WITHIN * problem.N * float(problem.dynamics.dt)
    later = U.clone()  # of those that have come to rest the same ones: a problem's are the same in every batch
    later[left] = _braked(problem.take(left), rest[left], bases[left], delays, ahead)[0]
    return torch.cat((U, later), dim=1)


def limits(problem: Problem) -> Limits:
    """The bounds of controls (B, m) at stages (B,), those of rates among them."""
    B, N, m = problem.B, problem.N, problem.m
    inf, bounds = problem.x0.new_full((1, 1, m), torch.inf), problem.control_bounds
    low, high = (bound.expand(B, N, m) for bound in ((-inf, inf) if bounds is None else bounds.over(N)))
    rows, rates = torch.arange(B), rates_of(problem.constraints)
    if rates is None:
        return lambda k, before: (low[rows, k], high[rows, k])
    fall, rise = (bound.expand(B, N, m) for bound in rates.over(N))
    first = torch.full_like(low[:, 0], torch.nan) if rates.previous is None else rates.previous.expand(B, m)

    def both(k: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
        before = torch.where((k == 0).unsqueeze(-1), first, before)  # NaN: the first controls are free
        upper = torch.fmin(high[rows, k], before + rise[rows, k])
        return torch.minimum(torch.fmax(low[rows, k], before + fall[rows, k]), upper), upper

    return both


def clamped(u: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Controls within bounds; those that are no numbers become 0 first."""
    return torch.minimum(torch.maximum(u.nan_to_num(), low), high)


def _candidates(problem: Problem, rest: Tensor, before: Tensor | None, mixed: bool) -> tuple[Tensor, Tensor]:
    """Controls (B, C, N, m) that candidates have until they brake and beside it, and the stages (C,) at which they do.

    Shares of infinite bounds are those of rest.
    """
    bases, bounds, m = [rest] if before is None else [rest, before], problem.control_bounds, problem.m
    bases = [] if mixed else bases
    if bounds is not None:
        up, down = (
            torch.where(torch.isfinite(bound - rest), bound - rest, 0.0) for bound in bounds.over(problem.N)[::-1]
        )
        shares = [share * unit for unit in torch.eye(m, dtype=rest.dtype) for share in SHARES]
        if mixed:
            parts = (part for part in product(SHARES, repeat=m) if min(map(abs, part)) < 1.0)
            shares = [rest.new_tensor(part) for part in parts]
        elif m <= MOST_TOGETHER:
            shares += [rest.new_tensor(signs) for signs in product((-1.0, 1.0), repeat=m)]
        bases += [rest + share.clamp(min=0.0) * up - share.clamp(max=0.0) * down for share in shares]
    # Where models differ by stage, one stage is of one model for all candidates: they brake at once.
    later = BRAKES_AFTER if problem.along is problem.dynamics else BRAKES_AFTER[:1]
    delays = torch.tensor([int(share * problem.N) for share in later]).repeat_interleave(len(bases))
    return torch.stack(bases, dim=1).repeat(1, len(later), 1, 1), delays


def _braked(problem: Problem, rest: Tensor, bases: Tensor, delays: Tensor, ahead: float) -> tuple[Tensor, Tensor]:
    """Controls (B, C, N, m), and which of them come to rest, (B, C): those of `ahead` 0 alone.

    Args:
        ahead: how long after the next knot the speed is to be 0, with controls at rest until then, s.
    """
    B, C, N, m = bases.shape
    each, first, rows = torch.arange(B).repeat_interleave(C), delays.repeat(B), torch.arange(B * C)
    many, steady = problem.take(each), problem.along is problem.dynamics
    varied = problem.take(each.repeat(m + 2)).dynamics
    U, calm, bounds = bases.flatten(0, 1).clone(), rest.repeat_interleave(C, dim=0), limits(many)
    _keep_states_within(many, U, calm, first)
    x, u = open_loop(current(for_solvers(many)), U)[rows, first, : problem.n], U[rows, (first - 1).clamp(min=0)]
    rests = torch.zeros(B * C, dtype=torch.bool)
    for k in range(N - int(delays.min())):
        stage = (first + k).clamp(max=N - 1)
        low, high = bounds(stage, u)
        quiet, begun, then = calm[rows, stage], U[rows, stage], calm[rows, (stage + 1).clamp(max=N - 1)]
        span = torch.where(torch.isfinite(high - low), high - low, 1.0).clamp(min=torch.finfo(x.dtype).tiny)
        stages = (varied, varied) if steady else (varied.at(k), varied.at(min(k + 1, N - 1)))
        change, left = _toward_rest(problem, stages, x, begun, span, quiet, then, ahead)
        if ahead == 0.0:  # m until the end of the horizon with controls at rest
            rests |= left * float(problem.dynamics.dt) * (N - stage) <= ADMITTED
        u = clamped(torch.where(rests.unsqueeze(-1), quiet, begun + span * change), low, high)
        runs = first + k < N
        U[rows[runs], stage[runs]] = u[runs]
        if bool(rests.all()):
            break
        x = (many.dynamics if steady else many.dynamics.at(k)).step(x, u)
    after = torch.arange(N) > (first + k).unsqueeze(-1)
    U = torch.where((after & rests.unsqueeze(-1)).unsqueeze(-1), calm, U)
    return U.view(B, C, N, m), rests.view(B, C)


def _keep_states_within(problem: Problem, U: Tensor, rest: Tensor, first: Tensor) -> None:
    """Bring controls U (R, N, m) of the stages before `first` (R,) towards rest, each as far as bounds of states ask of
    it alone, in place: a vehicle that is as fast as it may be goes on so, and turns as before."""
    bounds, (R, N, m), last = bounds_of(problem.constraints, "x"), U.shape, int(first.max())
    if not bounds or last == 0:
        return
    lower = U.new_full((R, N + 1, problem.n), -torch.inf)
    upper = -lower
    for each in bounds:  # those of users are of their states, which come first: solvers may have further ones
        for side, other, tighter in zip((lower, upper), each.over(N + 1), (torch.maximum, torch.minimum), strict=True):
            columns = side[..., : other.shape[-1]]
            columns.copy_(tighter(columns, other))
    x = problem.x0
    for k in range(last):
        away = torch.diag_embed(U[:, k] - rest[:, k]).transpose(0, 1)  # (m, R, m)
        tried = torch.cat((rest[:, k].unsqueeze(0), rest[:, k] + away))
        still, *moved = problem.dynamics.step(x.repeat(m + 1, 1), tried.flatten(0, 1)).view(m + 1, R, -1)
        change = torch.stack(moved) - still
        room = torch.where(change > 0, upper[:, k + 1] - still, lower[:, k + 1] - still)
        share = torch.where(change == 0, 1.0, (room / change).nan_to_num(1.0)).clamp(0.0, 1.0).amin(-1)
        runs = k < first
        U[runs, k] = (rest[:, k] + share.T * (U[:, k] - rest[:, k]))[runs]
        x = problem.dynamics.step(x, U[:, k])


def _toward_rest(
    problem: Problem,
    stages: tuple[Dynamics, Dynamics],
    x: Tensor,
    u: Tensor,
    span: Tensor,
    quiet: Tensor,
    then: Tensor,
    ahead: float,
) -> tuple[Tensor, Tensor]:
    """By how many ranges (R, m) controls u are to change at a stage, and the speed (R,) after it with controls `quiet`.

    The speed is that at the next knot, or `ahead` s later with controls `then`.
    """
    R, m = u.shape
    place_states = slice(0, problem.n) if problem.dynamics.position is None else problem.position
    tried = torch.cat((u.unsqueeze(0), u + PROBE * torch.diag_embed(span).transpose(0, 1), quiet.unsqueeze(0)))
    now, later = stages
    x, then = now.step(x.repeat(m + 2, 1), tried.flatten(0, 1)), then.repeat(m + 2, 1)
    if not later.is_integrated:
        speeds = (later.step(x, then) - x)[..., place_states] / problem.dynamics.dt
    else:
        if ahead > 0.0:
            x = INTEGRATORS[later.integrator](lambda z: later.field(z, then), x, ahead)
        speeds = later.field(x, then)[..., place_states]
    v, *others, still = speeds.view(m + 2, R, -1).unbind(0)
    J = (torch.stack(others, dim=-1) - v.unsqueeze(-1)) / PROBE  # (R, d, m), by shares of the ranges
    squares, identity = J.mT @ J, torch.eye(m, dtype=x.dtype)
    size = squares.diagonal(dim1=-2, dim2=-1).sum(-1)
    size = torch.where(size > 0, size, 1.0)  # of a speed that no control changes yet
    squares = squares + SMALLEST_SQUARE * size[:, None, None] * identity
    squares = torch.where(torch.isfinite(squares).flatten(1).all(-1)[:, None, None], squares, identity)
    change = -torch.linalg.solve(squares, (J.mT @ v.unsqueeze(-1)).nan_to_num()).squeeze(-1)
    return change, still.square().sum(-1).sqrt()


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
