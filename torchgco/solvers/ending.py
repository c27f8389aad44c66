"""What a solve ends with: gains, optimality and statuses of returned trajectories, and the history of every problem.

Optimality is the share of the cost that the quadratic model could still save: the expected decrease of one full step on
J_var + lam'c, plus the complementarity gap. It doesn't depend on the scale of cost, controls or constraints. Where the
model is regularised or rounded, its step is shorter than a full one, and slopes count, too: see `_by_slopes`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchgco.base.status import STALLED, UNMOVED, Status, is_over
from torchgco.ilqr.riccati import BackwardPass
from torchgco.judging.gates import passages
from torchgco.kernels import cost_scale, kernels_of, measured, path_clearance
from torchgco.lagrangian.lagrangian import Lagrangian, PassEnd, State, binding
from torchgco.obstacles.base import ADMITTED
from torchgco.problem.horizons import as_solved
from torchgco.problem.problem import Problem
from torchgco.solution import Solution

STATIONARY = 1e-4  # share of the cost that may be left to save in a stationary trajectory
DOUBTED = 1e-3  # the same where the interior point met its tolerances, as slopes of a flat cost do far away
FIRST, STRONGER, TRIES = 1e-9, 100.0, 10  # regularisation where the backward pass fails, as a share of the cost unit
# The error of a curvature by rounding, times the states' and controls' size squared, as a share of that unit.
HIDES = 0.1


def start_status(X: Tensor, merit: Tensor, start_is_clear: Tensor | None) -> Tensor:
    """The statuses (B,) of problems that can't start, with rollouts X (B, N+1, n); RUNNING for the others."""
    # NaN compares as clear of every obstacle, so finiteness decides first.
    finite = torch.maximum(X.flatten(1).abs().amax(-1), merit.abs()) < torch.inf  # which NaN isn't either
    status = torch.where(finite, int(Status.RUNNING), int(Status.NON_FINITE))
    if start_is_clear is not None:
        status = torch.where(finite & ~start_is_clear, int(Status.INVALID_START), status)
    return status


class Optimality(NamedTuple):
    gains: Tensor  # [K d] (B, N, m, n+1): u = U + K (x - X) + d
    left: Tensor  # (B,): share of the cost that could still be saved; infinite where no backward pass succeeds
    worst: Tensor  # (B,): the largest violation
    sensitive: Tensor  # (B,) bool: whether rounding may decide where a rollout by PyTorch ends


def optimality(lagrangian: Lagrangian, X: Tensor, U: Tensor, cost: Tensor | None = None) -> Optimality:
    """Gains along X (B, N+1, n), U (B, N, m), and the first-order optimality of the trajectory with its multipliers.

    Args:
        cost: J_var (B,), where it is known.
    """
    problem = lagrangian.problem
    step, slack, worst, sensitive, run = kernels_of(problem).judged(lagrangian, X, U)
    mu = torch.zeros_like(slack)
    for i in range(TRIES):
        # Where a control costs nothing, or rounding spoils the Hessian, regularisation still gives gains.
        if not bool(step.failed.any()):
            break
        mu = torch.where(step.failed, FIRST * STRONGER**i * cost_scale(problem).unit, mu)
        step = _merged(step, run(mu))
    saved = -step.expected_change(torch.ones_like(slack)) + slack
    _, constant, least = cost_scale(problem)
    cost = least + ((problem.cost.total(X, U) if cost is None else cost) - constant).abs()
    rounds = _rounds(lagrangian, X, U)
    if bool(((mu > 0) | rounds).any()):
        sizes = _sizes(problem, U)
        resists = 0.5 * mu * U.shape[1] * sizes.square().contiguous().sum(-1)  # what a change as large would cost by mu
        hidden = (resists > STATIONARY * cost) | rounds
        saved = torch.where(hidden, torch.maximum(saved, _by_slopes(problem, run, sizes)), saved)
    gains = torch.where(step.failed.view(-1, 1, 1, 1), torch.nan, step.gains.movedim(0, 1))
    return Optimality(gains, torch.where(step.failed, torch.inf, saved / cost), worst, sensitive)


def _rounds(lagrangian: Lagrangian, X: Tensor, U: Tensor) -> Tensor:
    """Where rounding of the rows' stiffness hides curvatures of the cost, (B,): states or controls have small units."""
    size = torch.cat((X.flatten(1), U.flatten(1)), dim=1).abs().amax(-1)
    stiffness = torch.finfo(X.dtype).eps * lagrangian.multipliers.mu * size.square()
    hides = stiffness > HIDES * cost_scale(lagrangian.problem).unit
    return hides & _binds(lagrangian, X, U) if bool(hides.any()) else hides


def _binds(lagrangian: Lagrangian, X: Tensor, U: Tensor) -> Tensor:
    """Whether a row binds, (B,): others have no stiffness."""
    binds = torch.zeros_like(lagrangian.multipliers.mu, dtype=torch.bool)
    for constraint, lam in zip(lagrangian.problem.constraints, lagrangian.multipliers.lam, strict=True):
        binds |= (binding(constraint.sense, constraint.value(X, U), lam) != 0).flatten(1).any(-1)
    return binds


def _sizes(problem: Problem, U: Tensor) -> Tensor:
    """The size of each control, (B, m): the largest of U (B, N, m), or half its bounds' range; 1 where all are 0."""
    sizes, bounds = U.abs().amax(dim=1), problem.control_bounds
    if bounds is not None:
        half = 0.5 * bounds.range
        sizes = torch.where(torch.isfinite(half), torch.maximum(sizes, half), sizes)
    return torch.where(sizes > 0, sizes, 1.0)


def _by_slopes(problem: Problem, run: Callable[[Tensor], BackwardPass], sizes: Tensor) -> Tensor:
    """The slopes of J_var + lam'c by the controls, times these controls' sizes (B, m), summed, (B,).

    Regularisation adds the same to the curvature of each control, whatever its units: where these are small, it hides
    what the controls could still save. With as much as numbers can hold, squares included, steps are along the slopes,
    and so short that no stage feels another's.
    """
    mu = torch.finfo(sizes.dtype).max ** 0.5 * cost_scale(problem).unit.clamp(max=1.0)
    slopes = run(mu).gains[..., -1].movedim(0, 1).abs() * mu.view(-1, 1, 1)
    return (slopes * sizes.unsqueeze(1)).contiguous().sum(-1).sum(-1)


def _merged(first: BackwardPass, second: BackwardPass) -> BackwardPass:
    """The first pass where it succeeded, the second elsewhere."""
    again = first.failed
    gains = torch.where(again.view(1, -1, 1, 1), second.gains, first.gains)
    linear, quadratic = (torch.where(again, b, a) for a, b in zip(first[1:3], second[1:3], strict=True))
    return BackwardPass(gains, linear, quadratic, again & second.failed)


def judged_between(problem: Problem, X: Tensor, U: Tensor, status: Tensor) -> Tensor:
    """The statuses (B,), but INFEASIBLE where a trajectory keeps all rows and isn't feasible between the knots.

    It touches an obstacle there, of a kind that can be measured, or doesn't pass a gate, as the tolerance of the rows
    was too large for that.
    """
    rows = ((status == Status.CONVERGED) | (status == Status.FEASIBLE)).nonzero().flatten()
    if rows.numel() == 0:
        return status
    bad = fails_between(problem.take(rows), X[rows], U[rows])
    status = status.clone()
    status[rows[bad]] = int(Status.INFEASIBLE)
    return status


def fails_between(problem: Problem, X: Tensor, U: Tensor, clearance: Tensor | None = None) -> Tensor:
    """Whether trajectories touch an obstacle that can be measured between two knots, or miss a gate, (B,) bool.

    Args:
        clearance: `path_clearance` (B,), where it is known.
    """
    bad = torch.zeros_like(X[:, 0, 0], dtype=torch.bool)
    if all(obstacles.has_chords for obstacles in problem.obstacles):
        bad = (path_clearance(problem, X, U) if clearance is None else clearance) < 0
    for way in passages(problem, X, U).values():
        bad = bad | ~way.passed.all(-1)
    return bad


def touches(problem: Problem, solution: Solution) -> Tensor:
    """Which trajectories (B,) are INFEASIBLE only because they touch an obstacle between two knots."""
    touching = (solution.status == Status.INFEASIBLE) & (solution.violation <= ADMITTED)
    rows = touching.nonzero().flatten()
    if rows.numel() > 0:
        times = None if solution.times is None else solution.times[rows]
        touching[rows] = path_clearance(*as_solved(problem.take(rows), solution.X[rows], solution.U[rows], times)) < 0
    return touching


def final_status(ended: Tensor, left: Tensor, violation: Tensor, tolerance: float, constrained: bool) -> Tensor:
    """The status (B,) of the returned trajectories, for statuses `ended` that say why the solve stopped.

    CONVERGED: stationary, and violated by no more than the solver's own tolerance. FEASIBLE: by no more than
    `ADMITTED`, for problems with constraints. INFEASIBLE: by more, although higher penalties were tried for as long as
    they gained anything, or for rows that no control moves. Where neither holds, and where a solve failed, the reason
    stays.
    """
    over, fits = is_over(ended), violation <= max(tolerance, ADMITTED)
    stationary = (left <= STATIONARY) | (over & ((left <= DOUBTED) | torch.isinf(left)))
    limit = torch.full_like(ended, int(Status.MAX_ITERATIONS))
    reason = torch.where((ended == Status.CONVERGED) | (ended == STALLED) | over, limit, ended)
    status = torch.where(fits & constrained, int(Status.FEASIBLE), reason)
    status = torch.where(stationary & (violation <= tolerance), int(Status.CONVERGED), status)
    status = torch.where(~fits & ((ended == STALLED) | (ended == UNMOVED)), int(Status.INFEASIBLE), status)
    status = torch.where(torch.isinf(left) & ~over, int(Status.NOT_POSITIVE_DEFINITE), status)
    lost = ~fits | torch.isinf(left)
    status = torch.where((ended == Status.TIME_LIMIT) & lost, ended, status)  # more time might find more
    failed = (ended == Status.NON_FINITE) | (ended == Status.NOT_POSITIVE_DEFINITE) | (ended == Status.INVALID_START)
    return torch.where(failed, ended, status)


if TYPE_CHECKING:
    import pandas as pd


ORDER = ["element", "attempt", "iteration"]  # of a trace's rows


class Recorder:
    """Collects one small tensor per pass and column; the table is made once, at the end."""

    def __init__(self) -> None:
        self._passes: list[dict[str, Tensor]] = []
        self.attempt = 1

    def add(self, problem: Problem, rows: Tensor, state: State, end: PassEnd) -> None:
        """Record the iteration just made by the problems `rows` of the batch, except where the backward pass failed."""
        guided = state.penalty.is_active if state.penalty is not None else torch.zeros_like(end.failed)
        row = {
            "element": rows,
            "attempt": torch.full_like(rows, self.attempt),
            "iteration": state.iterations - 1,
            "outer": state.outer,
            "inner": state.inner - 1,
            "cost": state.cost,
            "merit": state.merit,
            "alpha": end.alpha,
            "regularisation": end.used,
            "violation": measured(problem, state.X, state.U),
            "guided": guided,
        }
        self._passes.append({name: value[~end.failed].clone() for name, value in row.items()})

    def frame(self, unit: Tensor, constant: Tensor) -> pd.DataFrame:
        """The table, sorted by element (the problem), attempt and iteration.

        By place in the batch, `unit` is the unit that costs were divided by, `constant` what was subtracted from them
        before; the table holds the costs as they were.
        """
        import pandas as pd

        if not self._passes:
            return pd.DataFrame()
        columns = {name: torch.cat([row[name] for row in self._passes]).cpu().numpy() for name in self._passes[0]}
        return in_units(pd.DataFrame(columns), unit, constant).sort_values(ORDER, ignore_index=True)


def in_units(trace: pd.DataFrame, unit: Tensor, constant: Tensor) -> pd.DataFrame:
    """A trace with costs times a unit, plus a constant, both by place in the batch."""
    if trace.empty:
        return trace
    scale, more = unit.cpu().numpy()[trace["element"]], constant.cpu().numpy()[trace["element"]]
    costs = {name: trace[name] * scale for name in ("cost", "merit", "regularisation")}
    return trace.assign(**costs | {name: costs[name] + more for name in ("cost", "merit")})


def appended(trace: pd.DataFrame | None, later: pd.DataFrame | None) -> pd.DataFrame | None:
    """Two traces as one, in which each problem's attempts of the later one are numbered on."""
    if trace is None or later is None or trace.empty or later.empty:
        return later if trace is None or trace.empty else trace
    import pandas as pd

    before = trace.groupby("element")["attempt"].max()
    numbered = later.assign(attempt=later["attempt"] + later["element"].map(before).fillna(0).astype(int))
    return pd.concat((trace, numbered)).sort_values(ORDER, ignore_index=True)
