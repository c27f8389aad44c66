"""What the code of a problem depends on: equal signatures, equal kernels.

Only torchgco's own parts have a signature: their code reads their fields and nothing else. A user's code may read
anything, so it is traced anew for every solve.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import fields, is_dataclass
from typing import Any

from torch import Tensor

from torchgco.base.tree import PerElement, is_users
from torchgco.costs.quadratic import BoundQuadratic
from torchgco.native.packing import KINDS
from torchgco.problem.problem import Problem

PLAIN = (bool, int, float, str, type(None))


def signature(problem: Problem) -> Hashable | None:
    """A key that problems share only where their native kernels are the same; None where a part is a user's own."""
    try:
        cost = problem.cost
        return (
            (problem.N, problem.n, problem.m, str(problem.x0.dtype), str(problem.x0.device)),
            _part(problem.dynamics),
            ("quadratic", cost.diagonal) if type(cost) is BoundQuadratic else _part(cost),
            tuple(type(c) if type(c) in KINDS else _part(c) for c in problem.constraints),
        )
    except _Unknown:
        return None


class _Unknown(Exception):
    """A part whose code may depend on more than its fields."""


def _part(part: Any) -> Hashable:
    """The class of a part with its fields: of values per problem the form alone, of all others the content."""
    if is_users(part) or not is_dataclass(part):
        raise _Unknown
    own = {*part.batched, *part.per_element} if isinstance(part, PerElement) else set()
    named = ((f.name, getattr(part, f.name)) for f in fields(part))
    return type(part), *((name, _form(value) if name in own else _content(value)) for name, value in named)


def _form(value: Any) -> Hashable:
    """What a trace sees of values per problem: a row that all problems share is traced as such."""
    if isinstance(value, tuple):
        return tuple(map(_form, value))
    if isinstance(value, Tensor):
        return str(value.dtype), value.dim(), tuple(value.shape[1:]), tuple(value.shape[:1]) == (1,)
    return _content(value)


def _content(value: Any) -> Hashable:
    if isinstance(value, Tensor):
        plain = value.detach().cpu().contiguous()
        return str(value.dtype), tuple(value.shape), plain.numpy().tobytes()
    if isinstance(value, (tuple, list)):
        return type(value), *map(_content, value)
    if isinstance(value, slice):
        return "slice", value.start, value.stop, value.step
    if isinstance(value, PLAIN):
        return type(value), value
    return _part(value)
