"""Parts bound to a problem: what a user's class leaves out, or what it would lose, ends here in one line."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, MutableMapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from torchgco.base.errors import InputError, shown
from torchgco.base.shapes import Dimensions, describe
from torchgco.base.tree import is_users
from torchgco.constraints.base import Constraint
from torchgco.costs.base import Cost
from torchgco.dynamics.base import Dynamics
from torchgco.obstacles.base import Obstacles

Part = TypeVar("Part")
# Of bound parts, by identity, the ones that were given.
_given: MutableMapping[Any, Any] = WeakIdKeyDictionary()
# What a class says of its own fields, which a bound part of another class has no use for.
OF_FIELDS = {"bind", "batched", "per_element"}
# Methods that say what a part is, and those that a class of ours computes beside them from its own fields alone.
SAID = "stage", "terminal", "total", "value", "at", "signed_distance", "field", "step"
COMPUTED = (
    "expand", "scaled", "value", "rows", "accumulate", "violation", "worst", "at", "signed_distance",
    "segment_clearance", "chord_clearance", "jacobians",
)  # fmt: skip
INTERFACES = Cost, Constraint, Obstacles, Dynamics  # what these compute, they compute by a part's own methods


def bound(part: Any, dims: Dimensions, field: str, kind: type[Part]) -> Part:
    """The part for one problem, by its own `bind`.

    Raises:
        InputError: `bind` returns another kind of thing, or one of torchgco's own classes that doesn't do what the
            user's class does: a subclass of `QuadraticCost`, say, whose `stage` would never be called. Or a user's
            class has one method of its own and inherits another that doesn't know it, such as `stage` and `expand`.
    """
    result = part.bind(dims)
    if not isinstance(result, kind):
        raise InputError(f"{field}.bind", f"a method that returns a {kind.__name__}", describe(result))
    if isinstance(result, Constraint) and is_users(result):
        knots = getattr(result, "knots", None)
        if not isinstance(knots, slice) and not (isinstance(knots, Tensor) and knots.dtype == torch.int64):
            raise InputError(f"{field}.knots", "a slice or an int64 tensor (K,), which `bind` sets", shown(knots))
    for name in _lost(part, result):
        expected = f"a class whose own methods are called: {type(result).__name__} takes its place"
        raise InputError(f"{field}.{name}", expected, f"one of {type(part).__name__}")
    for users, name, heir in _torn(result):
        expected = f"a method of {type(result).__name__}, which has a `{users}` of its own, or a class without {heir}'s"
        raise InputError(f"{field}.{name}", expected, f"the one of {heir}, which doesn't call this `{users}`")
    return result


def remember(pairs: Iterable[tuple[Any, Any]]) -> None:
    """Keep what was given with each bound part, for `as_given`."""
    for part, result in pairs:
        if result is not part:
            with suppress(TypeError):  # no weak reference to it
                _given[result] = part


def as_given(fields: Mapping[str, Any]) -> dict[str, Any]:
    """A problem's fields with the parts that were given in place of ones that are bound to another problem.

    These have that one's knots, numbers and shapes: with another N, say, they would be other constraints.
    """
    parts, rows = {name: _origin(fields[name]) for name in ("dynamics", "cost")}, fields["constraints"]
    if isinstance(rows, list | tuple) and any(_origin(row) is not row for row in rows):
        parts["constraints"] = [_origin(row) for row in rows]
    return {**fields, **parts}


def _origin(part: Any) -> Any:
    """What was given where `part` is bound; itself elsewhere."""
    with suppress(TypeError):  # no weak reference to it
        return _given.get(part, part)
    return part


def _lost(part: Any, result: Any) -> Iterator[str]:
    """Names that a user's class redefines and that are other ones in the class of what its `bind` returned."""
    inner = result.inscribed if isinstance(result, Obstacles) else result  # a body's balls meet obstacles of the class
    if isinstance(inner, type(part)) or not _is_ours(type(result)):
        return
    values = {field.name for field in fields(part)} if is_dataclass(part) else set[str]()
    for cls in type(part).__mro__:
        if _is_ours(cls):
            return
        for name, value in vars(cls).items():
            if name.startswith("__") or name in OF_FIELDS or name in values:
                continue
            if hasattr(type(result), name) and getattr(type(result), name) is not value:
                yield name


def _torn(result: Any) -> Iterator[tuple[str, str, str]]:
    """A user's own method, one that is inherited from a class of ours and computes without it, and this class."""
    line = type(result).__mro__
    for name in COMPUTED:
        index = next((i for i, cls in enumerate(line) if name in vars(cls)), None)
        unused = name == "at" and isinstance(result, Constraint) and not result.geometric
        unused |= name == "rows" and getattr(type(result), "value", None) is not Obstacles.value
        if index is None or unused or line[index] in INTERFACES or not _is_ours(line[index]):
            continue
        users = [cls for cls in line[:index] if not _is_ours(cls)]
        method = next((method for method in SAID if method != name and any(method in vars(cls) for cls in users)), None)
        if method is not None:
            yield method, name, line[index].__name__


def _is_ours(cls: type) -> bool:
    return cls.__module__.partition(".")[0] == "torchgco"
