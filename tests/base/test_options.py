"""Annotations of options as checks: kinds, ranges, NumPy's numbers, subclasses, and what can't be checked."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf, nan
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, runtime_checkable

import numpy as np
import pytest
import torch
from torch import Tensor

from torchgco import InputError
from torchgco.base.options import (
    Above,
    AtLeast,
    AtMost,
    Below,
    Count,
    Extended,
    Natural,
    Positive,
    PositiveOrInfinite,
    Seconds,
    Share,
    check_options,
    check_value,
)

if TYPE_CHECKING:
    from nowhere import Unknown  # type: ignore


@runtime_checkable
class Walks(Protocol):
    def walk(self) -> None: ...


class Hidden(Protocol):
    def hide(self) -> None: ...


class Dog:
    def walk(self) -> None: ...


@dataclass(frozen=True)
class Options:
    count: Count = 1
    natural: Natural | None = None
    rate: Positive = 1.0
    share: Share = 0.5
    time: Seconds = 1.0
    open: Annotated[float, AtLeast(0, "m"), Below(1)] = 0.5
    factor: Annotated[float, Above(0), AtMost(2)] = 1.0
    bound: Extended = 1.0
    limit: PositiveOrInfinite = 1.0
    flag: bool = True
    word: Literal["a", "b"] | None = "a"
    text: str = ""
    row: tuple[Positive, ...] = (1.0,)
    rows: Sequence[tuple[float, float]] = ()
    per_problem: Positive | Tensor = 1.0
    walker: Walks = Dog()
    function: Callable[[int], int] | None = None
    table: Mapping[str, Any] | None = None
    anything: Any = None
    hidden: Hidden | None = None
    made: int = field(init=False)

    def __post_init__(self) -> None:
        check_options(self, "options")


BAD = [
    ("count", 0, "a whole number of at least 1"), ("count", 1.0, "a whole number"), ("count", True, "a whole number"),
    ("count", "1", "a whole number"), ("count", None, "a whole number"), ("natural", -1, "of at least 0, or null"),
    ("rate", 0, "a number above 0"), ("rate", nan, "a number above 0"), ("rate", inf, "a number above 0"),
    ("rate", True, "a number"), ("count", 10**30, "of 64 bits"), ("rate", 10**400, "of 64 bits"),
    ("rate", torch.tensor(1.0), "a number"), ("rate", 1j, "a number"),
    ("share", 1.1, "between 0 and 1"), ("time", 0.0, "a number above 0 s"), ("open", 1, "of at least 0 m and below 1"),
    ("factor", 0, "above 0 and at most 2"), ("factor", 2.1, "at most 2"), ("bound", nan, "a number or infinity"),
    ("limit", 0.0, "a number above 0 or infinity"), ("limit", nan, "above 0 or infinity"), ("limit", -inf, "above 0"),
    ("flag", 1, "true or false"), ("word", "c", "a or b, or null"), ("word", ["a"], "a or b"), ("text", 5, "text"),
    ("row", 1.0, "a list of numbers above 0"), ("row", "12", "a list"), ("row", (1.0, 0.0), "numbers above 0"),
    ("rows", [[1.0]], "a list of lists of 2 numbers"), ("rows", [5], "a list"), ("per_problem", 0.0, "above 0 or"),
    ("per_problem", [1.0], "a tensor"), ("walker", 5, "of class Walks"), ("walker", Dog, "of class Walks"),
    ("function", 5, "a function, or null"), ("table", 5, "of class Mapping, or null"),
]  # fmt: skip
GOOD = [
    ("count", 2**62), ("natural", 0), ("rate", 1), ("bound", -inf), ("limit", inf), ("word", None),
    ("row", [1, 2.5]), ("row", ()),
    ("rows", [(1, 2), [3.0, 4.0]]), ("row", np.array([1.0, 2.0])), ("per_problem", torch.zeros(2)),
    ("function", len), ("table", {}), ("anything", object()), ("hidden", 5),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value", "expected"), BAD)
def test_a_value_that_does_not_fit_is_named(name: str, value: object, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        Options(**{name: value})
    assert caught.value.field == f"options.{name}" and expected in caught.value.expected
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(("name", "value"), GOOD)
def test_a_value_that_fits_is_kept(name: str, value: object) -> None:
    assert getattr(Options(**{name: value}), name) is value


@pytest.mark.parametrize(
    ("name", "value"),
    [("count", np.int64(3)), ("rate", np.float32(0.5)), ("flag", np.bool_(False)), ("natural", np.uint8(2))],
)
def test_numbers_of_numpy_become_those_of_python(name: str, value: np.generic) -> None:
    held = getattr(Options(**{name: value}), name)
    assert held == value and type(held) is type(value.item())


def test_a_long_integer_becomes_a_float_where_one_will_do() -> None:
    held = Options(rate=10**24).rate
    assert isinstance(held, float) and held == 1e24


def test_numbers_of_numpy_keep_their_kind() -> None:
    for name, value in (("count", np.float64(3.0)), ("count", np.int64(0)), ("rate", np.float32(nan))):
        with pytest.raises(InputError, match=rf"options\.{name}"):
            Options(**{name: value})


def test_the_value_is_shown_on_one_line() -> None:
    with pytest.raises(InputError, match=r"got '1\.5'"):
        Options(rate="1.5")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="got Tensor"):
        Options(rate=torch.zeros(30, 3))  # type: ignore[arg-type]


def test_a_subclass_is_checked_as_far_as_its_annotations_are_known() -> None:
    @dataclass(frozen=True)
    class More(Options):
        own: Unknown = None  # known to type checkers alone
        count: Unknown = "many"  # another kind than in the base class

    assert More().count == "many" and More(own=5).own == 5
    with pytest.raises(InputError, match=r"options\.rate"):
        More(rate=-1.0)

    class Plain(Options):
        """No dataclass of its own."""

    with pytest.raises(InputError, match=r"options\.share"):
        Plain(share=2.0)


def test_copies_are_checked_and_errors_can_be_pickled() -> None:
    options = Options(count=5)
    assert replace(options, count=6).count == 6
    with pytest.raises(InputError, match=r"options\.count") as caught:
        replace(options, count=0)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


def test_a_single_value_is_checked_alike() -> None:
    assert check_value(None, Seconds | None, "t") is None and check_value(np.int64(2), Count, "n") == 2
    with pytest.raises(InputError, match="t: expected a number above 0 s, or null, got 'abc'"):
        check_value("abc", Seconds | None, "t")
