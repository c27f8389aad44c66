"""How the commands `torchgco` and `torchgco-report` end: exit codes, Ctrl-C and SIGTERM, output that nobody reads."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from torchgco.base.errors import InputError

Handler = Callable[[int, FrameType | None], None]
SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Refused(SystemExit):
    """Refusals on their way through Hydra, which turns errors of callbacks into warnings, and announces others."""

    def __init__(self, *lines: object) -> None:
        super().__init__(2)
        self.lines = lines


class Terminated(KeyboardInterrupt):
    """SIGTERM arrived: handled as Ctrl-C is, but for the word and the exit code."""


def ended(command: str, work: Callable[[], int]) -> int:
    """Run a command; returns its exit code.

    That is the code of `work`; 2, with a line for each mistake, for malformed input; 130 for Ctrl-C; 143 for SIGTERM.
    """
    try:
        with raised():
            return work()
    except (InputError, Refused) as error:
        for line in error.lines if isinstance(error, Refused) else (error,):
            print(f"{command}: {line}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as error:
        terminated = isinstance(error, Terminated)
        word = "terminated" if terminated else "interrupted"
        print(f"\n{command}: {word}; the same command resumes from here", file=sys.stderr)
        return 128 + (signal.SIGTERM if terminated else signal.SIGINT)


@contextmanager
def raised(handler: Handler | None = None) -> Iterator[None]:
    """In this block Ctrl-C raises KeyboardInterrupt and SIGTERM raises Terminated; afterwards all is as before.

    A signal that is ignored stays so, as in the background of a shell, and the handler of another program is kept.

    Args:
        handler: in place of `throw`.
    """
    before = {}
    if threading.current_thread() is threading.main_thread():  # only that one may set handlers and gets signals
        own = (signal.default_int_handler, signal.SIG_DFL, throw)
        before = {number: held for number in SIGNALS if (held := signal.getsignal(number)) in own}
    for number in before:
        signal.signal(number, handler or throw)
    try:
        yield
    finally:
        for number, held in before.items():
            signal.signal(number, held)


def throw(number: int, frame: FrameType | None) -> None:
    """The handler that raises."""
    raise Terminated if number == signal.SIGTERM else KeyboardInterrupt


def say(text: str) -> None:
    """Print a text; a reader that has read enough, as `head` does, isn't an error.

    Raises:
        InputError: the system refuses to write (disk full).
    """
    try:
        print(text, flush=True)
    except BrokenPipeError:
        silence()
    except OSError as error:
        silence()
        raise InputError("standard output", "room to write", error.strerror or error) from None


def silence() -> None:
    """Let all that is still buffered for standard output, or printed later, go nowhere: nobody reads it.

    Otherwise Python would complain when it ends.
    """
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
