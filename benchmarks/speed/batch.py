"""Seconds and memory per problem as the batch grows, every batch in a process of its own, to measure its peak memory.

`python -m benchmarks.speed.batch ORDER` is such a process: it prints what `measure` returns as JSON.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from benchmarks.lib import ROOT
from benchmarks.lib.families import EVERY
from benchmarks.speed.bench import Bench, Took
from benchmarks.speed.sizes import Sizes
from torchgco.experiments.config.build import Setup
from torchgco.kernels import kernels_of
from torchgco.scenarios import Task
from torchgco.search import FromProposal, FromSamples, PathProposals, Restarts, Row, Tube

SECTION, SOLVER = "batch", "gco"
WORLDS = ("woods40", "woods60")  # where a problem takes most time and memory
START = 10.0  # seconds that a process takes before it solves anything
SHARE = 0.15  # of the time left that one batch may take


def run(bench: Bench) -> None:
    for name in WORLDS if bench.sizes.world_batch else ():
        _started(bench, f"{name}, B = {bench.sizes.world_batch}", bench.sizes.world_batch, False, name)
    for batches, limited in ((bench.sizes.whole_batches, False), (bench.sizes.limited_batches, True)):
        known = 0.0
        for batch in batches:
            case = f"B = {batch}{', 2 outer' if limited else ''}"
            # Estimated from the last batch: in a larger batch a problem takes no longer.
            seconds = START + known * max(batch, bench.sizes.fewest_layouts)
            if bench.fits(SECTION, case, seconds, SHARE):
                known = _started(bench, case, batch, limited)


def _started(bench: Bench, case: str, batch: int, limited: bool, family: str = "forest30") -> float:
    """Start the process and read its last line; returns its seconds per problem, 0 where it failed."""
    order = {"batch": batch, "limited": limited, "family": family, "device": bench.device}
    words = [sys.executable, "-m", "benchmarks.speed.batch", json.dumps({**order, "sizes": asdict(bench.sizes)})]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    if done.returncode != 0:
        # Most likely killed, out of memory: a result, no reason to stop.
        bench.row(SECTION, case, SOLVER, "ended with", str(done.returncode))
        bench.say(done.stderr[-2000:])
        return 0.0
    measured = json.loads(done.stdout.splitlines()[-1])
    seconds = measured["seconds"]
    bench.row(SECTION, case, SOLVER, "per problem", 1000 * seconds, "ms")
    bench.row(SECTION, case, SOLVER, "per problem and iteration", 1000 * seconds / measured["iterations"], "ms")
    bench.row(SECTION, case, SOLVER, "problems per second", 1 / seconds, "1/s")
    if measured["bytes"] is not None:
        bench.row(SECTION, case, SOLVER, "peak memory", measured["bytes"] / 2**20, "MiB")
        bench.row(SECTION, case, SOLVER, "memory per problem", measured["bytes"] / 2**20 / batch, "MiB")
    return seconds


def measure(order: dict[str, Any]) -> dict[str, Any]:
    """Seconds and iterations per problem, and the peak memory above the start, in bytes (None: unknown)."""
    sizes = Sizes(**order["sizes"])
    bench = Bench(sizes, device=order["device"])
    setup = bench.setup(*EVERY[order["family"]].generated)
    if order["limited"]:
        setup = replace(setup, solver=limited(setup.solver))
    batch = order["batch"]
    warm = _task(setup, 0, min(batch, 2))
    limited(setup.solver).solve(warm.problem, warm.U0)  # compiles, and allocates what is allocated once
    held = _start_of_memory(bench.device)
    total, iterations, flown = Took(0.0, 0.0), 0, 0
    # A mean of few problems is uncertain: small batches repeat until `fewest_layouts` layouts are flown.
    while flown < max(batch, sizes.fewest_layouts):
        task = _task(setup, flown, batch)
        kernels_of(task.problem)
        solution, took = bench.timed(lambda t=task: setup.solver.solve(t.problem, t.U0, seed=setup.seed))
        total, iterations, flown = total + took, iterations + int(solution.iterations.sum()), flown + batch
    peak = _peak_of_memory(bench.device)
    above = None if held is None or peak is None else max(0, peak - held)
    return {"seconds": total.each(flown).seconds, "iterations": max(1.0, iterations / flown), "bytes": above}


def _task(setup: Setup, start: int, batch: int) -> Task:
    return setup.task(setup.scenario.draw(range(start, start + batch), setup.seed))


def limited(solver: Restarts) -> Restarts:
    """Two outer iterations, and one attempt: neither a second round of proposals nor other draws of samples."""
    passes, attempted = list[Row](), False
    for one in solver.passes.steps:
        again = isinstance(one, Tube) or (isinstance(one, FromProposal) and attempted)
        again |= isinstance(one, PathProposals) and one.when == "far"
        again |= isinstance(one, FromSamples) and one.when != "unproposed"
        attempted |= isinstance(one, FromProposal)
        passes += [] if again else [one]
    return replace(solver, local=replace(solver.local, max_outer_iterations=2), passes=passes)


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
