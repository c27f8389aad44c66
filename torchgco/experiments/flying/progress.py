"""What a study shows while it flies: a bar, lines in a log or where several jobs share a terminal, or nothing."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from typing import IO, Any, Protocol, Self

from tqdm import tqdm

from torchgco.base.notices import watched
from torchgco.experiments.config.launching import side_by_side

# Parts of a trial count too: a mission is one, and takes seconds.
BAR_FORMAT = "{l_bar}{bar}| {n:.0f}/{total_fmt} [{elapsed}<{remaining}, {rate_fmt}{postfix}]"
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
    """A line on stderr every PERIOD seconds and one at the end, in place of a bar.

    Bars of several jobs would overwrite each other, and a log would hold every state of a bar.
    """

    def __init__(self, name: str, total: int, initial: int) -> None:
        self.name, self.total, self.done, self.solver = name, total, float(initial), ""
        self.shown, self.told = time.monotonic(), -1.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, failure: object, *_: object) -> None:
        """The last line, where all went well, and it says more than the one before."""
        if failure is None and self.done != self.told:
            self._say()

    def set_description(self, desc: str) -> None:
        """The solver, or the number of processes, named in the next line."""
        self.solver = desc

    def update(self, n: float) -> None:
        """Count trials, and print a line where the last one is old enough."""
        self.done += n
        if time.monotonic() - self.shown >= PERIOD:
            self._say()

    def _say(self) -> None:
        self.shown, self.told = time.monotonic(), self.done
        print(f"{self.name}: {self.done:.0f}/{self.total} trials, {self.solver}", file=sys.stderr, flush=True)


def lines_alone() -> bool:
    """Whether a bar would be out of place: nobody watches, or other jobs write to the same terminal."""
    return side_by_side() or not watched()


def page_bar(total: int, slow: int, unit: str, of: str | None = None) -> tqdm:
    """A bar over the parts of a page, shown where there are `slow` or more and somebody watches."""
    return tqdm(total=total, desc=of, unit=unit, leave=False, disable=total < slow or not watched())


def draw(drawings: Mapping[str, Callable[[], object]]) -> None:
    """Draw figures, and say before how many: they may take longer than what they show."""
    if not drawings:
        return
    text = f"drawing {len(drawings)} figure{'s' if len(drawings) > 1 else ''}"
    if lines_alone():
        print(f"{text} ...", file=sys.stderr, flush=True)
    for drawing in tqdm(drawings.values(), text, unit="figure", dynamic_ncols=True, disable=lines_alone()):
        drawing()
