"""Augmented Lagrangian around iLQR, with optional guidance (Algorithms 1 and 4)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import torch
from torch import Tensor

from torchgco.base.draws import DrawKey
from torchgco.base.errors import InputError
from torchgco.base.options import Above, AtLeast, AtMost, Count, Positive
from torchgco.base.status import STOPPED, Status
from torchgco.base.tree import copied, put, take
from torchgco.kernels import kernels_of, measured, open_loop, value
from torchgco.kernels.outer import NativeOuter
from torchgco.lagrangian.lagrangian import (
    Iterate,
    Lagrangian,
    Multipliers,
    PassEnd,
    SolveEnd,
    State,
    update_and_raise_penalty,
)
from torchgco.lagrangian.penalties import Penalty
from torchgco.lagrangian.quality import is_preferred
from torchgco.obstacles.base import ADMITTED
from torchgco.problem.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers.caught import StopWhenCaught
from torchgco.solvers.contracts import Advice, Call, Guidance, Progress, Solver
from torchgco.solvers.ending import Recorder, start_status
from torchgco.solvers.ilqr import ILQR
from torchgco.solvers.session import Session

PENALTY_MAX = 1e12  # ceiling of mu
SETTLED = 1e-3  # share of J_var: a solve ends once an inner solve changes it by less and is feasible
PASSES_AT_ONCE = 256  # problems times passes in one native call: between calls, an interrupt can end the solve
HOLD = 2.0  # penalty on an abandoned trajectory, as a multiple of the extra cost of its replacement


@dataclass(frozen=True)
class AugmentedLagrangian(Solver, named="solver"):
    """AL-iLQR, for each problem: inner solve, multiplier update, penalty update, guidance, until it has converged.

    With `inner.as_printed` the loop is that of the paper: mu grows after every inner solve, inequalities have the
    printed form (see `lagrangian.penalty_weights`), and only max_outer_iterations ends it. Otherwise mu grows while
    the violation is over its tolerance, inequalities have the Powell-Hestenes-Rockafellar form, and a solve ends where
    an inner solve has converged to a feasible trajectory that changes the cost by less than 0.1 %.

    Args:
        inner: the local solver.
        guidance: called after every inner solve for a penalty on the next one, or for controls that replace the
            iterate; None: no guidance.
        initial_penalty, penalty_growth: mu and its factor eta per outer iteration; mu in units of the cost with
            `inner.as_printed`, else of `Problem.cost_unit`.
        max_outer_iterations: outer limit; the only end of the paper's loop.
        violation_tolerance: violation (metres for lengths) up to which a trajectory counts as feasible.
        slots: problems that run at the same time; the others wait for a free slot. None: all. No result depends on it.
        record: keep the history of every problem in `solution.trace`.

    Raises:
        InputError: a field out of its range.
    """

    inner: ILQR = ILQR()
    guidance: Guidance | None = None
    initial_penalty: Annotated[float, Above(0), AtMost(PENALTY_MAX)] = 20.0
    penalty_growth: Annotated[float, AtLeast(1)] = 2.2
    max_outer_iterations: Count = 10
    violation_tolerance: Positive = ADMITTED
    slots: Count | None = None
    record: bool = False

    def recording(self) -> AugmentedLagrangian:
        """The same solver, which keeps the history of every problem."""
        return replace(self, record=True)

    def in_slots(self, slots: int) -> AugmentedLagrangian:
        """The same solver with at most `slots` problems at a time."""
        return replace(self, slots=slots)

    def run(self, call: Call) -> Solution:
        """Solve a checked call."""
        session = Session(call, self.inner.as_printed, record=self.record)
        guidance = None if self.guidance is None else self.guidance.suited(session.call.problem)
        end = self.outer_loop(session.call, guidance, recorder=session.recorder)
        return session.finished(end, self.violation_tolerance, self.slots)

    def improved(self, call: Call) -> tuple[Iterate, Tensor]:
        """The trajectories of a solve without its verdict, in the user's units, and the iterations made (B,)."""
        session = Session(call, self.inner.as_printed)
        end = self.outer_loop(session.call)
        return session.trajectories(end), end.iterations

    def outer_loop(
        self,
        call: Call,
        guidance: Guidance | None = None,
        penalty: Penalty | None = None,
        recorder: Recorder | None = None,
        guide_first: bool = False,
        by_arrival: bool = False,
    ) -> SolveEnd:
        """The solve without its verdict, in the units of the call: with guidance, or with a fixed penalty.

        Args:
            guide_first: also call guidance before the first inner solve.
            by_arrival: an iterate that has arrived at a stated goal is preferred to any that hasn't.
        """
        loop = OuterLoop(self, call, guidance, penalty, recorder, guide_first, by_arrival)
        run_all(loop, max(1, self.slots or call.problem.B))
        return loop.result


@dataclass(eq=False)
class OuterLoop:
    """The outer loops of one call (Algorithm 4); statuses are (b,) int64, RUNNING until a problem ends."""

    solver: AugmentedLagrangian
    call: Call
    guidance: Guidance | None
    penalty: Penalty | None
    recorder: Recorder | None
    guide_first: bool
    by_arrival: bool
    stopped: int = 0  # problems that guidance has stopped
    _result: SolveEnd | None = None
    _passes: NativeOuter | None = None  # of the running problems

    def __post_init__(self) -> None:
        # As printed, only the outer limit ends a solve, mu always grows, and inequalities have the printed form.
        self.as_printed = self.solver.inner.as_printed
        self.limit = 1 if self.recorder is not None else self.solver.inner.max_iterations
        # Whether guidance is asked after every pass.
        self._guided = self.guidance is not None and not isinstance(self.guidance, StopWhenCaught)

    @property
    def result(self) -> SolveEnd:
        """How the problems have ended so far."""
        if self._result is None:
            self._result = SolveEnd.blank(self.call.problem, self.call.U0)
        return self._result

    def begin(self, rows: Tensor) -> tuple[State, Tensor]:
        """Rollouts of the initial controls of the problems `rows`, and the statuses of invalid starts."""
        problem, U = self._part(rows), self.call.U0[rows]
        if self.call.warm is None:
            multipliers = Multipliers.zero(problem, self.solver.initial_penalty)
        else:
            multipliers = take(self.call.warm, rows)
        if self._guided:
            X = open_loop(problem, U)
            penalty = None if self.guidance is None else self.guidance.start(problem, X)
            cost, merit = value(Lagrangian(problem, multipliers, penalty, not self.as_printed), X, U)
        else:
            penalty = take(self.penalty, rows) if self.guidance is None else None
            lagrangian = Lagrangian(problem, multipliers, penalty, not self.as_printed)
            X, cost, merit = kernels_of(problem).begun(lagrangian, U)
        none, worst = torch.zeros_like(rows), torch.full_like(cost, torch.inf)
        state = State(
            rows=rows.clone(),
            X=X, U=U, cost=cost, merit=merit.clone(), multipliers=multipliers, penalty=penalty,
            regularisation=torch.zeros_like(cost),
            inner=none, outer=none.clone(), iterations=none.clone(), rung=none.clone(), guided=none.clone(),
            replaced=torch.zeros_like(none, dtype=torch.bool), last_cost=worst.clone(),
            best=copied(Iterate(X, U, multipliers, cost, worst)),
        )  # fmt: skip
        status = start_status(X, merit, problem.start_is_clear)
        if self.guide_first:
            well = (status == Status.RUNNING).nonzero().flatten()
            self._ask_guidance(problem, state, well, status)
            self._begin_inner(problem, state, well)
        return state, status

    def regroup(self, rows: Tensor) -> None:
        """Continue with these problems as the running ones."""
        self.problem = self._part(rows)
        self._passes = None

    def _part(self, rows: Tensor) -> Problem:
        """The problems `rows`, in their order; all of them are the whole, of which native kernels know more."""
        whole = self.call.problem
        return whole if rows.numel() == whole.B else whole.take(rows)

    def advance(self, s: State) -> Tensor:
        """Inner solves of the running problems and the outer iterations after them; returns the statuses.

        At least one inner solve each; by PyTorch, or if recorded, one iteration.
        """
        status = self._by_iterations(s) if (passes := self._whole_passes(s)) is None else self._by_passes(passes, s)
        if self.call.late:
            status[status == Status.RUNNING] = Status.TIME_LIMIT
        return status

    def _whole_passes(self, s: State) -> NativeOuter | None:
        """Passes over the running problems by their kernels; None where these make single iterations alone."""
        solver, stop = self.solver, self.guidance if isinstance(self.guidance, StopWhenCaught) else None
        if self._passes is None or self._guided:  # guidance may have replaced tensors of the state
            after = None if stop is None else stop.single_contact_after
            self._passes = kernels_of(self.problem).outer_passes(
                self.problem, s, solver.inner.descent, phr=not self.as_printed, base=self.call.outer[s.rows],
                by_arrival=self.by_arrival, stops=stop is not None, single_after=-1 if after is None else after,
                ends=not self.as_printed, max_outer=solver.max_outer_iterations,
                growth=solver.penalty_growth, penalty_max=PENALTY_MAX, tolerance=solver.violation_tolerance,
                settled=SETTLED,
            )  # fmt: skip
        return self._passes

    def _by_passes(self, passes: NativeOuter, s: State) -> Tensor:
        """As `advance`: with one call of the kernels for all of it where nothing else has to look on."""
        if self.recorder is not None:
            self.recorder.add(self.problem, self.call.rows[s.rows], s, passes.iterate())
            passes.update()
        elif self._guided or self.call.callback is not None or self.call.deadline is not None:
            passes.run(1)
        else:
            passes.run_half(PASSES_AT_ONCE)
        status = passes.outcome.clone()
        going = (passes.ended & (status == Status.RUNNING)).nonzero().flatten()
        if self._guided and going.numel() > 0:
            self._ask_guidance(self.problem, s, going, status)
            self._begin_inner(self.problem, s, going)
        return status

    def _by_iterations(self, s: State) -> Tensor:
        lagrangian = Lagrangian(self.problem, s.multipliers, s.penalty, not self.as_printed)
        end = kernels_of(self.problem).descend(lagrangian, s, self.solver.inner.descent, self.limit)
        if self.recorder is not None:
            self.recorder.add(self.problem, self.call.rows[s.rows], s, end)
        rows = end.ended.nonzero().flatten()
        if rows.numel() > 0:
            self._outer_iteration(s, rows, end)
        return end.status

    def _outer_iteration(self, s: State, rows: Tensor, end: PassEnd) -> None:
        """Algorithm 4, lines 7-12, for the problems in `rows`, whose inner solve has ended."""
        solver, problem, X, U = self.solver, self.problem.take(rows), s.X[rows], s.U[rows]
        worst = measured(problem, X, U)
        growth = torch.full_like(worst, solver.penalty_growth)
        if not self.as_printed:
            growth = growth.masked_fill(worst <= solver.violation_tolerance, 1.0)
        multipliers = update_and_raise_penalty(problem, X, U, take(s.multipliers, rows), growth, PENALTY_MAX)
        self._keep_best(s, rows, problem, Iterate(X, U, multipliers, s.cost[rows], worst))
        s.multipliers = copied(s.multipliers)
        put(s.multipliers, rows, multipliers)
        s.outer[rows] += 1
        end.status[rows] = self._status(s, rows, end, worst)
        s.last_cost[rows] = s.cost[rows]
        going = rows[end.status[rows] == Status.RUNNING]
        if going.numel() > 0:
            self._ask_guidance(self.problem, s, going, end.status)
            self._begin_inner(self.problem, s, going)

    def _status(self, s: State, rows: Tensor, end: PassEnd, worst: Tensor) -> Tensor:
        """Why problems end: the outer limit, or convergence; else RUNNING."""
        status = torch.full_like(rows, Status.RUNNING)
        over = s.outer[rows] >= self.solver.max_outer_iterations
        status[over & end.stuck[rows]] = Status.LINE_SEARCH_FAILED
        status[over & ~end.stuck[rows]] = Status.MAX_ITERATIONS
        if not self.as_printed:
            settled = (s.cost[rows] - s.last_cost[rows]).abs() <= SETTLED * s.cost[rows].abs()
            status[end.converged[rows] & settled & (worst <= self.solver.violation_tolerance)] = Status.CONVERGED
        return status

    def _keep_best(self, s: State, rows: Tensor, problem: Problem, new: Iterate) -> None:
        old = take(s.best, rows)
        chosen = is_preferred(problem, new, old, self.solver.violation_tolerance, self.by_arrival).nonzero().flatten()
        put(s.best, rows[chosen], take(new, chosen))

    def _begin_inner(self, running: Problem, s: State, rows: Tensor) -> None:
        """The next inner solve of `rows` of the running problems: L_M with its new multipliers and penalty."""
        s.regularisation[rows] = 0.0
        multipliers, penalty = take((s.multipliers, s.penalty), rows)
        lagrangian = Lagrangian(running.take(rows), multipliers, penalty, not self.as_printed)
        s.cost[rows], s.merit[rows] = value(lagrangian, s.X[rows], s.U[rows])
        s.inner[rows] = s.rung[rows] = 0

    def _ask_guidance(self, running: Problem, s: State, rows: Tensor, status: Tensor) -> None:
        rows = rows[~s.replaced[rows]]
        if self.guidance is None or rows.numel() == 0:
            return
        problem = running.take(rows)
        where = s.rows[rows]
        key = DrawKey(self.call.seed, self.call.ids[where], self.call.outer[where] + s.outer[rows])
        advice = self.guidance.update(problem, s.X[rows], s.U[rows], take(s.penalty, rows), key)
        if advice.penalty is not None:
            if s.penalty is None:
                raise InputError("guidance.start", "a penalty, as `update` returns one", None)
            put(s.penalty, rows, advice.penalty)
            s.guided[rows] += advice.penalty.is_active
        if advice.stop is not None:
            status[rows[advice.stop]] = STOPPED
        if advice.U is not None and advice.taken is not None:
            self._replace_iterate(s, rows, problem, advice)

    def _replace_iterate(self, s: State, rows: Tensor, problem: Problem, advice: Advice) -> None:
        """Continue from the advised controls where they are taken.

        The multipliers belong to the abandoned trajectory, so they start again at zero. To keep the solver from
        returning there, mu is raised until the penalty there is `HOLD` times the extra cost of the new trajectory.
        """
        assert advice.U is not None and advice.taken is not None
        taken = advice.taken.nonzero().flatten()
        if taken.numel() == 0:
            return
        subset, where, U = problem.take(taken), rows[taken], advice.U[taken]
        X, old = open_loop(subset, U), take(s.multipliers, where)
        lam = tuple(torch.zeros_like(z) for z in old.lam)
        unit = Lagrangian(subset, Multipliers(lam, torch.ones_like(old.mu)), None, True)
        cost, merit = value(unit, s.X[where], s.U[where])
        needed = (subset.cost.total(X, U) - cost).clamp(min=0.0) / (merit - cost).clamp(min=1e-12)
        put(s.multipliers, where, Multipliers(lam, torch.maximum(old.mu, HOLD * needed).clamp(max=PENALTY_MAX)))
        s.X, s.U = s.X.clone(), s.U.clone()
        s.X[where], s.U[where] = X, U
        s.replaced[where] = True
        penalized = s.penalty.is_active[where] if s.penalty is not None else torch.zeros_like(taken, dtype=torch.bool)
        s.guided[where] += ~penalized

    def end(self, s: State, places: Tensor, status: Tensor) -> None:
        """Keep the best and the last iterate of the problems at `places` of the state."""
        whole = places.numel() == s.rows.numel()
        state = s if whole else take(s, places)
        violation = measured(self.problem.take(places), state.X, state.U)
        last = Iterate(state.X, state.U, state.multipliers, state.cost, violation)
        best, known = state.best, torch.isfinite(state.best.violation)
        if not bool(known.all()):
            best = copied(last)
            put(best, known, take(state.best, known))
        ended = SolveEnd(best, last, status, state.iterations, state.outer, state.guided)
        if whole and self._result is None and places.numel() == self.call.problem.B:
            self._result = ended
        else:
            put(self.result, state.rows, ended)
        self.stopped += int((status == STOPPED).sum())

    def report(self, passes: int, rows: Tensor, waiting: int, before: State, state: State | None) -> None:
        """The progress of a pass, for the callback; `state` is that of the problems that run on, if any."""
        if self.call.callback is not None:
            now = take(before, slice(0, 0)) if state is None else state
            total, left = self.call.problem.B, now.rows.numel() + waiting
            self.call.callback(Progress(passes, self.call.rows[rows], total - left - self.stopped, total, now))


def run_all(work: OuterLoop, slots: int) -> None:
    """Run all problems of a call to their end, at most `slots` at a time.

    Nested loops would wait for the slowest problem of the batch at three levels. Here every problem is at its own place
    in the loops. A problem that ends frees its slot for a waiting one; if none waits, the running batch shrinks.
    """
    first, waiting = torch.arange(work.call.problem.B, device=work.call.rows.device).tensor_split([slots])
    state, status = work.begin(first)
    work.regroup(state.rows)
    running, waiting = _replaced(work, state, status, waiting)
    passes = 0
    while running is not None:
        state, worked = running, running.rows.clone()  # a copy: slots are refilled in place
        running, waiting = _replaced(work, state, work.advance(state), waiting)
        passes += 1
        work.report(passes, worked, waiting.numel(), state, running)


def _replaced(work: OuterLoop, state: State, status: Tensor, waiting: Tensor) -> tuple[State | None, Tensor]:
    """The state with ended problems replaced by waiting ones, or removed; and the rows still waiting.

    None where no problem runs on.
    """
    while True:
        ended = (status != Status.RUNNING).nonzero().flatten()
        if ended.numel() == 0:
            return (state if status.numel() > 0 else None), waiting
        work.end(state, ended, status[ended])
        status = status.clone()
        status[ended] = Status.RUNNING
        news = min(ended.numel(), waiting.numel())
        if news > 0:
            begun, refused = work.begin(waiting[:news])
            waiting = waiting[news:]
            put(state, ended[:news], begun)
            status[ended[:news]] = refused
        if news == 0 and ended.numel() == status.numel():
            return None, waiting
        if ended.numel() > news:
            stays = torch.ones_like(status, dtype=torch.bool)
            stays[ended[news:]] = False
            stay = stays.nonzero().flatten()
            state, status = take(state, stay), status[stay]
        work.regroup(state.rows)
