"""The time to solve a single problem, cold and from the previous solution, the latter also by a compiled problem."""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import dataclass, field, replace
from statistics import mean
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchgco
from benchmarks.speed.bench import Bench, Took
from benchmarks.speed.peers import CasADiPeer
from torchgco.baselines import CasADiSolver
from torchgco.baselines.casadi import PreparedCasADi
from torchgco.experiments.config.build import Setup
from torchgco.judging.judge import Verdict, judge
from torchgco.kernels import kernels_of, open_loop
from torchgco.lagrangian.lagrangian import Multipliers, shifted
from torchgco.scenarios import Task
from torchgco.solution import Solution

SECTION = "latency"
SHARE = 0.15  # of the time left that a layout may take
# As in the loops (`benchmarks.speed.loop_peers`): with its default barrier multipliers save FATROP little.
WARM = CasADiSolver("fatrop", tolerance=1e-6, options={"mu_init": 1e-3})


@dataclass
class Flights:
    """Flights of one solver from one kind of start."""

    times: list[Took] = field(default_factory=list)
    setups: list[float] = field(default_factory=list)
    verdicts: list[Verdict] = field(default_factory=list)

    def add(self, took: Took, setup: float, verdict: Verdict) -> None:
        """Add one flight."""
        self.times.append(took)
        self.setups.append(setup)
        self.verdicts.append(verdict)

    def count(self, word: str) -> str:
        """The share of flights that are feasible, or reached, as "hits/count"."""
        return f"{sum(int(getattr(verdict, word).sum()) for verdict in self.verdicts)}/{len(self.verdicts)}"


@dataclass
class Continued(CasADiPeer):
    """FATROP one stage later: from the shifted controls, with its own multipliers and a small first barrier."""

    known: dict[str, Any] = field(default_factory=dict)  # arguments of its program

    @classmethod
    def after(cls, bench: Bench, task: Task, solution: Solution, following: Task) -> Continued:
        """It gets its multipliers where it continues from the solution of the stage before, untimed."""
        before, later = WARM.prepare(task.problem), following.problem
        prepared, took = bench.timed(lambda: WARM.prepare(later), compiling=True)
        assert isinstance(before, PreparedCasADi) and isinstance(prepared, PreparedCasADi)
        found = before.function(**_arguments(before, solution.X, solution.U))
        known = _arguments(prepared, open_loop(later, following.U0), following.U0)
        multipliers = {"lam_x0": found["lam_x"], "lam_g0": found["lam_g"]}
        return cls("fatrop", following, took.seconds, prepared=prepared, known=known | multipliers)

    def solve(self, bench: Bench) -> tuple[Tensor, float, Took]:
        found, took = bench.timed(lambda: self.prepared.function(**self.known))
        problem, stages = self.task.problem, np.array(found["x"]).ravel()[: -self.task.problem.n]
        U = torch.from_numpy(stages).view(1, problem.N, -1)[..., problem.n :].contiguous()
        return U, float(self.prepared.function.stats()["iter_count"]), took


def _arguments(prepared: PreparedCasADi, X: Tensor, U: Tensor) -> dict[str, Any]:
    """Guess, numbers and bounds of one problem, as CasADi's function takes them."""
    numbers = prepared.program.values(prepared.problem, 0)
    lower, upper = prepared.program.limits.bounds(numbers, prepared.program.variables.numel())
    guess = torch.cat((torch.cat((X[0, :-1], U[0]), dim=-1).flatten(), X[0, -1]))
    equal = np.asarray(prepared.program.equality)
    rows = {"lbg": np.where(equal, 0.0, -np.inf), "ubg": np.zeros(len(equal))}
    return {"x0": guess.numpy(), "p": numbers, "lbx": lower, "ubx": upper, **rows}


AllFlights = defaultdict[tuple[str, str], Flights]  # by start and solver


def run(bench: Bench) -> None:
    """Measure as many layouts as fit into the time: cold, then warm from the cold solution."""
    setup = bench.setup("scenario=forest")
    tasks = [setup.task(setup.scenario.draw([i], setup.seed)) for i in range(bench.sizes.latency_layouts)]
    bench.warm(setup, tasks[0])
    flights: AllFlights = defaultdict(Flights)
    known = 0.0
    for task in tasks:
        if not bench.fits(SECTION, "a further layout", known, SHARE):
            break
        began = time.monotonic()
        solution = _fly(bench, setup, CasADiPeer.ready(bench, "fatrop", task), "cold", None, flights)
        following = _next(task, solution)
        peer = Continued.after(bench, task, solution, following)
        _fly(bench, setup, peer, "warm", solution.multipliers.shifted(), flights)
        _fly_compiled(bench, task, following, flights)
        known = time.monotonic() - began
    _say(bench, flights)


def _fly(
    bench: Bench, setup: Setup, peer: CasADiPeer, start: str, warm: Multipliers | None, flights: AllFlights
) -> Solution:
    """Fly FATROP, `gco`, FATROP, so that a drift of the machine's speed cancels in the ratio."""
    task = peer.task
    peer.fly(bench)
    setup_time = bench.timed(lambda: kernels_of(task.problem), compiling=True)[1]
    solution, took = bench.timed(lambda: setup.solver.solve(task.problem, task.U0, seed=setup.seed, warm=warm))
    peer.fly(bench)
    assert peer.verdict is not None
    verdict = judge(task.problem, solution.U, task.goal, task.goal_radius)
    flights[start, "gco"].add(took, setup_time.seconds, verdict)
    flights[start, "fatrop"].add(peer.took, peer.setup, peer.verdict)
    return solution


def _fly_compiled(bench: Bench, task: Task, following: Task, flights: AllFlights) -> None:
    """The same step by a compiled problem, after its own first solve."""
    compiled = torchgco.compile(task.problem, receding=True)
    setup_time = bench.timed(compiled, compiling=True)[1]
    answer, took = bench.timed(lambda: compiled(x0=following.problem.x0))
    verdict = judge(following.problem, answer.U, following.goal, following.goal_radius)
    flights["warm", "compile"].add(took, setup_time.seconds, verdict)


def _say(bench: Bench, flights: AllFlights) -> None:
    means = {key: mean(took.seconds for took in mine.times) for key, mine in flights.items()}
    for (start, solver), mine in flights.items():
        bench.row(SECTION, start, solver, "mean", 1000 * means[start, solver], "ms")
        bench.row(SECTION, start, solver, "longest", 1000 * max(took.seconds for took in mine.times), "ms")
        bench.row(SECTION, start, solver, "mean wall", 1000 * mean(took.wall for took in mine.times), "ms")
        bench.row(SECTION, start, solver, "set-up", 1000 * mean(mine.setups), "ms")
        for word in ("feasible", "reached"):
            bench.row(SECTION, start, solver, word, mine.count(word))
        ratio = means[start, "fatrop"] / means[start, solver]
        if solver != "fatrop":
            bench.row(SECTION, start, solver, f"seconds fatrop / {solver}", ratio, "", f"fatrop / {solver}")


def _next(task: Task, solution: Solution) -> Task:
    """The problem one stage later, with the remaining controls and the last control repeated."""
    return replace(task, problem=replace(task.problem, x0=solution.X[:, 1]), U0=shifted(solution.U))
