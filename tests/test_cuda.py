"""On a CUDA device PyTorch's kernels give the answers of the CPU's, within rounding, and those in CUDA C++ the bits of
C; skipped without a device.

`tests/test_other_device.py` finds mixed devices without hardware. These are the operations themselves.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor

import torchgco
from benchmarks.families.general_problems import FAMILIES
from tests.problems import planar_batch
from tests.test_elsewhere import learned
from tests.test_other_device import problem_of
from torchgco import (
    GCO,
    ILQR,
    MPPI,
    AugmentedLagrangian,
    ControlBounds,
    FunctionCost,
    FunctionDynamics,
    Goal,
    InputError,
    InteriorPoint,
    Problem,
    QuadraticCost,
    Solution,
    Spheres,
    certify,
    judge,
)
from torchgco.base.draws import DrawKey
from torchgco.kernels import use_native
from torchgco.native.cuda.compiler import Loaded, available
from torchgco.native.cuda.engine import OnDevice, working_on

pytestmark = [pytest.mark.cuda, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]
KINDS = "spheres", "boxes", "capsules", "oscillating", "map", "states", "function"
FEW = AugmentedLagrangian(ILQR(max_iterations=4), max_outer_iterations=3)


@pytest.fixture(autouse=True)
def eager() -> Iterator[None]:
    """The CPU solves with PyTorch's kernels, too."""
    use_native(False)
    yield
    use_native(True)


def assert_same(there: Solution, here: Solution, tolerance: float = 1e-6) -> None:
    assert there.U.device.type == "cuda" and there.statuses == here.statuses
    for name in ("X", "U", "cost", "violation"):
        torch.testing.assert_close(getattr(there, name).cpu(), getattr(here, name), rtol=tolerance, atol=tolerance)


def discs(device: str, B: int = 3) -> tuple[Problem, Tensor]:
    """Planar problems with discs and a goal, on a device."""
    problem, U0 = planar_batch(B=B, N=15, obstacles=4)
    spheres, bounds = problem.constraints
    cost = QuadraticCost([5, 5, 1e-8, 1, 1, 1e-8], [0.1, 0.1], [50, 50, 1e-8, 1, 1, 1e-8], x_ref=[1, 0.4, 0, 0, 0, 0])
    bodies = Spheres(
        torch.where(spheres.absent.unsqueeze(-1), torch.nan, spheres.centers).to(device),
        torch.where(spheres.absent, torch.nan, spheres.inflated_radii - 0.06).to(device), 0.06,
    )  # fmt: skip
    limits = ControlBounds(bounds.lower.to(device), bounds.upper.to(device))
    goal = Goal(torch.tensor([1.0, 0.4], dtype=torch.float64, device=device), 0.3)
    parts = [bodies, limits]
    return Problem(problem.dynamics, cost, parts, problem.x0.to(device), problem.N, goal), U0.to(device)


def test_guided_solves_agree() -> None:
    solver = AugmentedLagrangian(
        inner=ILQR(max_iterations=5), guidance=GCO(sampler=MPPI(samples=10)), max_outer_iterations=3
    )
    assert_same(solver.solve(*discs("cuda")), solver.solve(*discs("cpu")))


def test_the_default_solver_reaches_the_same_goals() -> None:
    """A search ends among several optima: rounding may choose, so verdicts and costs are compared, not trajectories."""
    (there, _), (here, _) = discs("cuda", 8), discs("cpu", 8)
    found, expected = (torchgco.solve(problem, verbose=False) for problem in (there, here))
    assert found.statuses == expected.statuses
    torch.testing.assert_close(found.cost.cpu(), expected.cost, rtol=1e-4, atol=0.0)
    verdict, same = judge(there, found.U), judge(here, expected.U)
    assert verdict.reached.device.type == "cuda" and verdict.reached.tolist() == same.reached.tolist()


@pytest.mark.parametrize("kind", KINDS)
def test_local_solves_are_judged_and_certified_alike(kind: str) -> None:
    (there, U_there), (here, U_here) = problem_of(kind, "cuda"), problem_of(kind, "cpu")
    found, expected = FEW.solve(there, U_there), FEW.solve(here, U_here)
    assert_same(found, expected)
    pairs = [(judge(there, found.U), judge(here, expected.U))]
    pairs += [(certify(there, found.X, found.U), certify(here, expected.X, expected.U))]
    for one, other in pairs:
        for name, value in vars(other).items():
            torch.testing.assert_close(getattr(one, name).cpu(), value, rtol=1e-4, atol=1e-5, equal_nan=True)


@pytest.mark.parametrize("kind", KINDS)
def test_the_interior_point_agrees(kind: str) -> None:
    solver = InteriorPoint(max_iterations=40)
    assert_same(solver.solve(*problem_of(kind, "cuda")), solver.solve(*problem_of(kind, "cpu")), 1e-5)


@pytest.mark.parametrize("name", ["pendulum", "cartpole", "landing", "bicycle_discs"])
def test_general_families_agree(name: str) -> None:
    """As a user makes them: with the GPU as PyTorch's default device."""
    here = FAMILIES[name].problem(0)
    with torch.device("cuda"):
        there = FAMILIES[name].problem(0)
    assert there.x0.device.type == "cuda"
    found, expected = (torchgco.solve(one, solver="interior_point", verbose=False) for one in (there, here))
    assert found.statuses == expected.statuses
    torch.testing.assert_close(found.cost.cpu(), expected.cost, rtol=1e-6, atol=1e-9)


def test_a_network_is_solved_and_compiling_for_the_gpu_refused() -> None:
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(3, 16), torch.nn.Tanh(), torch.nn.Linear(16, 2)).double()

    def problem(device: str) -> Problem:
        model = net.to(device)
        step = lambda x, u: x + 0.1 * torch.stack((x[..., 1], u[..., 0]), -1) + 0.05 * model(torch.cat((x, u), -1))
        cost = FunctionCost(
            lambda x, u: 0.1 * u.square().sum(-1) + x.square().sum(-1), lambda x: 10.0 * x.square().sum(-1)
        )
        x0 = torch.tensor([[1.0, 0.0], [0.5, 0.5]], dtype=torch.float64, device=device)
        return Problem(FunctionDynamics(step, 2, 1, 0.1), cost, [ControlBounds(-1.0, 1.0)], x0, 15)

    expected = torchgco.solve(problem("cpu"), verbose=False)
    there = problem("cuda")
    assert_same(torchgco.solve(there, verbose=False), expected)
    with pytest.raises(InputError, match="one on the CPU"):
        torchgco.compile(there, solver="interior_point")


def test_c_on_the_cpu_solves_problems_of_the_device() -> None:
    """By copies, with the CPU's bits; gradients lead back to tensors of the device."""
    use_native(True)
    grads = []
    for device in ("cuda", "cpu"):
        problem, _ = discs(device)
        x0 = problem.x0.clone().requires_grad_()
        solution = torchgco.solve(replace(problem, x0=x0), solver="interior_point", verbose=False)
        assert solution.X.device.type == device
        solution.X.square().sum().backward()
        grads.append((solution.X.detach().cpu(), x0.grad.cpu()))
    assert torch.equal(grads[0][0], grads[1][0])
    torch.testing.assert_close(grads[0][1], grads[1][1], rtol=1e-6, atol=1e-9)


def test_c_on_the_cpu_reads_what_functions_hold_on_the_device() -> None:
    use_native(True)
    found = [torchgco.solve(learned(device)[0], verbose=False) for device in ("cpu", "cuda")]
    assert [one.account and one.account.kernels for one in found] == ["native", "native"]
    assert found[1].X.device.type == "cuda" and torch.equal(found[0].X, found[1].X.cpu())
    answers = [torchgco.compile(learned(device)[0], "interior_point")(x0=[[0.0] * 4] * 2) for device in ("cpu", "cuda")]
    assert torch.equal(answers[0].X, answers[1].X)


def on_the_device() -> AbstractContextManager[None]:
    """A block in which kernels of the device serve however few problems."""
    use_native(True)
    return working_on(OnDevice(partial(Loaded, device=torch.device("cuda")), 1))


needs_kernels = pytest.mark.skipif(not available(), reason="no cuda-core")


@needs_kernels
@pytest.mark.parametrize("solver", ["al_ilqr", "interior_point", "gco"])
def test_kernels_of_the_device_have_the_bits_of_c(solver: str) -> None:
    found = []
    for block in (nullcontext, on_the_device):
        use_native(True)
        with block():
            found.append(torchgco.solve(*discs("cpu", 40), solver=solver, verbose=False))
    assert torch.equal(found[0].X, found[1].X) and torch.equal(found[0].cost, found[1].cost)


@needs_kernels
@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-12), ("float32", 1e-5)])
def test_samples_on_the_device_have_the_weights_of_c(dtype: str, tolerance: float) -> None:
    """But for exp, which rounds otherwise there."""
    sampler, found = MPPI(samples=1000, rounds=3, noise_knots=5, elite=4, covariance=0.5, dtype=dtype), []
    for block in (nullcontext, on_the_device):
        use_native(True)
        problem, U = discs("cpu", 5)
        with block():
            found.append(sampler.improved(problem, U, DrawKey(7, torch.arange(5), torch.arange(5))))
    torch.testing.assert_close(*found, rtol=tolerance, atol=tolerance)


def test_single_precision_works() -> None:
    problem, _ = discs("cuda")
    found = torchgco.solve(problem.cast(torch.float32), verbose=False)
    assert found.X.dtype == torch.float32 and bool((found.violation < 1e-3).all())
