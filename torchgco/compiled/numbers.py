"""The numbers of a problem by name, new ones for them, and memory of their own for each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.numbers import Floats, Number, numbers_of_fields
from torchgco.base.tree import own_mapped
from torchgco.problem.goal import Goal, GoalBall, GoalState
from torchgco.problem.problem import Problem


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
    parts: dict[str, Any] = {name: _own(getattr(problem, name), B) for name in ("dynamics", "constraints", "time")}
    parts |= {"x0": problem.x0.clone(), "cost": _own(problem.cost.by_knot(problem.N), B)}
    goal = problem.goal
    if goal is not None and goal.required:
        row = parts["constraints"][-1]
        assert isinstance(row, GoalBall | GoalState)
        parts["goal"] = row.goal(goal, problem.position)
    return problem._with(parts)


def numbers_of(problem: Problem) -> list[Number]:
    """The numbers of a problem that has memory of its own for each, `with_own_numbers`."""
    collected = [Number("x0", (problem.x0.numpy(),), "x0", False, lambda new: None)]
    collected += problem.cost.numbers("cost") + numbers_of_fields(problem.dynamics, "dynamics", "dynamics")
    for i, constraint in enumerate(problem.constraints):
        collected += constraint.numbers(f"constraints[{i}]", i)
    return collected


def with_numbers_as_they_are(problem: Problem) -> Problem:
    """The same problems after numbers were written, with nothing that was computed from the previous ones."""
    constraints = tuple(constraint.remade() for constraint in problem.constraints)
    known = replace(problem.known, row_shapes=None, interior=None, packed={}, lifted={})
    now = problem._with({"constraints": constraints}, known)
    if now.goal is None or now.goal.assumed:
        dims = now._dimensions(now.x0)
        now = now._with({"goal": Goal.derived(now.cost.goal(now.x0), dims)}, known)
    return now


def _own(part: Any, B: int) -> Any:
    """A part of a problem with copies of all its numbers, one for every problem."""

    def each(value: Tensor) -> Tensor:
        if value.dim() == 0:
            return value
        return value.expand(B, *value.shape[1:]).clone(memory_format=torch.contiguous_format)

    return own_mapped(part, each)
