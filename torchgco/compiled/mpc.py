"""Controllers that plan in every period: MPC, which holds its plan or stops where a solve fails, and MPPI in a loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base.draws import DrawKey
from torchgco.base.errors import InputError, shown
from torchgco.base.numbers import as_floats, measured
from torchgco.base.options import PositiveOrInfinite, Seconds, Seed, check_value
from torchgco.base.shapes import CPU, check_shape, check_tensor, check_untransformed, computing_on
from torchgco.base.status import Status
from torchgco.compiled.answer import Answer
from torchgco.compiled.compiled import CONVERGED, FEASIBLE, Compiled
from torchgco.compiled.compiling import compile
from torchgco.compiled.motion import Motion
from torchgco.compiled.numbers import Numbers, numbers_of, with_numbers_as_they_are, with_own_numbers
from torchgco.compiled.stages import check_loop_in_free_time, in_periods, previous_of, stage_of
from torchgco.guidance.mppi import MPPI
from torchgco.kernels import current, held_on_cpu, is_mixed, open_loop, path_clearance, served_by
from torchgco.lagrangian.lagrangian import shifted
from torchgco.phases import Phases
from torchgco.problem.alone import check_rows
from torchgco.problem.horizons import as_solved
from torchgco.problem.problem import Problem, current_problem
from torchgco.receding.holding import Held, better, clamped, held
from torchgco.receding.plan import Plan, mean_controls, stages_between
from torchgco.solution import Solution


class MPC:
    """Model predictive control: in every period the problem is solved from the measured states.

        mpc = torchgco.MPC(problem, period=0.02)
        u = mpc.step(x, x_ref=reference)  # for 0.02 s

    Controls, states and multipliers of the plan before are moved on by the period, which needn't be a whole number of
    stages, and the interior point continues from there (`torchgco.compile`). Where that fails, it tries again from what
    can be flown then, and after it the solver does. Where all fail or are late, a vehicle flies the plan before with
    feedback on the measured state, if the constraints of now allow that, else what comes to rest, else what breaks them
    least. All controls are within their bounds. `RateBounds` with a `previous` count from the controls that were
    returned last; where a period is shorter than a stage they have a row per knot, and the first one allows as much of
    a stage's change as the period is of the stage. Obstacles that move go on by themselves where a step doesn't say
    where they are.

    Controls are the plan's means over the next period: in periods longer than a stage those of several ones. Where the
    time is free, a plan lasts as long as is left of the one before, or as is best.

    Args:
        problem: B vehicles with stages of one length, or a free time; its start isn't used. Of a GPU it is solved as by
            `torchgco.solve`; plans lie on the CPU.
        solver: "gco" or "interior_point": of the first period, and of those that no plan before leads to, where an
            obstacle has come into the way, say. None: "gco" among obstacles, as only it searches for other ways, else
            "interior_point".
        period: s, from one step to the next; None: a stage of dt.
        max_seconds: of a step; a solve that isn't ready by then is late. None: the period, if one is given, of all
            steps but the first; infinity: none is late.
        changes: names of the numbers that steps may change, beside the starts and `previous`, which each step writes.
            None: all.
        tolerance: as `torchgco.compile` takes it.

    Attributes:
        t: time of the last step, s; the first one's is 0, or what `step` was given.
        plan: what is flown since then, each vehicle's from the time that it was made at; None before the first step.
        answer: the last solve's `Answer`, whether it is flown or not; None before the first step.

    Raises:
        InputError: as `torchgco.compile`; stages that differ in length, horizons of each problem, free starts, or
            obstacles that move without numbers that say where they are. Where the time is free: a shortest duration
            below a period, `RateBounds` with a `previous`.
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
        if isinstance(problem, Phases):
            raise InputError("problem", "a Problem; PhasesMPC takes phases", "Phases")
        asked = current_problem(problem)
        problem = held_on_cpu(asked)
        for name, value in (("horizon", problem.horizon), ("free_start", problem.free_start)):
            if value is not None:
                raise InputError(f"problem.{name}", "None in a loop, which starts from measured states", "one")
        self._free = problem.time is not None
        self.dt = float(problem.dynamics.dt) if self._free else stage_of(problem)
        self.period = self.dt if period is None else check_value(period, Seconds, "period")
        if self._free:
            check_loop_in_free_time(problem, self.period)
        self.max_seconds = check_value(max_seconds, PositiveOrInfinite | None, "max_seconds")
        if solver is None:
            solver = "gco" if problem.obstacles else "interior_point"
        self._spans_stages = self._free or self.period > self.dt  # whether a period may be longer than one
        self._previous = previous_of(problem)
        if self._previous:
            asked, problem = (in_periods(one, min(1.0, self.period / self.dt)) for one in (asked, problem))
        self._motion = Motion(problem)
        places = self._motion.places
        changes = None if changes is None else ["x0", *self._previous, *places, *changes]
        self.compiled: Compiled = compile(asked, solver, changes, tolerance=tolerance)
        self._problem, self._limit = problem, self.max_seconds
        if self._limit is None and period is not None:
            self._limit = self.period
        self._at_first = {name: self.numbers[name] for name in (*self._previous, *places)}
        self.reset()

    def reset(self) -> None:
        """Forget the plan, and begin at time 0 again: the next step solves as the first one does.

        Numbers that steps were given stay, but for controls before and places of what moves.
        """
        self.t, self.answer, self._plan = 0.0, None, None
        self._held = np.zeros(self._problem.B, dtype=bool)
        self._feasible, self._unlooked = np.zeros((2, self._problem.B), dtype=bool)
        self._begun = np.zeros(self._problem.B)
        self._u: Tensor | None = None
        self.numbers.write(self._at_first)
        self._motion.forget()

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
        """Which vehicles fly no plan that was solved for now: one of an earlier step, or one to stop, (B,) bool."""
        return torch.from_numpy(self._held.copy())

    @property
    def feasible(self) -> Tensor:
        """Which vehicles are known to keep their constraints by what they fly, (B,) bool, between the knots, too.

        A plan that is held needn't reach a required goal. False before the first step, and of plans that are held where
        the time is free: they aren't looked at. New plans are looked at between the knots when this is asked for.
        """
        rows = torch.from_numpy(self._feasible & self._unlooked).nonzero().flatten()
        if rows.numel() > 0 and self.answer is not None:
            times = None if self.answer.t is None else self.answer.t[rows]
            with torch.no_grad(), torch.inference_mode(False), computing_on(CPU):
                now = as_solved(self.compiled.now.take(rows), self.answer.X[rows], self.answer.U[rows], times)
                if all(obstacles.has_chords for obstacles in now[0].obstacles):
                    self._feasible[rows.numpy()] = (path_clearance(*now) >= 0).numpy()
        self._unlooked[:] = False
        return torch.from_numpy(self._feasible.copy())

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
        values = self.numbers.named(numbers, named)
        if "x0" in values:
            raise InputError("numbers", "other numbers than x0, which the states x are", "x0")
        if self._u is not None:
            values = dict.fromkeys(self._previous, self._u) | values
        values["x0"] = state
        first, limit = self.answer is None, self.max_seconds if self.answer is None else self._limit
        limit = limit if max_seconds is None else max_seconds
        later = 0.0 if first else self.period if t is None else now - self.t
        values = self._motion.numbers(self.compiled.problem, now, values)
        moved = {"elapsed": later} if self._free else {"shift": stages_between(later / self.dt)}
        known = dict[int, Held]()
        answer = self.compiled.call(
            values, not first, **moved, max_seconds=None if limit == np.inf else limit,
            begin=None if first or self._free else lambda problem, rows: self._known(problem, rows, now, known),
        )  # fmt: skip
        self._motion.keep(self.compiled.problem, now)
        ended = answer.status.numpy()
        solved = (ended == CONVERGED) | (ended == FEASIBLE)
        self._held, self._feasible, self._unlooked = ~solved, solved.copy(), solved.copy()
        if solved.all():
            self._begun, self._plan = np.full(len(solved), now), None
            u = self._made(answer).mean(now, self.period) if self._spans_stages else answer.u
        else:
            with computing_on(CPU), torch.inference_mode(False):
                u = self._hold(answer, solved, now, state, known)
        if not solved.all() or bool(answer.violation.any()):
            u = within_bounds(self.compiled.problem, u)
        self.t, self.answer, self._u = now, answer, u
        return u[0].clone() if state.ndim == 1 and len(u) == 1 else u.clone()

    def _known(self, problem: Problem, rows: Tensor, now: float, known: dict[int, Held]) -> tuple[Tensor, Tensor]:
        """States and controls that the problems in `rows` could fly by now; `known` takes them."""
        plan = self.plan
        flyable = held(problem, None if plan is None else plan.take(rows), now)
        known |= {b: Held(*(tensor[i : i + 1] for tensor in flyable)) for i, b in enumerate(rows.tolist())}
        return flyable.X, flyable.U

    def _hold(
        self, answer: Answer, solved: np.ndarray, now: float, state: np.ndarray, known: dict[int, Held]
    ) -> Tensor:
        """The controls (B, m), where some problems have no plan that was solved for now."""
        plan, before, kept = self._made(answer, now), self.plan, np.zeros_like(solved)
        if self._free:
            kept = ~solved & (before is not None)
        else:
            rows = torch.from_numpy(~solved).nonzero().flatten()
            missing = torch.tensor([b for b in rows.tolist() if b not in known], dtype=torch.int64)
            if missing.numel() > 0:
                self._known(self.compiled.now.take(missing), missing, now, known)
            flyable = Held(*map(torch.cat, zip(*(known[b] for b in rows.tolist()), strict=True)))
            flyable = better(self.compiled.now.take(rows), flyable, answer.U[rows])
            plan = plan.with_rows(rows, replace(plan.take(rows), X=flyable.X, U=flyable.U, K=flyable.K))
            # At other times than its knots a plan before isn't, to the last millimetre, what was looked at.
            at_knots = [isinstance(stages_between(float(now - self._begun[b]) / self.dt), int) for b in rows.tolist()]
            kept[rows.numpy()] = flyable.is_before.numpy() & at_knots
            self._feasible[rows.numpy()] = flyable.feasible
        self._begun = np.where(kept, self._begun, now)
        if before is not None:
            rows = torch.from_numpy(kept).nonzero().flatten()
            plan = plan.with_rows(rows, before.take(rows))
        self._plan = plan
        return self._plan.mean(now, self.period, state) if self._spans_stages else self._plan.at(now, state).u

    def _made(self, answer: Answer, now: float | None = None) -> Plan:
        """An answer's plans, from the times that they were made at, or all from now."""
        problem, begun = self.compiled.problem, self._begun if now is None else np.full_like(self._begun, now)
        return Plan(
            X=answer.X, U=answer.U, K=answer.K, start=torch.from_numpy(begun), dt=self.dt, dynamics=problem.dynamics,
            bounds=problem.control_bounds, knots=answer.t,
        )  # fmt: skip

    def _time(self, t: float | None) -> float:
        return time_of(
            t, None if self.answer is None else self.t, self.t if self.answer is None else self.t + self.period
        )


def within_bounds(problem: Problem, u: Tensor) -> Tensor:
    """Controls (B, m) within the bounds of the first stage, which a solver's tolerance may exceed."""
    bounds = problem.control_bounds
    if bounds is None:
        return u
    low, high = bounds.over(problem.N)
    return clamped(u, low[:, 0], high[:, 0])


def time_of(t: Any, before: float | None, otherwise: float) -> float:
    """When a step is, s: t, or `otherwise` where that isn't given.

    Args:
        before: time of the last step; None: there was none.

    Raises:
        InputError: no time, or one that isn't after the last step's.
    """
    if t is None:
        return otherwise
    late = before is None or (isinstance(t, int | float) and t > before)
    if isinstance(t, bool) or not isinstance(t, int | float) or not np.isfinite(t) or not late:
        raise InputError("t", "a time in seconds" if before is None else f"a time after {before:g} s", shown(t))
    return float(t)


class MPPIController:
    """Model predictive path integral control: `command(x)` samples around the plan before.

        controller = torchgco.MPPIController(problem, torchgco.MPPI(samples=1000, covariance=0.5, temperature=0.1))
        u = controller.command(x)

    Where pytorch_mppi has num_samples, noise_sigma (a matrix), lambda_, horizon and U_init, here are `MPPI.samples`,
    `covariance` (its diagonal), `temperature`, the problem's N, and `reset(U)`. Samples that touch an obstacle pay a
    penalty; other constraints than the bounds of controls don't count, as in `MPPI`. Obstacles that move go on by
    themselves where a command doesn't say where they are.

    Args:
        problem: B vehicles; its start isn't used. Of a GPU, samples run there with the extra `cuda`, else on the CPU.
        sampler: options of a command's rounds.
        seed: of the noise; commands of one seed repeat themselves, each vehicle's as it would be alone.
        period: s, by which the plan moves on from command to command; None: a stage.

    Attributes:
        numbers: what commands may change: names, shapes and values, also to be read and written by name.
        U: the plan (B, N, m), of which the last command returned the mean over the period: of its first stage at least.

    Raises:
        InputError: a problem with stages of several lengths or a free time; one of another device that can't be served
            from the CPU; a covariance that doesn't fit.
    """

    def __init__(
        self, problem: Problem, sampler: MPPI | None = None, seed: int = 0, period: float | None = None
    ) -> None:
        check_untransformed("MPPIController")
        problem = current_problem(problem)
        device, problem = problem.x0.device, held_on_cpu(problem)
        self._origin = device, is_mixed(problem)  # as `Compiled.origin`
        self.sampler = check_value(sampler or MPPI(), MPPI, "sampler")
        self.sampler.check(problem)
        self.seed, self.period = check_value(seed, Seed, "seed"), check_value(period, Seconds | None, "period")
        self._dt, self._motion, self._t = stage_of(problem), Motion(problem), 0.0
        self._stages = 1 if self.period is None else stages_between(self.period / self._dt)
        with torch.inference_mode(False), computing_on(CPU):
            self._problem, self._ids = with_own_numbers(problem), torch.arange(problem.B)
        self.numbers = Numbers(numbers_of(self._problem), lambda number: None)
        self.reset()

    def reset(self, U: Any = None) -> None:
        """Begin again: with the plan U (B, N, m) or (N, m), by default the cost's controls of rest.

        Raises:
            InputError: controls of another shape, or that aren't finite.
        """
        with torch.inference_mode(False), computing_on(CPU):
            problem = self._problem
            blank = problem.x0.new_zeros(problem.B, problem.N, problem.m)
            if U is None:
                plan = problem.cost.rest_controls(blank)
            else:
                plan = torch.from_numpy(as_floats(U, "U")).to(blank)
                check_shape(plan, (problem.B, problem.N, problem.m)[3 - plan.dim() :], "U")
                check_tensor(plan, "U")
                plan = plan.expand_as(blank)
        self.U, self._commands = plan.clone(), 0
        self._motion.forget()

    def command(self, x: Any, *, shift: bool = True, numbers: Mapping[str, Any] | None = None, **named: Any) -> Tensor:
        """The controls (B, m) for the next period from states x (B, n); (m,) for x (n,) of one vehicle.

        Args:
            shift: the plan begins a period later than at the last command (pytorch_mppi's shift_nominal_trajectory);
                without, commands refine the plan of one time.
            numbers, named: new numbers of the problem by name, such as x_ref or centers.

        Raises:
            InputError: states or numbers that don't fit. Nothing is changed then. A function that branches on values,
                and that mixes knots or vehicles along the plan.
        """
        state, B = measured(x, *self._problem.x0.shape), self._problem.B
        t = self._t + (self.period or self._dt) * bool(shift and self._commands)
        values = self.numbers.named(numbers, named, {"x0": state})
        self.numbers.write(self._motion.numbers(self._problem, t, values))
        self._motion.keep(self._problem, t)
        self._t = t
        with torch.no_grad(), torch.inference_mode(False), computing_on(CPU), served_by(*self._origin):
            before = shifted(self.U, self._stages) if shift and self._commands else self.U
            key = DrawKey(self.seed, self._ids, torch.full_like(self._ids, self._commands))
            now = current(with_numbers_as_they_are(self._problem))
            improved = self.sampler.improved(now, before, key)
            if not now.known.in_c:  # only PyTorch's kernels call code that looks at values
                check_rows(now, open_loop(now, improved), improved)
            self.U = improved
        self._commands += 1
        u = self.U[:, 0].clone()
        if self.period is not None and self.period > self._dt:
            knots = self._dt * np.arange(self.U.shape[1] + 1.0)[None]
            u = mean_controls(self.U, knots, np.zeros((1, 1)), self.period)
        u = u.to(self._origin[0])
        return u[0] if state.ndim == 1 and B == 1 else u
