"""Problems of one form as one batch."""

from __future__ import annotations

from dataclasses import is_dataclass
from typing import Any

import torch
from torch import Tensor

from torchgco.base.shapes import MISTAKES
from torchgco.base.tree import PerElement, changed, field_names
from torchgco.problem.problem import Problem

PARTS = ("dynamics", "cost", "constraints", "goal")


class _Unlike(Exception):
    """Two problems differ in more than the numbers of their rows."""


def merged(one: Problem, other: Problem) -> Problem | None:
    """The problems of both, one after the other; None where they have different forms."""
    if one.N != other.N or one.x0.dtype != other.x0.dtype:
        return None
    try:
        parts: dict[str, Any] = {
            name: _rows(getattr(one, name), getattr(other, name), one.B, other.B) for name in PARTS
        }
    except _Unlike:
        return None
    parts["x0"] = torch.cat((one.x0, other.x0))
    return one._with(parts)


def _rows(a: Any, b: Any, A: int, B: int) -> Any:
    """What holds rows of A, and of B problems, as that of both."""
    if isinstance(a, Tensor) and isinstance(b, Tensor):
        return _shared_or_each(a, b, A, B)
    if type(a) is not type(b):
        raise _Unlike
    if isinstance(a, tuple):
        if len(a) != len(b):
            raise _Unlike
        return tuple(_rows(x, y, A, B) for x, y in zip(a, b, strict=True))
    if isinstance(a, PerElement):
        rowed = (*a.batched, *a.per_element)
        for name in set(field_names(type(a))) - set(rowed):
            if not _same(getattr(a, name), getattr(b, name)):
                raise _Unlike
        return changed(a, {name: _rows(getattr(a, name), getattr(b, name), A, B) for name in rowed}) if rowed else a
    if is_dataclass(a) and not isinstance(a, type):
        return changed(a, {name: _rows(getattr(a, name), getattr(b, name), A, B) for name in field_names(type(a))})
    if not _same(a, b):
        raise _Unlike
    return a


def _shared_or_each(a: Tensor, b: Tensor, A: int, B: int) -> Tensor:
    """A row per problem; the single one that all share where both have the same."""
    if a.dim() == 0 or b.dim() == 0:
        a, b = (x.reshape(1) if x.dim() == 0 else x for x in (a, b))
    if a.shape[1:] != b.shape[1:] or a.dtype != b.dtype:
        raise _Unlike
    if len(a) == len(b) == 1 and torch.equal(a, b) and (A, B) != (1, 1):
        return a
    rows = [x.expand(count, *x.shape[1:]) if len(x) == 1 else x for x, count in ((a, A), (b, B))]
    return torch.cat(rows)


def _same(a: Any, b: Any) -> bool:
    """Whether two values that no problem has of its own are the same."""
    if a is b:
        return True
    if isinstance(a, Tensor) or isinstance(b, Tensor):
        alike = isinstance(a, Tensor) and isinstance(b, Tensor) and a.shape == b.shape and a.dtype == b.dtype
        return alike and torch.equal(a, b)
    try:
        return type(a) is type(b) and bool(a == b)
    except MISTAKES:
        return False
