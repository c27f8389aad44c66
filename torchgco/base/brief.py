"""Short representations: what differs from the defaults, and shapes instead of numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any

import numpy as np
from torch import Tensor

TEXT_LETTERS = 200  # of a representation
FEW_NUMBERS = 6  # numbers that are shown themselves
VALUE_LETTERS = 60  # letters of a value


class Brief:
    """Mixin: a class, dataclass or not, whose `repr` is short; subclasses may define their own."""

    def __init_subclass__(cls, **more: Any) -> None:
        super().__init_subclass__(**more)
        if "__repr__" not in cls.__dict__:  # what is there already, a dataclass doesn't replace
            cls.__repr__ = super(cls, cls).__repr__  # type: ignore[method-assign]

    def __repr__(self) -> str:
        return brief(self)


def brief(part: Any, deep: int = 1) -> str:
    """A dataclass as NAME(field=value, ...), without the fields that have their default; anything else by its class.

    Args:
        deep: how many parts within each other are shown with their own fields.
    """
    name = type(part).__name__.removeprefix("Bound").lstrip("_")
    if not is_dataclass(part) or deep < 0:
        return name
    shown = [
        f"{field.name}={_value(value, deep - 1)}"
        for field in fields(part)
        if field.repr and (value := getattr(part, field.name)) is not None and not _is_default(field, value)
    ]
    text = f"{name}({', '.join(shown)})"
    return text if len(text) <= TEXT_LETTERS else f"{text[: TEXT_LETTERS - 4]}...)"


def _is_default(field: Field[Any], value: Any) -> bool:
    default = field.default_factory() if field.default_factory is not MISSING else field.default
    if value is default:
        return True
    alike = type(value) is type(default) and not isinstance(value, Tensor | np.ndarray)
    return alike and bool(value == default)


def _value(value: Any, deep: int) -> str:
    if isinstance(value, Tensor | np.ndarray):
        if int(np.prod(value.shape)) <= FEW_NUMBERS and int(np.prod(value.shape[:-1])) == 1:
            return str([f"{x:.4g}" for x in value.reshape(-1).tolist()]).replace("'", "")
        return f"{type(value).__name__.lower()}{tuple(value.shape)}"
    if isinstance(value, slice):
        return f"{value.start}:{value.stop}"
    if is_dataclass(value) and not isinstance(value, type):
        return brief(value, deep)
    if callable(value) and not isinstance(value, type):
        return getattr(value, "__name__", type(value).__name__)
    if isinstance(value, Sequence) and not isinstance(value, str) and value and is_dataclass(value[0]):
        return f"[{', '.join(type(item).__name__ for item in value)}]"
    text = repr(value)
    return text if len(text) <= VALUE_LETTERS and "\n" not in text else f"{text[:VALUE_LETTERS].splitlines()[0]}..."
