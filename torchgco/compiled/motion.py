"""Obstacles that move while a loop runs: where they are in each of its periods."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.numbers import Floats
from torchgco.base.tree import copied
from torchgco.problem.problem import Problem


class Motion:
    """What a loop was told of its obstacles that move, and when.

    All places follow from what was told last: a path that were moved on from period to period would lose its corners.

    Args:
        problem: of the loop.

    Raises:
        InputError: obstacles that move, and have no numbers that say where all of them are.
    """

    def __init__(self, problem: Problem) -> None:
        self._places = dict[int, list[str]]()  # full names, by the places of the constraints
        self._told = dict[int, tuple[float, Any, dict[str, Floats]]]()  # when, which obstacles, and all numbers now
        self._again = set[int]()  # of which a step tells something new
        for i, part in enumerate(problem.constraints):
            if getattr(part, "moving", False):
                self._places[i] = [name for name in _numbers(problem, i) if name.endswith((".centers", ".places"))]
                if not self._places[i]:
                    expected = "obstacles in a loop that rest, or have numbers that say where all of them are"
                    raise InputError(f"problem.constraints[{i}]", expected, f"{type(part.bare).__name__}, which move")

    @property
    def places(self) -> list[str]:
        """The full names of the numbers that say where they are."""
        return [name for names in self._places.values() for name in names]

    def forget(self) -> None:
        """The next step is the first one."""
        self._told.clear()

    def numbers(self, problem: Problem, t: float, given: Mapping[str, Any]) -> dict[str, Any]:
        """What a step at time t writes: the numbers that it is given, and places of what has moved meanwhile."""
        found, self._again = dict[str, Any](), set[int]()
        for i, (since, part, left) in self._told.items():
            now, later = _numbers(problem, i), _numbers(problem, i, part.later(t - since))
            written = {name for name, value in now.items() if not np.array_equal(value, left[name])}
            found |= {name: later[name] for name in self._places[i] if name not in written}
            if written or not given.keys().isdisjoint(now):
                self._again.add(i)
        return found | dict(given)

    def keep(self, problem: Problem, t: float) -> None:
        """What the obstacles are after a step at time t."""
        for i in self._places:
            known = i in self._told and i not in self._again
            since, part = self._told[i][:2] if known else (t, copied(problem.constraints[i]))
            self._told[i] = since, part, _numbers(problem, i)


def _numbers(problem: Problem, i: int, part: Any = None) -> dict[str, Floats]:
    """Copies of the numbers of constraint i, or of another one in its place, by full names."""
    part = problem.constraints[i] if part is None else part
    return {number.name: number.value for number in part.numbers(f"constraints[{i}]", i)}
