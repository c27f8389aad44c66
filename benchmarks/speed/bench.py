"""What a section is handed: sizes, a clock, a device, and a place for its rows."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import torch

from benchmarks.speed.results import MEASURED, Results
from benchmarks.speed.sizes import Sizes
from torchgco.experiments.build import Setup, compose
from torchgco.kernels import compile_kernels

T = TypeVar("T")
SEED = 1000  # of all drawn layouts


@dataclass
class Bench:
    """One run. Times are wall-clock seconds of this process, the device's work awaited."""

    sizes: Sizes
    results: Results | None = None  # None: rows are said, not kept
    source: dict[str, str] = field(default_factory=dict)  # the columns that all rows share
    device: str = "cpu"
    compiled: bool = False
    deadline: float = float("inf")  # on time.monotonic
    say: Callable[[str], None] = partial(print, flush=True)

    def setup(self, *overrides: str) -> Setup:
        """Model, scenario and solver as `torchgco` makes them from these overrides, at this run's sizes."""
        extra = [] if self.sizes.num_stages is None else [f"scenario.stages={self.sizes.num_stages}"]
        setup = compose([*extra, *overrides, f"seed={SEED}", f"device={self.device}"])
        limit = self.sizes.inner_iterations
        if limit is not None and hasattr(setup.solver, "inner"):
            inner = replace(setup.solver.inner, max_iterations=limit)
            setup = replace(setup, solver=replace(setup.solver, inner=inner, max_outer_iterations=2))
        return setup

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

    def timed(self, work: Callable[[], T]) -> tuple[T, float]:
        """What the work returns, and its seconds."""
        self.wait()
        began = time.perf_counter()
        result = work()
        self.wait()
        return result, time.perf_counter() - began

    def wait(self) -> None:
        if self.device == "cuda":
            torch.cuda.synchronize()

    def modes(self) -> Sequence[bool]:
        """Eager, and compiled where that is asked for."""
        return (False, True) if self.compiled else (False,)

    @contextmanager
    def mode(self, compiled: bool):
        """Kernels compiled for a while."""
        compile_kernels(compiled)
        try:
            yield
        finally:
            compile_kernels(False)
