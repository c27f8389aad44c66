"""The numbers of a problem's parts: where they lie, of which shape they are, and how new ones are written there.

Shapes begin with the axis of problems. References have an axis of all knots; what a problem's parts share between
stages stays shared. Each part names its own in `numbers`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.shapes import bound_of
from torchgco.base.tree import PerElement
from torchgco.base.values import Values

Floats = np.ndarray[Any, np.dtype[np.float64]]
Wrong: TypeAlias = tuple[str, Any] | None  # (expected, got); None: nothing is wrong
Check: TypeAlias = Callable[[Floats], Wrong]
Joint: TypeAlias = Callable[[Mapping[str, Floats]], Wrong]


@dataclass(slots=True)
class Number:
    """One of them.

    Args:
        name: where it is in the problem, such as "constraints[1].centers".
        views: the memory that holds it, (B, ...); or of all stages, (B, N, ...), and of the last knot, (B, ...).
        part: whose number it is: "x0", "cost", "dynamics", or the place of a constraint.
        derived: whether kernels read what is computed from it, not the number itself.
        check: says what is wrong with new numbers, (expected, got), or None.
        after: is called when new numbers have been written.
        none: what None stands for in new numbers; only bounds have some.
        joint: says what is wrong with new numbers, by full names, that are written together; raises or returns as
            `check`.
    """

    name: str
    views: tuple[Floats, ...]
    part: str | int
    derived: bool
    check: Check
    after: Callable[[], object] | None = None
    joint: Joint | None = None
    shape: tuple[int, ...] = ()
    none: float | None = None

    def __post_init__(self) -> None:
        first, *last = self.views
        self.shape = first.shape if not last else (len(first), first.shape[1] + 1, *first.shape[2:])

    @property
    def value(self) -> Floats:
        """A copy, (B, ...)."""
        first, *last = self.views
        return first.copy() if not last else np.concatenate((first, last[0][:, None]), axis=1)

    def checked(self, value: Any) -> Floats:
        """New numbers of this shape, or without the axis of problems for all of them.

        Raises:
            InputError: another shape, no numbers, or numbers that the problem can't have.
        """
        value = value if self.none is None else bound_of(value, self.none)
        floats, shape = as_floats(value, self.name), self.shape
        if floats.shape != shape and floats.shape != shape[1:]:
            expected = f"shape {shape}" if len(shape) == 1 else f"shape {shape}, or {shape[1:]} for all problems"
            raise InputError(self.name, expected, floats.shape)
        if (wrong := self.check(floats)) is not None:
            raise InputError(self.name, *wrong)
        return floats

    def write(self, floats: Floats) -> None:
        """Write numbers that are `checked`."""
        if len(self.views) == 1:
            self.views[0][...] = floats
        else:
            first, last = self.views
            first[...], last[...] = floats[..., :-1, :], floats[..., -1, :]
        if self.after is not None:
            self.after()


def as_floats(value: Any, name: str) -> Floats:
    """Numbers as an array in double precision.

    Raises:
        InputError: no numbers.
    """
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value
    try:
        array = np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value)
        if array.dtype.kind not in "biufO":  # NumPy would drop imaginary parts, and read text and dates
            raise TypeError
        return array.astype(np.float64)
    except (TypeError, ValueError, NotImplementedError):
        raise InputError(name, "numbers", type(value).__name__) from None


def numbers(
    where: str,
    fields: Mapping[str, tuple[Tensor, Check]],
    part: str | int,
    derived: bool = True,
    after: Callable[[], object] | None = None,
    joint: Joint | None = None,
) -> list[Number]:
    """A number for each of these fields, with its check; all else as of `Number`."""
    return [
        Number(f"{where}.{name}", (tensor.numpy(),), part, derived, check, after, joint)
        for name, (tensor, check) in fields.items()
    ]


def numbers_of_fields(part: Any, where: str, index: str | int) -> list[Number]:
    """The floating numbers of any part, its `values` by their own names."""
    entries = []
    for field in (*part.batched, *part.per_element) if isinstance(part, PerElement) else ():
        value = getattr(part, field)
        tensors: dict[str, Any] = {field: value}
        if isinstance(value, Values):
            names = (*value.names, *value.knot_names)
            tensors = dict(zip(names, (*value.rows, *value.knot_rows), strict=True))
        elif isinstance(value, PerElement):
            entries += numbers_of_fields(value, f"{where}.{field}", index)
        for key, tensor in tensors.items():
            if isinstance(tensor, Tensor) and tensor.is_floating_point() and tensor.dim() > 0:
                entries += numbers(where, {key: (tensor, finite)}, index)
    return entries


def crossed(part: Any, where: str, is_over: Callable[..., Any], expected: str) -> Joint:
    """A check of a part's lower and upper bounds together."""

    def check(new: Mapping[str, Floats]) -> Wrong:
        bounds = (new.get(f"{where}.{side}", getattr(part, side).numpy()) for side in ("lower", "upper"))
        lower, upper = np.broadcast_arrays(*bounds)
        over = is_over(lower, upper)
        return (expected, f"{lower[over][0]:g} and {upper[over][0]:g}") if over.any() else None

    return check


def finite(new: Floats) -> Wrong:
    return None if np.isfinite(new).all() else ("finite numbers", "NaN or infinity")


def present(new: Floats) -> Wrong:
    return None if np.isfinite(new).all() else ("finite numbers (put an obstacle far away to be rid of it)", "others")


def lengths(new: Floats) -> Wrong:
    return finite(new) or (None if (new >= 0).all() else ("lengths of at least 0", float(new.min())))


def above_zero(new: Floats) -> Wrong:
    return finite(new) or (None if (new > 0).all() else ("numbers above 0", float(new.min())))


def at_least_zero(new: Floats) -> Wrong:
    return finite(new) or (None if (new >= 0).all() else ("numbers of at least 0", float(new.min())))


def above_zero_or_infinite(new: Floats) -> Wrong:
    return None if (new > 0).all() else ("numbers above 0, or infinity", float(new.min()))


def angles(new: Floats) -> Wrong:
    return None if ((new > 0) & (new < np.pi)).all() else ("angles in rad, above 0 and below pi", new.tolist())


def directions(new: Floats) -> Wrong:
    return finite(new) or (None if (np.abs(new).max(-1) > 0).all() else ("vectors other than 0", new.tolist()))


def measured(x: Any, B: int, n: int) -> Floats:
    """States (B, n), or (n,) of all vehicles.

    Raises:
        InputError: another shape, no numbers, NaN or infinity.
    """
    state = as_floats(x, "x")
    if state.shape not in ((B, n), (n,)):
        raise InputError("x", f"shape ({B}, {n}), or ({n},) for all vehicles", state.shape)
    if not math.isfinite(state.sum()) and not np.isfinite(state).all():  # a sum takes a third of the time
        raise InputError("x", "finite states", "NaN or infinity")
    return state
