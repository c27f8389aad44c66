"""The error for malformed input, and the warnings: on guidance, starts, horizons, contacts, lengths."""

from __future__ import annotations

import os
from pathlib import Path

MAX_LETTERS = 300  # letters of a value in an error
NAMED = 5  # problems that a warning names


class InputError(ValueError):
    """Malformed input: the field at fault, the expected value, and the given one, in one line."""

    def __init__(self, field: str, expected: str, got: object) -> None:
        self.field, self.expected, self.got = field, expected, got
        text = " ".join(str(got).split())
        shown = text if len(text) <= MAX_LETTERS else f"{text[:MAX_LETTERS]}..."
        super().__init__(f"{field}: expected {expected}, got {shown}")

    def __reduce__(self) -> tuple[type, tuple[str, str, str]]:
        return type(self), (self.field, self.expected, str(self.got))  # so that a worker process can return it


def undefined(part: object, name: str) -> InputError:
    """The error of a class that leaves out a method which what is asked for needs."""
    return InputError(f"{type(part).__name__}.{name}", "a method of this name, which is needed here", "none")


def shown(value: object) -> str:
    """A value as an error shows it: its repr where that fits on a line, else its type."""
    try:
        text = repr(value)
    except ValueError:  # a whole number of more digits than Python writes
        return type(value).__name__
    return text if len(text) <= 80 and "\n" not in text else type(value).__name__


def first_line(error: BaseException) -> str:
    """An error in one line: the first of its text, or its type."""
    return (str(error).splitlines() or [type(error).__name__])[0]


def theirs(error: BaseException) -> BaseException | None:
    """An error with the part of its traceback that begins in a user's code, as the cause of an InputError.

    None where no user's code raised it: how it came to pass within torchgco tells a user nothing.
    """
    import torch

    ours = tuple(str(Path(file).parent) + os.sep for file in (Path(__file__).parent, torch.__file__))
    trace = error.__traceback__
    while trace is not None and trace.tb_frame.f_code.co_filename.startswith(ours):
        trace = trace.tb_next
    return None if trace is None else error.with_traceback(trace)


class GuidanceWarning(UserWarning):
    """Guidance, or a part of it, can't be used for a problem, which is solved without it."""


class DeviceWarning(UserWarning):
    """A problem of another device is solved on the CPU, in a fraction of the time."""


class StartWarning(UserWarning):
    """A start that may be free is held at its guess: the solver can't choose it."""


class ScaleWarning(UserWarning):
    """A problem's lengths are so small that the tolerances, which are in metres, don't see them."""


class HorizonWarning(UserWarning):
    """A horizon is shorter than the way to the goal needs at the limits on speed."""


class StepWarning(UserWarning):
    """A model's time step is too long: half of it gives other states, or a cost that is off by over 1 %."""


class RefusalWarning(UserWarning):
    """A user's code raises an error for a state that a trajectory goes through; it counts as not finite."""


class TraceWarning(UserWarning):
    """A model's compiled code gives other states than the model itself."""


class ContactWarning(UserWarning):
    """A trajectory whose status says feasible touches an obstacle between two knots."""
