"""Other solvers on the first layouts of a task, one problem at a time: FATROP, IPOPT and acados.

All get the problem's own model, cost and constraints, traced. They start from the vehicle at rest, or from a trajectory
along the roadmap's best path, whose time counts. Only the controls of a peer's result are judged.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.lib import acados
from benchmarks.speed.bench import Bench, Took
from torchgco.base.errors import InputError
from torchgco.baselines import GuidedCasADi
from torchgco.judging.judge import Verdict, judge
from torchgco.scenarios import Task

GUIDED = "fatrop_guided"


def first(task: Task, count: int) -> Task:
    """The first problems of a task."""
    count = min(count, task.problem.B)
    rows = torch.arange(count, device=task.U0.device)
    return replace(
        task, problem=task.problem.take(rows), U0=task.U0[rows], goal=task.goal[rows],
        layouts=task.layouts.take(range(count)),
    )  # fmt: skip


@dataclass
class Peer(ABC):
    """A solver prepared for a few problems; its set-up is timed separately."""

    name: str
    task: Task
    setup: float = 0.0  # s
    times: list[Took] = field(default_factory=list)  # per problem, in every flight
    verdict: Verdict | None = None
    iterations: float = 0.0

    @abstractmethod
    def solve(self, bench: Bench) -> tuple[Tensor, float, Took]:
        """Controls (B, N, m) from the task's initial guess, mean iterations, and the time of all problems."""

    @property
    def count(self) -> int:
        return self.task.problem.B

    @property
    def took(self) -> Took:
        """Time per problem, the mean of all flights."""
        return sum(self.times, Took(0.0, 0.0)).each(len(self.times))

    @property
    def seconds(self) -> float:
        return self.took.seconds

    @property
    def spread(self) -> float:
        """Largest minus smallest of the flights' times, as a share of their mean."""
        times = [took.seconds for took in self.times]
        return (max(times) - min(times)) / self.seconds

    @property
    def per_reached(self) -> float:
        """Seconds per layout reached; infinite where none was reached."""
        reached = 0 if self.verdict is None else int(self.verdict.reached.sum())
        return self.seconds * self.count / reached if reached else float("inf")

    def fly(self, bench: Bench) -> None:
        """Solve all problems once more."""
        U, self.iterations, took = self.solve(bench)
        self.times.append(took.each(self.count))
        self.verdict = judge(self.task.problem, U, self.task.goal, self.task.goal_radius)
        bench.say(f"  {self.name} flew {self.count}: {self.times[-1].seconds:.3g} s per problem")

    def flies(self, bench: Bench, section: str, case: str) -> bool:
        """As `fly`; False, with a row that says why, where it fails."""
        try:
            self.fly(bench)
        except (InputError, RuntimeError) as error:
            bench.row(section, case, self.name, "ended with", str(error).strip().splitlines()[-1][:80])
            return False
        return True


@dataclass
class CasADiPeer(Peer):
    """FATROP or IPOPT through CasADi, with the settings of the configuration `name`."""

    prepared: Any = None

    @classmethod
    def ready(cls, bench: Bench, name: str, task: Task) -> CasADiPeer:
        solver = bench.setup(f"solver={name}", *_model(task)).solver
        prepared, took = bench.timed(lambda: solver.prepare(task.problem), compiling=True)
        if isinstance(solver, GuidedCasADi):
            warm = first(task, 1)
            solver.guess(warm.problem, warm.U0)  # compiles
        return cls(name, task, took.seconds, prepared=prepared)

    def solve(self, bench: Bench) -> tuple[Tensor, float, Took]:
        solution, took = bench.timed(lambda: self.prepared.solve(self.task.problem, self.task.U0))
        return solution.U, float(solution.iterations.double().mean()), took


@dataclass
class AcadosPeer(Peer):
    """acados in its separate environment, from the vehicle at rest or from the guess of `fatrop_guided`."""

    folder: Path = Path()  # where it writes and compiles
    guided: GuidedCasADi | None = None

    @classmethod
    def ready(cls, bench: Bench, name: str, task: Task, folder: Path) -> AcadosPeer:
        guided = bench.setup(f"solver={GUIDED}", *_model(task)).solver if name.endswith("guided") else None
        return cls(name, task, folder=folder / name, guided=guided)

    def solve(self, bench: Bench) -> tuple[Tensor, float, Took]:
        problem, U, took = self.task.problem, self.task.U0, Took(0.0, 0.0)
        if self.guided is not None:
            guided = self.guided
            guess, took = bench.timed(lambda: guided.guess(problem, self.task.U0))
            U = guess.U
        answer = acados.fly(problem, U, self.folder)
        self.setup = self.setup or answer.setup
        own = Took(float(answer.processor.sum()), float(answer.wall.sum()))
        return answer.U, float(answer.iterations.mean()), took + own


def _model(task: Task) -> tuple[str, ...]:
    """The override that composes a solver's settings for the task's model."""
    return ("model=planar", "scenario=planar_trap") if task.layouts.dimension == 2 else ()
