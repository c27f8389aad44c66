"""What a study shows while it flies: a bar, lines where several jobs share a terminal, or nothing."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from typing import IO, Any, Protocol, Self

from tqdm import tqdm

from torchgco.experiments.config.launching import side_by_side

# Parts of a trial count too: a mission is one, and takes seconds.
LAYOUT = "{l_bar}{bar}| {n:.0f}/{total_fmt} [{elapsed}<{remaining}, {rate_fmt}{postfix}]"
PERIOD = 30.0  # s between two lines of a job


class Bar(Protocol):
    """The part of a tqdm bar that a flight uses."""

    def update(self, n: float) -> Any: ...
    def set_postfix_str(self, s: str, refresh: bool) -> Any: ...
    def write(self, s: str, file: IO[str]) -> Any: ...


class NoBar:
    """Shows warnings only, in worker processes: even a disabled tqdm makes a semaphore, which leaks in a kill."""

    def update(self, n: float) -> None:
        """Nothing is shown."""

    def set_postfix_str(self, s: str, refresh: bool) -> None:
        """Nothing is shown."""

    def write(self, s: str, file: IO[str]) -> None:
        """The line as it is."""
        print(s, file=file)


class Lines(NoBar):
    """A line on stderr every PERIOD seconds, in place of a bar: bars of several jobs would overwrite each other."""

    def __init__(self, name: str, total: int, initial: int) -> None:
        self.name, self.total, self.done, self.solver = name, total, float(initial), ""
        self.shown = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None: ...

    def set_description(self, desc: str) -> None:
        """The solver, or the number of processes, named in the next line."""
        self.solver = desc

    def update(self, n: float) -> None:
        """Count trials, and print a line where the last one is old enough."""
        self.done += n
        if time.monotonic() - self.shown >= PERIOD:
            self.shown = time.monotonic()
            print(f"{self.name}: {self.done:.0f}/{self.total} trials, {self.solver}", file=sys.stderr, flush=True)


def draw(drawings: Mapping[str, Callable[[], object]]) -> None:
    """Draw figures, and say before how many: they may take longer than what they show."""
    if not drawings:
        return
    text = f"drawing {len(drawings)} figure{'s' if len(drawings) > 1 else ''}"
    if side_by_side():
        print(f"{text} ...", file=sys.stderr, flush=True)
    for drawing in tqdm(drawings.values(), text, unit="figure", dynamic_ncols=True, disable=side_by_side()):
        drawing()
