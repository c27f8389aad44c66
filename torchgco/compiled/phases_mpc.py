"""PhasesMPC: a vehicle that plans the rest of its phases anew in every period."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.numbers import as_floats, measured
from torchgco.base.options import PositiveOrInfinite, Seconds, check_value
from torchgco.base.tree import is_users
from torchgco.compiled.compiled import CONVERGED, FEASIBLE
from torchgco.compiled.compiling import compile
from torchgco.compiled.mpc import time_of, within_bounds
from torchgco.compiled.numbers import Numbers
from torchgco.compiled.phases import CompiledPhases, PhasesAnswer
from torchgco.compiled.stages import follows
from torchgco.constraints.gates import has_gates
from torchgco.phases import Phases
from torchgco.problem.free_time import FreeTime
from torchgco.problem.problem import Problem
from torchgco.receding.plan import STAGE_ROUNDING, Plan

NAME = re.compile(r"(phases|jumps)\[(\d+)\](.*)")
ROW = re.compile(r"\.constraints\[(\d+)\](.*)")


class PhasesMPC:
    """Model predictive control through phases: in every period what is left of them is solved from the measured state.

        mpc = torchgco.PhasesMPC(phases, period=0.02)
        u = mpc.step(x)  # for 0.02 s, or until `mpc.begins[0]`, when the next phase begins

    The horizon shrinks. Phases that are over drop out, and the present one is cut to what is left of it: its N stages
    then are shorter, and the bounds of a free duration are those of the rest. It is over when the last plan says so, or
    when a step says that the next one has begun: where a foot lands, that is measured. Durations of the others stay
    free, or fixed, as they are given.

    Args:
        phases: of one vehicle; each phase's model has a field to integrate, as of `FreeTime`.
        solver: as of `torchgco.compile`.
        period: s, from one step to the next; None: a stage of the first phase.
        max_seconds: of a step; None: the period, if one is given, of all steps but the first.
        tolerance: as `torchgco.compile` takes it.

    Attributes:
        t: time of the last step, s; the first one's is 0, or what `step` was given.
        phase: the number of the present phase.
        begins: when the phases after it begin, and the last one ends, by the plan that is flown, s.
        answer: the last solve's `PhasesAnswer`, of the phases that are left; None before the first step.
        held: whether a plan of an earlier step is flown, as the solve failed or was late.

    Raises:
        InputError: as `torchgco.compile`; several vehicles, a loop, a free start, several segments of time, gates,
            obstacles that move, references by knot, rows at knots inside a phase, `RateBounds` with a `previous`.
    """

    t: float
    phase: int
    begins: list[float]
    answer: PhasesAnswer | None
    held: bool

    def __init__(
        self, phases: Phases, solver: str | None = None, period: float | None = None, *,
        max_seconds: float | None = None, tolerance: float | None = None,
    ) -> None:  # fmt: skip
        if not isinstance(phases, Phases):
            raise InputError("phases", "Phases; MPC serves one problem", shown(phases))
        phases = phases.current()
        if phases.B != 1 or phases.closing is not None:
            got = "a loop" if phases.B == 1 else f"{phases.B} of them"
            raise InputError("phases", "those of one vehicle, which end somewhere", got)
        for i, one in enumerate(phases.members):
            _check(one, f"phases.problems[{i}]")
        lasting = [one if one.time else replace(one, time=FreeTime(1.0, 1.0, weight=0.0)) for one in phases.members]
        self.period = check_value(period or float(lasting[0].dynamics.dt), Seconds, "period")
        self.max_seconds = check_value(max_seconds, PositiveOrInfinite | None, "max_seconds")
        self._limit = period if max_seconds is None else max_seconds
        self._phases, self._times = phases, [one.time for one in lasting]
        self._nominal = [one.N * float(one.dynamics.dt) for one in lasting]
        self._rows = [[i for i, row in enumerate(one.constraints) if not _at_start(row, one.N)] for one in lasting]
        self._loops = [self._loop(lasting, i, solver, tolerance) for i in range(len(lasting))]
        self.reset()

    def _loop(self, lasting: list[Problem], i: int, solver: str | None, tolerance: float | None) -> CompiledPhases:
        """The phases from i on; rows of the present one's start are over."""
        first = replace(lasting[i], constraints=[lasting[i].constraints[row] for row in self._rows[i]])
        given = self._phases.jumps
        left = Phases([first, *lasting[i + 1 :]], None if given is None else given[i:])
        made: CompiledPhases = compile(left, solver, tolerance=tolerance)
        return made

    def reset(self) -> None:
        """Forget the plan, and begin at time 0 in the first phase again."""
        self.t, self.phase, self.answer, self.held, self.begins = 0.0, 0, None, False, []
        self._began, self._plans, self._values = 0.0, dict[int, Plan](), dict[str, Any]()

    @property
    def numbers(self) -> Numbers:
        """What steps may change: names as those of all phases, and shapes."""
        return self._loops[0].numbers

    def step(
        self, x: Any, *, phase: int | None = None, t: float | None = None, max_seconds: float | None = None,
        numbers: Mapping[str, Any] | None = None, **named: Any,
    ) -> Tensor:  # fmt: skip
        """The controls (1, m) of the present phase for the next period, from a state x (1, n); (m,) for x (n,).

        Args:
            phase: the one that the vehicle is in by now, where that is known; None: by the plan.
            t: time of the measurement, s, where steps come at other times than every period.
            max_seconds: of this step alone.
            numbers, named: new numbers, which stay; of phases that are over, too, which nothing reads any more.

        Raises:
            InputError: a state, a time, a phase or numbers that don't fit, or all phases are over. Nothing is changed
                then.
        """
        first = self.answer is None
        now = time_of(t, None if first else self.t, self.t if first else self.t + self.period)
        place, began = self._place(phase, now)
        values = self._values | self.numbers.named(numbers, named)
        there = {name: value for old, value in values.items() if (name := self._named(old, place)) is not None}
        state = measured(x, 1, self._phases.members[place].n)
        there |= {"phases[0].x0": state} | self._left(place, now - began, values)
        loop = self._loops[place]
        for name, value in there.items():
            loop.numbers.find(name).checked(value)
        for i in range(self.phase, place):
            dropped = sorted({*range(len(self._phases.members[i + 1].constraints))} - {*self._rows[i + 1]})
            self._loops[i + 1].begin_after(self._loops[i], dropped)
        since = now if place != self.phase and phase is not None else max(began, self.t)
        limit = max_seconds if max_seconds is not None else self.max_seconds if first else self._limit
        limit = None if limit == np.inf else limit
        answer = loop.call(there, not first, None, 0.0 if first else now - since, limit)
        self.t, self.phase, self.answer, self._began, self._values = now, place, answer, began, values
        return self._flown(answer, state, now)

    def _place(self, phase: Any, now: float) -> tuple[int, float]:
        """The present phase, and when it began."""
        place, began, last = self.phase, self._began if self.answer is not None else now, len(self._loops) - 1
        if phase is not None:
            if isinstance(phase, bool) or not isinstance(phase, int) or not place <= phase <= last:
                raise InputError("phase", f"one of {place} to {last}", shown(phase))
            return phase, began if phase == place else now
        due = [begin for begin in self.begins if now >= begin - STAGE_ROUNDING * self.period]
        if len(due) > last - place:
            raise InputError("t", f"a time before {self.begins[-1]:g} s, when the last phase is over", now)
        return place + len(due), due[-1] if due else began

    def _left(self, place: int, seconds: float, values: Mapping[str, Any]) -> dict[str, Any]:
        """The bounds on the rest of the present phase, so many seconds after it began, of those that steps have given,
        or the problem."""
        time, gone = self._times[place], seconds / self._nominal[place]
        rest = dict[str, Any]()
        for name in ("least", "most", "guess"):
            whole = values.get(f"phases[{place}].time.{name}", getattr(time, name))
            if whole is not None:
                rest[f"phases[0].time.{name}"] = np.maximum(as_floats(whole, name) - gone, STAGE_ROUNDING)
        return rest

    def _named(self, name: str, place: int) -> str | None:
        """The name of a number among what is left from a phase on; None where that is over."""
        whole = NAME.fullmatch(name)
        assert whole is not None
        kind, i, rest = whole[1], int(whole[2]) - place, whole[3]
        if i < 0:
            return None
        if kind == "phases" and i == 0 and (row := ROW.fullmatch(rest)) is not None:
            shift = self._rows[0] if place == 0 else range(len(self._phases.members[place].constraints))
            original = shift[int(row[1])]
            if original not in self._rows[place]:
                return None
            rest = f".constraints[{self._rows[place].index(original)}]{row[2]}"
        return f"{kind}[{i}]{rest}"

    def _flown(self, answer: PhasesAnswer, state: np.ndarray, now: float) -> Tensor:
        """The controls, of the new plan where there is one, else of the one before."""
        ended = int(answer.status[0])
        self.held = ended not in (CONVERGED, FEASIBLE) and self.phase in self._plans
        if not self.held:
            begins = [now + begin for begin in answer.begins[0].tolist()]
            self.begins = begins[1:]
            self._plans = {self.phase + i: self._plan(i, begins[i]) for i in range(len(answer))}
        plan, problem = self._plans[self.phase], self._phases.members[self.phase]
        u = within_bounds(problem, plan.mean(now, self.period, state if self.held else None))
        return u[0].clone() if state.ndim == 1 else u.clone()

    def _plan(self, i: int, start: float) -> Plan:
        assert self.answer is not None
        part, problem = self.answer[i], self._phases.members[self.phase + i]
        return Plan(
            X=part.X, U=part.U, K=part.K, start=torch.tensor([start], dtype=torch.float64),
            dt=float(problem.dynamics.dt), dynamics=problem.dynamics, bounds=problem.control_bounds, knots=part.t,
        )  # fmt: skip


def _at_start(row: Any, N: int) -> bool:
    """Whether rows are of a phase's first knot alone."""
    return torch.arange(N + 1)[row.knots].tolist() == [0]


def _reads_knots(part: Any) -> bool:
    return is_users(part) and getattr(part, "reads_knots", False)


def _check(one: Problem, where: str) -> None:
    """Refuse, in a line each, what a phase that is cut doesn't leave as it is."""
    wrong = {
        "time": "several segments" if one.time is not None and one.time.count > 1 else None,
        "free_start": "one" if one.free_start is not None else None,
        "cost": next(iter(sorted(one.cost.names_by_stage())), "a function of k" if _reads_knots(one.cost) else None),
        "constraints": "Gates" if has_gates(one) else None,
    }
    for name, got in wrong.items():
        if got is not None:
            raise InputError(f"{where}.{name}", "what stays the same in a phase that is cut", got)
    for i, row in enumerate(one.constraints):
        knots = torch.arange(one.N + 1)[row.knots].tolist()
        inner = knots[-1:] < [one.N - 1] or (len(knots) > 1 and knots != list(range(min(knots[0], 1), knots[-1] + 1)))
        got = "obstacles that move" if getattr(row, "moving", False) else "a `previous`" if follows(row) else None
        if got is None and knots and knots != [0] and inner:
            got = f"rows at knots {knots}"
        if got is None and _reads_knots(row):
            got = "a function of k"
        if got is not None:
            raise InputError(f"{where}.constraints[{i}]", "rows at rest, of all knots, the first or the last", got)
