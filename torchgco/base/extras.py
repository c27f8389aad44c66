"""Libraries of the package's extras, which need not be there."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from torchgco.base.errors import InputError


def imported(module: str, extra: str, field: str, title: str | None = None) -> Any:
    """A module of an extra.

    Args:
        field: what needs it, for errors.
        title: the library's name; None: the module's.

    Raises:
        InputError: it isn't installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        name = title or module.split(".")[0]
        raise InputError(field, f"{name} (`pip install torchgco[{extra}]`)", error) from None
