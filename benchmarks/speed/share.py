"""Shares of the time of a `gco` solve: by phase of the method, and in each phase by native function."""

from __future__ import annotations

import importlib
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any

from benchmarks.speed.bench import Bench
from benchmarks.speed.families import FAMILIES

SECTION = "share"

# A phase lasts while its function (module:attributes) runs, except for phases inside it; the rest is the outer loop.
PHASES = {
    "paths sought": "torchgco.roadmap.roadmap:Roadmap.paths",
    "paths tracked": "torchgco.search.paths:PathProposals.track",
    "candidates relaxed": "torchgco.search.paths:PathProposals.relax",
    "candidates refined": "torchgco.search.candidates:Candidates.refined",
    "rest of the proposal": "torchgco.search.paths:PathProposals.propose",
    "plans sampled": "torchgco.guidance.mppi:MPPI.improve",
    "set-up": "torchgco.native.engine:Engine.__init__",
}
OUTER = "outer loop"
# These call the native libraries; an argument is the native function or its name.
CALLS = ("torchgco.native.engine:run", "torchgco.native.sampler:run", "torchgco.roadmap.native:NativeSearch._run")
PYTHON = "Python and PyTorch"


class Shares:
    """Seconds by phase and native function, each without the timers inside it; and native calls by phase."""

    def __init__(self, wait: Callable[[], None]) -> None:
        self.seconds: Counter[tuple[str, str]] = Counter()
        self.calls: Counter[str] = Counter()
        self.wait = wait
        self.open = [(OUTER, PYTHON)]
        self.since = 0.0

    def begin(self, phase: str | None, function: str) -> None:
        """Book the time until now, then time this pair; phase None: the phase that runs."""
        self._book()
        self.open.append((phase or self.open[-1][0], function))

    def end(self) -> None:
        """Book the time until now, then time the previous pair again."""
        self._book()
        self.open.pop()

    def _book(self) -> None:
        self.wait()
        now = time.process_time()
        self.seconds[self.open[-1]] += now - self.since
        self.since = now

    @contextmanager
    def running(self) -> Iterator[None]:
        """Wrap all functions of PHASES and CALLS in timers; restored at the end."""
        originals = []
        places = [(place, phase) for phase, place in PHASES.items()] + [(place, None) for place in CALLS]
        for place, phase in places:
            holder, attribute = _find(place)
            originals.append((holder, attribute, getattr(holder, attribute)))
            setattr(holder, attribute, self._around(originals[-1][2], phase))
        self.since = time.process_time()
        try:
            yield
            self._book()
        finally:
            for holder, attribute, function in reversed(originals):
                setattr(holder, attribute, function)

    def _around(self, work: Callable[..., Any], phase: str | None) -> Callable[..., Any]:
        @wraps(work)
        def timed(*args: Any, **kwargs: Any) -> Any:
            name = next((arg for arg in args if isinstance(arg, str)), None)
            self.begin(phase, PYTHON if phase else name or args[0].__name__)
            self.calls[self.open[-1][0]] += phase is None
            try:
                return work(*args, **kwargs)
            finally:
                self.end()

        return timed


def _find(place: str) -> tuple[Any, str]:
    """The object that holds a function, and its name there."""
    module, path = place.split(":")
    *holders, attribute = path.split(".")
    holder: Any = importlib.import_module(module)
    for name in holders:
        holder = getattr(holder, name)
    return holder, attribute


def run(bench: Bench) -> None:
    large = bench.sizes.share_batch
    for name, batch in (("forest30", large), ("forest30", 1), ("planar_trap", large)):
        _measure(bench, name, batch)


def _measure(bench: Bench, name: str, batch: int) -> None:
    """Time one solve of new problems, in a process that has solved other problems."""
    setup = bench.setup(*FAMILIES[name])
    bench.warm(setup, setup.task(setup.scenario.draw([batch, batch + 1], setup.seed)))
    task = setup.task(setup.layouts(batch))
    shares = Shares(bench.wait)
    with shares.running():
        setup.solver.solve(task.problem, task.U0, seed=setup.seed)
    case, total = f"{name}, B = {batch}", sum(shares.seconds.values())
    functions = [f for f in dict.fromkeys(f for _, f in shares.seconds) if f != PYTHON]
    for phase in ("all", *PHASES, OUTER):  # "all" first: its row has all columns
        own = {f: s for (p, f), s in shares.seconds.items() if p == phase}
        if phase == "all":
            own = {f: sum(s for (_, g), s in shares.seconds.items() if g == f) for f in (*functions, PYTHON)}
        for function in (*functions, PYTHON):
            if function in own:
                bench.row(SECTION, case, phase, function, 100 * own[function] / total, "%")
        if own:
            bench.row(SECTION, case, phase, "sum", 100 * sum(own.values()) / total, "%")
            calls = shares.calls[phase] if phase != "all" else shares.calls.total()
            bench.row(SECTION, case, phase, "native calls", calls)
            bench.row(SECTION, case, phase, "per problem", 1000 * sum(own.values()) / batch, "ms")
