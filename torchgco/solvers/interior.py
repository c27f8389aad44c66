"""A primal-dual interior point on multiple shooting, tight from any guess, and which violations no step lowers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchgco.base.options import Count, Positive
from torchgco.base.status import SOLVED, STALLED, UNMOVED, Status, is_over
from torchgco.base.tree import put, take
from torchgco.constraints.bounds import Bounds, bounds_of
from torchgco.ilqr.riccati import backward
from torchgco.kernels import (
    at_once,
    cost_scale,
    expect_interior,
    interior_of,
    measured,
    open_loop,
    rolled_out,
)
from torchgco.lagrangian.barrier import GOLDEN, BarrierOptions, least_violation
from torchgco.lagrangian.lagrangian import Iterate, Lagrangian, Multipliers, SolveEnd, linearise
from torchgco.lagrangian.quality import is_better
from torchgco.lagrangian.unmoved import unmoved
from torchgco.native.compiler import NativeError
from torchgco.native.interior import InteriorKernels
from torchgco.problem.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers.contracts import Call, Progress, Solver
from torchgco.solvers.convexity import half_ranges, is_affine, looks_convex_row
from torchgco.solvers.ending import STATIONARY, optimality, start_status
from torchgco.solvers.ilqr import ILQR, descend
from torchgco.solvers.session import Session
from torchgco.solvers.timing import Chooser
from torchgco.solvers.unbounded import ROUNDING, beyond_rounding, falls_without_end

WITHOUT_END = Status.MAX_ITERATIONS, Status.LINE_SEARCH_FAILED, Status.NOT_POSITIVE_DEFINITE, Status.NON_FINITE
HEAVY = 1e11  # penalty beside which a cost of one unit counts for nothing
STUCK = 1e-3  # share of the squared violation that one Gauss-Newton step could save: about 1 where it can be closed
STEP_REGULARISATION = 1e-9  # regularisation of that step, as a share of the largest entry of its Hessians
ROUNDED = 1e-6  # share of the squared violation that is left to rounding where rows contradict each other
REPAIR = ILQR(max_iterations=200, tolerance=1e-12)


def least_violated(call: Call, end: SolveEnd, tolerance: float) -> SolveEnd:
    """The same, with STALLED where a solve failed and no step from its end lowers the violation any further."""
    failed = torch.stack([end.status == status for status in WITHOUT_END]).any(0)
    rows = (failed & ~(end.best.violation <= tolerance)).nonzero().flatten()
    if rows.numel() == 0 or call.late:
        return end
    problem, old = call.problem.take(rows).held_at(end.best.X[rows, 0]), take(end.best, rows)
    cost_scale(problem)
    multipliers = Multipliers.zero(problem, HEAVY)
    repaired, ended = descend(REPAIR, Lagrangian(problem.in_cost_units(), multipliers, None, phr=True), old.U)
    X, U, violation = repaired.X, repaired.U, measured(problem, repaired.X, repaired.U)
    # A problem without a feasible trajectory ends at a stationary point of the violation; others may do so, too.
    stuck = (ended != Status.NON_FINITE) & (ended != Status.NOT_POSITIVE_DEFINITE)
    stuck &= left_to_close(problem, X, U) <= STUCK
    stuck |= contradicts(problem, X, U, tolerance) & (call.problem.free_start is None)
    stuck &= violation > tolerance
    less = (stuck & (violation < old.violation)).nonzero().flatten()
    new = Iterate(X, U, old.multipliers, problem.cost.total(X, U), violation)
    put(end.best, rows[less], take(new, less))
    end.status[rows[stuck]] = STALLED
    return end


def left_to_close(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """The share (B,) of the squared violation that one Gauss-Newton step is predicted to save; NaN without any step."""
    s = problem.n + 1 + problem.m
    H, squares = X.new_zeros(*X.shape[:2], s, s), X.new_zeros(X.shape[0])
    for constraint in problem.constraints:
        c = constraint.value(X, U)
        if constraint.sense == "inequality":
            c = c.clamp(min=0.0)
        constraint.accumulate(X, U, c, (c != 0).to(c.dtype), H)
        squares = squares + 0.5 * c.square().sum(-1).sum(-1)
    H = H.transpose(0, 1)
    step = backward(linearise(problem, X, U), H, STEP_REGULARISATION * H.abs().amax(dim=(0, 2, 3)))
    saved = -step.expected_change(torch.ones_like(squares)) / squares
    flat = (H == 0).all(0).flatten(1).all(-1) & (squares > 0)  # no violated row has a slope: no step saves anything
    return torch.where(flat, 0.0, torch.where(step.failed, torch.nan, saved))


def contradicts(problem: Problem, X: Tensor, U: Tensor, tolerance: float) -> Tensor:
    """Whether rows can't all be met within a tolerance by controls within their bounds, whatever these are, (B,) bool.

    Of an affine model with convex rows, others left out. Their squared violations lie above their tangent at any
    trajectory X (B, N+1, n), U (B, N, m): where that is above 0 for all controls within the bounds, none meets the
    rows. That is Farkas' lemma with the violations as multipliers.
    """
    s, n = problem.n + 1 + problem.m, problem.n
    H, squares = X.new_zeros(*X.shape[:2], s, s), X.new_zeros(X.shape[0])
    for constraint in problem.constraints:
        if isinstance(constraint, Bounds) and constraint.of == "u":
            continue
        c = constraint.value(X, U)
        excess = torch.where(c > tolerance, c - tolerance, 0.0)
        if constraint.sense == "equality":
            excess = excess + torch.where(c < -tolerance, c + tolerance, 0.0)
        convex = looks_convex_row(problem, constraint, X, U)
        excess = torch.where(convex.view(-1, 1, 1), excess, 0.0)
        constraint.accumulate(X, U, excess, torch.zeros_like(excess), H)
        squares = squares + excess.square().sum(-1).sum(-1)
    F, by_state = linearise(problem, X, U), H[:, -1, :n, n]
    least, bounds = 0.5 * squares, problem.control_bounds
    sides = [U.new_tensor(end) for end in (-torch.inf, torch.inf)] if bounds is None else bounds.over(problem.N)
    low, high = (side.expand_as(U) for side in sides)
    for k in range(problem.N - 1, -1, -1):
        slope = H[:, k, n + 1 :, n] + (by_state.unsqueeze(1) @ F[k, :, :n, n + 1 :]).squeeze(1)
        ends = [slope * (end[:, k] - U[:, k]) for end in (low - tolerance, high + tolerance)]
        least = least + torch.where(slope != 0, torch.minimum(*ends), 0.0).sum(-1)
        by_state = H[:, k, :n, n] + (by_state.unsqueeze(1) @ F[k, :, :n, :n]).squeeze(1)
    return (least > ROUNDED * squares) & is_affine(problem, X, U)


REPORTED_AT_ONCE = 256  # problems between two reports of progress
SADDLE_STEPS = 1e-3, 1e-1  # sizes of the controls, by which a solve goes on beside a saddle point or a maximum
ROUGH, FEW = 1e-2, 60  # tolerance, and iterations, of a trajectory whose time is to be freed next
DRAWN_ITERATIONS = 30  # iterations of a drawn guess, after which its cost is compared
PENALTY = 10.0  # of the multipliers returned, for solvers that need one, as a multiple of the cost unit


@dataclass(frozen=True)
class InteriorPoint(Solver, named="solver"):
    """The method of Waechter and Biegler (2006) with a Riccati recursion over the stages, many problems side by side.

    States and controls are variables, and the dynamics are constraints between them, so a guess of states may be
    anything; Hessians are exact. Returned trajectories are rollouts. It needs a C compiler. In single precision, on
    other devices, and of code that can't be traced PyTorch computes values and derivatives, and the same code in C all
    else, in double precision on the CPU.

    Args:
        tolerance: of the optimality conditions, scaled as in the paper; in float32 8e-6, or what rounding allows.
            IPOPT: tol.
        violation_tolerance: residual (metres for lengths) up to which a trajectory may have converged; in float32
            1.2e-5 at least. IPOPT: constr_viol_tol.
        max_iterations: of each problem. IPOPT: max_iter.
        initial_barrier: the barrier parameter mu at the start. IPOPT: mu_init.
        warm_barrier: the same, and `bound_push`, for a call with multipliers of an earlier solution.
        bound_push: least slack at the start, and how far a guess is moved inside of its bounds, as a share of its size
            (of 1 at least) or of half their range. IPOPT: bound_push, bound_frac.
        acceptable_tolerance: an error of the conditions at which a problem counts as solved, too, once it hasn't fallen
            by half in three iterations, or no step or iteration is left. IPOPT: acceptable_tol.

    Raises:
        InputError: a field out of its range.
    """

    tolerance: Positive = 1e-8
    violation_tolerance: Positive = 1e-6
    max_iterations: Count = 500
    initial_barrier: Positive = 0.1
    warm_barrier: Positive = 1e-6
    bound_push: Positive = 1e-2
    acceptable_tolerance: Positive = 1e-10

    def options(self, warm: bool, **changes: float) -> BarrierOptions:
        """What kernels read; `changes` of its fields."""
        return replace(
            BarrierOptions(
                tol=self.tolerance, constr_viol_tol=self.violation_tolerance, max_iter=self.max_iterations,
                acceptable_tol=self.acceptable_tolerance, bound_push=self.warm_barrier if warm else self.bound_push,
                counts=STATIONARY, warm=int(warm),
            ),
            **changes,
        )  # fmt: skip

    def run(self, call: Call) -> Solution:
        """Solve a checked call."""
        session, admitted = Session(call, own_units=True), self.admitted(call.problem)
        kernels = interior_of(session.call.problem)  # or an error that says what is missing
        end = self.solved(session.call, escapes=True, kernels=kernels)
        if not bool(is_over(end.status).all()):
            end = self.no_worse(session.call, guessed(session.call), end)
        return session.finished(least_violated(session.call, end, admitted), admitted)

    def admitted(self, problem: Problem) -> float:
        """The violation tolerance, or what rounding in the problem's precision allows."""
        return least_violation(self.violation_tolerance, problem.x0.dtype)

    def announce(self, problem: Problem) -> None:
        """For every problem."""
        expect_interior(problem)

    def frees_start(self, problem: Problem) -> bool:
        """Always."""
        return True

    def take_states(self, problem: Problem) -> bool:
        """Always."""
        return True

    def choosing_time(self, problem: Problem) -> Chooser:
        """This solver; where the time is held, with a tolerance that any trajectory meets, and few iterations."""
        coarse = replace(self, tolerance=max(self.tolerance, ROUGH), max_iterations=min(self.max_iterations, FEW))
        first = replace(self, max_iterations=coarse.max_iterations)
        rough = replace(coarse, max_iterations=DRAWN_ITERATIONS).solved
        return Chooser(coarse, self, self.admitted(problem), first, rough=rough)

    def solved(
        self,
        call: Call,
        X0: Tensor | None = None,
        guess: Iterate | None = None,
        smoothing: float = 0.0,
        escapes: bool = False,
        kernels: InteriorKernels | None = None,
    ) -> SolveEnd:
        """The solve without its verdict, in the units of the call.

        Args:
            X0: states to begin with, (B, N+1, n), of the first those components that are free; None: the call's, else
                the rollout of its controls; the start held where these are not finite.
            guess: `guessed` of the call, where it is known.
            smoothing: mu in units of the cost: J_var - mu times the logarithms of all slacks is minimised; 0: J_var.
            escapes: where the conditions of first order hold but the cost falls to second order, as at an equilibrium
                that a guess at rest never leaves, solve again from beside, and keep what costs less, or falls without
                end.
            kernels: `interior_of` the call's problems, where they are known.
        """
        problem, X0 = call.problem, call.X0 if X0 is None else X0
        try:
            kernels = kernels or interior_of(problem)
        except NativeError:  # no compiler: a search goes on with what its other solver finds
            end = SolveEnd.blank(problem, call.U0)
            end.status[:] = int(Status.MAX_ITERATIONS)
            return replace(end, best=guess or guessed(call))
        if X0 is None:
            X = open_loop(problem, call.U0) if guess is None else guess.X
        else:
            X = torch.cat((problem.start_in(X0[:, 0]).unsqueeze(1), X0[:, 1:]), dim=1)
        start = problem.x0.unsqueeze(1).expand_as(X)
        status = start_status(start, problem.x0[:, 0], problem.start_is_clear)
        X = torch.where(torch.isfinite(X).flatten(1).all(-1).view(-1, 1, 1), X, start)
        end = SolveEnd.blank(problem, call.U0)
        end.status[:] = status
        rows = (status == Status.RUNNING).nonzero().flatten()
        begun, falls = torch.zeros_like(status, dtype=torch.bool), torch.zeros_like(status, dtype=torch.bool)
        for chunk in rows.split(at_once(REPORTED_AT_ONCE)):
            if call.late:
                end.status[chunk] = Status.TIME_LIMIT
                continue
            falls[chunk] = self._some(kernels, call.take(chunk), X[chunk], chunk, end, smoothing, escapes)
            begun[chunk] = True
            if call.callback is not None:
                done = int((end.status != Status.RUNNING).sum())
                call.callback(Progress(1, call.rows[chunk], done, problem.B))
        if not bool(begun.all()):
            others = (~begun).nonzero().flatten()
            put(end.best, others, take(guess or guessed(call), others))
        self._escape(kernels, call, end, falls)
        return end

    def _escape(self, kernels: InteriorKernels, call: Call, end: SolveEnd, falls: Tensor) -> None:
        """Solve again beside the results that `falls` (B,) marks; what costs less takes their place in `end`.

        So does a cost that falls without end, whose solve has none either.
        """
        for share in SADDLE_STEPS:
            rows = falls.nonzero().flatten()
            if rows.numel() == 0:
                return
            if call.late:
                end.status[rows] = Status.TIME_LIMIT
                return
            old, near = take(end.best, rows), call.take(rows)
            near = replace(near, U0=_beside(near.problem, old.U, share), warm=None, X0=None, callback=None)
            new = SolveEnd.blank(near.problem, near.U0)
            fell = self._some(kernels, near, open_loop(near.problem, near.U0), torch.arange(len(rows)), new, 0.0, True)
            cheaper = new.best.cost < old.cost - STATIONARY * old.cost.abs()
            better = cheaper & (new.best.violation <= self.admitted(near.problem))
            better &= (new.status == SOLVED) | self._endless(near, new, better)
            end.iterations[rows] += new.iterations
            kept = better.nonzero().flatten()
            put(end.best, rows[kept], take(new.best, kept))
            put(end.last, rows[kept], take(new.best, kept))
            falls[rows[kept]] = fell[kept]

    def _endless(self, call: Call, end: SolveEnd, asked: Tensor) -> Tensor:
        """Where of the failed solves of a call that are `asked` for (B,) the cost falls without end, (B,) bool."""
        endless = asked & ~is_over(end.status) & torch.isfinite(end.best.cost)
        if (rows := endless.nonzero().flatten()).numel() > 0:
            problem, best = call.problem.take(rows), take(end.best, rows)
            left = optimality(Lagrangian(problem, best.multipliers, None, phr=True), best.X, best.U, best.cost).left
            endless[rows] = falls_without_end(problem, call.U0[rows], best, left, self.admitted(problem))
        return endless

    def no_worse(self, call: Call, guess: Iterate, end: SolveEnd) -> SolveEnd:
        """The same, but with the guess where a solve failed and its result is worse: less feasible, or costlier."""
        problem, best = call.problem, end.best
        if (rows := (~is_over(end.status)).nonzero().flatten()).numel() == 0:
            return end
        lost = ~(torch.isfinite(best.cost) & torch.isfinite(best.violation))
        violated = beyond_rounding(problem.held_at(best.X[:, 0]), best.U, best.violation, ROUNDING)
        worse = is_better(guess.cost, guess.violation, best.cost, violated, self.admitted(problem)) | lost
        rows = rows[(worse & torch.isfinite(guess.cost) & torch.isfinite(guess.violation))[rows]]
        multipliers = take(best.multipliers, rows)
        none = Multipliers(tuple(torch.zeros_like(lam) for lam in multipliers.lam), multipliers.mu)
        put(best, rows, replace(take(guess, rows), multipliers=none))
        return end

    def _some(
        self, kernels: InteriorKernels, call: Call, X: Tensor, rows: Tensor, end: SolveEnd, smoothing: float,
        escapes: bool,
    ) -> Tensor:  # fmt: skip
        """Solves problems, and puts how they ended into `end` at `rows`; whether their costs fall to second order."""
        problem, warm = call.problem, call.warm
        if warm is None:
            multipliers, mu = Multipliers.zero(problem, 1.0).lam, self.initial_barrier
        else:
            mu = self.warm_barrier
            multipliers = tuple(lam.clone(memory_format=torch.contiguous_format) for lam in warm.lam)
        how = self.options(warm is not None, smoothing=smoothing, minimum=int(escapes), seconds=call.seconds_left)
        X, U = inside(problem, X, call.U0, how.bound_push)
        X[:, 0] = problem.start_in(X[:, 0])  # a given start isn't moved
        scale = cost_scale(problem)
        fitted = Multipliers(multipliers, PENALTY * scale.unit)
        out = kernels.solve(problem, X, U, multipliers, X.new_full((problem.B,), mu), scale, how)
        X, U, worst = rolled_out(problem, X, U, out["gains"])
        iterate = Iterate(X, U, fitted, problem.cost.total(X, U), worst)
        put(end.best, rows, iterate)
        put(end.last, rows, iterate)
        status = out["status"].long()
        status = torch.where(status == Status.CONVERGED, SOLVED, status)
        broken = (status == Status.INFEASIBLE).nonzero().flatten()  # rows that were left out
        if broken.numel() > 0:
            fixed = unmoved(problem.take(broken), X[broken], U[broken], self.admitted(problem))
            status[broken] = torch.where(fixed, UNMOVED, int(Status.LINE_SEARCH_FAILED))
        sound = torch.isfinite(iterate.cost) & torch.isfinite(iterate.violation)
        end.status[rows] = torch.where(sound, status, int(Status.NON_FINITE))
        end.iterations[rows] = out["iterations"]
        return (out["falls"] > 0.0) & (end.status[rows] == SOLVED)


def _beside(problem: Problem, U: Tensor, share: float) -> Tensor:
    """Controls (B, N, m) beside U, by an uneven share of their size or range, the same whatever the batch."""
    count = torch.arange(1, U[0].numel() + 1, dtype=U.dtype, device=U.device).view(U.shape[1:])
    return U + share * half_ranges(problem, U) * (2.0 * torch.frac(GOLDEN * count) - 1.0)


def guessed(call: Call) -> Iterate:
    """The trajectory that a call's controls lead to, without multipliers."""
    problem, U = call.problem, call.U0
    X = open_loop(problem, U)
    none = Multipliers.none(problem, U.new_zeros(problem.B))
    return Iterate(X, U, none, problem.cost.total(X, U), measured(problem, X, U))


def inside(problem: Problem, X: Tensor, U: Tensor, push: float) -> tuple[Tensor, Tensor]:
    """X (B, N+1, n) and U (B, N, m) moved inside of their bounds, by a share `push` of their size or range at most."""
    X, U = (z.clone(memory_format=torch.contiguous_format) for z in (X, U))
    for bounds in bounds_of(problem.constraints):
        z = U if bounds.of == "u" else X
        (lower, upper), size = bounds.by_knot, bounds.lower.shape[-1]
        half = 0.5 * (upper - lower)  # two bounds that coincide leave no room
        low, high = (
            torch.where(b.isinf(), 0.0, push * torch.minimum(b.abs().clamp(min=1.0), half)) for b in (lower, upper)
        )
        values = z[:, bounds.knots, :size]
        z[:, bounds.knots, :size] = torch.minimum(torch.maximum(values, lower + low), upper - high)
    return X, U
