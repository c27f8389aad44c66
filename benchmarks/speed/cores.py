"""Problems per second of a large batch with one thread and with two, each in a process of its own.

`python -m benchmarks.speed.cores ORDER` is such a process: it prints the elapsed seconds per problem.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import asdict

import torch

from benchmarks.lib import ROOT
from benchmarks.speed.bench import Bench
from benchmarks.speed.sizes import Sizes

SECTION, SOLVER = "cores", "gco"
THREADS = (1, 2, 1)  # the first again at the end: if the machine's speed drifts, their mean doesn't favour either


def run(bench: Bench) -> None:
    batch, seconds = bench.sizes.cores_batch, {}
    if len(_cores()) < max(THREADS):
        bench.row(SECTION, f"B = {batch}", SOLVER, "left out: cores", str(len(_cores())))
        return
    for threads in THREADS:
        seconds.setdefault(threads, []).append(_started(bench, threads))
    mean = {threads: sum(all_) / len(all_) for threads, all_ in seconds.items()}
    for threads, took in mean.items():
        case = f"B = {batch}, threads: {threads}"
        bench.row(SECTION, case, SOLVER, "wall per problem", 1000 * took, "ms")
        bench.row(SECTION, case, SOLVER, "times one thread", mean[1] / took)


def _cores() -> set[int]:
    """The cores of this machine that this process could use: `_one_core` has left it one."""
    return set(range(os.cpu_count() or 1))


def _started(bench: Bench, threads: int) -> float:
    order = json.dumps({"threads": threads, "sizes": asdict(bench.sizes)})
    number = str(threads)
    environment = {**os.environ, "OMP_NUM_THREADS": number, "MKL_NUM_THREADS": number, "OPENBLAS_NUM_THREADS": number}
    words = [sys.executable, "-m", "benchmarks.speed.cores", order]
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    return float(done.stdout.splitlines()[-1])


def measure(threads: int, sizes: Sizes) -> float:
    """Elapsed seconds per problem of a batch of forests."""
    torch.set_num_threads(threads)
    bench = Bench(sizes, say=lambda text: None)
    setup = bench.setup("scenario=forest", f"device.threads={threads}")
    task = setup.task(setup.layouts(sizes.cores_batch))
    bench.warm(setup, task)
    _, took = bench.timed(lambda: setup.solver.solve(task.problem, task.U0, seed=setup.seed))
    return took.wall / sizes.cores_batch


if __name__ == "__main__":
    asked = json.loads(sys.argv[1])
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, set(sorted(_cores(), reverse=True)[: asked["threads"]]))
    print(measure(asked["threads"], Sizes(**asked["sizes"])))
