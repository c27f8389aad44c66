"""The end of a solve for the problems that no attempt has brought to theirs: more iterations, then other controls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from torchgco.base.draws import DrawKey, smooth_normal
from torchgco.base.status import Status
from torchgco.base.tree import take
from torchgco.constraints.bounds import ControlBounds
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers
from torchgco.native.dispatch import open_loop, value
from torchgco.problem.problem import Problem
from torchgco.search.best import Best
from torchgco.solvers.augmented_lagrangian import PENALTY_MAX, AugmentedLagrangian
from torchgco.solvers.contracts import Call
from torchgco.solvers.state import STALLED, STOPPED, Iterate

CHANGE = 0.1  # standard deviation of the change of stalled controls, as a share of half their range
KNOTS = 10  # of its noise
# Close to a stationary point a violation changes with the square of CHANGE, and its penalty has to weigh more by that
# factor to outweigh the cost; ten times more to be sure.
OVERWEIGHT = 10.0 / CHANGE**2
TINY = 1e-12  # violation term that no division needs
STREAM = 1 << 20  # outer iteration that keys the noise: no solve makes so many


def finish(best: Best, solver: AugmentedLagrangian) -> None:
    """Continue where a limit has ended a solve; from other controls where an infeasible trajectory has stalled.

    The multipliers and penalties of the best trajectory are kept. A trajectory may be stationary for any penalty, as a
    car at rest is that should stand beside its place: there the solve starts again close by.
    """
    status = best.end.status
    limits = (Status.MAX_ITERATIONS, Status.LINE_SEARCH_FAILED, STOPPED)
    cut = torch.stack([status == int(limit) for limit in limits]).any(0)
    _attempt(best, solver, cut.nonzero().flatten(), _from_best)
    stalled = (best.end.status == STALLED) & (best.end.best.violation > solver.violation_tolerance)
    _attempt(best, solver, stalled.nonzero().flatten(), _from_changed)


def _attempt(
    best: Best, solver: AugmentedLagrangian, rows: Tensor, start: Callable[[Call, Iterate, float], Call]
) -> None:
    """One more solve of the problems in `rows`, from where `start` says."""
    best.next_attempt()
    if rows.numel() == 0 or best.call.late:
        return
    call = start(best.call.take(rows), take(best.end.best, rows), solver.initial_penalty)
    end = best.attempt(call, solver=solver)
    best.keep(rows, end)
    # The end of this solve says more than that of the attempt whose trajectory may have been kept.
    best.end.status[rows[end.status == STALLED]] = STALLED


def _from_best(call: Call, best: Iterate, least: float) -> Call:
    return replace(call, U0=best.U, warm=best.multipliers)


def _from_changed(call: Call, best: Iterate, least: float) -> Call:
    key = DrawKey(call.seed, call.ids, torch.full_like(call.ids, STREAM))
    U = best.U + CHANGE * _half_ranges(call.problem, best.U) * smooth_normal(key, KNOTS, best.U)
    return replace(call, U0=U, warm=_balanced(call.problem, U, least))


def _balanced(problem: Problem, U: Tensor, least: float) -> Multipliers:
    """Multipliers of zero with penalties that weigh `OVERWEIGHT` times the cost of U (B, N, m), and at least `least`.

    With less, the first step would lead back to where the cost is lowest and the violation stationary.
    """
    unit, X = Multipliers.zero(problem, 1.0), open_loop(problem, U)
    cost, merit = value(Lagrangian(problem, unit, None, True), X, U)
    mu = OVERWEIGHT * (cost.abs() / (merit - cost).clamp(min=TINY)).nan_to_num(least, PENALTY_MAX, least)
    return replace(unit, mu=mu.clamp(min=least, max=PENALTY_MAX))


def _half_ranges(problem: Problem, U: Tensor) -> Tensor:
    """Half the range of each control between its bounds, (B, 1, m); 1 or the largest control where it is unbounded."""
    half = U.abs().amax(1, keepdim=True).clamp(min=1.0)
    for bounds in problem.constraints:
        if isinstance(bounds, ControlBounds):
            own = 0.5 * bounds.range.unsqueeze(1)
            half = torch.where(torch.isfinite(own), own, half)
    return half
