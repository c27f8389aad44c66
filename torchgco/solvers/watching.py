"""What `torchgco.solve` shows while it solves: lines on request, and a bar where it takes long and somebody watches."""

from __future__ import annotations

import sys
import time
from collections import Counter
from typing import Any

from torchgco.base.notices import AFTER, watched
from torchgco.solution import Solution
from torchgco.solvers.contracts import Progress, RowEnd

BAR_STEP = 0.1  # s between two drawings of the bar


class Watcher:
    """A callback that shows the progress of one solve of B problems; to be closed.

    Args:
        name: of the solver.
        tabled: whether it reports the rows of a table.
        verbose: True: a line on stdout for every row of the solver's table that worked on some problem, or, of a solver
            without one, after the passes 1, 2, 4, 8 ..., and one at the end; False: nothing; None: no lines.
    """

    def __init__(self, name: str, B: int, tabled: bool, verbose: bool | None) -> None:
        self.name, self.B, self.tabled, self.verbose = name, B, tabled, bool(verbose)
        self.began = self.drawn = time.monotonic()
        self.next = 1
        self.bar = None if verbose is False or not watched() else _bar(name, B)

    @property
    def callback(self) -> Watcher | None:
        """Itself, where there is anything to show."""
        return self if self.verbose or self.bar is not None else None

    def __call__(self, now: Progress) -> None:
        """Show a line, and move the bar."""
        if now.row is not None:
            self._say(self._row(now.row))
        elif now.candidates is None and not self.tabled and now.passes >= self.next:
            self.next = 2 * now.passes
            self._say(f"pass {now.passes:4d}: {_problems(now.rows.numel())}, {now.finished} of {now.total} ended")
        if self.bar is not None and (late := time.monotonic()) - self.drawn > BAR_STEP:
            self.drawn = late
            state = "" if now.candidates is None else "candidates {}/{}".format(*now.candidates)
            self.bar.set_postfix_str(state, refresh=False)
            self.bar.update(max(0, now.finished - self.bar.n))

    def end(self, solution: Solution) -> None:
        """Show how the problems ended."""
        if not self.verbose:
            return
        counts = Counter(status.name for status in solution.statuses).most_common()
        ended = ", ".join(f"{count} {status}" for status, count in counts)
        iterations = f"{int(solution.iterations.median())} iterations in the median, " if self.B else ""
        self._say(f"{self.name}: {_problems(self.B)}: {ended}; {iterations}{self._seconds}")

    def close(self) -> None:
        """Take the bar away."""
        if self.bar is not None:
            self.bar.close()

    @property
    def _seconds(self) -> str:
        return f"{time.monotonic() - self.began:.2f} s"

    def _row(self, row: RowEnd) -> str:
        """A line such as "row  3 Solve           64 problems; all in all 40 feasible, 30 at the goal; 0.31 s"."""
        stand = f"all in all {row.feasible} feasible, {row.arrived} at the goal"
        return f"row {row.number:2d} {row.name:14s} {_problems(row.worked)}; {stand}; {self._seconds}"

    def _say(self, line: str) -> None:
        if not self.verbose:
            return
        if self.bar is not None:
            self.bar.clear()
        print(line, file=sys.stdout, flush=True)


def _problems(count: int) -> str:
    return f"{count} problem{'' if count == 1 else 's'}"


def _bar(name: str, B: int) -> Any:
    from tqdm import tqdm  # takes a while to load, and few watch

    return tqdm(total=B, desc=name, unit="problem", delay=AFTER, leave=False, dynamic_ncols=True, file=sys.stderr)
