"""Where the time of a `gco` solve goes: timers around the kernels, each leaving out what it calls."""

from __future__ import annotations

import importlib
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any

from benchmarks.speed.bench import Bench

SECTION = "share"

# Share, and the functions (module, then attributes) whose own time it is.
KERNELS = {
    "inner solves": ("torchgco.native.engine:Engine.iterate", "torchgco.solvers.iteration:EagerIterations.run"),
    "rollouts and values": ("torchgco.native.engine:Engine.open_loop", "torchgco.native.engine:Engine.value"),
    "gains and optimality": ("torchgco.solvers.batch:optimality",),
    "sampling": ("torchgco.guidance.mppi:MPPI.improve",),
    "roadmap": ("torchgco.guidance.roadmap:Roadmap.ways",),
    "rest of the candidates": ("torchgco.guidance.detour:Detour.propose",),
    "outer updates": ("torchgco.solvers.batch:Loop._end_inner",),
}


class Shares:
    """Seconds by name, each without those of the timers inside it."""

    def __init__(self, wait: Callable[[], None]) -> None:
        self.seconds: Counter[str] = Counter()
        self.wait = wait
        self.open: list[str] = []
        self.since = 0.0

    def switch(self) -> None:
        """Book the time since the last switch on the timer that ran."""
        self.wait()
        now = time.perf_counter()
        if self.open:
            self.seconds[self.open[-1]] += now - self.since
        self.since = now

    def around(self, name: str, work: Callable[..., Any]) -> Callable[..., Any]:
        """The same function with a timer."""

        @wraps(work)
        def timed(*args: Any, **kwargs: Any) -> Any:
            self.switch()
            self.open.append(name)
            try:
                return work(*args, **kwargs)
            finally:
                self.switch()
                self.open.pop()

        return timed

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Timers in the place of all kernels, for a while."""
        originals = []
        for name, places in KERNELS.items():
            for holder, attribute in map(_find, places):
                originals.append((holder, attribute, getattr(holder, attribute)))
                setattr(holder, attribute, self.around(name, originals[-1][2]))
        try:
            yield
        finally:
            for holder, attribute, function in originals:
                setattr(holder, attribute, function)


def _find(place: str) -> tuple[Any, str]:
    """The object that holds a function, and its name there."""
    module, path = place.split(":")
    *holders, attribute = path.split(".")
    holder: Any = importlib.import_module(module)
    for name in holders:
        holder = getattr(holder, name)
    return holder, attribute


def run(bench: Bench) -> None:
    setup = bench.setup("scenario=forest")
    task = setup.task(setup.layouts(bench.sizes.share_batch))
    case = f"forest, B = {bench.sizes.share_batch}"
    for compiled in bench.modes():
        name = "gco, compiled" if compiled else "gco"
        solve = lambda: setup.solver.solve(task.problem, task.U0, seed=setup.seed)
        with bench.mode(compiled):
            if compiled:
                solve()
            shares = Shares(bench.wait)
            with shares.installed():
                seconds = bench.timed(shares.around("rest", solve))[1]
        for kernel in (*KERNELS, "rest"):
            bench.row(SECTION, case, name, kernel, 100 * shares.seconds[kernel] / seconds, "%")
        bench.row(SECTION, case, name, "seconds a problem", seconds / bench.sizes.share_batch, "s")
