"""What a section receives: sizes, clocks, a device, and a place for its rows."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import torch

from benchmarks.speed.results import MEASURED, Results
from benchmarks.speed.sizes import Sizes
from torchgco.experiments.build import Setup, compose
from torchgco.native.dispatch import engine_of
from torchgco.scenarios import Task

T = TypeVar("T")
SEED = 1000  # of all drawn layouts
WARM_UP = 2  # problems solved off the clock, for what is traced and compiled


@dataclass(frozen=True)
class Took:
    """How long something took, s."""

    seconds: float  # of the processor; on a GPU as `wall`. All ratios are of these
    wall: float  # by the clock on the wall

    def __add__(self, other: Took) -> Took:
        return Took(self.seconds + other.seconds, self.wall + other.wall)

    def each(self, count: int) -> Took:
        """The same for one of so many."""
        return Took(self.seconds / count, self.wall / count)


@dataclass
class Bench:
    """One run: what it measures, where, and how long it may take."""

    sizes: Sizes
    results: Results | None = None  # None: rows are said, not kept
    source: dict[str, str] = field(default_factory=dict)  # the columns that all rows share
    device: str = "cpu"
    deadline: float = float("inf")  # on time.monotonic
    say: Callable[[str], None] = partial(print, flush=True)

    def setup(self, *overrides: str) -> Setup:
        """Model, scenario and solver as `torchgco` makes them from these overrides, at this run's sizes."""
        extra = [] if self.sizes.num_stages is None else [f"scenario.stages={self.sizes.num_stages}"]
        setup = compose([*extra, *overrides, f"seed={SEED}", f"device={self.device}"])
        limit = self.sizes.inner_iterations
        return setup if limit is None else replace(setup, solver=limited(setup.solver, limit))

    def warm(self, setup: Setup, task: Task) -> None:
        """Trace and compile what the solver needs for these problems: solve the first ones, off the clock."""
        engine_of(task.problem)
        rows = torch.arange(min(WARM_UP, task.problem.B), device=task.U0.device)
        setup.solver.solve(task.problem.take(rows), task.U0[rows], seed=setup.seed)

    def row(self, section: str, case: str, solver: str, quantity: str, value: Any, unit: str = "", ratio: str = ""):
        """Keep and say one measurement; `ratio` names what was divided by what, where it is one."""
        shown = f"{value:.6g}" if isinstance(value, float) else str(value)
        row = dict(zip(MEASURED, (section, case, solver, quantity, shown, unit, ratio), strict=True))
        if self.results is not None:
            self.results.add({**row, **self.source})
        self.say(f"  {section}: {case}, {solver}: {quantity} {shown} {unit}".rstrip())

    def left(self) -> float:
        """Seconds until the run should be over."""
        return self.deadline - time.monotonic()

    def fits(self, section: str, case: str, seconds: float, share: float = 1.0) -> bool:
        """Whether a measurement of so many seconds takes at most this share of the time left; said where it doesn't."""
        if seconds <= share * self.left():
            return True
        self.row(section, case, "all", "left out: would take", seconds, "s")
        return False

    def timed(self, work: Callable[[], T]) -> tuple[T, Took]:
        """What the work returns, and how long it took, the device's work awaited."""
        self.wait()
        processor, wall = time.process_time(), time.perf_counter()
        result = work()
        self.wait()
        processor, wall = time.process_time() - processor, time.perf_counter() - wall
        return result, Took(wall if self.device == "cuda" else processor, wall)

    def wait(self) -> None:
        if self.device == "cuda":
            torch.cuda.synchronize()


def limited(solver: Any, iterations: int) -> Any:
    """The solver with two outer iterations of so many inner ones, where it is an augmented Lagrangian or uses one."""
    if hasattr(solver, "local"):
        return replace(solver, local=limited(solver.local, iterations))
    if not hasattr(solver, "inner"):
        return solver
    return replace(solver, inner=replace(solver.inner, max_iterations=iterations), max_outer_iterations=2)
