"""The context of a section: sizes, clocks, a device, and a store for its rows."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import torch

from benchmarks.speed.results import MEASURED, Results
from benchmarks.speed.sizes import Sizes
from torchgco.base import clock
from torchgco.experiments.config.build import Setup, compose
from torchgco.judging.judge import Verdict
from torchgco.kernels import kernels_of
from torchgco.scenarios import Task

T = TypeVar("T")
SEED = 1000  # of all drawn layouts
WARM_UP = 2  # problems solved untimed, so that everything is traced and compiled


@dataclass(frozen=True)
class Took:
    """How long something took, s."""

    seconds: float  # processor time; on a GPU the same as `wall`. All ratios use it
    wall: float  # elapsed time

    def __add__(self, other: Took) -> Took:
        return Took(self.seconds + other.seconds, self.wall + other.wall)

    def each(self, count: int) -> Took:
        """The time per item, for `count` items."""
        return Took(self.seconds / count, self.wall / count)


@dataclass
class Bench:
    """One run: its sizes, device, results and time limit."""

    sizes: Sizes
    results: Results | None = None  # None: rows are printed, not kept
    source: dict[str, str] = field(default_factory=dict)  # the columns that all rows share
    device: str = "cpu"
    deadline: float = float("inf")  # by time.monotonic, s
    say: Callable[[str], None] = partial(print, flush=True)

    def setup(self, *overrides: str) -> Setup:
        """Model, scenario and solver that `torchgco` composes from these overrides, at this run's sizes."""
        extra = [] if self.sizes.num_stages is None else [f"scenario.stages={self.sizes.num_stages}"]
        setup = compose([*extra, *overrides, f"seed={SEED}", f"device={self.device}"])
        limit = self.sizes.inner_iterations
        return setup if limit is None else replace(setup, solver=limited(setup.solver, limit))

    def warm(self, setup: Setup, task: Task) -> None:
        """Trace and compile everything that the solver needs for these problems: solve the first two, untimed."""
        kernels_of(task.problem)
        rows = torch.arange(min(WARM_UP, task.problem.B), device=task.U0.device)
        setup.solver.solve(task.problem.take(rows), task.U0[rows], seed=setup.seed)

    def row(self, section: str, case: str, solver: str, quantity: str, value: Any, unit: str = "", ratio: str = ""):
        """Store and print one measurement; for a ratio, `ratio` names dividend and divisor."""
        shown = f"{value:.6g}" if isinstance(value, float) else str(value)
        row = dict(zip(MEASURED, (section, case, solver, quantity, shown, unit, ratio), strict=True))
        if self.results is not None:
            self.results.add({**row, **self.source})
        self.say(f"  {section}: {case}, {solver}: {quantity} {shown} {unit}".rstrip())

    def times(self, section: str, case: str, solver: str, took: Took) -> None:
        """Rows of the time per problem."""
        self.row(section, case, solver, "seconds per problem", took.seconds, "s")
        self.row(section, case, solver, "wall", took.wall, "s")

    def counts(self, section: str, case: str, solver: str, verdict: Verdict) -> None:
        """Rows of what the judge counts."""
        for quantity, hits in (("feasible", verdict.feasible), ("reached", verdict.reached)):
            self.row(section, case, solver, quantity, f"{int(hits.sum())}/{hits.numel()}")
        cost = verdict.cost[verdict.reached]
        self.row(section, case, solver, "median cost", float(cost.quantile(0.5)) if cost.numel() else "")

    def left(self) -> float:
        """Seconds until the deadline."""
        return self.deadline - time.monotonic()

    def fits(self, section: str, case: str, seconds: float, share: float = 1.0) -> bool:
        """Whether `seconds` are at most `share` of the time left; otherwise a row says that the case is left out."""
        if seconds <= share * self.left():
            return True
        self.row(section, case, "all", "left out: would take", seconds, "s")
        return False

    def timed(self, work: Callable[[], T], compiling: bool = False) -> tuple[T, Took]:
        """The result of `work`, and its time, until the device has finished, with or without tracing and compiling.

        Python's garbage is collected before, not in the middle: most of it is of the peers' models.
        """
        gc.collect()
        gc.disable()
        self.wait()
        clocks = (time.process_time, time.perf_counter) if compiling else (clock.processor_seconds, clock.seconds)
        began = [now() for now in clocks]
        result = work()
        self.wait()
        processor, wall = (now() - before for now, before in zip(clocks, began, strict=True))
        gc.enable()
        return result, Took(wall if self.device == "cuda" else processor, wall)

    def wait(self) -> None:
        if self.device == "cuda":
            torch.cuda.synchronize()


def limited(solver: Any, iterations: int) -> Any:
    """The solver with 2 outer iterations of at most `iterations` inner ones, where it has an augmented Lagrangian."""
    if hasattr(solver, "local"):
        return replace(solver, local=limited(solver.local, iterations))
    if not hasattr(solver, "inner"):
        return solver
    return replace(solver, inner=replace(solver.inner, max_iterations=iterations), max_outer_iterations=2)
