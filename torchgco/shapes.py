"""The glossary of dimensions, and the checks at the border.

Dimensions, always these letters in this order:

    B  problems in the batch      S  samples of a problem      N  stages (controls); knots are 0..N
    n  states                     m  controls                  p  rows of a constraint      d  space (2 or 3)
    k  index of a stage or knot   s  = n + 1 + m, the size of the homogeneous vector [x, 1, u]

    X  (B, N+1, n) states         U  (B, N, m) controls        c <= 0 is feasible
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, ClassVar, Self, TypeAlias

import torch
from torch import Tensor

Rows: TypeAlias = Tensor | slice


class InputError(ValueError):
    """Malformed input: the field at fault, what was expected there, and what came."""

    def __init__(self, field: str, expected: str, got: object) -> None:
        self.field, self.expected, self.got = field, expected, got
        super().__init__(f"{field}: expected {expected}, got {got}")

    def __reduce__(self) -> tuple[type, tuple[str, str, str]]:
        return type(self), (self.field, self.expected, str(self.got))  # a worker process hands it on whole


class GuidanceWarning(UserWarning):
    """Guidance, or a part of it, can't serve a problem: it is solved without."""


class PerElement:
    """Mixin for problem parts that may hold one value per problem.

    A subclass names its tensor fields with a batch axis: in `batched` those where it always has length B; in
    `per_element` those where length 1, or a parameter without axes, stands for a value that all problems share.
    """

    batched: ClassVar[tuple[str, ...]] = ()
    per_element: ClassVar[tuple[str, ...]] = ()

    def take(self, index: Rows) -> Self:
        """The same part for the problems in `index` (int64, (B',), or a slice)."""
        changes = {name: take(getattr(self, name), index) for name in self.batched}
        for name in self.per_element:
            value = getattr(self, name)
            if isinstance(value, Tensor) and value.dim() > 0 and value.shape[0] != 1:
                changes[name] = value[index]
        return replace(self, **changes) if changes else self  # type: ignore[type-var]


def take(tree: Any, index: Rows) -> Any:
    """Rows `index` of every tensor in nested tuples and dataclasses; None and plain values pass unchanged."""
    if isinstance(tree, Tensor):
        return tree[index]
    if isinstance(tree, PerElement):
        return tree.take(index)
    if isinstance(tree, tuple):
        return tuple(take(leaf, index) for leaf in tree)
    if is_dataclass(tree) and not isinstance(tree, type):
        return replace(tree, **{f.name: take(getattr(tree, f.name), index) for f in fields(tree)})
    return tree


def cast(tree: Any, dtype: torch.dtype) -> Any:
    """Every floating tensor in nested tuples and dataclasses in another precision; all else passes unchanged."""
    if isinstance(tree, Tensor):
        return tree.to(dtype) if tree.is_floating_point() else tree
    if isinstance(tree, tuple):
        return tuple(cast(leaf, dtype) for leaf in tree)
    if is_dataclass(tree) and not isinstance(tree, type):
        copy = object.__new__(type(tree))  # parts are checked and bound already
        for name, value in vars(tree).items():
            object.__setattr__(copy, name, cast(value, dtype))
        return copy
    return tree


def copied(tree: Any) -> Any:
    """The same with every tensor cloned."""
    if isinstance(tree, Tensor):
        return tree.clone()
    if isinstance(tree, tuple):
        return tuple(copied(leaf) for leaf in tree)
    if is_dataclass(tree) and not isinstance(tree, type):
        return replace(tree, **{f.name: copied(getattr(tree, f.name)) for f in fields(tree)})
    return tree


def put(tree: Any, index: Tensor, rows: Any) -> None:
    """Write `rows` into rows `index` of every tensor of `tree`, in place; the two have the same structure."""
    if isinstance(tree, Tensor):
        tree[index] = rows
    elif isinstance(tree, tuple):
        for leaf, new in zip(tree, rows, strict=True):
            put(leaf, index, new)
    elif is_dataclass(tree) and not isinstance(tree, type):
        for f in fields(tree):
            put(getattr(tree, f.name), index, getattr(rows, f.name))


def tensor(value: Any, field: str, like: Tensor | None = None) -> Tensor:
    """`value` (tensor, array, nested sequence or number) as a floating tensor of the dtype and device of `like`.

    Raises InputError where it isn't numeric, and where a tensor comes with another dtype or device than `like`:
    converting it silently would hide a mistake.
    """
    if isinstance(value, Tensor):
        if like is not None and value.dtype != like.dtype:
            raise InputError(field, f"dtype {like.dtype} as in x0", value.dtype)
        if like is not None and value.device != like.device:
            raise InputError(field, f"device {like.device} as in x0", value.device)
        return value
    dtype = like.dtype if like is not None else torch.float64
    device = like.device if like is not None else None
    try:
        plain = list(value) if isinstance(value, Sequence) else value
        return torch.as_tensor(plain, dtype=dtype, device=device)
    except (TypeError, ValueError, RuntimeError):
        raise InputError(field, "numbers", repr(value)) from None


@dataclass(frozen=True)
class Dimensions:
    """What a part must know of its problem in order to check and shape its tensors."""

    B: int
    N: int
    n: int
    m: int
    dt: float | None  # s, None for dynamics without a time step
    position: slice | None
    like: Tensor  # x0: dtype and device of everything


def check_shape(value: Tensor, shape: tuple[int | str, ...], field: str) -> None:
    """Raise InputError unless `value` has `shape`; a letter stands for any length and says which dimension it is."""
    fits = value.dim() == len(shape) and all(
        isinstance(want, str) or want == got for want, got in zip(shape, value.shape, strict=True)
    )
    if not fits:
        raise InputError(field, f"shape ({', '.join(map(str, shape))})", tuple(value.shape))


def lead(parameter: Tensor | float, component: Tensor) -> Tensor | float:
    """A model parameter shaped to multiply a component (B, ...) of states with leading batch axis.

    A number or a tensor without axes is returned as it is; one of shape (B,) gets the axes that the component has.
    """
    if isinstance(parameter, Tensor) and parameter.dim() == 1:
        return parameter.view(-1, *([1] * (component.dim() - 1)))
    return parameter


def components(z: Tensor) -> tuple[Tensor, ...]:
    """The components (...) of vectors (..., n), each of them contiguous: arithmetic on strided ones takes longer."""
    return z.movedim(-1, 0).contiguous().unbind(0)


def vectors(*parts: Tensor) -> Tensor:
    """Vectors (..., n) of n components (...), which stay apart in memory for those who ask for them again."""
    return torch.stack(parts).movedim(0, -1)
