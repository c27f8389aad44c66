"""The one loop: every pass is one iLQR iteration, or the rest of an inner solve, for all problems that still run.

In nested loops a batch would wait for its slowest member at three levels. Here each element carries its own phase:
inner and outer iteration, regularisation, penalty, guidance. Those whose inner solve has ended get their multiplier
update in the same pass, and those that end give their slot to one that waits, or leave the batch. Per element the
iterates are those of the paper's nested loops, whatever its companions.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchgco.constraints.guides import Guide
from torchgco.draws import DrawKey
from torchgco.errors import InputError
from torchgco.lagrangian import Lagrangian, Multipliers, is_better, update, violation
from torchgco.native.dispatch import cost_unit, engine_of, open_loop, reproducible, value
from torchgco.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers.attempts import go_on_from, has_arrived, try_again
from torchgco.solvers.iteration import EagerIterations, NativeIterations, PassEnd
from torchgco.solvers.state import Callback, InnerEnd, Iterate, OuterLoop, Progress, State
from torchgco.solvers.trace import Recorder
from torchgco.solvers.verdict import final_status, optimality
from torchgco.status import Status
from torchgco.tree import copied, put, take


class Loop:
    """One solve of one batch. Holds the running state; created and dropped by a solver's `solve`.

    Raises:
        InputError: U0, ids or warm don't fit the problem.
    """

    def __init__(
        self,
        solver: OuterLoop,
        problem: Problem,
        U0: Tensor,
        seed: int,
        ids: Tensor | None,
        warm: Multipliers | None,
        callback: Callback | None,
        guide: Guide | None = None,
    ) -> None:
        self.ids = check_call(problem, U0, ids)
        if warm is not None:
            warm.check(problem)
        self.solver, self.seed, self.callback, self.given = solver, seed, callback, problem
        self.unit = cost_unit(problem) if solver.inner.normalise else torch.ones_like(problem.x0[:, 0])
        if solver.inner.normalise:
            problem = problem.in_cost_units()
            warm = None if warm is None else warm.scaled(1.0 / self.unit)
            guide = None if guide is None else replace(guide, weight=guide.weight / self.unit)
        self.guidance = None if solver.guidance is None else solver.guidance.suited(problem)
        self.whole, self.U0, self.warm, self.guide = problem, U0, warm, guide
        self.result = _empty_result(problem, U0)
        self.recorder = Recorder() if solver.record else None
        everyone = torch.arange(problem.B, device=U0.device)
        slots = problem.B if solver.slots is None else min(solver.slots, problem.B)
        self.waiting = everyone[slots:]
        self.state = self._begin(everyone[:slots])
        self.problem = problem if slots == problem.B else problem.take(everyone[:slots])
        limit = 1 if solver.record else solver.inner.max_iterations
        native = engine_of(problem) is not None
        self.iterations = NativeIterations(solver.inner, limit) if native else EagerIterations(solver.inner)

    def run(self) -> Solution:
        """Pass after pass until every element has ended."""
        self._end(self._bad_starts(self.state))
        passes = 0
        while self.state.rows.numel() > 0:
            rows = self.state.rows.clone()  # slots are filled again in place
            self._end(self._pass())
            passes += 1
            if self.callback is not None:
                total = self.whole.B
                left = self.state.rows.numel() + self.waiting.numel()
                self.callback(Progress(passes, rows, total - left, total, self.state))
        return self._finished()

    # Start -------------------------------------------------------------------------------------------------------

    def _begin(self, rows: Tensor) -> State:
        """The state in which the elements `rows` begin."""
        problem, solver = self.whole.take(rows), self.solver
        U = self.U0[rows]
        X = open_loop(problem, U)
        duals = Multipliers.zero(problem, solver.initial_penalty) if self.warm is None else take(self.warm, rows)
        guide = take(self.guide, rows) if self.guidance is None else self.guidance.start(problem, X)
        cost, merit = value(Lagrangian(problem, duals, guide, solver.clip), X, U)
        zero, worst = torch.zeros_like(rows), torch.full_like(cost, torch.inf)
        iterate = Iterate(X, U, duals, cost, worst)
        return State(
            rows=rows,
            X=X, U=U, cost=cost, merit=merit.clone(), duals=duals, guide=guide,
            regularisation=torch.zeros_like(cost),
            inner=zero, outer=zero.clone(), iterations=zero.clone(), rung=zero.clone(), advised=zero.clone(),
            guided=zero.clone(),
            last_cost=worst.clone(),
            best=copied(iterate), origin=copied(iterate),
            attempt=zero.clone(), since=zero.clone(), led=torch.zeros_like(rows, dtype=torch.bool),
        )  # fmt: skip

    def _bad_starts(self, state: State) -> Tensor:
        """Statuses (B',) of elements that can't begin, RUNNING for the others."""
        status = torch.full_like(state.rows, Status.RUNNING)
        status[~self.whole.start_is_clear[state.rows]] = Status.INVALID_START
        # NaN compares as clear of every obstacle, hence after it.
        finite = torch.isfinite(state.merit) & torch.isfinite(state.X).flatten(1).all(-1)
        status[~finite] = Status.NON_FINITE
        return status

    # One pass ----------------------------------------------------------------------------------------------------

    def _pass(self) -> Tensor:
        """Iterations of every running element; returns the statuses it leaves them in."""
        s = self.state
        lagrangian = Lagrangian(self.problem, s.duals, s.guide, self.solver.clip)
        end = self.iterations.run(s, lagrangian)
        if self.recorder is not None:
            self.recorder.add(self.problem, s, end)
        if bool(end.ended.any()):
            self._end_inner(end)
        return end.status

    # Outer iteration ---------------------------------------------------------------------------------------------

    def _end_inner(self, end: PassEnd) -> None:
        """Algorithm 4, lines 7-12, for the elements whose inner solve has ended."""
        s, solver, status = self.state, self.solver, end.status
        rows = end.ended.nonzero().flatten()
        problem, X, U, duals = self.problem.take(rows), s.X[rows], s.U[rows], take(s.duals, rows)
        now = violation(problem, X, U)
        growth = torch.full_like(now, solver.penalty_growth)
        if not solver.grow_when_feasible:
            growth = growth.masked_fill(now <= solver.violation_tolerance, 1.0)
        updated = update(problem, X, U, duals, growth, solver.penalty_max)
        self._remember(rows, Iterate(X, U, updated, s.cost[rows], now))
        s.outer[rows] += 1
        inner_end = InnerEnd(
            end.converged[rows], end.stuck[rows], s.outer[rows] - s.since[rows], s.cost[rows], s.last_cost[rows], now
        )
        status[rows] = solver.verdict(inner_end)
        s.last_cost[rows] = s.cost[rows]
        try_again(s, rows, problem, updated, status, solver)
        going = (status[rows] == Status.RUNNING).nonzero().flatten()
        if going.numel() > 0:
            self._next_inner(rows[going], take(updated, going))

    def _remember(self, rows: Tensor, new: Iterate) -> None:
        """Keep the best iterate that ended an inner solve: feasible before infeasible, then by cost."""
        old, limit = take(self.state.best, rows), self.solver.violation_tolerance
        better = is_better(new.cost, new.violation, old.cost, old.violation, limit)
        if self.solver.arrival is not None:
            problem = self.problem.take(rows)
            arrived, old_arrived = (has_arrived(problem, it, self.solver.arrival, limit) for it in (new, old))
            better = torch.where(arrived == old_arrived, better, arrived)
        chosen = better.nonzero().flatten()
        put(self.state.best, rows[chosen], take(new, chosen))

    def _next_inner(self, rows: Tensor, duals: Multipliers) -> None:
        """The next inner solve of the elements in `rows`: multipliers, penalties, guidance, and L_M with them."""
        s = self.state
        s.duals = Multipliers(tuple(lam.clone() for lam in s.duals.lam), s.duals.mu.clone())
        put(s.duals, rows, duals)
        self._be_guided(rows[~s.led[rows]])
        s.regularisation[rows] = 0.0
        lagrangian = Lagrangian(self.problem.take(rows), take(s.duals, rows), take(s.guide, rows), self.solver.clip)
        s.cost[rows], s.merit[rows] = value(lagrangian, s.X[rows], s.U[rows])
        s.inner[rows] = s.rung[rows] = 0

    def _be_guided(self, rows: Tensor) -> None:
        """Ask guidance for the elements in `rows`, and go on from the plans that it hands over."""
        s, guidance = self.state, self.guidance
        if guidance is None or rows.numel() == 0:
            return
        problem = self.problem.take(rows)
        advice = guidance.update(problem, s.X[rows], s.U[rows], take(s.guide, rows), self._key(rows))
        put(s.guide, rows, advice.guide)
        s.guided[rows] += advice.guide.is_active | advice.taken
        if advice.iterations is not None:
            s.advised[rows] += advice.iterations
        put(s.duals, rows, go_on_from(s, rows, problem, advice, take(s.duals, rows), self.solver))

    def _key(self, rows: Tensor) -> DrawKey:
        s = self.state
        return DrawKey(self.seed, self.ids[s.rows[rows]], s.outer[rows], s.since[rows], s.attempt[rows].clamp(min=1))

    # End ---------------------------------------------------------------------------------------------------------

    def _end(self, status: Tensor) -> None:
        """Elements that have ended make room for those that wait, or leave the batch."""
        while True:
            ended = (status != Status.RUNNING).nonzero().flatten()
            if ended.numel() == 0:
                return
            self._write(ended, status)
            news = min(ended.numel(), self.waiting.numel())
            fresh, self.waiting = self._begin(self.waiting[:news]), self.waiting[news:]
            put(self.state, ended[:news], fresh)
            status = torch.full_like(status, Status.RUNNING)
            status[ended[:news]] = self._bad_starts(fresh)
            if ended.numel() > news:
                stays = torch.ones_like(status, dtype=torch.bool)
                stays[ended[news:]] = False
                stay = stays.nonzero().flatten()
                self.state, status = take(self.state, stay), status[stay]
            self.problem = self.whole.take(self.state.rows)

    def _write(self, rows: Tensor, status: Tensor) -> None:
        """Copy what the elements in `rows` are worth into the result: the best iterate where there is one."""
        s, problem = self.state, self.problem.take(rows)
        last = Iterate(s.X[rows], s.U[rows], take(s.duals, rows), s.cost[rows], torch.zeros_like(s.cost[rows]))
        has_best = torch.isfinite(s.best.violation[rows]).nonzero().flatten()
        last = replace(last, violation=violation(problem, last.X, last.U))
        put(last, has_best, take(take(s.best, rows), has_best))
        place, r = s.rows[rows], self.result
        r.X[place], r.U[place], r.cost[place], r.violation[place] = last.X, last.U, last.cost, last.violation
        put(r.multipliers, place, last.duals)
        r.status[place] = status[rows]
        r.iterations[place], r.outer_iterations[place] = (s.iterations + s.advised)[rows], s.outer[rows]
        r.guided[place] = s.guided[rows]

    def _finished(self) -> Solution:
        """The result in the units that the problem was given in, with gains and final statuses."""
        r, solver = self.result, self.solver
        left = torch.zeros_like(r.cost)
        for rows in torch.arange(self.whole.B, device=self.U0.device).split(solver.slots or self.whole.B):
            lagrangian = Lagrangian(self.whole.take(rows), take(r.multipliers, rows), None, solver.clip)
            r.K[rows], r.d[rows], left[rows] = optimality(lagrangian, r.X[rows], r.U[rows])
            r.X[rows], r.U[rows] = reproducible(lagrangian.problem, r.X[rows], r.U[rows], r.K[rows])
        status = final_status(r.status, left, r.violation, solver.violation_tolerance, bool(self.whole.constraints))
        return replace(
            r, status=status, cost=self.given.cost.total(r.X, r.U), multipliers=r.multipliers.scaled(self.unit),
            trace=None if self.recorder is None else self.recorder.frame(self.unit),
        )  # fmt: skip


def _empty_result(problem: Problem, U0: Tensor) -> Solution:
    blank = torch.zeros(problem.B, dtype=torch.int64, device=U0.device)
    worth = U0.new_zeros(problem.B)
    return Solution(
        X=U0.new_zeros(problem.B, problem.N + 1, problem.n), U=torch.zeros_like(U0),
        K=U0.new_zeros(*U0.shape, problem.n), d=torch.zeros_like(U0),
        multipliers=Multipliers.zero(problem, 0.0), cost=worth, violation=worth.clone(),
        status=blank, iterations=blank.clone(), outer_iterations=blank.clone(), guided=blank.clone(),
    )  # fmt: skip


def check_call(problem: Problem, U0: Tensor, ids: Tensor | None) -> Tensor:
    """The ids (B,), after checking what every solver is handed."""
    problem.check_controls(U0)
    if ids is None:
        return torch.arange(problem.B, device=problem.x0.device)
    if not isinstance(ids, Tensor) or tuple(ids.shape) != (problem.B,) or ids.dtype != torch.int64:
        raise InputError("ids", f"an int64 tensor ({problem.B},)", getattr(ids, "shape", type(ids).__name__))
    return ids
