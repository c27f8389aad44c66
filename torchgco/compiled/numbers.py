"""The numbers of a problem by name: where they lie, of which shape they are, and how new ones are written there.

Shapes begin with the axis of problems. References have an axis of all knots; what a problem's parts share between
stages stays shared.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.shapes import bound_of

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
        given, shape = as_floats(value, self.name), self.shape
        if given.shape != shape and given.shape != shape[1:]:
            expected = f"shape {shape}" if len(shape) == 1 else f"shape {shape}, or {shape[1:]} for all problems"
            raise InputError(self.name, expected, given.shape)
        if (wrong := self.check(given)) is not None:
            raise InputError(self.name, *wrong)
        return given

    def write(self, given: Floats) -> None:
        """Write numbers that are `checked`."""
        if len(self.views) == 1:
            self.views[0][...] = given
        else:
            first, last = self.views
            first[...], last[...] = given[..., :-1, :], given[..., -1, :]
        if self.after is not None:
            self.after()


class Numbers(Mapping[str, Floats]):
    """All numbers of a problem, by full names; a last part that only one of them has will do, too.

    `numbers[name]` is a copy, and `numbers[name] = value` writes.
    """

    def __init__(self, found: list[Number], changed: Callable[[Number], None]) -> None:
        self._all = {number.name: number for number in found}
        short = [_short(number.name) for number in found]
        self._by_name = dict(self._all)
        for name, number in zip(short, found, strict=True):
            if Counter(short)[name] == 1:
                self._by_name.setdefault(name, number)
        self._changed = changed

    def find(self, name: str) -> Number:
        """The number of this name.

        Raises:
            InputError: there is none, or there are several.
        """
        number = self._by_name.get(name)
        if number is None:
            alike = [full for full in self._all if _short(full) == name]
            raise InputError("numbers", f"one of {', '.join(alike or map(self._named, self._all))}", name)
        return number

    def named(self, *given: Mapping[str, Any] | None) -> dict[str, Any]:
        """Values by full names, from mappings by any names.

        Raises:
            InputError: a name that isn't there, or a number that is given twice, by whichever names.
        """
        found, names = dict[str, Any](), dict[str, str]()
        for name, value in ((name, value) for part in given for name, value in (part or {}).items()):
            full = self.find(name).name
            if full in found:
                raise InputError("numbers", "each number once", f"{full} twice, as {names[full]} and {name}")
            found[full], names[full] = value, name
        return found

    def __getitem__(self, name: str) -> Floats:
        return self.find(name).value

    def __setitem__(self, name: str, value: Any) -> None:
        self.write({name: value})

    def write(self, values: Mapping[str, Any]) -> None:
        """Write several; all are checked before the first is written."""
        new = [(number := self.find(name), number.checked(value)) for name, value in self.named(values).items()]
        joint = [(number, check) for number, _ in new if (check := number.joint) is not None]
        together = {number.name: np.broadcast_to(given, number.shape) for number, given in new} if joint else {}
        for number, check in joint:
            if (wrong := check(together)) is not None:
                raise InputError(number.name, *wrong)
        for number, given in new:
            number.write(given)
            self._changed(number)

    def __iter__(self) -> Iterator[str]:
        return iter(self._all)

    def __len__(self) -> int:
        return len(self._all)

    def __repr__(self) -> str:
        rows = [(self._named(name), "x".join(map(str, n.shape)), name) for name, n in self._all.items()]
        widths = [max(len(row[i]) for row in rows) for i in (0, 1)]
        return "\n".join(f"{a:{widths[0]}}  {b:{widths[1]}}  {c}" for a, b, c in [("name", "shape", "where"), *rows])

    def _named(self, name: str) -> str:
        short = _short(name)
        return short if self._by_name.get(short) is self._all[name] else name


def as_floats(value: Any, name: str) -> Floats:
    """Numbers as an array in double precision.

    Raises:
        InputError: no numbers.
    """
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value
    try:
        return np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(name, "numbers", type(value).__name__) from None


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


def _short(name: str) -> str:
    return name.rpartition(".")[2]


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
