"""The interior point of Waechter and Biegler (2006) in PyTorch's kernels, for a batch of problems at once.

The algorithm is that of native/c/interior.c, step by step; lagrangian/barrier.py says what its options mean.
Problems that have ended leave the batch.
"""

from __future__ import annotations

import time

import torch
from torch import Tensor

from torchgco.base.status import Status
from torchgco.eager import step as riccati
from torchgco.eager.fixed import (
    breaks_rows_left_out,
    join_multipliers,
    readmit,
    relax,
    sort_rows,
    split_multipliers,
)
from torchgco.eager.loose import hold_loose
from torchgco.eager.model import Derivatives, Model
from torchgco.eager.search import Step, curvature, go_back, search, stepped
from torchgco.eager.sizes import steepest
from torchgco.eager.softness import gives_of
from torchgco.eager.state import (
    Kinds,
    State,
    adjoin,
    blank,
    column,
    errors,
    find_solved,
    first_barrier,
    lower_barrier,
    remeasure,
    renew,
    residuals,
    settle,
)
from torchgco.lagrangian.barrier import BarrierOptions
from torchgco.problem.scale import CostScale


def solve(
    model: Model, X: Tensor, U: Tensor, lam: tuple[Tensor, ...], barrier: Tensor, scale: CostScale, how: BarrierOptions
) -> dict[str, Tensor]:
    """As `native.interior.InteriorEngine.solve`, for any device and dtype."""
    problem = model.problem
    flat = torch.cat([X.new_zeros(problem.B, 0), *(part.flatten(1) for part in lam)], dim=-1)  # (B, R)
    equality = torch.zeros(flat.shape[1], dtype=torch.bool, device=X.device)
    for group in model.groups:
        equality[group.place.rows] = group.part.sense == "equality"
    kinds = Kinds(equality, how, scale, barrier.clone(), problem.N, problem.n)
    B, until = problem.B, time.monotonic() + how.seconds
    out = {
        "status": torch.zeros(B, dtype=torch.int32, device=X.device),
        "iterations": torch.zeros(B, dtype=torch.int64, device=X.device),
        "gains": X.new_zeros(B, problem.N, problem.m, problem.n + 1),
        "error": X.new_zeros(B), "theta": X.new_zeros(B), "falls": X.new_zeros(B),
    }  # fmt: skip
    loop = _Loop(kinds, model, blank(problem, X, U, flat))
    if B > 0:
        begin(kinds, model, loop.t)
    while loop.t.rows.numel() > 0:
        status, error = loop.iterate()
        if time.monotonic() > until:
            status = torch.where(status == Status.RUNNING, int(Status.TIME_LIMIT), status)
        ended = (status != Status.RUNNING).nonzero().flatten()
        if ended.numel() == 0:
            continue
        t, part = loop.t.take(ended), loop.model.take(ended)
        rows = t.rows
        stiffest = torch.nn.functional.pad(torch.where(kinds.inside(t), t.z / t.s, 0.0), (0, 1)).amax(-1)
        end = status[ended]
        end = torch.where((end == Status.CONVERGED) & breaks_rows_left_out(kinds, t), int(Status.INFEASIBLE), end)
        # The slack of a violated row without slope falls to 0, and its multiplier has no end.
        fails = (end == Status.NON_FINITE) | (end == Status.NOT_POSITIVE_DEFINITE)
        end = torch.where(fails & torch.isposinf(stiffest), int(Status.LINE_SEARCH_FAILED), end)
        out["status"][rows], out["iterations"][rows] = end.to(torch.int32), t.made
        out["error"][rows], out["theta"][rows] = error[ended], t.theta
        out["gains"][rows, ..., : problem.n] = gains(kinds, part, t)
        if how.minimum:
            falls = ~_factors(kinds, part, t, torch.zeros_like(t.shift)).good
            falls &= stiffest < 1.0 / how.rounding  # which decides where it is larger
            out["falls"][rows] = falls.to(X.dtype)
        X[rows], U[rows], barrier[rows] = t.X, t.U, t.mu
        found = t.z / column(t.scale)
        split_multipliers(part, t, found)
        flat[rows] = found
        loop.keep((status == Status.RUNNING).nonzero().flatten())
    sizes = [knots * rows for knots, rows in problem.row_shapes]
    for own, part in zip(lam, flat.split(sizes, dim=-1), strict=True):
        own.copy_(part.view_as(own))
    return out


def begin(kinds: Kinds, model: Model, t: State) -> None:
    """The scale of the cost, slacks and multipliers."""
    how = kinds.how
    t.soft = torch.full_like(t.mu, how.jacobian_regularization_value)
    slopes, H = model.cost_model(t.X, t.U)
    largest, plain = steepest(model, t.X, t.U, slopes, H)
    scale = how.nlp_scaling_obj_target_gradient / largest
    scaled = torch.isfinite(scale) & (largest > 0.0)
    t.scale, t.raised = torch.where(scaled, scale, t.scale), torch.where(scaled, plain / largest, t.raised)
    t.mu = first_barrier(kinds, t)
    settle(kinds, model, t)
    sort_rows(kinds, model, t)
    diagonal = t.scale.view(-1, 1, 1) * H.diagonal(dim1=-2, dim2=-1).abs()
    if bool(kinds.equality.any()):
        share, rows = torch.full_like(t.mu, how.slight), kinds.equality.expand_as(t.out)
        t.gives = gives_of(model, model.slopes(t.X, t.U), diagonal, share, rows)
    t.s = torch.where(kinds.inside(t), torch.maximum(-t.c, how.bound_push * t.room), 1.0)
    remeasure(kinds, t)
    if not how.warm:
        renew(kinds, model, t)
        hold_loose(kinds, model, t, diagonal)
        return
    join_multipliers(model, t)
    z = column(t.scale) * t.z
    inside = torch.maximum(z, column(t.mu) / (how.kappa_sigma * t.s))
    t.z = torch.where(kinds.inside(t), inside, torch.where(kinds.fixed(t), z, 0.0))
    adjoin(kinds, model.slopes(t.X, t.U), t)


def gains(kinds: Kinds, model: Model, t: State) -> Tensor:
    """The gains K (b, N, m, n) along the trajectories."""
    return _factors(kinds, model, t, t.shift).K.transpose(0, 1)


def _expanded(model: Model, t: State) -> Derivatives:
    """The derivatives at the iterate, with its multipliers."""
    objective = column(t.objective)
    return model.expand(t.X, t.U, t.scale * t.objective, objective.unsqueeze(-1) * t.y, objective * t.z)


def _factors(kinds: Kinds, model: Model, t: State, shift: Tensor) -> riccati.Factors:
    """The factors at the iterate with shifts (b,)."""
    at = _expanded(model, t)
    H = curvature(kinds, at, t)
    return riccati.factor(at.F, H, shift, kinds.how.pivot, model.problem.free_start)


class _Loop:
    """The problems that are running, t; others have left."""

    def __init__(self, kinds: Kinds, model: Model, t: State) -> None:
        self.kinds, self.model, self.t = kinds, model, t

    def keep(self, rows: Tensor) -> None:
        """Go on with some of the problems."""
        self.t, self.model = self.t.take(rows), self.model.take(rows)

    def iterate(self) -> tuple[Tensor, Tensor]:
        """One iteration; the statuses (b,) of the problems that end, RUNNING for others, and the errors (b,)."""
        kinds, model, t, how = self.kinds, self.model, self.t, self.kinds.how
        every = torch.ones_like(t.watching)
        readmit(kinds, model, t, every, how.theta_max_fact)  # beyond which no residual is accepted
        relax(kinds, model, t)
        at, r = _expanded(model, t), residuals(kinds, t, t.c, t.s)
        test = errors(kinds, at, t, r, model.problem.free_start)
        status = torch.full_like(t.made, int(Status.RUNNING))
        astray = t.watching & ~torch.isfinite(test.whole)
        small = (test.whole <= max(how.tol, how.acceptable_tol)) & (test.primal <= how.constr_viol_tol) & ~t.restoring
        if bool(astray.any()):
            go_back(t, astray)
        solved = find_solved(kinds, t, test, ~astray)
        again = readmit(kinds, model, t, solved, how.constr_viol_tol)
        if bool(again.any()):
            at, r = _expanded(model, t), residuals(kinds, t, t.c, t.s)
        over = t.made >= how.max_iter
        limit = torch.where(small, int(Status.CONVERGED), int(Status.MAX_ITERATIONS))
        ended = torch.where(over, limit, status)
        ended = torch.where(torch.isfinite(test.whole), ended, int(Status.NON_FINITE))
        ended = torch.where(solved, torch.where(again, status, int(Status.CONVERGED)), ended)
        status = torch.where(astray, status, ended)
        running = (status == Status.RUNNING) & ~astray
        if bool(running.any()):
            lower_barrier(kinds, t, test, running)
            self._move(status, running, small, at, r)
        return status, test.whole

    def _move(self, status: Tensor, running: Tensor, small: Tensor, at: Derivatives, r: Tensor) -> None:
        """A step of the problems `running`; the statuses of those that end, in place."""
        kinds, t, how = self.kinds, self.t, self.kinds.how
        step, moving = self._directed(running, at, r)
        t.last = torch.where(moving & (t.shift > 0.0), t.shift, t.last)
        astray = running & ~moving & t.watching
        if bool(astray.any()):
            go_back(t, astray)
        lost = running & ~moving & ~astray
        indefinite = torch.where(small, int(Status.CONVERGED), int(Status.NOT_POSITIVE_DEFINITE))
        status[:] = torch.where(lost, indefinite, status)
        tau = torch.clamp(1.0 - t.mu, min=how.tau_min, max=how.tau_max)
        won = search(kinds, self.model, t, step, moving, tau)
        t.made = t.made + running.to(t.made.dtype)
        self._remember_shift(won)
        t.soft = torch.where(won, (how.soft_decay * t.soft).clamp(min=how.jacobian_regularization_value), t.soft)
        t.failures = torch.where(won & ~t.restoring & (t.forced == 0.0), 0, t.failures)
        status[:] = torch.where(moving & ~won & small, int(Status.CONVERGED), status)
        lost = self._recover(moving & ~won & ~small)
        status[:] = torch.where(lost, int(Status.LINE_SEARCH_FAILED), status)
        self._resume(status == Status.RUNNING)

    def _remember_shift(self, won: Tensor) -> None:
        """Where only short steps are accepted, the step reaches further than the model: more curvature shortens it."""
        t, how = self.t, self.kinds.how
        lower, floor = how.recovery_decay * t.forced, how.shift_crawl
        higher = torch.where(t.shift > floor, how.recovery_growth * t.shift, t.last.clamp(min=floor))
        lower = torch.where(lower >= floor, lower, 0.0)
        t.forced = torch.where(won & ~t.restoring, torch.where(t.crawls, higher, lower), t.forced)

    # The direction --------------------------------------------------------------------------------------------------

    def _directed(self, running: Tensor, at: Derivatives, r: Tensor) -> tuple[Step, Tensor]:
        """The step of the problems `running`, and which of them have one."""
        kinds, t, how = self.kinds, self.t, self.kinds.how
        t.shift = torch.where(running, t.forced, t.shift)
        H, free = curvature(kinds, at, t), self.model.problem.free_start
        none = torch.zeros_like(t.c)
        factors = riccati.factor(at.F, H, t.shift, how.pivot, free)
        step = Step(at, H, factors, t.gap.clone(), r.clone(), t.X, t.U, t.y, none, none)
        moving = self._shifted(step, running)
        stepped(kinds, step, t)
        while t.z.shape[1] > 0:
            # Where equalities contradict each other to first order, their multipliers explode: a softer step is taken.
            largest = torch.where(kinds.fixed(t), (t.z + step.dz).abs(), 0.0).amax(-1)
            large = moving & (largest > how.explodes * t.raised) & (t.soft < how.softest)
            if not bool(large.any()):
                break
            t.soft = torch.where(large, how.soft_growth * t.soft, t.soft)
            step.H, t.shift = curvature(kinds, at, t), torch.where(large, t.forced, t.shift)
            rows = large.nonzero().flatten()
            self._factor(step, rows)
            moving = moving & (~large | self._shifted(step, large))
            stepped(kinds, step, t)
        return step, moving

    def _factor(self, step: Step, rows: Tensor) -> None:
        free, at = self.model.problem.free_start, (step.at.F[rows], step.H[rows], self.t.shift[rows])
        new = riccati.factor(*at, self.kinds.how.pivot, None if free is None else free[rows])
        riccati.put(step.factors, rows, new)

    def _shifted(self, step: Step, of: Tensor) -> Tensor:
        """Factors of the problems `of` with the least shift of the ladder that makes them positive definite.

        Returns which have one.
        """
        t, how = self.t, self.kinds.how
        lost, never = torch.zeros_like(of), t.last == 0.0
        while True:
            bad = of & ~lost & ~step.factors.good
            if not bool(bad.any()):
                return of & ~lost
            less = (how.perturb_dec_fact * t.last).clamp(min=how.min_hessian_perturbation)
            first = torch.where(never, how.first_hessian_perturbation, less)
            growth = torch.where(never, how.perturb_inc_fact_first, torch.full_like(t.last, how.perturb_inc_fact))
            following = torch.where(t.shift == 0.0, first, growth * t.shift)
            t.shift = torch.where(bad, following, t.shift)
            lost = lost | (bad & ~(t.shift <= how.max_hessian_perturbation))
            self._factor(step, bad.nonzero().flatten())

    # Feasibility alone ----------------------------------------------------------------------------------------------

    def _recover(self, failed: Tensor) -> Tensor:
        """Problems whose line search failed look for feasibility alone: steps of least length that close residuals.

        Where there is nothing to close, they start again with new multipliers and a shift. Returns those that give up.
        """
        t, how = self.t, self.kinds.how
        if not bool(failed.any()):
            return failed
        t.failures = t.failures + failed.to(t.failures.dtype)
        lost = failed & (t.failures > how.failures)
        renewed = failed & ~lost
        seeks = renewed & (t.theta > how.constr_viol_tol) & ~t.restoring
        t.forced = torch.where(renewed, (how.forced_growth * t.forced).clamp(min=how.shift_recovery), t.forced)
        t.entered = torch.where(seeks, t.theta, t.entered)
        t.restoring = torch.where(renewed, seeks, t.restoring)
        t.objective = torch.where(renewed, (~seeks).to(t.objective.dtype), t.objective)
        self._anew(renewed)
        return lost

    def _resume(self, of: Tensor) -> None:
        """Problems that have become feasible enough go on with the cost."""
        t, how = self.t, self.kinds.how
        less = t.theta <= how.required_infeasibility_reduction * t.entered
        done = of & t.restoring & (less | (t.theta <= how.constr_viol_tol))
        t.restoring = t.restoring & ~done
        t.objective = torch.where(done, 1.0, t.objective)
        self._anew(done)

    def _anew(self, of: Tensor) -> None:
        """New multipliers and filters of the problems `of`."""
        rows = of.nonzero().flatten()
        if rows.numel() == 0:
            return
        some, part = self.t.take(rows), self.model.take(rows)
        renew(self.kinds, part, some)
        remeasure(self.kinds, some)
        self.t.put(rows, some)
