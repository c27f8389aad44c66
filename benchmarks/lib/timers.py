"""Processor seconds by what runs: functions are wrapped in timers for a while, and restored."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from functools import wraps
from pkgutil import resolve_name
from typing import Any

Name = Callable[[Any, tuple[Any, ...]], Hashable]  # what runs, from what ran before and a function's arguments


class Timers:
    """Seconds by name. The time of a name runs while one of its functions does, except for timed ones inside it.

    Args:
        rest: the name of what is in none of the functions.
        wait: returns when the device has finished.
    """

    def __init__(self, rest: Hashable, wait: Callable[[], None] = lambda: None) -> None:
        self.seconds: Counter[Any] = Counter()
        self.calls: Counter[Any] = Counter()
        self.open, self.wait = [rest], wait
        self.since = 0.0

    @contextmanager
    def running(self, places: Mapping[str, Name]) -> Iterator[None]:
        """Time functions inside this context.

        Args:
            places: "module.attribute" or "module.Class.attribute" of each, and how its calls are named.
        """
        originals = []
        for place, name in places.items():
            holder, _, attribute = place.rpartition(".")
            owner = resolve_name(holder)
            originals.append((owner, attribute, getattr(owner, attribute)))
            setattr(owner, attribute, self._around(originals[-1][-1], name))
        self.since = time.process_time()
        try:
            yield
            self._book()
        finally:
            for owner, attribute, function in reversed(originals):
                setattr(owner, attribute, function)

    def _book(self) -> None:
        self.wait()
        now = time.process_time()
        self.seconds[self.open[-1]] += now - self.since
        self.since = now

    def _around(self, work: Callable[..., Any], name: Name) -> Callable[..., Any]:
        @wraps(work)
        def timed(*args: Any, **kwargs: Any) -> Any:
            self._book()
            self.open.append(name(self.open[-1], args))
            self.calls[self.open[-1]] += 1
            try:
                return work(*args, **kwargs)
            finally:
                self._book()
                self.open.pop()

        return timed
