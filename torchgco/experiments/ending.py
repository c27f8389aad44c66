"""How commands begin and end: the folder of a run, exit codes, Ctrl-C and SIGTERM, output that nobody reads."""

from __future__ import annotations

import argparse
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

from torchgco.base.errors import InputError
from torchgco.base.signals import handled
from torchgco.native.compiler import NativeError

OWN_HANDLERS = (signal.default_int_handler, signal.SIG_DFL)  # handlers of Python and of the system


class Refused(SystemExit):
    """Refusals on their way through Hydra, which turns errors of callbacks into warnings, and announces others."""

    def __init__(self, *lines: object) -> None:
        super().__init__(2)
        self.lines = lines


class Terminated(KeyboardInterrupt):
    """SIGTERM arrived: handled as Ctrl-C is, but for the word and the exit code."""


def ended(command: str, work: Callable[[], int]) -> int:
    """Run a command; returns its exit code.

    That is the code of `work`; 2, with a line for each mistake, for malformed input, or a C compiler that is needed and
    fails; 130 for Ctrl-C; 143 for SIGTERM.
    """
    try:
        with raised():
            return work()
    except (InputError, Refused, NativeError) as error:
        for line in error.lines if isinstance(error, Refused) else (error,):
            print(f"{command}: {_visible(str(line))}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as error:
        terminated = isinstance(error, Terminated)
        word = "terminated" if terminated else "interrupted"
        print(f"\n{command}: {word}; the same command resumes from here", file=sys.stderr)
        return 128 + (signal.SIGTERM if terminated else signal.SIGINT)


class Noted:
    """A handler that raises, and notes the signal first: modules that are being loaded and destructors drop exceptions.

    While `held` is true, signals are noted only.
    """

    def __init__(self) -> None:
        self.held = False
        self.numbers: list[int] = []

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.numbers.append(number)
        if not self.held:
            self.raise_late()

    def raise_late(self) -> None:
        """Raise for a signal that was noted, but whose exception got lost."""
        if self.numbers:
            raise Terminated if self.numbers[0] == signal.SIGTERM else KeyboardInterrupt


@contextmanager
def raised() -> Iterator[Noted]:
    """In this block Ctrl-C raises KeyboardInterrupt and SIGTERM raises Terminated; afterwards all is as before.

    A signal that is ignored stays so, as in the background of a shell, and the handler of another program is kept.
    """
    noted = Noted()
    with handled(noted, lambda handler: handler in OWN_HANDLERS or isinstance(handler, Noted)):
        yield noted


def say(text: str) -> None:
    """Print a text; a reader that has read enough, as `head` does, isn't an error.

    Raises:
        InputError: the system refuses to write (disk full).
    """
    try:
        print(_visible(text), flush=True)
    except BrokenPipeError:
        silence()
    except OSError as error:
        silence()
        raise InputError("standard output", "room to write", error.strerror or error) from None


def _visible(text: str) -> str:
    """A text without control characters: names in files of others could command the terminal."""
    return re.sub(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]", "?", text)


def silence() -> None:
    """Let all that is still buffered for standard output, or printed later, go nowhere: nobody reads it.

    Otherwise Python would complain when it ends.
    """
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


TRUST = "admit any size in a run's files, and any class, such as a model of yours: its code runs"


class RunParser(argparse.ArgumentParser):
    """Takes `--trust` where files are read, and shows no usage before an error: one line for every mistake."""

    def __init__(self, prog: str, description: str, takes: str = "RUN", trusts: bool = True) -> None:
        super().__init__(prog=prog, description=description)
        self.takes = takes
        if trusts:
            self.add_argument("--trust", action="store_true", help=TRUST)

    def error(self, message: str) -> NoReturn:
        raise InputError("command line", f"{self.takes} and the options of --help", message)

    def run(self, arguments: Sequence[str] | None, work: Callable[[argparse.Namespace], int]) -> int:
        """Do the work of the program with its options; returns the exit code, see `ended`."""
        return ended(self.prog, lambda: work(self.parse_intermixed_args(arguments)))
