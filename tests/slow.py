"""Parameters of a test of which some take long: those are left to `make test-all`."""

from collections.abc import Iterable
from typing import Any

import pytest


def mostly(values: Iterable[Any], *slow: Any) -> list[Any]:
    """All of them, those of `slow` with its marker."""
    return [pytest.param(value, marks=pytest.mark.slow) if value in slow else value for value in values]
