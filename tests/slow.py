"""Parameters of a test of which some take long: those are left to `make test-all`."""

from collections.abc import Iterable
from typing import Any

import pytest


def mostly(values: Iterable[Any], *slow: Any, several: bool = False) -> list[Any]:
    """All of them, those of `slow` with its marker; `several`: each is a tuple of several parameters."""
    return [
        pytest.param(*(value if several else (value,)), marks=pytest.mark.slow) if value in slow else value
        for value in values
    ]
