"""Problems with memory of their own for every number, and what they are after numbers were written."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchgco.base.numbers import Number, numbers_of_fields
from torchgco.base.tree import own_mapped
from torchgco.problem.goal import Goal, GoalBall, GoalState
from torchgco.problem.problem import Problem


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
