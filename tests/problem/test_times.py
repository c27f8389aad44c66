"""Times of the knots: constant steps, stages of different length, horizons of different length."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import pytest
import torch
from torch import Tensor

import torchgco
from torchgco import Dynamics, FunctionCost, FunctionDynamics, Problem
from torchgco.problem.times import times

COST = FunctionCost(lambda x, u: u.square().sum(-1), lambda x: x.square().sum(-1))


def problem_of(dynamics: Dynamics, B: int = 2, N: int = 5, **more: Any) -> Problem:
    return Problem(dynamics, COST, [], torch.ones(B, 1).double(), N, **more)


def step(x: Tensor, u: Tensor, dt: Tensor) -> Tensor:
    return x + dt * u


def model(knot_values: Any = None, function: Callable[..., Tensor] = step, **more: Any) -> FunctionDynamics:
    return FunctionDynamics(function, 1, 1, 0.1, "none", knot_values=knot_values, **more)


def test_constant_steps_are_products() -> None:
    t = times(problem_of(model(function=lambda x, u: x + 0.1 * u), N=30))
    assert t.tolist() == [0.1 * k for k in range(31)]


def test_stages_of_different_length_add_up() -> None:
    lengths = torch.tensor([0.1, 0.2, 0.1, 0.4, 0.2]).double()
    shared = times(problem_of(model({"dt": lengths.view(1, 5, 1)})))
    assert shared.tolist() == pytest.approx([0, 0.1, 0.3, 0.4, 0.8, 1.0])
    each = times(problem_of(model({"dt": torch.stack((lengths, lengths.flip(0))).unsqueeze(-1)})))
    assert each.shape == (2, 6) and each[1].tolist() == pytest.approx([0, 0.2, 0.6, 0.7, 0.9, 1.0])


def test_a_class_may_have_another_step_at_each_stage() -> None:
    @dataclass(frozen=True)
    class Growing(Dynamics):
        dt: float = 0.1
        n: ClassVar[int] = 1
        m: ClassVar[int] = 1

        def at(self, k: int | Tensor) -> Self:
            return replace(self, dt=0.1 * (1 + k)) if isinstance(k, int) else self

        def field(self, x: Tensor, u: Tensor) -> Tensor:
            return u

    assert times(problem_of(Growing(), N=3)).tolist() == pytest.approx([0, 0.1, 0.3, 0.6])


def test_time_stands_still_after_a_horizon() -> None:
    problem = problem_of(model(function=lambda x, u: x + 0.1 * u), horizon=[5, 3])
    assert times(problem).tolist() == [[0.1 * k for k in range(6)], [0.1 * min(k, 3) for k in range(6)]]
    solution = torchgco.solve(problem, solver="hold")
    assert torch.equal(solution.t, times(problem))
    assert torch.equal(solution.take(torch.tensor([1])).t, times(problem)[1:])
    assert torch.equal(solution.take(torch.tensor([False, True])).t, times(problem)[1:])
