"""Signals: handlers that are set for a block, by all parts that hold, note or answer Ctrl-C and SIGTERM."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any

STOPS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def handled(
    handler: Callable[[int, FrameType | None], Any],
    replaces: Callable[[Any], bool],
    numbers: Sequence[signal.Signals] = STOPS,
) -> Iterator[None]:
    """In this block `handler` gets the signals whose own handler it `replaces`; afterwards all is as before.

    Only in the main thread: Python handles signals there, and no other thread may set handlers.
    """
    before: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: old for number in numbers if replaces(old := signal.getsignal(number))}
    for number in before:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)
