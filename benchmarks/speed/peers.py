"""FATROP and IPOPT on the first layouts of a task, one after the other."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from typing import Any

import torch

from benchmarks.speed.bench import Bench
from torchgco.judge import Verdict, judge
from torchgco.scenarios import Task

HAVE_CASADI = find_spec("casadi") is not None


def first(task: Task, count: int) -> Task:
    """The first problems of a task."""
    rows = torch.arange(count, device=task.U0.device)
    return replace(
        task, problem=task.problem.take(rows), U0=task.U0[rows], goal=task.goal[rows],
        layouts=task.layouts.take(range(count)),
    )  # fmt: skip


@dataclass
class Peer:
    """A solver made ready for a few problems; its set-up is on no clock but its own."""

    name: str
    task: Task
    prepared: Any
    setup_seconds: float
    times: list[float] = field(default_factory=list)  # seconds a problem, of every flight
    verdict: Verdict | None = None
    iterations: float = 0.0

    @classmethod
    def ready(cls, bench: Bench, name: str, task: Task) -> Peer:
        solver = bench.setup(f"solver={name}").solver
        prepared, seconds = bench.timed(lambda: solver.prepare(task.problem))
        return cls(name, task, prepared, seconds)

    @property
    def count(self) -> int:
        return self.task.problem.B

    @property
    def seconds(self) -> float:
        """Seconds a problem, the mean of all flights."""
        return sum(self.times) / len(self.times)

    @property
    def spread(self) -> float:
        """Largest minus smallest of the flights' times, as a share of their mean."""
        return (max(self.times) - min(self.times)) / self.seconds

    def fly(self, bench: Bench) -> None:
        """Solve all problems once more, from the vehicle at rest."""
        solution, seconds = bench.timed(lambda: self.prepared.solve(self.task.problem, self.task.U0))
        self.times.append(seconds / self.count)
        self.verdict = judge(self.task.problem, solution.U, self.task.goal, self.task.goal_radius)
        bench.say(f"  {self.name} flew {self.count}: {self.times[-1]:.3g} s a problem")
        self.iterations = float(solution.iterations.double().mean())
