"""Shares of the time of a `gco` solve: by phase of the method, and in each phase by native function."""

from __future__ import annotations

from typing import Any

from benchmarks.lib.families import FAMILIES
from benchmarks.lib.timers import Name, Timers
from benchmarks.speed.bench import Bench

SECTION = "share"

# A phase lasts while one of its functions runs, except for phases inside it; the rest is the outer loop.
PHASES = {
    "paths sought": ("torchgco.roadmap.roadmap.Roadmap.paths",),
    "paths tracked": ("torchgco.search.following.Follow.along",),
    "candidates relaxed": ("torchgco.search.proposals.PathProposals.relax",),
    "candidates refined": ("torchgco.search.candidates.Candidates.refined",),
    "rest of the proposal": ("torchgco.search.proposals.PathProposals.improve",),
    "plans sampled": ("torchgco.guidance.mppi.MPPI.improve",),
    "tubes solved": ("torchgco.search.tube.Tube._some",),
    "tightened": ("torchgco.search.finish.Converge.run", "torchgco.search.finish.ClearChords.run"),
    "verdict": ("torchgco.solvers.session.Session.finished",),
    "packed for C": ("torchgco.native.engine.Engine.packed", "torchgco.native.engine.Engine.terms"),
    "set-up": ("torchgco.native.engine.Engine.__init__",),
}
OUTER = "outer loop"
# These call the native libraries; an argument is the native function or its name.
CALLS = (
    "torchgco.kernels.outer.run",
    "torchgco.native.engine.run",
    "torchgco.native.interior.run",
    "torchgco.native.engine.run",
    "torchgco.roadmap.cheapest.GraphSearch._run",
)
PYTHON = "Python and PyTorch"


def _native(before: tuple[str, str], args: tuple[Any, ...]) -> tuple[str, str]:
    """The phase that runs, and the native function."""
    return before[0], next((arg for arg in args if isinstance(arg, str)), None) or args[0].__name__


PLACES: dict[str, Name] = {
    place: lambda _, __, phase=phase: (phase, PYTHON) for phase, places in PHASES.items() for place in places
}
PLACES |= dict.fromkeys(CALLS, _native)


def run(bench: Bench) -> None:
    large, alone = bench.sizes.share_batch, bench.sizes.share_alone
    for name in ("forest30", "planar_trap"):
        _measure(bench, name, large, 1)
        _measure(bench, name, 1, alone)


def _measure(bench: Bench, name: str, batch: int, solves: int) -> None:
    """Time some solves of new problems, in a process that has solved others."""
    setup = bench.setup(*FAMILIES[name].generated)
    bench.warm(setup, setup.task(setup.scenario.draw([batch * solves, batch * solves + 1], setup.seed)))
    starts = range(0, batch * solves, batch)
    tasks = [setup.task(setup.scenario.draw(range(i, i + batch), setup.seed)) for i in starts]
    timers = Timers((OUTER, PYTHON), bench.wait)
    with timers.running(PLACES):
        for task in tasks:
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
            bench.row(SECTION, case, phase, "native calls", calls / solves)
            bench.row(SECTION, case, phase, "per problem", 1000 * sum(own.values()) / (batch * solves), "ms")
