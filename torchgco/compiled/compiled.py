"""Compiled: one problem compiled and packed once, and solved again and again with other numbers."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, ClassVar, TypeAlias

import numpy as np
import torch
from torch import Tensor

from torchgco.api import solve
from torchgco.base import clock
from torchgco.base.errors import InputError, shown
from torchgco.base.numbers import Number
from torchgco.base.options import Positive, check_value
from torchgco.base.shapes import CPU, computing_on
from torchgco.base.status import Status
from torchgco.base.tree import put
from torchgco.compiled.answer import Answer
from torchgco.compiled.numbers import (
    KeptCarried,
    KeptInTime,
    KeptLifted,
    Numbers,
    kept_of,
    later,
    numbers_of,
    with_numbers_as_they_are,
    with_own_numbers,
)
from torchgco.explaining.explain import Account
from torchgco.kernels import cost_scale, held_on_cpu, is_mixed, served_by
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.lagrangian.quality import violation
from torchgco.native.engine import Engine
from torchgco.native.interior import Kept
from torchgco.phases import PhasesSolution
from torchgco.problem.horizons import for_solvers
from torchgco.problem.in_time import at_times
from torchgco.problem.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers.interior import PENALTY, InteriorPoint
from torchgco.tracing import traced_like

Begin: TypeAlias = Callable[[Problem, Tensor], tuple[Tensor, Tensor]]
CONVERGED, FEASIBLE, TIME_LIMIT = (int(s) for s in (Status.CONVERGED, Status.FEASIBLE, Status.TIME_LIMIT))


@contextmanager
def plainly() -> Iterator[None]:
    """Tensors that are kept lie on the CPU and can be written in place, whatever the caller's default and mode are.

    A warm call makes none, and does without: this takes as long as a part of the solve.
    """
    with torch.inference_mode(False), computing_on(CPU):
        yield


class Compiled:
    """A compiled problem; `compile` makes it. One thread calls it at a time.

    Attributes:
        numbers: what a call may change: names, shapes and values, also to be read and written by name.
        origin: the device of the problem, and whether its functions hold tensors of another one than the CPU.
    """

    numbers: Numbers
    _problem: Any

    def __init__(
        self, problem: Any, solver: str, changes: Sequence[str] | None, receding: bool, interior: InteriorPoint
    ) -> None:
        there = problem if problem.x0.device.type == CPU.type else held_on_cpu(problem)
        self.origin = problem.x0.device, isinstance(there, Problem) and is_mixed(there)
        self.solver, self.interior, self.receding, self.changes = solver, interior, receding, changes
        self._given: Any = problem
        with plainly():
            self._begin(self._owning(there))

    # What a problem is compiled by; `phases.CompiledPhases` has phases in its place.
    _owning: ClassVar[Any] = staticmethod(with_own_numbers)
    _refreshed: ClassVar[Any] = staticmethod(with_numbers_as_they_are)
    _form: ClassVar[Any] = staticmethod(for_solvers)
    _guess: ClassVar[Any] = staticmethod(later)
    _numbers_of: ClassVar[Any] = staticmethod(numbers_of)

    @property
    def _in_time(self) -> bool:
        return self._problem.time is not None

    def _begin(self, problem: Any) -> None:
        self._problem = problem
        all_numbers = self._numbers_of(problem)
        every = Numbers(all_numbers, self._note)
        chosen = None if self.changes is None else {every.find(name).name for name in self.changes}
        self.numbers = Numbers([n for n in all_numbers if chosen is None or n.name in chosen], self._note)
        self._changed = set[str | int]()
        self._lock = threading.Lock()
        self._warm = np.zeros(problem.B, dtype=bool)  # which problems have an answer to begin with
        self._found: Solution | None = None  # the last answer, where it isn't what C has left
        self._kept: Kept | None = None
        self._pack(problem)

    def _pack(self, problem: Any) -> None:
        """Compile and pack a problem as it is now; what was packed before hands its iterates on."""
        self._unit = torch.ones(problem.B, dtype=problem.x0.dtype)
        before, self._kept = self._kept, None
        with served_by(*self.origin):
            self._packed(problem)
        if self._kept is not None and before is not None:
            self._kept.begin_with(before)

    def _packed(self, problem: Any) -> None:
        if problem.B == 0:
            return
        self._kept = kept = kept_of(problem, self.interior.options(warm=True))
        if kept is not None:
            lifted = isinstance(kept, KeptCarried)
            self._problem = problem if lifted else kept.problem
            self._unit = cost_scale(kept.whole if lifted else kept.problem).unit

    def __call__(
        self,
        *,
        warm: bool = True,
        shift: float | None = None,
        elapsed: float | None = None,
        max_seconds: float | None = None,
        numbers: Mapping[str, Any] | None = None,
        **named: Any,
    ) -> Any:
        """Solve with new numbers; those that aren't named keep their values. Returns an `Answer`, a `PhasesAnswer` of
        phases.

        Args:
            warm: begin with the last answer, where that was a solution.
            shift: by how many stages, also parts of one, the horizon has moved since the last call; None: 1 if
                receding, else 0. Where the time is free, `elapsed` serves.
            elapsed: where the time is free, the time since the last call, s, by which the horizon has moved: the guess
                is what is then left of the last trajectories, and of their time. None: 0.
            max_seconds: after which the iterate so far is returned, without compiling; looked at in every iteration.
            numbers: new numbers by name, for names that are no words, such as "constraints[1].centers".
            named: the same.

        Raises:
            InputError: an unknown name, a number given twice, numbers of another shape or that the problem can't have,
                or a call while another thread's runs. Nothing is changed then.
        """
        return self.call(self.numbers.named(numbers, named), warm, shift, elapsed, max_seconds)

    def call(
        self,
        values: Mapping[str, Any],
        warm: bool = True,
        shift: float | None = None,
        elapsed: float | None = None,
        max_seconds: float | None = None,
        begin: Begin | None = None,
    ) -> Any:
        """The same, with the new numbers by full names.

        Args:
            begin: is given problems that the last answer doesn't lead to a solution of, and their places (b,), and
                returns states and controls from which C tries again, before the solver searches.
        """
        began = clock.seconds()
        if not self._lock.acquire(blocking=False):
            raise InputError("mpc", "one call at a time: a compiled problem per thread", "a call during another one")
        try:
            moved = self._moved(shift, elapsed)
            until = math.inf
            if max_seconds is not None:
                until = began + check_value(max_seconds, Positive, "max_seconds")
            able = self._warm if check_value(warm, bool, "warm") else np.zeros_like(self._warm)
            self.numbers.write(values)
            self._warm = np.zeros_like(self._warm)  # an error or an interrupt leaves nothing to begin with
            return self._solved(able, moved, began, until, begin)
        finally:
            self._lock.release()

    def _moved(self, shift: Any, elapsed: Any) -> float:
        """By how much the horizon has moved since the last call: stages, or seconds where the time is free."""
        free = self._in_time
        name, other = ("elapsed", "shift") if free else ("shift", "elapsed")
        moved, wrong = (elapsed, shift) if free else (shift, elapsed)
        if wrong is not None:
            raise InputError(
                other, f"None where the time is {'free' if free else 'fixed'}: `{name}` serves", shown(wrong)
            )
        if moved is None:
            return int(self.receding)
        if isinstance(moved, bool) or not isinstance(moved, int | float) or not 0 <= moved < math.inf:
            raise InputError(name, f"a number of {'seconds' if free else 'stages'}, at least 0", shown(moved))
        return moved

    @property
    def problem(self) -> Any:
        """The problem, or phases, whose parts hold the numbers as they are."""
        return self._problem

    @plainly()
    def solution(self) -> Solution:
        """The last answer with multipliers, costs and statuses; costs of what C solved are by the numbers as they are.

        Raises:
            InputError: there is no answer yet.
        """
        last = self._last
        if last is None:
            raise InputError("mpc", "a call before its solution is asked for", "none")
        if self._kept is None:
            return last
        now = self.now
        form, X, U = at_times(now, last.X, last.U, last.times)
        cost = torch.where(torch.isnan(last.cost), form.cost.total(X, U), last.cost)
        return replace(last, cost=cost, account=Account(now, self.interior))

    @property
    def _last(self) -> Solution | None:
        """The last answer; None before the first."""
        if self._found is None and self._kept is not None and self._warm.any():
            self._found = self._packed_solution(self._warm)
        return self._found

    @plainly()
    def stale(self) -> str | None:
        """What the compiled code would compute otherwise if it were compiled now, in a line; None: nothing.

        It sees functions that do something else, other numbers in them, other tensors in the place of those that they
        captured, and numbers of the given problem that were changed in place: a compiled problem has its own.
        """
        if self._given is not None and self._given.current() is not self._given:
            return "numbers of the problem were changed in place since it was compiled: pass them to the call by name"
        if self._kept is None:
            return None  # PyTorch's kernels call the functions themselves
        problem, then = self._form(self.now.renewed()), self._kept.engine
        read = then.captured.read()
        with traced_like(then.captured.traces):
            now = Engine(problem, compiles=False)
        if read is None or then.with_shared(read).computes_as(now, problem):  # None: a call compiles again by itself
            return None
        return "the problem's functions, or what they capture, have changed since it was compiled: compile it again"

    @plainly()
    def __getstate__(self) -> dict[str, Any]:
        """A process that loads it compiles again, and begins without an answer."""
        names = "solver", "interior", "receding", "changes", "origin"
        return {"problem": self.now} | {name: getattr(self, name) for name in names}

    def __setstate__(self, state: dict[str, Any]) -> None:
        problem = state.pop("problem")
        vars(self).update(state)
        self._given = None
        with plainly():
            self._begin(self._owning(problem))

    def _note(self, number: Number) -> None:
        if number.derived or isinstance(self._kept, KeptLifted):  # it has copies, or traced what it would read itself
            self._changed.add(number.part)

    def _refresh(self, shift: float = 0) -> None:
        """Have C begin `shift` stages later, and read what it doesn't share with the problem's tensors."""
        kept = self._kept
        assert kept is not None
        parts = self._changed
        if isinstance(kept, KeptLifted):
            with plainly():
                kept.shift(shift)
                parts = kept.read(parts, self.now)
        elif shift:
            kept.shift(shift)
        for changed in parts:
            if changed == "dynamics":
                kept.refresh_model()
            elif changed == "cost" and kept.engine.cost is not None:
                kept.refresh_cost()
            elif isinstance(changed, int):
                kept.refresh_constraint(changed)
        self._changed.clear()
        kept.start()
        if kept.is_outdated:  # C reads what functions capture as it is now
            with plainly():
                if not kept.refresh_captured():
                    self._pack(self.now.renewed())

    @property
    def now(self) -> Any:
        """The problem with its numbers as they are, and nothing that was computed from others."""
        return self._refreshed(self._problem)

    def _solved(self, able: np.ndarray, shift: float, began: float, until: float, begin: Begin | None) -> Answer:
        if self._kept is not None:
            self._refresh(shift)
        kept = self._kept
        if kept is None:
            with plainly():
                self._found = self._by_solver(shift if able.all() else None, until)
                return self._answer(able & able.all(), began)
        good = late = np.zeros_like(able)
        if able.any():
            left = math.inf if until == math.inf else max(0.0, until - clock.seconds())
            kept.solve(able, self.interior.warm_barrier, seconds=left)
            late, good = able & kept.finite & (kept.statuses == TIME_LIMIT), self._good(able)
        else:
            kept.iterations.zero_()
        self._found = None
        if not good.all():
            with plainly():
                self._found, again = self._packed_solution(good), torch.from_numpy(~(good | late)).nonzero().flatten()
                if again.numel() > 0 and begin is not None:
                    again = self._begun(self._found, again, begin, until)
                if again.numel() > 0:
                    self._again(self._found, again, until)
        return self._answer(good, began)

    def _good(self, rows: np.ndarray) -> np.ndarray:
        """Which of the problems that `rows` (B,) marks C has solved."""
        kept = self._kept
        assert kept is not None
        worst = kept.violations if kept.engine.measures else self._violation().numpy()
        good = kept.finite & (kept.statuses == CONVERGED) & (worst <= self.interior.violation_tolerance)
        return np.asarray(rows & good)

    def _begun(self, answer: Solution, rows: Tensor, begin: Begin, until: float) -> Tensor:
        """Solve the problems `rows` by C from other trajectories, into `answer`; those that are left to the solver."""
        kept = self._kept
        assert kept is not None
        kept.begin_at(rows, *begin(self.now.take(rows), rows))
        marked = np.zeros_like(self._warm)
        marked[rows.numpy()] = True
        left = until - clock.seconds()
        if left > 0:
            kept.solve(marked, self.interior.initial_barrier, seconds=left)
            tries = self._packed_solution(good := self._good(marked))
            done = torch.from_numpy(good).nonzero().flatten()
            put(answer, done, replace(tries.take(done), iterations=(answer.iterations + tries.iterations)[done]))
            rows, left = rows[~torch.from_numpy(good)[rows]], until - clock.seconds()
        if left > 0:
            return rows
        answer.status[rows] = TIME_LIMIT
        return rows[:0]

    def _violation(self) -> Tensor:
        """The largest violations (B,) of the trajectories that C has rolled out."""
        kept = self._kept
        assert kept is not None
        if kept.engine.measures:
            return kept.worst
        return violation(self._form(self.now).constraints, *kept.rolled)

    def _packed_solution(self, good: np.ndarray) -> Solution:
        """What C has found; CONVERGED where it is `good` (B,)."""
        kept = self._kept
        assert kept is not None
        ended = kept.statuses
        status = np.where(good | (ended == TIME_LIMIT), ended, Status.MAX_ITERATIONS)
        multipliers = Multipliers(kept.multipliers, PENALTY * self._unit)
        X, U, K, _, iterations = kept.copies()
        none, cost = torch.zeros_like(iterations), X.new_full((X.shape[0],), torch.nan)
        return Solution(
            X, U, K, torch.zeros_like(U), multipliers, cost, self._violation().clone(),
            torch.from_numpy(status.astype(np.int64)), iterations, none, none.clone(),
            times=kept.times,
        )  # fmt: skip

    def _again(self, answer: Solution, rows: Tensor, until: float) -> None:
        """Solve the problems `rows` from the start by the solver, into `answer` and what the next call begins with."""
        kept, tried = self._kept, answer.iterations[rows]
        assert kept is not None
        solution = self._by_solver(None, until, rows)
        bare = replace(solution, trace=None, search=None, account=None, needed=None)
        put(answer, rows, replace(bare, iterations=solution.iterations + tried))
        kept.take_over(rows, solution)

    def _by_solver(self, shift: float | None, until: float, rows: Tensor | None = None) -> Solution:
        """A solve of all problems, or some, by the solver that `compile` was given, from the last answer where a shift
        is given."""
        now: Any = self.now if rows is None else self.now.take(rows)
        seconds = None if until == math.inf else max(1e-3, until - clock.seconds())
        warm = None if shift is None or self._last is None else self._guess(now, self._last, shift)
        solver = self.interior if self.solver == "interior_point" else self.solver
        with served_by(*self.origin):
            found: Any = solve(now, solver=solver, warm=warm, max_seconds=seconds, verbose=False)
        return found.found if isinstance(found, PhasesSolution) else found  # type: ignore[no-any-return]

    def _answer(self, good: np.ndarray, began: float) -> Answer:
        last, kept = self._found, self._kept
        if last is not None:
            X, U, K, worst, iterations, status = (
                tensor.clone() for tensor in (last.X, last.U, last.K, last.violation, last.iterations, last.status)
            )
        else:
            assert kept is not None
            X, U, K, status, iterations = kept.copies()
            worst = torch.from_numpy(kept.violations.copy()) if kept.engine.measures else self._violation()
        # The next call may begin with solutions, and with what only the time was over for.
        ended = status.numpy()
        self._warm = (ended == CONVERGED) | (ended == FEASIBLE) | (ended == TIME_LIMIT)
        t = last.times if last is not None else None
        if last is None and isinstance(kept, KeptInTime):
            with plainly():
                t = kept.times
        return Answer(X, U, K, status, iterations, worst, torch.from_numpy(good), clock.seconds() - began, t)
