"""Seconds and memory per problem as the batch grows, every batch in a separate process."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict

from benchmarks.lib.provenance import ROOT
from benchmarks.speed.bench import Bench

SECTION, SOLVER = "batch", "gco"
START = 10.0  # seconds that a process takes before it solves anything
SHARE = 0.15  # of the time left that one batch may take


def run(bench: Bench) -> None:
    for batches, limited in ((bench.sizes.whole_batches, False), (bench.sizes.limited_batches, True)):
        known = 0.0
        for batch in batches:
            case = f"B = {batch}{', 2 outer' if limited else ''}"
            # Estimated from the last batch: in a larger batch a problem takes no longer.
            seconds = START + known * max(batch, bench.sizes.fewest_layouts)
            if bench.fits(SECTION, case, seconds, SHARE):
                known = _measure(bench, case, batch, limited)


def _measure(bench: Bench, case: str, batch: int, limited: bool) -> float:
    """Start the process and read its last line; returns its seconds per problem, 0 where it failed."""
    order = {"batch": batch, "limited": limited, "device": bench.device}
    words = [sys.executable, "-m", "benchmarks.speed.one_batch", json.dumps({**order, "sizes": asdict(bench.sizes)})]
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
