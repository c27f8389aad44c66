"""The numbers of a problem by name, new ones and memory of their own for them, and their other form in a free time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.numbers import Floats, Number, Wrong, above_zero, at_least_zero, numbers, numbers_of_fields
from torchgco.base.tree import own_mapped
from torchgco.kernels import cost_scale, current, interior_of
from torchgco.lagrangian.barrier import BarrierOptions
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.native.interior import InteriorEngine, Kept
from torchgco.problem.goal import Goal, GoalBall, GoalState
from torchgco.problem.horizons import for_solvers, states_for_solvers
from torchgco.problem.in_time import Elapsed, factors_in, factors_of, states_in_time, times_of
from torchgco.problem.problem import Problem
from torchgco.problem.scale import CostScale
from torchgco.solution import Solution
from torchgco.tracing import own_tensors


class Numbers(Mapping[str, Floats]):
    """All numbers of a problem, by full names; a last part that only one of them has will do, too.

    `numbers[name]` is a copy, and `numbers[name] = value` writes.
    """

    def __init__(self, numbers: list[Number], changed: Callable[[Number], None]) -> None:
        self._all = {number.name: number for number in numbers}
        short = [_short(number.name) for number in numbers]
        self._by_name = dict(self._all)
        for name, number in zip(short, numbers, strict=True):
            if Counter(short)[name] == 1:
                self._by_name.setdefault(name, number)
        self._changed = changed

    def find(self, name: str) -> Number:
        """The number of this name.

        Raises:
            InputError: there is none, or there are several.
        """
        number = self._by_name.get(name)
        if number is None:
            alike = [full for full in self._all if _short(full) == name]
            raise InputError("numbers", f"one of {', '.join(alike or map(self.short, self._all))}", name)
        return number

    def named(self, *mappings: Mapping[str, Any] | None) -> dict[str, Any]:
        """Values by full names, from mappings by any names.

        Raises:
            InputError: no mapping, a name that isn't there, or a number that is given twice, by whichever names.
        """
        if wrong := [mapping for mapping in mappings if not isinstance(mapping, Mapping | None)]:
            raise InputError("numbers", "a dict of numbers by name", shown(wrong[0]))
        values, names = dict[str, Any](), dict[str, str]()
        for name, value in ((name, value) for mapping in mappings for name, value in (mapping or {}).items()):
            full = self.find(name).name
            if full in values:
                raise InputError("numbers", "each number once", f"{full} twice, as {names[full]} and {name}")
            values[full], names[full] = value, name
        return values

    def __getitem__(self, name: str) -> Floats:
        return self.find(name).value

    def __setitem__(self, name: str, value: Any) -> None:
        self.write({name: value})

    def write(self, values: Mapping[str, Any]) -> None:
        """Write several; all are checked before the first is written."""
        new = [(number := self.find(name), number.checked(value)) for name, value in self.named(values).items()]
        joint = [(number, check) for number, _ in new if (check := number.joint) is not None]
        together = {number.name: np.broadcast_to(checked, number.shape) for number, checked in new} if joint else {}
        for number, check in joint:
            if (wrong := check(together)) is not None:
                raise InputError(number.name, *wrong)
        for number, checked in new:
            number.write(checked)
            self._changed(number)

    def __iter__(self) -> Iterator[str]:
        return iter(self._all)

    def __len__(self) -> int:
        return len(self._all)

    def __repr__(self) -> str:
        rows = [(self.short(name), "x".join(map(str, n.shape)), name) for name, n in self._all.items()]
        widths = [max(len(row[i]) for row in rows) for i in (0, 1)]
        return "\n".join(f"{a:{widths[0]}}  {b:{widths[1]}}  {c}" for a, b, c in [("name", "shape", "where"), *rows])

    def short(self, name: str) -> str:
        """The shortest name of the number with this full name."""
        short = _short(name)
        return short if self._by_name.get(short) is self._all[name] else name


def _short(name: str) -> str:
    return name.rpartition(".")[2]


def with_own_numbers(problem: Problem) -> Problem:
    """The same problems, with memory of its own for every number of every problem."""
    B = problem.B
    parts: dict[str, Any] = {name: owned(getattr(problem, name), B) for name in ("dynamics", "constraints", "time")}
    parts |= {"x0": problem.x0.clone(), "cost": owned(problem.cost.by_knot(problem.N), B)}
    goal = problem.goal
    if goal is not None and goal.required:
        row = parts["constraints"][-1]
        assert isinstance(row, GoalBall | GoalState)
        parts["goal"] = row.goal(goal, problem.position)
    return problem._with(parts)


def numbers_of(problem: Problem, where: str = "") -> list[Number]:
    """The numbers of a problem that has memory of its own for each, `with_own_numbers`; of its time, too.

    Args:
        where: the problem is, before the numbers' names.
    """
    collected = [Number(f"{where}x0", (problem.x0.numpy(),), "x0", False, lambda new: None)]
    collected += problem.cost.numbers(f"{where}cost")
    collected += numbers_of_fields(problem.dynamics, f"{where}dynamics", "dynamics")
    for i, constraint in enumerate(problem.constraints):
        collected += constraint.numbers(f"{where}constraints[{i}]", i)
    return collected if problem.time is None else _numbers_in_time(collected, problem, where)


def with_numbers_as_they_are(problem: Problem) -> Problem:
    """The same problems after numbers were written, with nothing that was computed from the previous ones."""
    constraints = tuple(constraint.remade() for constraint in problem.constraints)
    known = replace(problem.known, row_shapes=None, interior=None, packed={}, lifted={})
    now = problem._with({"constraints": constraints}, known)
    if now.goal is None or now.goal.assumed:
        dims = now._dimensions(now.x0)
        now = now._with({"goal": Goal.derived(now.cost.goal(now.x0), dims)}, known)
    return now


def owned(part: Any, B: int) -> Any:
    """A part of a problem with copies of all its numbers, one for every problem."""

    def each(value: Tensor) -> Tensor:
        if value.dim() == 0:
            return value
        return value.expand(B, *value.shape[1:]).clone(memory_format=torch.contiguous_format)

    return own_mapped(part, each)


class KeptLifted(Kept):
    """Kept problems in a form whose first states are the user's, then, where the time is free, its first factor."""

    def __init__(
        self, kernels: InteriorEngine, problem: Problem, scale: CostScale, options: BarrierOptions, user: Problem
    ) -> None:
        super().__init__(kernels, problem, scale, options)
        self._given, self._first = user.x0.numpy(), user.n + (user.time is not None)  # what is carried begins there

    def start(self) -> None:
        """See `Kept`; the factor of time is free, too."""
        self._x0[:, : self._given.shape[1]] = self._given
        super().start()

    def read(self, changed: set[str | int], now: Any) -> set[str | int]:
        """Put numbers of the user's parts that have changed where the form has copies of them.

        Args:
            now: what the user has given, with its numbers as they are.

        Returns:
            the parts whose numbers C has to read again.
        """
        raise NotImplementedError


class KeptCarried(KeptLifted):
    """Kept problems with rows of two knots: in the form `with_carried`.

    Args:
        kernels: of this form.
        user: the problems, whose tensors are written to.
        whole: the same in this form.
        options: see `Kept`.
    """

    def __init__(self, kernels: InteriorEngine, user: Problem, whole: Problem, options: BarrierOptions) -> None:
        self.user, self.whole = user, whole
        super().__init__(kernels, self._solved(), cost_scale(whole), options, user)
        every = [("cost", user.cost), *enumerate(user.constraints)]
        # Where the form has copies of a part's numbers: what is to be written, and read by C again.
        self._copied_in: dict[str | int, list[str | int]] = {
            i: [i] for i, part in every if getattr(part, "joins_knots", False) or _differ(part, _part(whole, i))
        }

    def _solved(self) -> Problem:
        """What solves are given."""
        return self.whole

    @property
    def carried(self) -> Tensor:
        """What is carried at the start, (B, r)."""
        return self.problem.x0[:, self._first :]

    def copies(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """See `Kept`: those of the user's states and controls."""
        (X, U, K, status, iterations), n, m = super().copies(), self.user.n, self.user.m
        return X[..., :n].contiguous(), U[..., :m].contiguous(), K[..., :m, :n].contiguous(), status, iterations

    def begin_at(self, rows: Tensor, X: Tensor, U: Tensor) -> None:
        """See `Kept`: trajectories of the user's problems."""
        super().begin_at(rows, *states_for_solvers(self.user.take(rows), X, U))

    def take_over(self, rows: Tensor, solution: Solution) -> None:
        """See `Kept`."""
        X, _ = states_for_solvers(self.user.take(rows), solution.X, solution.U)
        super().take_over(rows, replace(solution, X=X))

    def read(self, changed: set[str | int], now: Problem) -> set[str | int]:
        """See `KeptLifted`."""
        places = {place for part in changed for place in self._copied_in.get(part, ())}
        if not places:
            return changed
        new = for_solvers(now)
        self._x0[:, self._first :] = new.x0[:, self._first :].numpy()
        for place in places:
            overwrite(_part(self.whole, place), _part(new, place))
        return changed | places


class KeptInTime(KeptCarried):
    """Kept problems with a free time: in the form `in_time` and, as in solves with a choice of time, in units of cost.

    Args: see `KeptCarried`.
    """

    def __init__(self, kernels: InteriorEngine, user: Problem, whole: Problem, options: BarrierOptions) -> None:
        self.unit = cost_scale(whole).unit
        super().__init__(kernels, user, whole, options)
        self._copied_in["time"] = ["cost", *range(len(user.constraints), len(whole.constraints))]

    def _solved(self) -> Problem:
        return self.whole.in_cost_units()

    @property
    def times(self) -> Tensor:
        """Of the knots of `rolled`, (B, N+1), s."""
        return times_of(self.user, factors_in(self.user, self.rolled[0]))

    @property
    def multipliers(self) -> tuple[Tensor, ...]:
        """Copies of those of the user's rows, (B, K, p)."""
        return tuple(self.unit.view(-1, 1, 1) * lam for lam in self.lam[: len(self.user.constraints)])

    def shift(self, by: float) -> None:
        """Let all trajectories and multipliers begin `by` seconds later; see `Elapsed`."""
        if by == 0:
            return
        user, count = self.user, len(self.user.constraints)
        factors = factors_in(user, self.X)
        span = Elapsed.of(user, factors, by)
        X = span.states(self.X[..., : user.n])
        U = span.controls(self.U[..., : user.m], times_of(user, factors).diff(dim=1))
        lam = span.multipliers(self.lam[:count], self._knots[2 : 2 + count])
        for z, new in zip((self.X, self.U, *self.lam), (*states_in_time(user, X, U, span.factors), *lam), strict=False):
            z.copy_(new)

    def begin_at(self, rows: Tensor, X: Tensor, U: Tensor) -> None:
        """See `Kept`: trajectories of this form."""
        Kept.begin_at(self, rows, X, U)

    def take_over(self, rows: Tensor, solution: Solution) -> None:
        """See `Kept`."""
        user = self.user.take(rows)
        assert solution.times is not None
        self.X[rows], self.U[rows] = states_in_time(user, solution.X, solution.U, factors_of(user, solution.times))
        for lam in self.lam:
            lam[rows] = 0.0
        for lam, solved in zip(self.lam, solution.multipliers.scaled(1.0 / self.unit[rows]).lam, strict=False):
            lam[rows] = solved


def _part(problem: Problem, place: str | int) -> Any:
    """The cost of a problem, or a constraint by its place."""
    return problem.cost if place == "cost" else problem.constraints[int(place)]


def kept_of(problem: Problem, options: BarrierOptions) -> Kept | None:
    """Problems packed in the form `for_solvers`; None where C can't serve them, or has no warm starts: of horizons.

    Args:
        options: see `Kept`.
    """
    whole = current(for_solvers(problem))
    kernels = None if problem.horizon is not None else interior_of(whole)
    if not isinstance(kernels, InteriorEngine) or kernels.engine.captured.reads_own:
        return None
    if problem.time is not None:
        return KeptInTime(kernels, problem, whole, options)
    if any(part.joins_knots for part in problem.constraints):
        return KeptCarried(kernels, problem, whole, options)
    return Kept(kernels, whole, cost_scale(whole), options)


def _numbers_in_time(by_problem: list[Number], problem: Problem, where: str) -> list[Number]:
    """The numbers of a problem with a free time: those of the problem, of the time, and checks of what is by stage."""
    time = problem.time
    assert time is not None
    by_stage = problem.cost.names_by_stage()
    for number in by_problem:
        if number.part == f"{where}cost" and number.name.rpartition(".")[2] in by_stage:
            number.check = partial(steady, number, problem.N, number.check)
    tensors = {name: getattr(time, name) for name in ("least", "most", "weight", "guess")}
    fields = {
        name: (tensor, at_least_zero if name == "weight" else above_zero)
        for name, tensor in tensors.items()
        if tensor is not None
    }
    views = {name: tensor.numpy() for name, (tensor, _) in fields.items()}
    return by_problem + numbers(f"{where}time", fields, "time", joint=partial(_crossed, views, f"{where}time"))


def later(problem: Problem, last: Solution, shift: float) -> Solution:
    """A guess for a horizon that begins so many stages, or seconds, later."""
    if problem.time is not None:
        return _later_in_time(problem, last, shift)
    return last.shifted(shift) if shift else last


def _later_in_time(problem: Problem, last: Solution, seconds: float) -> Solution:
    """A guess for problems with a free time, so many seconds after the solution `last` began."""
    assert last.times is not None
    factors, knots = factors_of(problem, last.times), torch.arange(problem.N + 1)
    elapsed = Elapsed.of(problem, factors, seconds)
    rows = [knots[constraint.knots].tolist() for constraint in problem.constraints]
    lam = elapsed.multipliers(last.multipliers.lam, rows)
    X, U = elapsed.states(last.X), elapsed.controls(last.U, last.times.diff(dim=1))
    multipliers = Multipliers(lam, last.multipliers.mu)
    return replace(last, X=X, U=U, multipliers=multipliers, times=times_of(problem, elapsed.factors), needed=None)


def _differ(users: Any, lifted: Any) -> bool:
    """Whether a part has numbers that its form in free time has copies of."""
    there = {tensor.data_ptr() for tensor in own_tensors(lifted)}
    return any(tensor.data_ptr() not in there for tensor in own_tensors(users))


def overwrite(old: Any, new: Any) -> None:
    for there, here in zip(own_tensors(old), own_tensors(new), strict=True):
        if there.data_ptr() != here.data_ptr():
            there.copy_(here)


def steady(number: Number, N: int, check: Any, new: Floats) -> Wrong:
    """What is wrong with numbers by stage, which are the same at all stages where the time is free."""
    rows = np.moveaxis(new, new.ndim - len(number.shape) + 1, 0)[:N]
    if len(rows) > 1 and not (rows == rows[0]).all():
        return "the same at all stages, as when it was compiled, where the time is free", "others"
    return check(new)  # type: ignore[no-any-return]


def _crossed(views: dict[str, Floats], where: str, new: Any) -> Wrong:
    times = {name: new.get(f"{where}.{name}", view) for name, view in views.items()}
    inner: Sequence[Floats] = [times["guess"]] if "guess" in times else []
    for low, high in zip([times["least"], *inner], [*inner, times["most"]], strict=True):
        if (low > high).any():
            return (
                f"{where}.least at most {where}.guess and {where}.most",
                f"{low[low > high][0]:g} and {high[low > high][0]:g}",
            )
    return None
