"""A clock of solves that stands still while code is traced, compiled or loaded: first runs take no longer."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager


class _Left(threading.local):
    """What a thread's clocks leave out: by wall and by processor, s, and since when they have stood still."""

    out: tuple[float, float] = 0.0, 0.0
    since: tuple[float, float] | None = None


_left = _Left()


@contextmanager
def setting_up() -> Iterator[None]:
    """Code is traced, compiled, or loaded in this block: the clocks of its thread stand still, those of others run."""
    if _left.since is not None:
        yield
        return
    _left.since = began = _now()
    try:
        yield
    finally:
        wall, processor = (now - before for now, before in zip(_now(), began, strict=True))
        _left.out, _left.since = (_left.out[0] + wall, _left.out[1] + processor), None


@contextmanager
def loading() -> Iterator[None]:
    """Where this block loads modules, as PyTorch's derivatives do the first time, for seconds, clocks leave it out."""
    if _left.since is not None:
        yield
        return
    known, wall, processor = len(sys.modules), seconds(), processor_seconds()
    try:
        yield
    finally:
        if len(sys.modules) > known:
            more = seconds() - wall, processor_seconds() - processor
            _left.out = _left.out[0] + more[0], _left.out[1] + more[1]


def seconds() -> float:
    """Seconds since some moment without what this thread has spent on `setting_up`; only differences mean something."""
    return (_left.since or _now())[0] - _left.out[0]


def processor_seconds() -> float:
    """The same of all processors that this process uses, and children whose time was `added`."""
    return (_left.since or _now())[1] - _left.out[1]


def added(processor: float) -> None:
    """A child process that has ended, and did this thread's work, took so many seconds of processors."""
    wall, left_out = _left.out
    _left.out = wall, left_out - processor


def _now() -> tuple[float, float]:
    return time.perf_counter(), time.process_time()
