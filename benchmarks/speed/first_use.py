"""The time of a first use: `import torchgco`, and a model's first solve with an empty and a full cache folder.

`python -m benchmarks.speed.first_use MODEL` is such a process: it prints what `measure` returns as JSON.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from statistics import median
from typing import TYPE_CHECKING

import torch

import torchgco
from benchmarks.lib import ROOT
from torchgco import MPPI, presets
from torchgco.base.draws import DrawKey
from torchgco.kernels import kernels_of
from torchgco.problem.problem import Problem

if TYPE_CHECKING:
    from benchmarks.speed.bench import Bench  # a process that measures a first solve loads nothing else

SECTION = "first_use"
IMPORTS = 5  # number; their median counts
IMPORT = "import time; t = time.process_time(); import {}; print(time.process_time() - t)"
MODELS = {
    "Planar": lambda: torchgco.Planar(dt=0.05),
    "QuadrotorPlanning": lambda: torchgco.QuadrotorPlanning(dt=0.05),
    "QuadrotorPlant": lambda: torchgco.QuadrotorPlant(dt=0.05),
    "RotorTracking": lambda: torchgco.RotorTracking(dt=0.05),
}


def run(bench: Bench) -> None:
    for module in ("torchgco", "torch"):
        times = [float(started(["-c", IMPORT.format(module)], {})) for _ in range(IMPORTS)]
        bench.row(SECTION, f"import {module}", "python", "seconds", median(times), "s")
    for name in list(MODELS)[: bench.sizes.models]:
        with tempfile.TemporaryDirectory() as folder:
            for cache in ("empty", "full"):
                found = json.loads(started(["-m", "benchmarks.speed.first_use", name], {"TORCHGCO_CACHE": folder}))
                for quantity, seconds in found.items():
                    bench.row(SECTION, f"{name}, cache {cache}", "torchgco.solve", quantity, seconds, "s")


def started(words: list[str], environment: dict[str, str]) -> str:
    """The last line that a new Python process prints.

    Raises:
        RuntimeError: the process failed.
    """
    done = subprocess.run(
        [sys.executable, *words], cwd=ROOT, capture_output=True, text=True, env={**os.environ, **environment}
    )
    if done.returncode != 0:
        raise RuntimeError(f"{words} ended with {done.returncode}: {done.stderr[-2000:]}")
    return done.stdout.splitlines()[-1]


def measure(name: str) -> dict[str, float]:
    """Processor seconds, compilers included, by name; for "both, wall" elapsed seconds."""
    problem = _problem(name)
    from benchmarks.speed.batch import limited

    solver = limited(presets.gco(problem))
    engine = _took(lambda: kernels_of(problem))
    first, again = (_took(lambda: solver.solve(problem, _controls(problem))) for _ in range(2))
    rest = [max(0.0, a - b) for a, b in zip(first, again, strict=True)]
    key = DrawKey(0, torch.arange(problem.B), torch.arange(problem.B))
    sampler = _took(lambda: MPPI(samples=1, dtype="float32").improve(problem, _controls(problem), key))
    return {
        "kernels": engine[0],
        "more by the first solve": rest[0],
        "both": engine[0] + rest[0],
        "both, wall": engine[1] + rest[1],
        "where it samples, further": sampler[0],
    }


def _problem(name: str) -> Problem:
    """One problem from rest; with an obstacle near the straight line where the model has a position."""
    dynamics = MODELS[name]()
    n, m, at = dynamics.n, dynamics.m, dynamics.position
    x0 = torch.zeros(1, n, dtype=torch.float64)
    if n > 9:
        x0[:, 6] = 1.0  # upright
    goal = x0.clone()
    constraints: list = [torchgco.ControlBounds([-5.0] * m, [15.0] * m)]
    if at is not None:
        d = at.stop - at.start
        goal[:, at.start] = 3.0
        constraints.insert(0, torchgco.Spheres([[1.5] + [0.1] * (d - 1)], [0.3], 0.1))
    cost = torchgco.QuadraticCost(Q=[1.0] * n, R=[0.1] * m, Qf=[10.0] * n, x_ref=goal.unsqueeze(1))
    return Problem(dynamics, cost, constraints, x0, 40)


def _controls(problem: Problem) -> torch.Tensor:
    return problem.x0.new_zeros(1, problem.N, problem.m)


def _took(work: Callable) -> tuple[float, float]:
    """Processor seconds and elapsed seconds."""
    before, wall = _processor(), time.perf_counter()
    work()
    return _processor() - before, time.perf_counter() - wall


def _processor() -> float:
    """Processor seconds of this process and of its child processes that have ended."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(json.dumps(measure(sys.argv[1])))
