"""MPC: a controller that solves a compiled problem in every period, and holds its plan where that fails."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.options import Seconds, check_value
from torchgco.base.status import Status
from torchgco.compiled.compiled import CONVERGED, FEASIBLE, Answer, Compiled, compile
from torchgco.compiled.numbers import Numbers, measured
from torchgco.compiled.plan import Plan
from torchgco.compiled.stages import check_loop_in_free_time, follows, stage_of, stages_between
from torchgco.problem.problem import Problem, current_problem
from torchgco.solution import Solution


class MPC:
    """Model predictive control: in every period the problem is solved from the measured states.

        mpc = torchgco.MPC(problem, period=0.02)
        u = mpc.step(x, x_ref=reference)  # for 0.02 s

    Controls, states and multipliers of the plan before are moved on by the period, which needn't be a whole number of
    stages, and the interior point continues from there (`torchgco.compile`). Where a solve fails or is late, the plan
    before is held: its control of that time with feedback on the measured state, within the bounds. `RateBounds` with a
    `previous` count from the controls that were returned last.

    Where the time is free, a plan lasts as long as is left of the one before, or as is best. Controls are the plan's
    means over the next period, and of stages that are longer those of the first.

    Args:
        problem: B vehicles with stages of one length, or a free time; its start isn't used.
        solver: "gco" or "interior_point": of the first period, and of those that no plan before leads to, where an
            obstacle has come into the way, say. None: "gco" among obstacles, as only it searches for other ways, else
            "interior_point".
        period: s, from one step to the next; None: a stage of dt.
        max_seconds: of a step; a solve that isn't ready by then is late. None: none is.
        changes: names of the numbers that steps may change, beside the starts and `previous`, which each step writes.
            None: all.
        tolerance: as `torchgco.compile` takes it.

    Attributes:
        t: time of the last step, s; the first one's is 0, or what `step` was given.
        plan: what is flown since then, each vehicle's from the time that it was solved at; None before the first step.
        answer: the last solve's `Answer`, whether it is flown or not; None before the first step.

    Raises:
        InputError: as `torchgco.compile`; stages that differ in length, horizons of each problem, or free starts. Where
            the time is free: a shortest duration below a period, `RateBounds` with a `previous`.
    """

    def __init__(
        self,
        problem: Problem,
        solver: str | None = None,
        period: float | None = None,
        *,
        max_seconds: float | None = None,
        changes: Sequence[str] | None = None,
        tolerance: float | None = None,
    ) -> None:
        problem = current_problem(problem)
        for name, given in (("horizon", problem.horizon), ("free_start", problem.free_start)):
            if given is not None:
                raise InputError(f"problem.{name}", "None in a loop, which starts from measured states", "one")
        self._free = problem.time is not None
        self.dt = float(problem.dynamics.dt) if self._free else stage_of(problem)
        self.period = self.dt if period is None else check_value(period, Seconds, "period")
        if self._free:
            check_loop_in_free_time(problem, self.period)
        self.max_seconds = check_value(max_seconds, Seconds | None, "max_seconds")
        if solver is None:
            solver = "gco" if problem.obstacles else "interior_point"
        self._previous = [f"constraints[{i}].previous" for i, part in enumerate(problem.constraints) if follows(part)]
        changes = None if changes is None else ["x0", *self._previous, *changes]
        self.compiled: Compiled = compile(problem, solver, changes, tolerance=tolerance)
        self._problem = problem
        self.reset()

    def reset(self) -> None:
        """Forget the plan, and begin at time 0 again: the next step solves as the first one does."""
        self.t, self.answer, self._plan = 0.0, None, None
        self._held = np.zeros(self._problem.B, dtype=bool)
        self._begun = np.zeros(self._problem.B)
        self._u: Tensor | None = None

    t: float
    answer: Answer | None

    @property
    def numbers(self) -> Numbers:
        """What steps may change: names, shapes and values."""
        return self.compiled.numbers

    @property
    def plan(self) -> Plan | None:
        """See the class."""
        if self._plan is None and self.answer is not None:
            self._plan = self._made(self.answer)
        return self._plan

    @property
    def held(self) -> Tensor:
        """Which vehicles fly a plan of an earlier step, (B,) bool."""
        return torch.from_numpy(self._held.copy())

    @property
    def status(self) -> Tensor:
        """How the last step's solves ended, (B,) int64: of those that are held, why. See `Status`.

        Raises:
            InputError: no step yet.
        """
        if self.answer is None:
            raise InputError("mpc", "a step before its status is asked for", "none")
        return self.answer.status

    @property
    def statuses(self) -> list[Status]:
        """The same by name."""
        return [Status(status) for status in self.status.tolist()]

    def solution(self) -> Solution:
        """The last solve with multipliers and costs, to judge and explain; see `Compiled.solution`."""
        return self.compiled.solution()

    def step(
        self,
        x: Any,
        *,
        t: float | None = None,
        max_seconds: float | None = None,
        numbers: Mapping[str, Any] | None = None,
        **named: Any,
    ) -> Tensor:
        """The controls (B, m) for the next period, from states x (B, n) measured now; (m,) for x (n,) of one vehicle.

        Args:
            t: time of the measurement, s, where steps come at other times than every period.
            max_seconds: of this step alone.
            numbers, named: new numbers of the problem by name, such as x_ref or centers; see `Compiled`.

        Raises:
            InputError: states, a time or numbers that don't fit. Nothing is changed then.
        """
        state, now = measured(x, *self._problem.x0.shape), self._time(t)
        if self._previous and self._u is not None and "previous" not in named:
            numbers = dict.fromkeys(self._previous, self._u) | dict(numbers or {})
        later = 0.0 if self.answer is None else self.period if t is None else now - self.t
        moved = {"elapsed": later} if self._free else {"shift": stages_between(later / self.dt)}
        answer = self.compiled(
            x0=state, warm=self.answer is not None, numbers=numbers, **moved,
            max_seconds=self.max_seconds if max_seconds is None else max_seconds, **named,
        )  # fmt: skip
        ended = answer.status.numpy()
        solved = (ended == CONVERGED) | (ended == FEASIBLE)
        if self.answer is None or solved.all():
            self._held = np.zeros_like(solved)
            self._begun, self._plan = np.full(len(solved), now), None
            u = self._made(answer).mean(now, self.period) if self._free else answer.u
        else:
            before = self.plan
            assert before is not None
            self._held, self._begun = ~solved, np.where(solved, now, self._begun)
            self._plan = _mixed(solved, self._made(answer), before)
            u = self._plan.mean(now, self.period, state) if self._free else self._plan.at(now, state).u
        self.t, self.answer, self._u = now, answer, u
        return u[0].clone() if state.ndim == 1 and len(u) == 1 else u.clone()

    def _made(self, answer: Answer) -> Plan:
        problem = self.compiled.problem
        parts = answer.X, answer.U, answer.K, self._begun, self.dt, problem.dynamics, problem.control_bounds
        return Plan(*parts, answer.t)

    def _time(self, t: float | None) -> float:
        first = self.answer is None
        if t is None:
            return self.t if first else self.t + self.period
        if isinstance(t, bool) or not isinstance(t, int | float) or not np.isfinite(t) or (not first and t <= self.t):
            raise InputError("t", "a time in seconds" if first else f"a time after {self.t:g} s", shown(t))
        return float(t)


def _mixed(new: np.ndarray, plan: Plan, before: Plan) -> Plan:
    """The plan where `new` (B,), elsewhere the one before."""
    rows = torch.from_numpy(new)
    X, U, K = (
        torch.where(rows.view(-1, *[1] * (a.dim() - 1)), a, b)
        for a, b in ((plan.X, before.X), (plan.U, before.U), (plan.K, before.K))
    )
    knots = None if plan.knots is None else torch.where(rows.unsqueeze(-1), plan.knots, before.knots)  # type: ignore[arg-type]
    return replace(plan, X=X, U=U, K=K, start=np.where(new, plan.start, before.start), knots=knots)
