"""Counts of the examples that the random tests tried, by kind of input and outcome."""

from collections import Counter
from collections.abc import Callable
from typing import Any

from hypothesis import settings

from torchgco import InputError

COUNTS: Counter[tuple[str, str]] = Counter()
LONGEST = 500  # letters of a clear line


def examples(count: int) -> int:
    """`count` examples, or ten times as many where new ones are searched for."""
    return count if settings.default is not None and settings.default.derandomize else 10 * count


def count(kind: str, outcome: str) -> None:
    COUNTS[kind, outcome] += 1


def accepted_or_refused(kind: str, call: Callable[[], Any]) -> Any:
    """The result of the call, or None where it raises one clear line; any other exception is a failure."""
    try:
        result = call()
    except InputError as error:
        line = str(error)
        assert error.field and error.expected and "\n" not in line and len(line) <= LONGEST, line
        count(kind, "refused in one line")
        return None
    count(kind, "accepted")
    return result
