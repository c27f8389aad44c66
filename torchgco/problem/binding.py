"""Parts bound to a problem: what a user's class leaves out, or what it would lose, ends here in one line."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.shapes import Dimensions, describe
from torchgco.base.tree import is_users
from torchgco.constraints.base import Constraint

Part = TypeVar("Part")
# What a class says of its own fields, which a bound part of another class has no use for.
OF_FIELDS = {"bind", "batched", "per_element"}


def bound(part: Any, dims: Dimensions, field: str, kind: type[Part]) -> Part:
    """The part for one problem, by its own `bind`.

    Raises:
        InputError: `bind` returns another kind of thing, or one of torchgco's own classes that doesn't do what the
            user's class does: a subclass of `QuadraticCost`, say, whose `stage` would never be called.
    """
    found = part.bind(dims)
    if not isinstance(found, kind):
        raise InputError(f"{field}.bind", f"a method that returns a {kind.__name__}", describe(found))
    if isinstance(found, Constraint) and is_users(found):
        knots = getattr(found, "knots", None)
        if not isinstance(knots, slice) and not (isinstance(knots, Tensor) and knots.dtype == torch.int64):
            raise InputError(f"{field}.knots", "a slice or an int64 tensor (K,), which `bind` sets", shown(knots))
    for name in _lost(part, found):
        expected = f"a class whose own methods are called: {type(found).__name__} takes its place"
        raise InputError(f"{field}.{name}", expected, f"one of {type(part).__name__}")
    return found


def _lost(part: Any, found: Any) -> Iterator[str]:
    """Names that a user's class defines anew and that are other ones in the class of what its `bind` returned."""
    if isinstance(found, type(part)) or type(found).__module__.partition(".")[0] != "torchgco":
        return
    values = {field.name for field in fields(part)} if is_dataclass(part) else set[str]()
    for cls in type(part).__mro__:
        if cls.__module__.partition(".")[0] == "torchgco":
            return
        for name, value in vars(cls).items():
            if name.startswith("__") or name in OF_FIELDS or name in values:
                continue
            if hasattr(type(found), name) and getattr(type(found), name) is not value:
                yield name
