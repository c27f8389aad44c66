"""Code that refuses states, as a guard does that raises: there its values count as NaN, as those of a lost state.

A solve tries states far from what it returns, and what a user's code raises there would end it for all problems of its
batch. Only code that looks at values is spared, as no other knows which states to refuse.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, MutableMapping
from contextlib import suppress
from functools import partial
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from torchgco.base.errors import InputError, RefusalWarning, first_line
from torchgco.base.shapes import MISTAKES
from torchgco.base.tree import is_users
from torchgco.constraints.base import Constraint
from torchgco.costs.base import Cost
from torchgco.dynamics.base import Dynamics
from torchgco.problem.problem import Problem
from torchgco.tracing.recorder import looks_at_values

Found = TypeVar("Found")
_looking: MutableMapping[Any, bool] = WeakIdKeyDictionary()  # whether parts look at values, by identity


class Refusals:
    """The first error that parts have raised for states that are finite, and of which part it was.

    Args:
        where: which states these are, of which a warning is given at once; None: `warn_of_refusals` gives it.
    """

    def __init__(self, where: str | None = None) -> None:
        self.where = where
        self.first: tuple[str, BaseException] | None = None

    def add(self, field: str, error: BaseException) -> None:
        """Note that a part has raised an error."""
        if self.first is None:
            self.first = field, error
            if self.where is not None:
                self.warn(self.where)

    def warn(self, where: str) -> None:
        """Say which part has refused which states, if any has."""
        if self.first is not None:
            field, error = self.first
            told = f"{field} refuses {where}, which counts as not finite: {type(error).__name__}: {first_line(error)}"
            warnings.warn(told, RefusalWarning, stacklevel=2)


def spared(problem: Problem, run: Callable[[Problem], Found]) -> Found:
    """run(problem); where code that looks at values raises, run again with NaN in the place of its values there."""
    try:
        return run(problem)
    except InputError:
        raise
    except MISTAKES:
        sparing = with_refusals(problem)
        if sparing is problem:
            raise
    return run(sparing)


def with_refusals(problem: Problem) -> Problem:
    """The problem, whose parts that look at values give NaN for rows for which they raise; itself where none does."""
    refusals = Refusals()
    return with_looking(problem, lambda part, field, shape: sparing_part(part, field, shape, refusals))


def warn_of_refusals(problem: Problem, where: str) -> None:
    """Say which part of a problem `with_refusals` has refused which states, if any has."""
    parts = (part for part in (problem.dynamics, problem.cost, *problem.constraints) if isinstance(part, _Sparing))
    if (part := next(parts, None)) is not None:
        part.refusals.warn(where)


def with_looking(problem: Problem, change: Callable[[Any, str, tuple[int, int]], Any], again: bool = False) -> Problem:
    """The problem with change(part, field, shape) of each part that looks at values; itself where none does.

    Args:
        change: takes the part's name in errors, and of a constraint how many knots and rows it has.
        again: each part's code is tried, also where it was before.
    """
    first = problem.take(slice(0, 1))
    looks = partial(_looks, again)
    x = torch.where(torch.isfinite(first.x0), first.x0, 0.0)
    X, U = x.unsqueeze(1).repeat(1, problem.N + 1, 1), x.new_zeros(1, problem.N, problem.m)
    parts: dict[str, Any] = {}
    if looks(problem.dynamics, first.along.step, X[:, 1:], U):
        parts["dynamics"] = change(problem.dynamics, "dynamics", (0, 0))
    if looks(problem.cost, first.cost.total, X, U):
        parts["cost"] = change(problem.cost, "cost", (0, 0))
    rows = list(problem.constraints)
    for i, constraint in enumerate(first.constraints):
        if looks(rows[i], constraint.value, X, U):
            field = f"{getattr(constraint, 'name', '')}.function" if _is_function(constraint) else f"constraints[{i}]"
            rows[i] = change(rows[i], field, problem.row_shapes[i])
            parts["constraints"] = tuple(rows)
    return problem._with(parts, problem.known) if parts else problem


def sparing_part(part: Any, field: str, shape: tuple[int, int], refusals: Refusals) -> Any:
    """A dynamics, cost or constraint that gives NaN for rows that its code refuses."""
    if isinstance(part, _Sparing):
        return part
    if isinstance(part, Dynamics):
        mixin: type = _Model
    elif isinstance(part, Cost):
        mixin = _Price
    else:
        mixin = _Function if _is_function(part) else _Rows
    own = {"refusals": refusals, "field_name": field, "rows_shape": shape}
    kind = type(type(part).__name__, (mixin, type(part)), {"__module__": type(part).__module__, **own})
    made = copy.copy(part)
    object.__setattr__(made, "__class__", kind)
    return made


def _is_function(part: Any) -> bool:
    """Whether rows are those of a function of a knot, which may be asked for any number of knots."""
    return hasattr(part, "rows_at")


def _looks(again: bool, part: Any, values: Callable[..., Tensor], *arguments: Tensor) -> bool:
    if not is_users(part):
        return False
    looks = None if again else _looking.get(part)
    if looks is None:
        looks = looks_at_values(values, *arguments)
        with suppress(TypeError):  # no weak reference to it
            _looking[part] = looks
    return looks


class _Sparing:
    """What all kinds of parts do where their code raises."""

    refusals: ClassVar[Refusals]
    field_name: ClassVar[str]  # in errors
    rows_shape: ClassVar[tuple[int, int]]  # of a constraint: how many knots and rows

    def _spared(
        self, evaluate: Callable[..., Tensor], lost: Callable[[Tensor], Tensor], *arguments: Tensor, splits: bool = True
    ) -> Tensor:
        """evaluate(self, *arguments), where arguments (B, ...) or (B, K, ...) have a row for each problem.

        Args:
            lost: the values (1, ...) or (1, K, ...) of rows that are refused.
            splits: rows of one problem are tried one by one, too.
        """
        try:
            return evaluate(self, *arguments)
        except InputError:
            raise
        except MISTAKES as error:
            refused = error
        x, part = arguments[0], self
        if len(x) > 1:
            of = [(part.take(slice(b, b + 1)), [z[b : b + 1] for z in arguments]) for b in range(len(x))]  # type: ignore[attr-defined]
            return torch.cat([one._spared(evaluate, lost, *rows, splits=splits) for one, rows in of])
        if splits and x.dim() == 3 and x.shape[1] > 1:
            rows = [[z[:, i : i + 1] for z in arguments] for i in range(x.shape[1])]
            return torch.cat([self._spared(evaluate, lost, *row) for row in rows], dim=1)
        if all(bool(torch.isfinite(z).all()) for z in arguments):
            self.refusals.add(self.field_name, refused)
        return lost(x)


class _Model(_Sparing, Dynamics):
    def field(self, x: Tensor, u: Tensor) -> Tensor:
        return self._spared(lambda part, x, u: super().field(x, u), _lost, x, u, splits=self._is_one)

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        return self._spared(lambda part, x, u: super().step(x, u), _lost, x, u, splits=self._is_one)

    @property
    def _is_one(self) -> bool:
        """Whether the second axis may be split: it isn't that of the stages of which this is the model."""
        return not isinstance(getattr(self, "k", None), Tensor)


class _Price(_Sparing, Cost):
    total = Cost.total  # of what is spared

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        evaluate = lambda part, x, u: super().stage(x, u, k)
        return self._spared(evaluate, _lost_number, x, u, splits=not isinstance(k, Tensor))

    def terminal(self, x: Tensor) -> Tensor:
        return self._spared(lambda part, x: super().terminal(x), _lost_number, x)


class _Function(_Sparing, Constraint):
    def rows_at(self, k: Tensor | int, *arguments: Tensor) -> Tensor:
        p, evaluate = self.rows_shape[1], lambda part, *z: super().rows_at(k, *z)  # type: ignore[misc]
        lost = lambda z: _lost(z[..., :1]).expand(*z.shape[:-1], p)
        return self._spared(evaluate, lost, *arguments, splits=isinstance(k, int))


class _Rows(_Sparing, Constraint):
    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return self._spared(lambda part, X, U: super().value(X, U), self._lost, X, U, splits=False)

    def violation(self, X: Tensor, U: Tensor) -> Tensor:
        return self._spared(lambda part, X, U: super().violation(X, U), self._lost, X, U, splits=False)

    def _lost(self, X: Tensor) -> Tensor:
        return _lost(X[:, :1, :1]).expand(1, *self.rows_shape)


def _lost(x: Tensor) -> Tensor:
    """NaN of the same shape, which x still leads to: so are derivatives."""
    return torch.nan * x


def _lost_number(x: Tensor) -> Tensor:
    return torch.nan * x[..., 0]
