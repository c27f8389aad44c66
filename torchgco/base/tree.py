"""Nested tuples and dataclasses of tensors with a batch axis: select, cast, copy and write rows of all at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass, replace
from functools import lru_cache
from operator import is_
from typing import Any, ClassVar, Self, TypeAlias

import torch
from torch import Tensor

from torchgco.base.brief import Brief

Rows: TypeAlias = Tensor | slice


class PerElement(Brief):
    """Mixin for problem parts that may hold one value per problem.

    A subclass names its tensor fields with a batch axis: in `batched` those where it always has length B; in
    `per_element` those where length 1, or a parameter without axes, stands for a value that all problems share.
    """

    batched: ClassVar[tuple[str, ...]] = ()
    per_element: ClassVar[tuple[str, ...]] = ()

    def take(self, index: Rows) -> Self:
        """The same part for the problems in `index` (int64, (B',), or a slice)."""
        changes = dict[str, Any]()
        for name in self.batched:
            value = getattr(self, name)
            changes[name] = value[index] if type(value) is Tensor else None if value is None else take(value, index)
        for name in self.per_element:
            value = getattr(self, name)
            if isinstance(value, Tensor) and value.dim() > 0 and value.shape[0] != 1:
                changes[name] = value[index]
        return changed(self, changes) if changes else self


def passed_on(part: str, *names: str) -> tuple[Any, ...]:
    """Properties and methods that are those of a part: `knots, dt = passed_on("inner", "knots", "dt")`."""
    return tuple(property(lambda self, name=name: getattr(getattr(self, part), name)) for name in names)


def is_users(part: object) -> bool:
    """Whether a part's code is a user's: a class from elsewhere, or one of torchgco's that calls a user's function."""
    return getattr(part, "calls_function", False) or type(part).__module__.partition(".")[0] != "torchgco"


def take(tree: Any, index: Rows) -> Any:
    """Rows `index` of every tensor in nested tuples and dataclasses; None and plain values pass unchanged.

    Most parts are tensors, and each solve takes thousands: no call for these.
    """
    if isinstance(tree, Tensor):
        return tree[index]
    if isinstance(tree, PerElement):
        return tree.take(index)
    if isinstance(tree, tuple):
        rows: list[Any] = [
            leaf[index] if type(leaf) is Tensor else None if leaf is None else take(leaf, index) for leaf in tree
        ]
        return type(tree)(*rows) if hasattr(tree, "_fields") else tuple(rows)
    if not (names := field_names(type(tree))):
        return tree
    made = object.__new__(type(tree))  # its parts are checked and bound already
    for name in names:
        part = getattr(tree, name)
        taken = part[index] if type(part) is Tensor else None if part is None else take(part, index)
        object.__setattr__(made, name, taken)
    return made


def changed(part: Any, changes: Mapping[str, Any]) -> Any:
    """A dataclass with other values of some fields, which are checked already."""
    if not _is_plain(type(part)):
        return replace(part, **changes)
    other = object.__new__(type(part))  # each solve makes thousands
    for name in field_names(type(part)):
        object.__setattr__(other, name, changes[name] if name in changes else getattr(part, name))
    return other


def _made(kind: type, values: Mapping[str, Any]) -> Any:
    """An object with these values, which are checked and bound already."""
    made = object.__new__(kind)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made


@lru_cache(maxsize=4096)
def field_names(kind: type) -> tuple[str, ...]:
    """The names of a dataclass's fields; none of another class."""
    return tuple(f.name for f in fields(kind)) if is_dataclass(kind) else ()


@lru_cache(maxsize=4096)
def _is_plain(kind: type) -> bool:
    """Whether making a dataclass does nothing but set its fields; a user's may do anything."""
    return kind.__module__.partition(".")[0] == "torchgco" and not hasattr(kind, "__post_init__")


class LastTaken:
    """Rows of a tree, which are kept until others are asked for: several steps in turn look at the same ones."""

    def __init__(self, tree: Any) -> None:
        self.tree = tree
        self._last: tuple[Tensor, Any] | None = None

    def take(self, index: Tensor) -> Any:
        """Rows `index` (int64, (b,)) of the tree."""
        if self._last is None or not torch.equal(self._last[0], index):
            self._last = index, self.tree.take(index) if hasattr(self.tree, "take") else take(self.tree, index)
        return self._last[1]


def mapped(tree: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """The same with change(tensor) in the place of every tensor in nested sequences, mappings and dataclasses.

    Parts that hold none that it changes are the same objects.
    """
    if isinstance(tree, Tensor):
        return change(tree)
    if isinstance(tree, (tuple, list)):
        leaves = [mapped(leaf, change) for leaf in tree]
        if all(map(is_, leaves, tree)):
            return tree
        return type(tree)(*leaves) if hasattr(tree, "_fields") else type(tree)(leaves)
    is_part = is_dataclass(tree) and not isinstance(tree, type)
    if not is_part and not isinstance(tree, Mapping):
        return tree
    old: Any = vars(tree) if is_part else tree
    new = {name: mapped(value, change) for name, value in old.items()}
    if all(value is old[name] for name, value in new.items()):
        return tree
    return _made(type(tree), new) if is_part else new


def cast(tree: Any, dtype: torch.dtype) -> Any:
    """Every floating tensor in another precision."""
    return mapped(tree, lambda leaf: leaf.to(dtype) if leaf.is_floating_point() else leaf)


def moved(tree: Any, device: torch.device) -> Any:
    """Every tensor on a device."""
    return mapped(tree, lambda leaf: leaf.to(device))


def own_mapped(tree: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """The same with change(tensor) in the place of the tensors of problems, in tuples and the fields of `PerElement`s.

    All that leads to such a tensor is another object.
    """
    if isinstance(tree, Tensor):
        return change(tree)
    if isinstance(tree, tuple):
        leaves = (own_mapped(leaf, change) for leaf in tree)
        return type(tree)(*leaves) if hasattr(tree, "_fields") else tuple(leaves)
    if isinstance(tree, PerElement) and (tree.batched or tree.per_element):
        names = (*tree.batched, *tree.per_element)
        return _made(type(tree), vars(tree) | {name: own_mapped(getattr(tree, name), change) for name in names})
    return tree


def apart(tree: Any) -> Any:
    """`own_mapped` to tensor objects of its own, of the same memory.

    What else holds one of these tensors can then be distinguished from the tree.
    """
    return own_mapped(tree, Tensor.detach)


def copied(tree: Any) -> Any:
    """The same with every tensor cloned."""
    if isinstance(tree, Tensor):
        return tree.clone()
    if isinstance(tree, tuple):
        return tuple([leaf.clone() if type(leaf) is Tensor else copied(leaf) for leaf in tree])
    if not (names := field_names(type(tree))):
        return tree
    made = object.__new__(type(tree))
    for name in names:
        part = getattr(tree, name)
        object.__setattr__(made, name, part.clone() if type(part) is Tensor else None if part is None else copied(part))
    return made


def spread(values: Tensor, rows: Tensor) -> Tensor:
    """Values (b,) at their places `rows` (b,) in a batch; 0 at the others."""
    whole = values.new_zeros(int(rows.max()) + 1)
    whole[rows] = values
    return whole


def put(tree: Any, index: Tensor, rows: Any) -> None:
    """Write `rows` into rows `index` of every tensor of `tree`, in place; the two have the same structure."""
    if isinstance(tree, Tensor):
        tree[index] = rows
        return
    pairs: Iterable[tuple[Any, Any]]
    if isinstance(tree, tuple):
        pairs = zip(tree, rows, strict=True)
    else:
        pairs = ((getattr(tree, name), getattr(rows, name)) for name in field_names(type(tree)))
    for leaf, new in pairs:
        if type(leaf) is Tensor:
            leaf[index] = new
        elif leaf is not None:
            put(leaf, index, new)
