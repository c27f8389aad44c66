"""Parts that look at values, evaluated row by row: each knot of each problem by itself.

Python code that branches on values reads those of all rows that it is given, and can't be traced: before a solve,
nothing proves that it keeps them apart. What it gives for a row alone is what the user's code says of this row.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from typing import Any, Self, TypeAlias

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.tree import Rows, is_users
from torchgco.base.values import whole_numbers_become
from torchgco.constraints.base import Constraint, FunctionConstraint
from torchgco.constraints.between_knots import BetweenKnots
from torchgco.constraints.link import Integral, Summed
from torchgco.costs.base import Cost
from torchgco.dynamics.base import Dynamics
from torchgco.problem.border import ONE_KNOT, OWN_ROW, STEP_OF_STAGE, SUM_OF_STAGES, called
from torchgco.problem.in_time import at_times
from torchgco.problem.joined import unlike
from torchgco.problem.problem import Problem
from torchgco.problem.refusals import Refusals, sparing_part, with_looking

OF_STAGE = "a number for each state and control, of these alone"

# Values (b, ...) of a problem along X, U, of all knots at once or, where they can be had so, one knot after the other.
Values: TypeAlias = Callable[[Problem, Tensor, Tensor, bool], Tensor]


def row_by_row(problem: Problem, again: bool = False) -> Problem:
    """The problem, whose parts that look at values are evaluated row by row; itself where none does.

    Rows that a part's code refuses are NaN, of which a RefusalWarning tells where they are finite.

    Args:
        again: each part's code is tried, also where it was before.
    """
    refusals = Refusals("a state of what is judged")

    def change(part: Any, field: str, shape: tuple[int, int]) -> Any:
        spared = sparing_part(part, field, shape, refusals)
        if isinstance(part, Dynamics):
            return _made(spared, _Field if type(part).step is Dynamics.step else _Step)
        if isinstance(part, Cost):
            return _made(spared, _Cost)
        return _rows_alone(spared)

    return with_looking(problem, change, again)


def check_rows(problem: Problem, X: Tensor, U: Tensor, times: Tensor | None = None) -> None:
    """Check that rows of trajectories X (B, N+1, n), U (B, N, m) together are what each is by itself.

    Only parts that look at values are evaluated, along the trajectories that are finite.

    Args:
        times: (B, N+1), s, of the knots where the time is free.

    Raises:
        InputError: names the part at fault, as `Problem` does where that is seen when the problem is made.
    """
    apart = row_by_row(problem, again=True)
    rows = (torch.isfinite(X).flatten(1).all(-1) & torch.isfinite(U).flatten(1).all(-1)).nonzero().flatten()
    if apart is problem or rows.numel() == 0:
        return
    trajectories = X[rows], U[rows], None if times is None else times[rows]
    with torch.no_grad(), whole_numbers_become(X.dtype):
        whole, x, u = at_times(problem.take(rows), *trajectories)
        alone, _, _ = at_times(apart.take(rows), *trajectories)
        for field, wanted, values in _values(problem, apart):
            by_row = called(field, wanted, values, alone, x, u, True)
            for at_once in (True, False):
                together = called(field, wanted, values, whole, x, u, at_once)
                wrong = torch.ones_like(by_row, dtype=torch.bool)
                if together.shape == by_row.shape:
                    # Of a problem of which some rows are refused, all may count as lost where they are asked together.
                    lost = ~(_is_finite(together) | _is_finite(by_row))
                    wrong = unlike(together, by_row) & ~lost.view(-1, *[1] * (by_row.dim() - 1))
                if bool(wrong.any()):
                    raise InputError(field, wanted, _told(together, by_row, wrong, rows))


def _is_finite(values: Tensor) -> Tensor:
    return torch.isfinite(values).reshape(len(values), -1).all(-1)


def _values(problem: Problem, apart: Problem) -> Iterator[tuple[str, str, Values]]:
    """Field, expectation and values of each part that isn't the same in both problems."""
    if apart.dynamics is not problem.dynamics:
        yield "dynamics.step", STEP_OF_STAGE, _steps
    if apart.cost is not problem.cost:
        yield "cost.stage", OWN_ROW, _stages
        yield "cost.terminal", OWN_ROW, lambda p, X, U, _: p.cost.terminal(X[:, -1])
        if type(problem.cost).total is not Cost.total:
            yield "cost.total", SUM_OF_STAGES, lambda p, X, U, _: p.cost.total(X, U)
    for i, (bound, other) in enumerate(zip(problem.constraints, apart.constraints, strict=True)):
        if bound is not other:
            rows = bound.constraint if isinstance(bound, BetweenKnots) else bound
            field, wanted = f"constraints[{i}].value", OWN_ROW
            if not rows.joins_knots:
                wanted = ONE_KNOT
            if isinstance(rows, FunctionConstraint | Integral):
                field, wanted = f"{rows.name}.function", OF_STAGE if isinstance(rows, Integral) else ONE_KNOT
            yield field, wanted, lambda p, X, U, _, i=i: p.constraints[i].value(X, U)


def _steps(problem: Problem, X: Tensor, U: Tensor, at_once: bool) -> Tensor:
    if at_once:
        return problem.along.step(X[:, :-1], U)
    return torch.stack([problem.dynamics.at(k).step(X[:, k], U[:, k]) for k in range(problem.N)], dim=1)


def _stages(problem: Problem, X: Tensor, U: Tensor, at_once: bool) -> Tensor:
    if at_once:
        return problem.cost.stage(X[:, :-1], U, torch.arange(problem.N, device=U.device))
    return torch.stack([problem.cost.stage(X[:, k], U[:, k], k) for k in range(problem.N)], dim=1)


def _told(whole: Tensor, alone: Tensor, wrong: Tensor, rows: Tensor) -> str:
    """What an error says of values (b, ...) of problems `rows` (b,) that are `alone` where each row is by itself."""
    if whole.shape != alone.shape:
        return f"values of shape {tuple(whole.shape)} along the trajectories found, {tuple(alone.shape)} row by row"
    b, *k = wrong.nonzero()[0].tolist()
    knot = f", row {k[0]} along the trajectory" if k else ""
    numbers = f"{float(whole[(b, *k)]):.6g} along the trajectories found, {float(alone[(b, *k)]):.6g} by itself"
    return f"other values among other knots and problems: {numbers} (problem {int(rows[b])}{knot})"


def _made(part: Any, mixin: type) -> Any:
    """The same part with methods of `mixin` before its own."""
    made, kind = copy.copy(part), type(part)
    object.__setattr__(made, "__class__", type(kind.__name__, (mixin, kind), {"__module__": kind.__module__}))
    return made


def _each(row: Callable[[int, Any], Tensor], *arguments: Tensor) -> Tensor:
    """row(b, i) (1, ...) of all rows of arguments (B, ...) or (B, K, ...), where it takes those of (b, i) (1, ...)."""
    x = arguments[0]
    indices = [(b, i) for i in (range(x.shape[1]) if x.dim() == 3 else [None]) for b in range(len(x))]
    rows = torch.cat([row(*index) for index in indices])
    return rows if x.dim() == 2 else rows.unflatten(0, (-1, len(x))).transpose(0, 1)


def _at(z: Tensor, b: int, i: int | None) -> Tensor:
    """Row (1, ...) of (B, ...) or (B, K, ...)."""
    return z[b : b + 1] if i is None else z[b : b + 1, i]


def _one(b: int) -> slice:
    return slice(b, b + 1)


def _rows_alone(part: Any) -> Any:
    """A constraint whose code sees each row by itself, and so does what it evaluates between the knots."""
    if isinstance(part, FunctionConstraint):
        return _made(part, _Function)
    whole = part.joins_knots or isinstance(part, BetweenKnots)
    made = _made(part, _Integral if isinstance(part, Integral) else _Constraint if whole else _Rows)
    if isinstance(part, BetweenKnots | Integral) and is_users(model := part.model):
        object.__setattr__(made, "model", _made(model, _Field if type(model).step is Dynamics.step else _Step))
    if isinstance(part, BetweenKnots) and is_users(part.constraint):
        object.__setattr__(made, "constraint", _rows_alone(part.constraint))
    return made


class _Field(Dynamics):
    of_stages: tuple[Dynamics, Tensor] | None = None  # the model of any stage, and the stages (K,), set by `at`

    def at(self, k: int | Tensor) -> Self:
        model = super().at(k)
        if not isinstance(model, _Field):  # the user's code makes another object
            model = _made(model, _Step if isinstance(self, _Step) else _Field)
        return model if model is self or isinstance(k, int) else _for_stages(model, (self, k))

    def take(self, index: Rows) -> Self:
        model = super().take(index)
        if self.of_stages is None:
            return model
        return _for_stages(model, (self.of_stages[0].take(index), self.of_stages[1]))

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        if x.shape[:-1] == (1,):
            return super().field(x, u)
        return _each(lambda b, i: self._row(b, i).field(_at(x, b, i), _at(u, b, i)), x, u)

    def _row(self, b: int, i: int | None) -> Dynamics:
        model, k = self.of_stages or (self, None)
        return model.take(_one(b)) if k is None or i is None else model.take(_one(b)).at(int(k[i]))


def _for_stages(model: Any, of_stages: tuple[Dynamics, Tensor]) -> Any:
    model = copy.copy(model)
    object.__setattr__(model, "of_stages", of_stages)
    return model


class _Step(_Field):
    def step(self, x: Tensor, u: Tensor) -> Tensor:
        if x.shape[:-1] == (1,):
            return super().step(x, u)
        return _each(lambda b, i: self._row(b, i).step(_at(x, b, i), _at(u, b, i)), x, u)


class _Cost(Cost):
    total = Cost.total  # of rows by themselves

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        if x.shape[:-1] == (1,):
            return super().stage(x, u, k)
        number = lambda i: int(k[i]) if isinstance(k, Tensor) and k.dim() == 1 else k
        return _each(lambda b, i: self.take(_one(b)).stage(_at(x, b, i), _at(u, b, i), number(i)), x, u)

    def terminal(self, x: Tensor) -> Tensor:
        if x.shape[:-1] == (1,):
            return super().terminal(x)
        return _each(lambda b, i: self.take(_one(b)).terminal(_at(x, b, i)), x)


class _Function(FunctionConstraint):
    def rows_at(self, k: Tensor | int, *arguments: Tensor) -> Tensor:
        if arguments[0].dim() == 2:
            return super().rows_at(k, *arguments)
        number = lambda i: k if isinstance(k, int) else int(k[i])
        return _each(lambda b, i: self.take(_one(b)).rows_at(number(i), *(_at(z, b, i) for z in arguments)), *arguments)


class _Constraint(Constraint):
    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return super().value(X, U) if len(X) == 1 else self._of_each("value", X, U)

    def violation(self, X: Tensor, U: Tensor) -> Tensor:
        return super().violation(X, U) if len(X) == 1 else self._of_each("violation", X, U)

    def _of_each(self, name: str, X: Tensor, U: Tensor) -> Tensor:
        return torch.cat([getattr(self.take(_one(b)), name)(X[_one(b)], U[_one(b)]) for b in range(len(X))])


class _Rows(_Constraint):
    """Rows of a knot, which read that knot alone: each along a trajectory that stays there."""

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        if len(X) > 1:
            return self._of_each("value", X, U)
        rows = []
        for i, k in enumerate(torch.arange(X.shape[1])[self.knots].tolist()):
            stage = slice(min(k, U.shape[1] - 1), min(k, U.shape[1] - 1) + 1)
            rows.append(super().value(X[:, k : k + 1].expand_as(X), U[:, stage].expand_as(U))[:, i])
        return torch.stack(rows, dim=1)


class _Integral(_Constraint, Integral):
    @property
    def _summed(self) -> Summed:
        return _made(super()._summed, _Sums)


class _Sums(Summed):
    def _rate(self, x: Tensor, u: Tensor, k: int | Tensor | None) -> Tensor:
        if x.shape[:-1] == (1,):
            return super()._rate(x, u, k)
        number = lambda i: int(k[i]) if isinstance(k, Tensor) and k.dim() == 1 else k
        return _each(lambda b, i: self.take(_one(b))._rate(_at(x, b, i), _at(u, b, i), number(i)), x, u)
