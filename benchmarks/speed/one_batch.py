"""One batch size in a separate process, which `batch` starts: only so can its peak memory be measured."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from benchmarks.speed.bench import Bench, Took
from benchmarks.speed.sizes import Sizes
from torchgco.experiments.config.build import Setup
from torchgco.native.dispatch import engine_of
from torchgco.problem.problem import Problem
from torchgco.search import Restarts


def measure(order: dict[str, Any]) -> dict[str, Any]:
    """Seconds and iterations per problem, and the peak memory above the start, in bytes (None: unknown)."""
    sizes = Sizes(**order["sizes"])
    bench = Bench(sizes, device=order["device"])
    setup = bench.setup("scenario=forest")
    if order["limited"]:
        setup = replace(setup, solver=_limited(setup.solver))
    batch = order["batch"]
    _warm_up(setup, min(batch, 2))
    held = _start_of_memory(bench.device)
    total, iterations, flown = Took(0.0, 0.0), 0, 0
    # A mean of few problems is uncertain: small batches repeat until `fewest_layouts` layouts are flown.
    while flown < max(batch, sizes.fewest_layouts):
        problem, U0 = _problem(setup, flown, batch)
        engine_of(problem)
        solution, took = bench.timed(lambda p=problem, U=U0: setup.solver.solve(p, U, seed=setup.seed))
        total, iterations, flown = total + took, iterations + int(solution.iterations.sum()), flown + batch
    peak = _peak_of_memory(bench.device)
    above = None if held is None or peak is None else max(0, peak - held)
    return {"seconds": total.each(flown).seconds, "iterations": max(1.0, iterations / flown), "bytes": above}


def _problem(setup: Setup, start: int, batch: int) -> tuple[Problem, torch.Tensor]:
    task = setup.task(setup.scenario.draw(range(start, start + batch), setup.seed))
    return task.problem, task.U0


def _warm_up(setup: Setup, batch: int) -> None:
    """Solve once, so that kernels are compiled and one-time memory is allocated."""
    problem, U0 = _problem(setup, 0, batch)
    _limited(setup.solver).solve(problem, U0)


def _limited(solver: Restarts) -> Restarts:
    """Two outer iterations, and one attempt."""
    return replace(solver, local=replace(solver.local, max_outer_iterations=2), attempts=1)


def _start_of_memory(device: str) -> int | None:
    """Bytes held now; restarts the measurement of the peak. None: unknown."""
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        return torch.cuda.memory_allocated()
    try:
        Path("/proc/self/clear_refs").write_text("5")  # resets VmHWM
    except OSError:
        return None
    return _memory("VmRSS")


def _peak_of_memory(device: str) -> int | None:
    return torch.cuda.max_memory_allocated() if device == "cuda" else _memory("VmHWM")


def _memory(name: str) -> int | None:
    """Bytes, from Linux' status of this process; None where there is no such file."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith(name)), None)


if __name__ == "__main__":
    print(json.dumps(measure(json.loads(sys.argv[1]))))
