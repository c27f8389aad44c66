"""One problem alone: how long until there is a plan, from nothing and from the plan before."""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import replace
from statistics import mean

import torch
from torch import Tensor

from benchmarks.speed.bench import Bench
from benchmarks.speed.peers import HAVE_CASADI, Peer
from torchgco.experiments.build import Setup
from torchgco.judge import judge
from torchgco.lagrangian import Multipliers
from torchgco.scenarios import Task
from torchgco.solution import Solution

SECTION = "latency"
SHARE = 0.15  # of the time left, what a layout may take

Times = dict[tuple[str, str], list[float]]  # by start and solver
Counts = dict[tuple[str, str], list[bool]]


def run(bench: Bench) -> None:
    setup = bench.setup("scenario=forest")
    tasks = [setup.task(setup.scenario.draw([i], setup.seed)) for i in range(bench.sizes.latency_layouts)]
    for compiled in bench.modes():
        with bench.mode(compiled):
            _measure(bench, setup, tasks, "gco, compiled" if compiled else "gco")


def _measure(bench: Bench, setup: Setup, tasks: list[Task], name: str) -> None:
    """Layout by layout, as many as fit into the time: cold, then from what that gave."""
    first = 0.0
    if name != "gco":
        first = bench.timed(lambda: setup.solver.solve(tasks[0].problem, tasks[0].U0))[1]
    seconds, feasible, known = defaultdict(list), defaultdict(list), 0.0
    for task in tasks:
        if not bench.fits(SECTION, "a further layout", known, SHARE):
            break
        began = time.monotonic()
        solution = None
        for start in ("cold", "warm"):
            posed = task if solution is None else _next(task, solution)
            warm = None if solution is None else _shifted(solution.multipliers)
            peer = Peer.ready(bench, "fatrop", posed) if HAVE_CASADI else None
            if peer is not None:
                peer.fly(bench)
            solution, took = bench.timed(lambda p=posed, w=warm: setup.solver.solve(p.problem, p.U0, warm=w))
            seconds[start, name].append(took)
            feasible[start, name].append(_is_feasible(posed, solution.U))
            if peer is not None:
                peer.fly(bench)
                seconds[start, "fatrop"].append(peer.seconds)
                feasible[start, "fatrop"].append(bool(peer.verdict.feasible.all()))
        known = time.monotonic() - began
    _say(bench, name, seconds, feasible)
    if name != "gco":
        bench.row(SECTION, "cold", name, "compilation", max(0.0, first - seconds["cold", name][0]), "s")


def _say(bench: Bench, name: str, seconds: Times, feasible: Counts) -> None:
    for (start, solver), times in seconds.items():
        beside = solver if solver == name or name == "gco" else f"{solver}, beside compiled"
        bench.row(SECTION, start, beside, "mean", 1000 * mean(times), "ms")
        bench.row(SECTION, start, beside, "longest", 1000 * max(times), "ms")
        bench.row(SECTION, start, beside, "feasible", f"{sum(feasible[start, solver])}/{len(times)}")
        if solver == "fatrop":
            ratio = mean(times) / mean(seconds[start, name])
            bench.row(SECTION, start, name, "seconds fatrop / gco", ratio, "", f"fatrop / {name}")


def _is_feasible(task: Task, U: Tensor) -> bool:
    return bool(judge(task.problem, U, task.goal, task.goal_radius).feasible.all())


def _next(task: Task, solution: Solution) -> Task:
    """The problem one stage later, with the plan that is left and its last control again."""
    return replace(task, problem=replace(task.problem, x0=solution.X[:, 1]), U0=_shift(solution.U))


def _shifted(multipliers: Multipliers) -> Multipliers:
    return Multipliers(tuple(_shift(lam) for lam in multipliers.lam), multipliers.mu)


def _shift(values: Tensor) -> Tensor:
    """Knot k takes what belonged to k + 1; the last one stays."""
    return torch.cat((values[:, 1:], values[:, -1:]), dim=1)
