"""The estimated memory of a batch against the memory measured."""

import io
import subprocess
import sys
import warnings

import pytest
import torch

from tests.engines import engine_of
from tests.problems import planar_batch, quadrotor_batch
from torchgco import (
    Constraint,
    ControlBounds,
    FreeTime,
    FunctionDynamics,
    InputError,
    Integral,
    Link,
    Problem,
    QuadraticCost,
    RateBounds,
)
from torchgco.base.memory import free_memory
from torchgco.native.compiler import find_compiler
from torchgco.solvers.memory import (
    CPU_LIMIT,
    element_bytes,
    is_out_of_memory,
    least_bytes,
    plan_batch,
)

PEAK = """
import torch
from tests.problems import quadrotor_batch
from torchgco import AugmentedLagrangian, ILQR
torch.set_num_threads(1)
def peak(B):
    problem, U0 = quadrotor_batch(B=B, N=40, obstacles=20)
    AugmentedLagrangian(inner=ILQR(max_iterations=1), max_outer_iterations=2).solve(problem, U0)
    status = dict(line.split(":", 1) for line in open("/proc/self/status"))
    return int(status["VmHWM"].split()[0]) * 1024
small = peak(2)
print((peak(402) - small) / 400)
"""


@pytest.mark.slow
def test_a_problem_takes_the_estimated_memory() -> None:
    problem, _ = quadrotor_batch(B=3, N=40, obstacles=20)
    done = subprocess.run([sys.executable, "-c", PEAK], capture_output=True, text=True, check=True)
    assert 0.5 < element_bytes(problem) / float(done.stdout) < 2.0


def test_a_plan_fits_the_memory_that_is_free(monkeypatch) -> None:
    problem, _ = planar_batch(B=2, N=30)
    need = element_bytes(problem)
    monkeypatch.setattr("torchgco.solvers.memory.free_memory", lambda: 40 * need)
    assert plan_batch(problem) == 20 and plan_batch(problem, "cpu", processes=4) == 5
    monkeypatch.setattr("torchgco.solvers.memory.free_memory", lambda: 0)
    assert plan_batch(problem) == 1
    monkeypatch.setattr("torchgco.solvers.memory.free_memory", lambda: 10**15)
    assert plan_batch(problem) == CPU_LIMIT
    with pytest.raises(InputError, match="processes"):
        plan_batch(problem, processes=0)


def test_running_out_of_memory_is_recognised() -> None:
    assert is_out_of_memory(MemoryError()) and is_out_of_memory(
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes")
    )
    assert not is_out_of_memory(RuntimeError("shapes differ"))


def test_free_memory_is_what_the_kernel_says(monkeypatch) -> None:
    text = "MemTotal:       16000000 kB\nMemFree:          100000 kB\nMemAvailable:    2000000 kB\n"
    monkeypatch.setattr("builtins.open", lambda path: io.StringIO(text) if path == "/proc/meminfo" else None)
    assert free_memory() == 2_000_000 * 1024


def test_the_estimate_is_that_of_one_problem() -> None:
    problem, _ = planar_batch(B=4, N=10, obstacles=3)
    X, U = torch.zeros(4, 11, 6).double(), torch.zeros(4, 10, 2).double()
    rows = sum(c.value(X, U)[0].numel() for c in problem.constraints)
    assert engine_of(problem) is not None
    assert element_bytes(problem) == least_bytes(10, 6, 2, rows)


@pytest.mark.sampled(2)
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize(
    "row", [Link(components=[2]), Integral(lambda x, u: u.square().sum(-1), most=9.0), RateBounds(-1.0, 1.0)]
)
@pytest.mark.parametrize("free", [False, True])
def test_rows_of_several_knots_are_compiled_in_the_solvers_form(row: Constraint, free: bool) -> None:
    """A warning said that PyTorch's kernels solve them, many times slower."""
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.1, "rk4")
    cost = QuadraticCost([1.0] * 4, [0.1] * 2, [1.0] * 4)
    time = FreeTime(0.5, 2.0, weight=1.0) if free else None
    problem = Problem(model, cost, [row, ControlBounds(-2.0, 2.0)], [[0.0] * 4], 10, time=time)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert 10 * 8 * 10 * 4 < element_bytes(problem) < 1e5
