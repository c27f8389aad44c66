"""python -m benchmarks.endurance.overhead FOLDER LAYOUTS SHARD_SIZE: what a study costs besides its solves.

In one process with one thread, a study of one worker flies all layouts into FOLDER, and then direct calls fly the same
layouts, a batch per shard, without files. Prints processor seconds by phase as JSON: {"study": {...}, "direct": {...}}.
The time to import packages is in neither.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from pathlib import Path

import torch

from benchmarks.lib.timers import Timers
from torchgco import compose
from torchgco.experiments import app
from torchgco.experiments.flying import flight
from torchgco.kernels import kernels_of
from torchgco.solvers.memory import plan_batch

COMMON = ["solver=gco", "device.threads=1"]
FOLDER = "torchgco.experiments.results.folder.StudyFolder"
# A phase lasts while one of its functions runs, except for phases inside it.
PHASES = {
    "solve": ["torchgco.solvers.contracts.Solver.solve"],
    "judge": ["torchgco.experiments.flying.flight.judged_columns", "torchgco.experiments.flying.flight.certify"],
    "draw layouts": ["torchgco.scenarios.base.Scenario.draw"],
    "make problems": ["torchgco.scenarios.vehicle.Vehicle.task"],
    "progress": ["torchgco.experiments.flying.flight.SolveBatch._progress"],
    "digests": ["torchgco.experiments.flying.study.layout_digests"],
    "write shards": [f"{FOLDER}.keep"],
    "read shards": [
        f"{FOLDER}.flown", f"{FOLDER}.missing",
    ],
    "tables": [
        "torchgco.experiments.flying.study.with_success", f"{FOLDER}.finish",
        f"{FOLDER}.close",
    ],
    "report": ["torchgco.experiments.flying.study.write_report"],
}  # fmt: skip
FLIGHT, REPORT, REST = ("solve", "judge"), "report", "rest"


def direct(count: int, shard_size: int) -> None:
    """Fly and judge the layouts, a batch per shard."""
    setup = compose([*COMMON, f"study.layouts={count}"])
    layouts = setup.layouts()
    for begin in range(0, count, shard_size):
        part = layouts.take(range(begin, min(count, begin + shard_size)))
        task = setup.vehicle.task(part)
        kernels_of(task.problem)
        solver = setup.solver.prepare(task.problem).in_slots(plan_batch(task.problem))
        solution = solver.solve(task.problem, task.U0, seed=setup.seed, ids=torch.as_tensor(part.ids))
        verdict, _ = flight.judged_columns(task, solution.U, None)
        flight.certify(task.problem, solution.X, solution.U, verdict.feasible)


def sharded(folder: Path, count: int, shard_size: int) -> None:
    """Fly the same layouts as a study."""
    words = [*COMMON, "study.baselines=[]", "study.workers=1", f"study.layouts={count}"]
    sys.argv = ["torchgco", *words, f"study.shard_size={shard_size}", f"hydra.run.dir={folder}"]
    with open(os.devnull, "w") as sink, contextlib.redirect_stdout(sink), contextlib.redirect_stderr(sink):
        if app.main() != 0:
            raise RuntimeError("the study failed")


def main() -> int:
    folder, count, shard_size = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    direct(2, 2)  # imports, and kernels compiled or loaded
    timed = {}
    named = {place: lambda _, __, phase=phase: phase for phase, places in PHASES.items() for place in places}
    works = {"study": lambda: sharded(folder, count, shard_size), "direct": lambda: direct(count, shard_size)}
    for name, work in works.items():
        timers = Timers(REST)
        with timers.running(named):
            work()
        timed[name] = dict(timers.seconds)
    print(json.dumps(timed))
    return 0


if __name__ == "__main__":
    sys.exit(main())
