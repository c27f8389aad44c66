"""The contracts that solvers, guidance and callers share; those of guidance penalties are in `penalties`."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, Protocol, Self, runtime_checkable

import torch
from torch import Tensor

from torchgco.base import clock
from torchgco.base.brief import Brief
from torchgco.base.draws import DrawKey
from torchgco.base.errors import NAMED, InputError, StartWarning
from torchgco.base.options import Checked, Seconds, Seed, check_value
from torchgco.base.shapes import check_shape, check_tensor, check_untransformed, computing_on, describe
from torchgco.base.status import Status
from torchgco.base.tree import Rows, take
from torchgco.explaining.explain import Account
from torchgco.kernels import copied_to, cost_scale, current, interior_of, is_mixed, kernels_of, on_cpu, served_by, used
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.lagrangian.penalties import GuideRegion
from torchgco.problem.alone import check_rows
from torchgco.problem.horizons import at_rest_after, for_solvers, states_for_solvers
from torchgco.problem.in_time import at_times
from torchgco.problem.problem import Problem, current_problem
from torchgco.problem.refusals import spared, warn_of_refusals
from torchgco.solution import Solution
from torchgco.solvers.ending import judged_between
from torchgco.solvers.timing import Chooser, lifted_multipliers, solve_in_time


@dataclass(frozen=True)
class RowEnd:
    """What a row of a solver's table has done, and how all problems stand after it."""

    number: int  # of the row, from 1
    name: str
    worked: int  # problems that it worked on
    feasible: int
    arrived: int  # feasible, and at the goal


@dataclass(frozen=True)
class Progress:
    """The argument of a callback: after every pass, or after every problem where a solver takes one at a time.

    While candidates along paths are solved, it is called too, with `candidates` instead of a state; and after each row
    of a solver's table that worked on some problem, with `row`.
    """

    passes: int
    rows: Tensor  # (b,) int64: places in the batch of the problems in this pass
    finished: int
    total: int
    state: Any = None  # the running state of a batched solver, after the pass
    candidates: tuple[int, int] | None = None  # how many are solved, and of how many
    row: RowEnd | None = None


Callback = Callable[[Progress], None]


@dataclass(frozen=True)
class Call:
    """The arguments of one `Solver.solve`, checked."""

    problem: Problem
    U0: Tensor  # (B, N, m): initial controls
    seed: int
    ids: Tensor  # (B,) int64: key the random draws, together with the seed
    rows: Tensor  # (B,) int64: places in the batch that the user passed
    outer: Tensor  # (B,) int64: outer iterations that this call continues; draws are keyed by their number
    warm: Multipliers | None
    callback: Callback | None
    deadline: float | None = None  # of `clock.seconds`; after it the solve ends with the best trajectory so far
    X0: Tensor | None = None  # (B, N+1, n): states to begin with; None: those that U0 leads to

    @classmethod
    def checked(
        cls,
        problem: Problem,
        U0: Tensor,
        seed: int = 0,
        ids: Tensor | None = None,
        warm: Multipliers | None = None,
        callback: Callback | None = None,
        max_seconds: float | None = None,
    ) -> Call:
        """The call of `Solver.solve`.

        Raises:
            InputError: U0, ids or warm don't fit the problem, or an argument is of another kind or out of its range.
        """
        seed = check_value(seed, Seed, "seed")
        max_seconds = check_value(max_seconds, Seconds | None, "max_seconds")
        check_value(callback, Callable | None, "callback")
        deadline = None if max_seconds is None else clock.seconds() + max_seconds
        problem.check_controls(U0)
        if ids is not None:
            check_ids(ids, problem)
        if warm is not None:
            if not isinstance(warm, Multipliers):
                raise InputError("warm", "Multipliers, such as those of a solution", type(warm).__name__)
            warm.check(problem)
        made = cls.within(current(problem), U0, warm, callback)
        return replace(made, seed=seed, ids=made.ids if ids is None else ids, deadline=deadline)

    @classmethod
    def within(
        cls, problem: Problem, U0: Tensor, warm: Multipliers | None = None, callback: Callback | None = None
    ) -> Call:
        """A call within another solve, of what that has made."""
        rows = torch.arange(problem.B, device=problem.x0.device)
        return cls(problem, U0, 0, rows, rows, torch.zeros_like(rows), warm, callback)

    @property
    def late(self) -> bool:
        """Whether the time limit has passed."""
        return self.deadline is not None and clock.seconds() >= self.deadline

    @property
    def seconds_left(self) -> float:
        """Until the time limit, s, at least 0; infinite without one."""
        return math.inf if self.deadline is None else max(0.0, self.deadline - clock.seconds())

    def take(self, index: Rows) -> Self:
        """The same call for the problems in `index`; itself for all of them in their order."""
        subset = self.problem.take(index)
        if subset is self.problem:
            return self
        values = self.U0, self.ids, self.rows, self.outer, self.warm, self.X0
        U0, ids, rows, outer, warm, X0 = take(values, index)
        return type(self)(subset, U0, self.seed, ids, rows, outer, warm, self.callback, self.deadline, X0)

    def in_cost_units(self) -> tuple[Self, Tensor]:
        """The same call with costs and multipliers in units of `Problem.cost_unit`, and these units (B,)."""
        unit = cost_scale(self.problem).unit
        warm = None if self.warm is None else self.warm.scaled(1.0 / unit)
        return replace(self, problem=self.problem.in_cost_units(), warm=warm), unit


def check_ids(ids: Any, problem: Problem) -> None:
    """Raise InputError unless ids is int64 (B,) on the problem's device."""
    device = problem.x0.device
    if not isinstance(ids, Tensor) or (ids.shape, ids.dtype, ids.device) != ((problem.B,), torch.int64, device):
        raise InputError("ids", f"an int64 tensor ({problem.B},) on {device}", describe(ids))


def check_states(X0: Any, problem: Problem, field: str = "X0") -> None:
    """Raise InputError unless X0 is (B, N+1, n) of the problem's dtype and device."""
    check_tensor(X0, field, problem.x0)
    check_shape(X0, (problem.B, problem.N + 1, problem.n), field)


LEAST_SECONDS = 1e-9  # of a solve for which no time is left
CHOOSING_TIME = "interior_point, gco, gco_exact, ipopt or fatrop, which choose the time"


class Solver(Brief, Checked):
    """A solver for batches of problems. Its fields are its options; it keeps no state between calls.

    Attributes:
        joins_knots: whether `run` takes rows of two knots as they are; else what they need of the earlier knot are
            further states of `call.problem`.
        kernels: another library that solves; None: ours, native or PyTorch's.
    """

    joins_knots: ClassVar[bool] = False
    kernels: ClassVar[str | None] = None

    def solve(
        self,
        problem: Problem,
        U0: Tensor,
        seed: int = 0,
        ids: Tensor | None = None,
        warm: Multipliers | None = None,
        callback: Callback | None = None,
        max_seconds: float | None = None,
        X0: Tensor | None = None,
    ) -> Solution:
        """Solve every problem of the batch.

        Args:
            problem: B problems.
            U0: initial controls (B, N, m).
            seed, ids: key the random draws, where a solver makes any: the result of a problem depends on (seed, id),
                not on its place in the batch. seed is at least 0; ids is int64 (B,), by default 0..B-1.
            warm: multipliers and penalties of an earlier solution, for solvers that use them.
            callback: called with the progress after every pass.
            max_seconds: the batched solvers check the time after every pass; once it is over, they return the best
                trajectories so far. Results then depend on the speed of the machine. Compiling, which a form of problem
                needs once, doesn't count. ipopt and fatrop solve each problem in its share of the time, in a process
                that ends then, and return the guess where they aren't ready; the other baselines ignore it.
            X0: states to begin with (B, N+1, n), which U0 need not lead to, for solvers that `take_states`. The first
                states are those of the problem, but where these are free. A problem whose U0 or X0 isn't finite ends
                NON_FINITE, as one whose start isn't.

        Raises:
            InputError: U0, ids, warm or X0 don't fit the problem, or an option of the solver doesn't; X0 where the
                solver can't begin with states; a function that branches on values and that, along what was found,
                mixes knots or problems.
        """
        check_untransformed("solve")
        problem, limit = current_problem(problem), check_value(max_seconds, Seconds | None, "max_seconds")
        if self.kernels is None and (there := on_cpu(problem)) is not None:
            U0, ids, warm, X0 = copied_to((U0, ids, warm, X0), there.x0)
            with served_by(problem.x0.device, is_mixed(there)):
                solution = self.solve(there, U0, seed, ids, warm, callback, max_seconds, X0)
            account = solution.account and solution.account.asked(problem, None)
            return replace(copied_to(solution, problem.x0), account=account)
        ends = None if limit is None else clock.seconds() + limit

        def run(problem: Problem) -> Solution:
            left = None if ends is None else max(LEAST_SECONDS, ends - clock.seconds())
            options = {"seed": seed, "ids": ids, "callback": callback, "max_seconds": left}
            return self._found(problem, U0, warm, X0, options)

        return spared(problem, run)

    def _found(
        self, problem: Problem, U0: Tensor, warm: Multipliers | None, X0: Tensor | None, options: Mapping[str, Any]
    ) -> Solution:
        """`solve`, with further arguments of `Call.checked`."""
        with computing_on(problem.x0.device):
            if problem.B == 0:  # nothing to trace code with
                Call.checked(problem, U0, warm=warm, **options)
                return replace(Solution.empty(problem), account=Account(problem, self))
            if X0 is not None:
                check_states(X0, problem)
            problem.check_controls(U0)
            problem = _without_starts(problem, U0, X0)
            whole = for_solvers(problem, self.joins_knots)
            made = partial(Call.checked, whole, **options)
            if problem.time is not None:
                return self._in_time(problem, whole, U0, warm, X0, made)
            if problem.horizon is not None:
                U0 = at_rest_after(problem, U0)
            call = made(U0, warm=warm)
            self.announce(call.problem)
            call = call if X0 is None else self._from_states(call, X0, problem)
            if problem.free_start is not None and bool(problem.free_start.any()) and not self.frees_start(call.problem):
                expected = "InteriorPoint, also within gco, does"
                text = f"free_start: the start is held at x0, as {type(self).__name__} doesn't choose it; {expected}"
                warnings.warn(text, StartWarning, stacklevel=2)
            solution = self.run(call)
            solution = replace(solution, status=judged_between(call.problem, solution.X, solution.U, solution.status))
            solution = solution if whole is problem else solution.of_first_states(problem.n, problem.horizon)
            self._check(problem, call, solution)
            return replace(solution, account=Account(problem, self, kernels=self.kernels or used(call.problem)))

    def _in_time(
        self,
        problem: Problem,
        whole: Problem,
        U0: Tensor,
        warm: Multipliers | None,
        X0: Tensor | None,
        made: Callable[..., Call],
    ) -> Solution:
        """`solve` of a problem with a free time, which is `whole` for solvers; `made` makes a call of it."""
        lifted = None if warm is None else lifted_multipliers(problem, whole, warm)
        U = torch.cat((U0, U0.new_ones(*U0.shape[:2], whole.m - problem.m)), dim=-1)
        call = made(U, warm=lifted)
        self.announce(call.problem)
        chooser = self.choosing_time(call.problem)
        if chooser is None:
            raise InputError("solver", CHOOSING_TIME, type(self).__name__)
        solution = solve_in_time(chooser, problem, call, X0)
        self._check(problem, call, solution)
        _, X, U = at_times(problem, solution.X, solution.U, solution.times)
        account = Account(problem, self, kernels=self.kernels or used(call.problem))
        return replace(solution, status=judged_between(call.problem, X, U, solution.status), account=account)

    def _check(self, problem: Problem, call: Call, solution: Solution) -> None:
        """Raise InputError where code that branches on values has mixed knots or problems: only PyTorch's kernels call
        such code. Warn where it has refused states of problems that are lost."""
        if self.kernels is None and not call.problem.known.in_c:
            check_rows(problem, solution.X, solution.U, solution.times)
            if lost := (solution.status == Status.NON_FINITE).nonzero().flatten().tolist():
                warn_of_refusals(problem, f"a state of problem {', '.join(map(str, lost[:NAMED]))}")

    def choosing_time(self, problem: Problem) -> Chooser | None:
        """What solves problems with a free time, in the form `in_time`, for this solver; None: it can't."""
        return None

    def run(self, call: Call) -> Solution:
        """Solve a checked call."""
        raise NotImplementedError

    def announce(self, problem: Problem) -> None:
        """Say which libraries `run` will ask for, so that they are compiled side by side; called before any is."""

    def take_states(self, problem: Problem) -> bool:
        """Whether `run` can begin these problems with states that their controls don't lead to."""
        return False

    def _from_states(self, call: Call, X0: Tensor, problem: Problem) -> Call:
        """The call with states (B, N+1, n) of the user's problem to begin with; InputError where that can't be."""
        if not self.take_states(call.problem):
            able = "interior_point or, without obstacles, gco; or ipopt"
            raise InputError("X0", f"None, or a solver that can begin with states: {able}", type(self).__name__)
        return replace(call, X0=X0 if self.joins_knots else states_for_solvers(problem, X0, call.U0)[0])

    def frees_start(self, problem: Problem) -> bool:
        """Whether `run` chooses the free components of these problems' starts; if not, they stay at x0."""
        return False

    def prepare(self, problem: Problem) -> Solver:
        """The solver with everything built that this batch needs, so that nothing is compiled beside the solve."""
        problem = current_problem(problem)
        there = on_cpu(problem) or problem
        whole = for_solvers(there, self.joins_knots)
        with computing_on(whole.x0.device), served_by(problem.x0.device, is_mixed(there)):
            self.announce(whole)
            if whole.B > 0 and kernels_of(whole) and whole.known.expects_interior:
                interior_of(whole)
        return self

    def recording(self) -> Solver:
        """The same solver, which keeps a record of what it does, where it can; `Solution.explain` tells it."""
        return self

    def from_guesses(self, problem: Problem) -> Solver:
        """What solves the user's problem from each of several guesses: a local solver, after which this one goes on
        from the best, or this one."""
        return self

    def in_closed_loop(self, rounds: int) -> tuple[Solver, Solver]:
        """For a planner that solves again and again: what it asks for a new plan, and what continues a previous one.

        The first is this solver without the final polishing passes. The second improves a given plan locally, in at
        most `rounds` outer iterations where a solver makes attempts around a local one; else it is the first again.
        """
        return self, self

    def in_slots(self, slots: int) -> Solver | None:
        """The same solver with at most `slots` problems at a time; None where it takes all of them at once."""
        return None


def _without_starts(problem: Problem, *guess: Tensor | None) -> Problem:
    """The problem with NaN for the starts of those whose guess (B, ...) isn't finite: they end as if these weren't.

    Some solvers would lose them, and others begin elsewhere without a word.
    """
    fine = [torch.isfinite(part).flatten(1).all(-1, keepdim=True) for part in guess if part is not None]
    sound = torch.stack(fine).all(0)
    if bool(sound.all()):
        return problem
    return problem.started_at(torch.where(sound, problem.x0, torch.nan), problem.constraints)


@dataclass(frozen=True)
class Advice:
    """The answer of guidance for problems whose inner solve has just ended, B' of them."""

    penalty: GuideRegion | None  # of the next inner solve
    U: Tensor | None = None  # (B', N, m): controls that replace the iterate
    taken: Tensor | None = None  # (B',) bool: where U replaces the iterate
    stop: Tensor | None = None  # (B',) bool: where the solve is to end, for another attempt


@runtime_checkable
class Guidance(Protocol):
    """Plug-in of the outer loop (Algorithm 4), called after every inner solve."""

    def suited(self, problem: Problem) -> Guidance | None:
        """The guidance that can serve these problems, called once per solve; None: solve without guidance.

        A part that can't serve is no error: a GuidanceWarning names it and the reason.
        """
        ...

    def start(self, problem: Problem, X: Tensor) -> GuideRegion | None:
        """The penalty of the first inner solve, inactive for every problem; X (B, N+1, n)."""
        ...

    def update(self, problem: Problem, X: Tensor, U: Tensor, penalty: GuideRegion | None, key: DrawKey) -> Advice:
        """Advice for problems whose inner solve ended with X (B', N+1, n), U (B', N, m).

        `key` holds the number of the outer iteration.
        """
        ...
