"""Problems of another device are solved by C on the CPU: the bits of the CPU's problem, copied there and back."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

import pytest
import torch

import torchgco
from tests.other_device import OTHER, SecondDevice
from torchgco import ControlBounds, DeviceWarning, FunctionConstraint, Goal, Planar, Problem, QuadraticCost, Spheres
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


def test_code_that_holds_a_tensor_of_the_device_stays_there() -> None:
    with SecondDevice(), warnings.catch_warnings():
        warnings.simplefilter("error", DeviceWarning)
        most = torch.tensor([2.0], dtype=torch.float64, device=OTHER)
        problem, U0 = problem_of(OTHER, FunctionConstraint(lambda x: x[..., 3:4] - most))
        assert choice.on_cpu(problem) is None
        solution = torchgco.solve(problem, U0, torchgco.AugmentedLagrangian(max_outer_iterations=1), verbose=False)
        assert solution.account is not None and solution.account.kernels == "pytorch" and solution.X.device == OTHER


def test_chosen_kernels_stay_there() -> None:
    use_native(False)
    with SecondDevice():
        assert choice.on_cpu(problem_of(OTHER)[0]) is None
