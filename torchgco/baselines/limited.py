"""Work with a time limit, in a process of its own: other libraries' code may hang within a call, where nothing in
this process can end it."""

from __future__ import annotations

import ctypes
import os
import pickle
import signal
import sys
import warnings
from collections.abc import Callable
from threading import TIMEOUT_MAX
from typing import Any, NoReturn, TypeVar

from torchgco.base.clock import added

T = TypeVar("T")

TIMERS = {signal.ITIMER_REAL: signal.SIGALRM, signal.ITIMER_PROF: signal.SIGPROF}
LEAST_TIMER = 1e-3  # s; a timer of less than its resolution never ends
DIES_WITH_PARENT = 1  # PR_SET_PDEATHSIG of Linux's prctl


def limited(work: Callable[[], T], seconds: float, timer: int = signal.ITIMER_REAL) -> T:
    """The result of `work`, arrays and plain values, from a child process that shares what was built here.

    The child ends with its time, on an exception in this process, such as Ctrl-C, and (on Linux) with this process.
    `processor_seconds` counts what it uses.

    Args:
        seconds: above 0.
        timer: what is limited: `signal.ITIMER_REAL`, or `ITIMER_PROF`, the processor's time.

    Raises:
        TimeoutError: the time was over.
        ChildProcessError: the child ended otherwise.
        Exception: what `work` raises.
    """
    reader, writer = os.pipe()
    sys.stdout.flush()
    sys.stderr.flush()
    parent = os.getpid()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # other threads don't matter: the child runs `work` alone
        child = os.fork()
    if child == 0:
        _work(work, seconds, timer, parent, writer)
    try:
        os.close(writer)
        with open(reader, "rb") as pipe:
            answer = pipe.read()
    except BaseException:
        os.kill(child, signal.SIGKILL)
        raise
    finally:
        _, ended, used = os.wait4(child, 0)
        added(used.ru_utime + used.ru_stime)
        code = os.waitstatus_to_exitcode(ended)
    if code == -TIMERS[timer]:
        raise TimeoutError(f"took longer than {seconds:g} s")
    if code != 0 or not answer:
        raise ChildProcessError(f"ended with {code}")
    failed, result = pickle.loads(answer)
    if failed:
        raise result
    return result


def _work(work: Callable[[], Any], seconds: float, timer: int, parent: int, writer: int) -> NoReturn:
    """The child: it answers and ends, whatever the parent's code would do at an end."""
    code = 1
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent's, which ends this process
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        signal.signal(TIMERS[timer], signal.SIG_DFL)  # by the system: no Python code runs within a library's call
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {TIMERS[timer]})
        if sys.platform == "linux":
            ctypes.CDLL(None).prctl(DIES_WITH_PARENT, signal.SIGKILL)
        if os.getppid() == parent:  # it lived until now
            signal.setitimer(timer, min(max(seconds, LEAST_TIMER), TIMEOUT_MAX))
            with open(writer, "wb") as pipe:
                pipe.write(pickle.dumps(_tried(work)))
            code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    finally:
        os._exit(code)


def _tried(work: Callable[[], Any]) -> tuple[bool, Any]:
    """Whether the work failed, and its result or its exception."""
    try:
        return False, work()
    except Exception as error:
        return True, error
