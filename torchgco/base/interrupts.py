"""Ctrl-C and SIGTERM in the commands `torchgco` and `torchgco-report`: one line and an exit code, at any moment.

While modules are being loaded nothing is written yet, and an exception could be lost in one of them: the process ends
at once. In a study both signals raise an exception, which cleans up files and processes on its way to `main`.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

Handler = Callable[[int, FrameType | None], None]
SIGNALS = (signal.SIGINT, signal.SIGTERM)
STUDY, REPORT = "torchgco", "torchgco-report"


class Terminated(KeyboardInterrupt):
    """SIGTERM arrived: handled as Ctrl-C is, but for the word and the exit code."""


@contextmanager
def raised(handler: Handler | None = None) -> Iterator[None]:
    """In this block Ctrl-C raises KeyboardInterrupt and SIGTERM raises Terminated; afterwards all is as before.

    handler  in place of `throw`
    """
    before = _install(handler or throw)
    try:
        yield
    finally:
        for number, held in before.items():
            signal.signal(number, held)


def throw(number: int, frame: FrameType | None) -> None:
    """The handler that raises."""
    raise Terminated if number == signal.SIGTERM else KeyboardInterrupt


def farewell(error: KeyboardInterrupt, command: str = STUDY) -> int:
    """Print the line of an interrupted command; returns its exit code: 130, or 143 for Terminated."""
    number = signal.SIGTERM if isinstance(error, Terminated) else signal.SIGINT
    print(_line(number, command), file=sys.stderr)
    return 128 + number


def _install(handler: Handler) -> dict[signal.Signals, Handler | int | None]:
    """The handler for both signals; returns those before it.

    A signal that is ignored stays so, as in the background of a shell, and the handler of another program is kept.
    """
    if threading.current_thread() is not threading.main_thread():  # only that one may set handlers and gets signals
        return {}
    own = (signal.default_int_handler, signal.SIG_DFL, throw, _end)
    before = {number: held for number in SIGNALS if (held := signal.getsignal(number)) in own}
    for number in before:
        signal.signal(number, handler)
    return before


def _end(number: int, frame: FrameType | None) -> None:
    os.write(2, f"{_line(number, COMMAND or STUDY)}\n".encode())
    os._exit(128 + number)


def _line(number: int, command: str) -> str:
    word = "terminated" if number == signal.SIGTERM else "interrupted"
    return f"\n{command}: {word}; the same command resumes from here"


def _command() -> str | None:
    """Which of the commands this process runs; None in any other program, and in the workers of a study."""
    name, words = (getattr(sys, "argv", None) or [""])[0], sys.orig_argv
    if name == "-m":  # while Python looks for the module
        name = words[words.index("-m") + 1] if "-m" in words[:-1] else ""
    elif name not in words:  # a worker has the argv of its parent
        return None
    name = os.path.basename(name)
    return name if name in (STUDY, REPORT) else None


COMMAND = _command()
if COMMAND is not None:
    _install(_end)
