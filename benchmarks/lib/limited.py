"""Work with a limit of processor time, in a process of its own: a solver may hang within an iteration."""

from __future__ import annotations

import multiprocessing
import resource
import signal
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


def limited(work: Callable[[], T], seconds: int) -> T:
    """The result of `work`, NumPy arrays and plain values, from a child process that shares what was built here.

    Raises:
        TimeoutError: the limit of processor time was over.
        ChildProcessError: the child ended otherwise.
    """
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)

    def run() -> None:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
        sender.send(work())

    child = context.Process(target=run)
    child.start()
    sender.close()
    try:
        return receiver.recv()
    except EOFError:
        child.join()
        if child.exitcode in (-signal.SIGXCPU, -signal.SIGKILL):
            raise TimeoutError(f"took longer than {seconds} s") from None
        raise ChildProcessError(f"ended with {child.exitcode}") from None
    finally:
        child.join()
