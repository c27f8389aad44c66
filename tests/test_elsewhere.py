"""Problems of another device are solved by C on the CPU: the bits of the CPU's problem, copied there and back."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

import torchgco
from tests.other_device import OTHER, SecondDevice
from torchgco import (
    ControlBounds,
    DeviceWarning,
    FunctionConstraint,
    FunctionDynamics,
    Goal,
    Planar,
    Problem,
    QuadraticCost,
    Spheres,
)
from torchgco.kernels import choice, use_native

DOUBLE: dict[str, Any] = {"dtype": torch.float64, "device": "cpu"}
PLACES = {"kernels/choice.py"}  # of the copies there and back


@pytest.fixture(autouse=True)
def unsaid(monkeypatch) -> Iterator[None]:
    monkeypatch.setattr(choice, "_said", False)
    yield
    use_native(True)


def problem_of(device: Any, *more: Any, dtype: torch.dtype = torch.float64) -> tuple[Problem, Any]:
    put = lambda value: torch.tensor(value, **DOUBLE).to(device, dtype)
    cost = QuadraticCost(put([5, 5, 1, 1, 1, 1]), put([0.1, 0.1]), put([50, 50, 1, 1, 1, 1]), put([1, 0.4, 0, 0, 0, 0]))
    parts = [Spheres(put([[0.1, 0.15]]), put([0.15]), 0.06), ControlBounds(put([-10.0, -10]), put([10.0, 10])), *more]
    x0 = put([[-1.0, 0, 0, 0, 0, 0], [-1, 0.1, 0, 0, 0, 0]])
    return Problem(Planar(dt=0.1), cost, parts, x0, 12, Goal(put([1, 0.4]), 0.3)), put([[[0.0, 0.1]] * 12] * 2)


def numbers(solution: Any) -> list[Any]:
    names = ("X", "U", "K", "cost", "violation", "status", "iterations")
    return [getattr(solution, name).tolist() for name in names]


@pytest.mark.parametrize("solver", ["interior_point", "al_ilqr"])
@pytest.mark.parametrize("whole", [True, False])
def test_the_bits_are_those_of_the_cpu(solver: str, whole: bool) -> None:
    """By `torchgco.solve`, which looks at problems before and after, and by a solver itself, as studies ask it."""

    def solved(problem: Problem, U0: Any) -> Any:
        made = getattr(torchgco.presets, solver)(problem)
        return torchgco.solve(problem, U0, made, verbose=False) if whole else made.prepare(problem).solve(problem, U0)

    expected = solved(*problem_of("cpu"))
    with SecondDevice() as second:
        problem, U0 = problem_of(OTHER)
        second.moved.clear()
        with pytest.warns(DeviceWarning, match="solved by C on the CPU"):
            solution = solved(problem, U0)
        assert {place.split(":")[0] for place in second.moved} <= PLACES
        assert solution.X.device == solution.status.device == solution.t.device == OTHER
        assert solution.account is not None and solution.account.problem is problem
        assert solution.account.kernels == "native" and numbers(solution) == numbers(expected)
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeviceWarning)  # it is said once
            assert torchgco.solve(problem, warm=solution, solver=solver, verbose=False).X.device == OTHER


def test_single_precision_is_solved_in_double() -> None:
    problem, U0 = problem_of("cpu", dtype=torch.float32)
    expected = torchgco.solve(choice._copied(problem), U0.double(), "interior_point")
    with SecondDevice(), pytest.warns(DeviceWarning):
        solution = torchgco.solve(*problem_of(OTHER, dtype=torch.float32), "interior_point")
        assert solution.X.dtype == torch.float32 and solution.X.tolist() == expected.X.float().tolist()


def learned(device: Any, B: int = 2) -> tuple[Problem, list[torch.Tensor]]:
    """A model with a network, whose weights lie on the device, in a gap; and the weights."""
    draw = torch.Generator().manual_seed(0)
    sizes = (16, 6), (16,), (4, 16), (4,)
    weights = [torch.randn(size, generator=draw, dtype=torch.float64).mul(0.1).to(device) for size in sizes]

    def rates(x: Any, u: Any) -> Any:
        A, a, C, c = weights
        z = torch.cat((x, u), -1)
        push = torch.nn.functional.linear(torch.nn.functional.linear(z, A, a).tanh(), C, c)
        return torch.cat((x[..., 2:], u), -1) + push

    put = lambda value: torch.tensor(value, **DOUBLE).to(device)
    most = put([1.5])
    parts = [
        Spheres(put([[0.5, 0.05]]), put([0.2]), 0.1), ControlBounds(put([-4.0, -4]), put([4.0, 4])),
        FunctionConstraint(lambda x: x[..., 2:3] - most),
    ]  # fmt: skip
    cost = QuadraticCost(put([0.1, 0.1, 0, 0]), put([0.1, 0.1]), put([50, 50, 1, 1]), put([1.0, 0, 0, 0]))
    model = FunctionDynamics(rates, 4, 2, 0.1, position=slice(0, 2))
    x0 = torch.zeros(B, 4, **DOUBLE).to(device)
    return Problem(model, cost, parts, x0, 12, Goal(put([1.0, 0.0]), 0.3)), weights


@pytest.mark.parametrize("solver", ["interior_point", "al_ilqr", "gco"])
def test_code_that_holds_tensors_of_the_device_is_served_too(solver: str) -> None:
    """Weights of a network, read from the device at every solve, as they are by then."""
    expected = [numbers(torchgco.solve(learned("cpu")[0], solver=solver, verbose=False))]
    problem, weights = learned("cpu")
    weights[1] += 0.01
    expected.append(numbers(torchgco.solve(problem, solver=solver, verbose=False)))
    with SecondDevice(), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeviceWarning)
        problem, weights = learned(OTHER)
        found = []
        for step in (0.0, 0.01):
            weights[1] += step
            solution = torchgco.solve(problem, solver=solver, verbose=False)
            assert solution.account is not None and solution.account.kernels == "native" and solution.X.device == OTHER
            found.append(numbers(solution))
    assert found == expected and found[0] != found[1]


@pytest.mark.parametrize("solver", ["interior_point", "gco"])
def test_loops_hold_a_network_of_the_device(solver: str) -> None:
    controls = []
    for device in ("cpu", OTHER):
        with SecondDevice(), warnings.catch_warnings():
            warnings.simplefilter("ignore", DeviceWarning)
            problem, _ = learned(device, B=1)
            call, loop = torchgco.compile(problem, solver), torchgco.MPC(problem, solver)
            x = np.zeros((1, 4))
            controls.append([call(x0=x + 0.01 * i).U.tolist() for i in range(2)])
            controls[-1] += [np.asarray(loop.step(x)).tolist() for _ in range(2)]
            controls[-1].append(torchgco.MPPIController(problem, torchgco.MPPI(samples=20)).command(x).tolist())
    assert controls[0] == controls[1]


def test_solutions_with_a_network_of_the_device_have_gradients() -> None:
    """What leads to them is recorded on the device; backward passes have no second device without hardware."""
    found = []
    for device in ("cpu", OTHER):
        with SecondDevice(), warnings.catch_warnings():
            warnings.simplefilter("ignore", DeviceWarning)
            problem, _ = learned(device)
            x0 = problem.x0.clone().requires_grad_()
            solution = torchgco.solve(replace(problem, x0=x0), solver="interior_point", verbose=False)
            assert solution.X.requires_grad and solution.X.device == problem.x0.device
            assert all(solution.differentiable.tolist())
            found.append(torch.tensor(solution.detach().X.tolist(), **DOUBLE))
    torch.testing.assert_close(*found, rtol=1e-9, atol=1e-9)  # with the last step of Newton's method, by PyTorch there


@pytest.mark.parametrize("compiled", [False, True])
def test_exported_c_has_the_numbers_of_the_device(compiled: bool, tmp_path) -> None:
    texts = []
    for device in ("cpu", OTHER):
        with SecondDevice(), warnings.catch_warnings():
            warnings.simplefilter("ignore", DeviceWarning)
            problem, _ = learned(device, B=1)
            given = torchgco.compile(problem, "interior_point", receding=True) if compiled else problem
            folder = torchgco.export_c(given, tmp_path / str(device), "own")
            texts.append({path.name: path.read_text() for path in sorted(folder.iterdir()) if path.is_file()})
    assert texts[0] == texts[1] and "own.c" in texts[0]


def test_code_that_writes_into_a_tensor_of_the_device_is_not_traced() -> None:
    """A copy would be written to in its place."""
    with SecondDevice():
        count = torch.zeros(1, dtype=torch.float64, device=OTHER)
        problem, _ = problem_of(OTHER, FunctionConstraint(lambda x: x[..., 3:4] - 9.0 - 0.0 * count.add_(1.0)))
        assert choice.on_cpu(problem) is None


def test_chosen_kernels_stay_there() -> None:
    use_native(False)
    with SecondDevice():
        assert choice.on_cpu(problem_of(OTHER)[0]) is None
