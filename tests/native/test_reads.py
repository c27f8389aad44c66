"""How often a solve waits for tensors: values that Python reads, copies between devices, calls of a device.

None of them is made for each problem, or a device would be waited for as often as there are problems.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode

import torchgco
from tests.native.test_cuda import Shims, shimmed
from tests.other_device import OTHER, SecondDevice
from tests.slow import mostly
from tests.test_elsewhere import problem_of
from torchgco import Problem
from torchgco.experiments.config.build import compose
from torchgco.kernels import choice
from torchgco.native.compiler import find_compiler
from torchgco.native.cuda.engine import OnDevice
from torchgco.solvers import interior

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
needs_gxx = pytest.mark.skipif(shutil.which("g++") is None, reason="no g++")
READERS = "item", "tolist", "__bool__", "__int__", "__float__", "__index__", "cpu", "equal"
MOST_READS = {"gco": 170, "al_ilqr": 64, "interior_point": 64}  # of a solve; 163, 58 and 58 were counted


class Reads(TorchFunctionMode):
    """Counts the calls of functions by which Python reads what tensors hold."""

    def __init__(self) -> None:
        super().__init__()
        self.made: Counter[str] = Counter()

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if (name := getattr(func, "__name__", "")) in READERS:
            self.made[name] += 1
        return func(*args, **(kwargs or {}))


def forests(repeats: int) -> Problem:
    """Three forests, each several times: all take the same passes and iterations."""
    task = compose(["scenario=forest", "study.layouts=3", "scenario.stages=30"]).task()
    return task.problem.take(torch.arange(3).repeat(repeats))


@pytest.mark.filterwarnings("ignore::torchgco.HorizonWarning", "ignore::torchgco.StepWarning")
@pytest.mark.parametrize("solver", mostly(["interior_point", "gco", "al_ilqr"], "gco", "al_ilqr"))
def test_values_are_not_read_for_each_problem(solver: str) -> None:
    made = []
    for repeats in (1, 8):
        torchgco.solve(forests(repeats), solver=solver, verbose=False)  # traces, which a second solve needs no more
        with Reads() as reads:
            torchgco.solve(forests(repeats), solver=solver, verbose=False)
        made.append(reads.made)
    assert 0 < made[1].total() <= min(made[0].total() + 2, MOST_READS[solver]), made


@needs_gxx
@pytest.mark.parametrize("solver", mostly(["interior_point", "al_ilqr"], "al_ilqr"))
def test_a_device_is_called_and_copied_to_as_often_for_many_problems(solver: str, monkeypatch) -> None:
    counted = []
    for repeats in (1, 4):
        shims = Shims()
        served = OnDevice(shims, 1)
        monkeypatch.setattr(choice, "on_device", lambda device, on=served: on if device == OTHER else None)
        with SecondDevice() as second:
            problem = problem_of(OTHER)[0].take(torch.arange(2, device=OTHER).repeat(repeats))
            second.moves = 0
            torchgco.solve(problem, solver=solver, verbose=False)
            counted.append((second.moves, sorted(kernel for shim in shims.made for kernel in shim.launched)))
    assert counted[0] == counted[1] and counted[0][1]


@needs_gxx
def test_a_device_has_all_problems_in_one_call(monkeypatch) -> None:
    """The CPU takes them in parts, each of which would be too few for a device."""
    many = lambda: problem_of("cpu")[0].take(torch.arange(2).repeat(3))
    solve: Callable[[], Any] = lambda: torchgco.solve(many(), solver="interior_point", verbose=False)
    expected = solve()
    monkeypatch.setattr(interior, "REPORTED_AT_ONCE", 2)
    assert torch.equal(solve().X, expected.X)
    with shimmed(least=6) as shims:
        found = solve()
    assert "kernel_tgco_interior" in shims.launched and torch.equal(found.X, expected.X)
