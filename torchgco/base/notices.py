"""Lines on what takes some seconds.

A program that has configured logging gets them from the logger `torchgco`, at INFO. Otherwise they go to stderr, be it
a terminal, a notebook or a log, but not from worker processes. Bars are for people who watch.
"""

from __future__ import annotations

import logging
import multiprocessing
import sys

LOG = logging.getLogger("torchgco")
AFTER = 2.0  # s before a bar shows
CLEAR_LINE = "\r\x1b[K"  # erases the line of a terminal, such as a progress bar's

_speaks: bool | None = None


def speak(yes: bool | None) -> None:
    """Whether this process may show lines; None, the default: where it is no worker."""
    global _speaks
    _speaks = yes


def notice(text: str, brief: bool = False) -> None:
    """Show a line, or log it; on something `brief` it is shown only where somebody watches."""
    if LOG.isEnabledFor(logging.INFO):
        LOG.info(text)
        return
    if _may_speak() and sys.stderr is not None and (watched() or not brief):
        print(f"{CLEAR_LINE if _in_terminal() else ''}torchgco: {text}", file=sys.stderr, flush=True)


def watched() -> bool:
    """Whether somebody watches stderr: in a terminal and in interactive Python, but not from worker processes."""
    return _may_speak() and (_in_terminal() or hasattr(sys, "ps1"))


def _may_speak() -> bool:
    return multiprocessing.parent_process() is None if _speaks is None else _speaks


def _in_terminal() -> bool:
    return sys.stderr is not None and sys.stderr.isatty()
