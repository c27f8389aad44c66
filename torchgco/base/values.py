"""Values per problem, and per problem and knot, for the functions that a user passes to a problem's parts."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple
from weakref import WeakKeyDictionary

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from torchgco.base.errors import InputError, shown
from torchgco.base.shapes import Dimensions, tensor
from torchgco.base.tree import PerElement

Knot = int | Tensor | None
NAMED_PARAMETERS = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)


@dataclass(frozen=True)
class Values(PerElement):
    """Named tensors that functions take as keyword arguments, in the order of their names."""

    names: tuple[str, ...] = ()
    rows: tuple[Tensor, ...] = ()  # (B, ...)
    knot_names: tuple[str, ...] = ()
    knot_rows: tuple[Tensor, ...] = ()  # (B, N+1, ...), of dynamics (B, N, ...)
    stages: int = 0  # N

    batched: ClassVar[tuple[str, ...]] = ("rows", "knot_rows")

    def call(self, function: Callable[..., Tensor], *arguments: Tensor, k: Knot = None) -> Tensor:
        """function(*arguments) with its values, shaped for the first argument, (B, n), (B, K, n) or (B, S, n).

        `k` is the knot, or the knots (K,) of the second axis; it is passed on where the function asks for it.
        """
        (taken, asks_for_knot), x = taken_by(function), arguments[0]
        more: dict[str, Any] = {"k": k} if k is not None and asks_for_knot else {}
        for name, value in zip(self.names, self.rows, strict=True):
            if name in taken:
                more[name] = value[(slice(None), *[None] * (x.dim() - 2))]
        for name, value in zip(self.knot_names, self.knot_rows, strict=True):
            if name in taken:
                at_knot = value[:, k]
                more[name] = at_knot[:, None] if isinstance(k, int) and x.dim() == 3 else at_knot
        if "k" in more:
            with whole_numbers_become(x.dtype):
                return function(*arguments, **more)
        return function(*arguments, **more)

    def ending_at(self, last: Tensor) -> Values:
        """The same where the last knot stands for the knots `last` (B,), each problem's own."""
        each = torch.arange(len(last), device=last.device)
        rows = (torch.cat((row[:, :-1], row[each, last].unsqueeze(1)), dim=1) for row in self.knot_rows)
        return replace(self, knot_rows=tuple(rows))


NO_VALUES = Values()


def whole_numbers_become(dtype: torch.dtype) -> AbstractContextManager[Any]:
    """Knots times a number, as in 0.3 * k, have this precision: PyTorch's default one for that is single.

    In this thread alone, as PyTorch's default precision is that of all threads. TorchScript keeps the default one.
    """
    return nullcontext() if torch.get_default_dtype() is dtype else _Precision(dtype)


class _Precision(TorchFunctionMode):
    """Functions that make numbers of whole ones, or of Python's, give them in a precision."""

    def __init__(self, dtype: torch.dtype) -> None:
        super().__init__()
        self.dtype = dtype

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        out = func(*args, **kwargs)
        if not isinstance(out, Tensor) or out.dtype is not torch.get_default_dtype() or out.dtype is self.dtype:
            return out
        typed = [leaf for leaf in _leaves((*args, *kwargs.values())) if hasattr(leaf, "dtype")]
        if not all(isinstance(leaf, Tensor) and _is_whole(leaf) for leaf in typed):
            return out  # of numbers that have a precision
        if typed:
            args, kwargs = self._converted(args), {name: self._converted(value) for name, value in kwargs.items()}
        elif kwargs.get("dtype") is None:
            kwargs = {**kwargs, "dtype": self.dtype}
        try:
            return func(*args, **kwargs)
        except (TypeError, RuntimeError):  # it takes no other types
            return out

    def _converted(self, leaf: Any) -> Any:
        if isinstance(leaf, (tuple, list)):
            return type(leaf)(self._converted(entry) for entry in leaf)
        if isinstance(leaf, float):
            return torch.tensor(leaf, dtype=self.dtype)
        return leaf.to(self.dtype) if isinstance(leaf, Tensor) and leaf.dtype is not torch.bool else leaf


def _leaves(tree: tuple[Any, ...] | list[Any]) -> Iterator[Any]:
    for leaf in tree:
        yield from _leaves(leaf) if isinstance(leaf, (tuple, list)) else (leaf,)


def _is_whole(tensor: Tensor) -> bool:
    return not (tensor.is_floating_point() or tensor.is_complex())


def bound_values(
    values: Any,
    knot_values: Any,
    functions: tuple[Callable[..., Any] | None, ...],
    dims: Dimensions,
    field: str,
    knots: int | None = None,
) -> Values:
    """Values by name for B problems: (B, ...), and (B|1, knots, ...) for those of the knots, by default N+1.

    Raises:
        InputError: no mapping of names to numbers, another shape, or a name that no function takes.
    """
    knots = dims.N + 1 if knots is None else knots
    if isinstance(values, Values):
        return _checked(values, dims, field, knots)
    by_kind: dict[str, dict[str, Tensor]] = {"values": {}, "knot_values": {}}
    for kind, named, shape in (("values", values, (dims.B,)), ("knot_values", knot_values, (dims.B, knots))):
        if named is not None and not isinstance(named, Mapping):
            raise InputError(f"{field}.{kind}", "a dict of tensors by name, or None", shown(named))
        for name, value in (named or {}).items():
            where = f"{field}.{kind}[{name!r}]"
            value = tensor(value, where, dims.like)
            if kind == "knot_values" and value.shape[:1] == (1,):
                value = value.expand(dims.B, *value.shape[1:])
            if tuple(value.shape[: len(shape)]) != shape:
                raise InputError(where, f"shape ({', '.join(map(str, shape))}, ...)", tuple(value.shape))
            if not any(name in taken_by(function).names for function in functions if function is not None):
                raise InputError(where, "the name of an argument of the function", "a name that it doesn't take")
            by_kind[kind][name] = value
    rows, at_knots = by_kind["values"], by_kind["knot_values"]
    return Values(tuple(rows), tuple(rows.values()), tuple(at_knots), tuple(at_knots.values()), dims.N)


def _checked(values: Values, dims: Dimensions, field: str, knots: int) -> Values:
    """Values that were bound before, to another problem maybe."""
    for names, rows, shape in (
        (values.names, values.rows, (dims.B,)),
        (values.knot_names, values.knot_rows, (dims.B, knots)),
    ):
        for name, row in zip(names, rows, strict=True):
            if tuple(row.shape[: len(shape)]) != shape or row.dtype != dims.like.dtype:
                wanted = f"{dims.like.dtype} of shape ({', '.join(map(str, shape))}, ...)"
                raise InputError(f"{field}: value {name!r}", wanted, f"{row.dtype} {tuple(row.shape)}")
    return replace(values, stages=dims.N)


class _All(frozenset):
    def __contains__(self, name: object) -> bool:
        return True


class Taken(NamedTuple):
    """What a function takes by name: all where it takes **anything; and whether it has an argument k without a default.

    With a default, k is a constant of the user's.
    """

    names: frozenset[str]
    knot: bool


def taken_by(function: Callable[..., Any]) -> Taken:
    """What a function takes."""
    with suppress(KeyError, TypeError):  # not seen before, or it can't be a key
        return _known[function]
    called = function.forward if isinstance(function, torch.nn.Module) else function
    try:
        parameters = tuple(inspect.signature(called).parameters.values())
    except (TypeError, ValueError):  # a builtin without a signature
        parameters = ()
    named = [p for p in parameters if p.kind in NAMED_PARAMETERS]
    every = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters)
    names = _All() if every else frozenset(p.name for p in named)
    taken = Taken(names, any(p.name == "k" and p.default is p.empty for p in named))
    with suppress(TypeError):
        _known[function] = taken
    return taken


# A rollout by PyTorch's kernels asks at every knot; what a function captures must not outlive it for that.
_known: WeakKeyDictionary[Callable[..., Any], Taken] = WeakKeyDictionary()
