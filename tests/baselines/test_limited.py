"""Peers end with a time limit, whatever their code does, and lose nothing else; no process outlives its parent."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.baselines.test_casadi import PLUGINS, three_problems
from tests.slow import mostly
from torchgco import Field, InputError, Problem, Status, solve
from torchgco.base.clock import processor_seconds
from torchgco.baselines import CasADiSolver
from torchgco.baselines.limited import limited
from torchgco.maps import OccupancyGrid

LIMIT = 4.0  # s; a solve takes hundredths


def hang() -> None:
    """Code of a library that never returns, and lets no Python code run."""
    ctypes.PyDLL(None).pause()


@dataclass
class HangsAt:
    """A plugin that hangs at a problem with these parameters."""

    function: Any
    at: np.ndarray

    def __call__(self, p: np.ndarray, **given: Any) -> Any:
        if np.array_equal(p, self.at):
            hang()
        return self.function(p=p, **given)

    def stats(self) -> dict[str, Any]:
        return self.function.stats()


@pytest.mark.parametrize("own", mostly([False, True], False))
@pytest.mark.parametrize(("plugin", "place"), [("ipopt", 2), ("fatrop", 0)])
def test_a_problem_that_hangs_ends_alone(plugin: str, place: int, own: bool) -> None:
    """By the limit of the whole solve, and by that of each problem; the others have the same bits as without one."""
    problem, U0 = three_problems()
    plain = CasADiSolver(plugin).prepare(problem)
    due, reports = plain.solve(problem, U0), []
    solver = replace(plain.solver, max_seconds=LIMIT if own else None)
    hangs = HangsAt(plain.function, plain.program.values(plain.problem, place))
    found = replace(plain, solver=solver, function=hangs).solve(
        problem, U0, max_seconds=None if own else LIMIT, callback=reports.append
    )
    others = [b for b in range(3) if b != place]
    assert found.statuses[place] == Status.TIME_LIMIT and torch.equal(found.U[place], U0[place])
    assert int(found.iterations[place]) == 0
    for name in ("U", "cost", "status", "iterations"):
        assert torch.equal(getattr(found, name)[others], getattr(due, name)[others])
    assert [(p.finished, p.total) for p in reports] == [(1, 3), (2, 3), (3, 3)]


@pytest.mark.parametrize("plugin", PLUGINS)
def test_no_time_is_a_time_limit(plugin: str) -> None:
    problem, U0 = three_problems()
    found = CasADiSolver(plugin).solve(problem, U0, max_seconds=1e-6)
    assert found.statuses == [Status.TIME_LIMIT] * 3 and torch.equal(found.U, U0)


@pytest.mark.parametrize("plugin", PLUGINS)
def test_a_map_is_refused_in_one_line(plugin: str) -> None:
    problem, _ = three_problems()
    empty = Field(OccupancyGrid(np.zeros((20, 20), dtype=bool), (-5.0, -5.0), 0.5), vehicle_radius=0.1)
    mapped = Problem(problem.dynamics, problem.cost, [empty], problem.x0, problem.N)
    with pytest.raises(InputError, match="take maps") as caught:
        solve(mapped, solver=plugin, verbose=False)
    assert "\n" not in str(caught.value)


def test_work_ends_at_its_limit_and_says_how_it_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    children, fork = [], os.fork

    def counted() -> int:
        children.append(fork())
        return children[-1]

    def fails() -> None:
        raise RuntimeError("crossed bounds")

    def endless() -> None:
        while True:
            pass

    monkeypatch.setattr(os, "fork", counted)
    assert limited(lambda: (np.ones(3).tolist(), "x" * 10**6), 60) == ([1.0] * 3, "x" * 10**6)
    for timer, work in ((signal.ITIMER_REAL, hang), (signal.ITIMER_PROF, endless)):
        with pytest.raises(TimeoutError, match=r"longer than 0\.2 s"):
            limited(work, 0.2, timer)
    with pytest.raises(ChildProcessError, match="ended with 3"):
        limited(lambda: sys.exit(3), 60)
    with pytest.raises(RuntimeError, match="crossed bounds"):
        limited(fails, 60)
    with pytest.raises(ChildProcessError, match="ended with"):
        limited(lambda: lambda: 0, 60)  # no value that can be sent
    assert len(children) == 6
    for child in children:  # none is left, whatever else other tests have started
        with pytest.raises(ChildProcessError):
            os.waitpid(child, os.WNOHANG)


PARENT = """
import os
from tests.baselines.test_limited import hang
from torchgco.baselines.limited import limited

def work():
    print(os.getpid(), flush=True)
    hang()

limited(work, 600.0)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a child of a killed process ends with its time")
@pytest.mark.parametrize(
    "number", mostly([signal.SIGINT, signal.SIGTERM, signal.SIGKILL], signal.SIGINT, signal.SIGTERM)
)
def test_no_process_outlives_its_parent(number: signal.Signals) -> None:
    with subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        parent.send_signal(number)
        assert parent.wait(60) != 0
    until = time.monotonic() + 60.0
    while _is_running(child) and time.monotonic() < until:
        time.sleep(0.05)
    assert not _is_running(child)


def _is_running(process: int) -> bool:
    try:
        with open(f"/proc/{process}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize("limit", [60.0, 0.2])
def test_the_clock_counts_what_a_child_uses(limit: float) -> None:
    """Benchmarks compare by it: a peer in a process of its own isn't free, nor is one that is ended."""

    def works() -> None:
        began = time.process_time()
        while time.process_time() - began < 0.4:
            pass

    began = processor_seconds()
    try:
        limited(works, limit, signal.ITIMER_PROF)
    except TimeoutError:
        assert limit < 0.4
    assert 0.5 * min(limit, 0.4) < processor_seconds() - began < 2.0
