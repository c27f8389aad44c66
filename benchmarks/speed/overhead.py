"""python -m benchmarks.speed.overhead: Python calls and time of a problem and its solves, forests beside FATROP.

Calls are those of the package's functions, in a run of their own; times are processor time of one thread, without a
collection of garbage.
"""

from __future__ import annotations

import gc
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import median
from types import FrameType
from typing import Any

import torch
from torch import Tensor

import torchgco
from benchmarks.lib.command import Command
from benchmarks.lib.families import FAMILIES
from benchmarks.lib.page import markdown
from benchmarks.speed.first_use import started
from benchmarks.speed.loop import rates
from torchgco import Bicycle, ControlBounds, FunctionCost, FunctionDynamics, Planar, Problem, QuadraticCost, Spheres
from torchgco.baselines import CasADiSolver
from torchgco.experiments.config.build import compose

HEAD = "case", "Python calls", "median, ms", "longest, ms", "FATROP, ms", "times as fast"
# A process's import, PyTorch apart, and first solve of a car: whole sources, as the import of this module loads more.
FIRST = """
import time, torch
began = time.process_time()
import torchgco
def rates(x, u):
    speed, heading = x[..., 3], x[..., 2]
    return torch.stack((speed * heading.cos(), speed * heading.sin(), speed * u[..., 1].tan() / 2.5, u[..., 0]), -1)
model = torchgco.FunctionDynamics(rates, 4, 2, 0.1, "rk4", position=slice(0, 2))
cost = torchgco.QuadraticCost(Q=[1, 1, 0, 0.1], R=[0.1, 0.1], Qf=[10, 10, 1, 1], x_ref=[3, 1, 0, 0])
problem = torchgco.Problem(model, cost, [torchgco.ControlBounds([-3, -0.5], [3, 0.5])], [[0.0] * 4], N=30)
torchgco.solve(problem)
print(1e3 * (time.process_time() - began))
"""
PACKAGE = str(Path(torchgco.__file__).parent)
CASES = "small", "functions", "bicycle", "forests", "first"
Case = tuple[str, Sequence[Callable[[], Any]], Sequence[Callable[[], Any]]]  # name, what is measured, and FATROP's


def counted(work: Callable[[], Any]) -> int:
    """How many functions of the package some work calls, comprehensions apart: some versions of Python inline these."""
    calls = Counter[bool]()

    def count(frame: FrameType, event: str, argument: Any) -> None:
        code = frame.f_code
        calls[event == "call" and code.co_filename.startswith(PACKAGE) and not code.co_name.startswith("<")] += 1

    sys.setprofile(count)
    try:
        work()
    finally:
        sys.setprofile(None)
    return calls[True]


def milliseconds(work: Callable[[], Any]) -> float:
    """Processor time of some work, without a collection of garbage in the middle."""
    gc.collect()
    gc.disable()
    try:
        began = time.process_time()
        work()
        return 1e3 * (time.process_time() - began)
    finally:
        gc.enable()


def small() -> Problem:
    """Two vehicles in the plane, past a disc."""
    cost = QuadraticCost(Q=[5, 5, 0, 1, 1, 0], R=[0.1, 0.1], Qf=[50, 50, 0, 1, 1, 0], x_ref=[1, 0.4, 0, 0, 0, 0])
    parts = [Spheres(centers=[[0.2, 0.1]], radii=[0.1], vehicle_radius=0.06), ControlBounds([-10, -10], [10, 10])]
    x0 = torch.tensor([[-1.0, 0, 0, 0, 0, 0], [-1.0, 0.1, 0, 0, 0, 0]], dtype=torch.float64)
    return Problem(Planar(dt=0.05), cost, parts, x0, N=120)


def effort(x: Tensor, u: Tensor) -> Tensor:
    return u.square().sum(-1) + (x[..., :2] - 3.0).square().sum(-1)


def distance(x: Tensor) -> Tensor:
    return 10.0 * (x[..., :2] - 3.0).square().sum(-1)


def slow(x: Tensor) -> Tensor:
    return x[..., 3:].square() - 9.0


def functions() -> Problem:
    """A car of a user's functions, of new parts."""
    parts = [torchgco.FunctionConstraint(slow), ControlBounds([-3.0, -0.5], [3.0, 0.5])]
    model = FunctionDynamics(rates, 4, 2, 0.1, "rk4", position=slice(0, 2))
    return Problem(model, FunctionCost(effort, distance), parts, torch.eye(4).double()[3:], 30)


def bicycle() -> Problem:
    cost = QuadraticCost(Q=[1, 1, 0, 0.1, 0], R=[0.1, 0.1], Qf=[50, 50, 0, 1, 0], x_ref=[6, 2, 0, 0, 0])
    return Problem(Bicycle(), cost, [ControlBounds([-2.0, -1.0], [2.0, 1.0])], torch.zeros(1, 5).double(), N=30)


def _of(name: str, make: Callable[[], Problem], solvers: Sequence[str], repeats: int) -> Iterator[Case]:
    """A problem, its solves, both together, and a compiled call."""
    problem = make()
    yield f"{name}: `Problem`", [make] * repeats, ()
    for solver in solvers:
        yield f"{name}: `solve`, `{solver}`", [lambda s=solver: torchgco.solve(problem, solver=s)] * repeats, ()
    yield f"{name}: both", [lambda: torchgco.solve(make(), solver=solvers[0])] * repeats, ()
    compiled = torchgco.compile(problem)
    compiled()
    yield f"{name}: a compiled call", [lambda: compiled(x0=problem.x0)] * repeats, ()


def _forests(count: int) -> Iterator[Case]:
    """Public forests of 30 spheres alone, each cold, and from its solution one stage later."""
    setup = compose(FAMILIES["forest30"].overrides())
    tasks = [setup.task(setup.scenario.draw([i], setup.seed)) for i in range(count)]
    problems, guesses = [task.problem for task in tasks], [task.U0 for task in tasks]
    found = [torchgco.solve(problem, U) for problem, U in zip(problems, guesses, strict=True)]
    later = [p.started_at(s.X[:, 1], p.constraints) for p, s in zip(problems, found, strict=True)]
    moved = [solution.shifted() for solution in found]
    cold = [lambda p=p, U=U: torchgco.solve(p, U) for p, U in zip(problems, guesses, strict=True)]
    warm = [lambda p=p, s=s: torchgco.solve(p, warm=s) for p, s in zip(later, moved, strict=True)]
    yield f"{count} forests alone, cold", cold, _fatrop(problems, guesses)
    yield f"{count} forests alone, warm", warm, _fatrop(later, [solution.U for solution in moved])


def _fatrop(problems: Sequence[Problem], guesses: Sequence[Tensor]) -> list[Callable[[], Any]]:
    peers = [CasADiSolver("fatrop").prepare(problem) for problem in problems]
    return [lambda q=q, p=p, U=U: q.solve(p, U) for q, p, U in zip(peers, problems, guesses, strict=True)]


def chosen(names: Sequence[str], repeats: int) -> Iterator[Case]:
    """The cases of these names, in their order."""
    if "small" in names:
        yield from _of("small", small, ("interior_point", "gco"), repeats)
    if "functions" in names:
        yield from _of("functions", functions, ("gco", "interior_point"), repeats)
    if "bicycle" in names:
        yield from _of("bicycle", bicycle, ("gco",), repeats)
    if "forests" in names:
        yield from _forests(repeats)


def row(case: Case) -> list[str]:
    """Calls of the first piece of work, and the times of all, FATROP's in between."""
    name, works, peers = case
    works[0]()
    calls = counted(works[0])
    own, theirs = list[float](), list[float]()
    for i, work in enumerate(works):
        work()
        theirs += [milliseconds(peers[i])] if peers else []
        own.append(milliseconds(work))
    peer = [f"{median(theirs):.1f}", f"{sum(theirs) / sum(own):.1f}"] if peers else ["-", "-"]
    return [name, f"{calls}", f"{median(own):.2f}", f"{max(own):.2f}", *peer]


def first(repeats: int) -> list[str]:
    """Processes that solve what another one has compiled before, as it has Python's modules."""
    with tempfile.TemporaryDirectory() as folder:
        own = {"TORCHGCO_CACHE": folder, "PYTHONPYCACHEPREFIX": folder, "PYTHONDONTWRITEBYTECODE": ""}
        took = [float(started(["-c", FIRST], own)) for _ in range(1 + repeats)][1:]
    name = "a process's import, PyTorch's apart, and first solve"
    return [name, "-", f"{median(took):.0f}", f"{max(took):.0f}", "-", "-"]


def table(cases: Sequence[str], repeats: int) -> str:
    """A row per case."""
    rows = [row(case) for case in chosen(cases, repeats)]
    return markdown(HEAD, [*rows, *([first(min(repeats, 5))] if "first" in cases else [])])


main = Command(
    __doc__, "overhead", table, "{repeats} repeats", "CasADi",
    cases=(CASES, "which, by default all", CASES), repeats=(16, "of each, or forests"),
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(main())
