"""A clock of solves that stands still while code is traced and compiled: a first run takes no longer than others."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager


class _Left(threading.local):
    """What a thread's clock leaves out, s, and since when it has stood still."""

    out: float = 0.0
    since: float | None = None


_left = _Left()


@contextmanager
def setting_up() -> Iterator[None]:
    """Code is traced, compiled, or loaded in this block: the clock of its thread stands still, those of others run."""
    if _left.since is not None:
        yield
        return
    _left.since = began = _now()
    try:
        yield
    finally:
        _left.out, _left.since = _left.out + _now() - began, None


def seconds() -> float:
    """Seconds since some moment without what this thread has spent on `setting_up`; only differences mean something."""
    return (_now() if _left.since is None else _left.since) - _left.out


def _now() -> float:
    return time.perf_counter()
