"""Shares of the time of a `gco` solve: by phase of the method, and in each phase by native function."""

from __future__ import annotations

from typing import Any

from benchmarks.lib.families import FAMILIES
from benchmarks.lib.timers import Timers
from benchmarks.speed.bench import Bench

SECTION = "share"

# A phase lasts while its function runs, except for phases inside it; the rest is the outer loop.
PHASES = {
    "paths sought": "torchgco.roadmap.roadmap.Roadmap.paths",
    "paths tracked": "torchgco.search.following.Follow.track",
    "candidates relaxed": "torchgco.search.proposals.PathProposals.relax",
    "candidates refined": "torchgco.search.candidates.Candidates.refined",
    "rest of the proposal": "torchgco.search.proposals.PathProposals.improve",
    "plans sampled": "torchgco.guidance.mppi.MPPI.improve",
    "set-up": "torchgco.native.engine.Engine.__init__",
}
OUTER = "outer loop"
# These call the native libraries; an argument is the native function or its name.
CALLS = ("torchgco.native.engine.run", "torchgco.native.sampler.run", "torchgco.roadmap.native.NativeSearch._run")
PYTHON = "Python and PyTorch"


def _native(before: tuple[str, str], args: tuple[Any, ...]) -> tuple[str, str]:
    """The phase that runs, and the native function."""
    return before[0], next((arg for arg in args if isinstance(arg, str)), None) or args[0].__name__


PLACES = {place: lambda _, __, phase=phase: (phase, PYTHON) for phase, place in PHASES.items()} | dict.fromkeys(
    CALLS, _native
)


def run(bench: Bench) -> None:
    large = bench.sizes.share_batch
    for name, batch in (("forest30", large), ("forest30", 1), ("planar_trap", large)):
        _measure(bench, name, batch)


def _measure(bench: Bench, name: str, batch: int) -> None:
    """Time one solve of new problems, in a process that has solved other problems."""
    setup = bench.setup(*FAMILIES[name].generated)
    bench.warm(setup, setup.task(setup.scenario.draw([batch, batch + 1], setup.seed)))
    task = setup.task(setup.layouts(batch))
    timers = Timers((OUTER, PYTHON), bench.wait)
    with timers.running(PLACES):
        setup.solver.solve(task.problem, task.U0, seed=setup.seed)
    case, total = f"{name}, B = {batch}", sum(timers.seconds.values())
    functions = [f for f in dict.fromkeys(f for _, f in timers.seconds) if f != PYTHON]
    for phase in ("all", *PHASES, OUTER):  # "all" first: its row has all columns
        own = {f: s for (p, f), s in timers.seconds.items() if p == phase}
        if phase == "all":
            own = {f: sum(s for (_, g), s in timers.seconds.items() if g == f) for f in (*functions, PYTHON)}
        for function in (*functions, PYTHON):
            if function in own:
                bench.row(SECTION, case, phase, function, 100 * own[function] / total, "%")
        if own:
            bench.row(SECTION, case, phase, "sum", 100 * sum(own.values()) / total, "%")
            calls = sum(n for (p, f), n in timers.calls.items() if f != PYTHON and phase in (p, "all"))
            bench.row(SECTION, case, phase, "native calls", calls)
            bench.row(SECTION, case, phase, "per problem", 1000 * sum(own.values()) / batch, "ms")
