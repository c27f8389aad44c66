"""Phases that are solved again: what was made of them is kept, and no number or function that has changed is missed."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import compiled
from torchgco import ControlBounds, FreeTime, FunctionCost, FunctionDynamics, Jump, Phases, Problem, QuadraticCost
from torchgco.kernels import choice

pytestmark = compiled
D = torch.float64


class Numbers:
    """Numbers of all kinds that phases read."""

    def __init__(self) -> None:
        self.drag, self.weight = torch.tensor(0.3, dtype=D), 0.1
        self.kept, self.push = np.array([0.8]), torch.tensor([[0.5]], dtype=D)
        self.most, self.start = torch.tensor([2.0, 2.0], dtype=D), torch.tensor([[0.0, 0.0, 0.0, 0.0]], dtype=D)

    def phases(self) -> Phases:
        glide = lambda x, u: torch.cat((x[..., 2:], u - self.drag * x[..., 2:]), -1)
        model = FunctionDynamics(glide, n=4, m=2, dt=0.1, integrator="rk4", position=slice(0, 2))
        effort = FunctionCost(lambda x, u: self.weight * u.square().sum(-1))
        there = QuadraticCost([0.0] * 4, [0.1, 0.1], [50.0, 50.0, 1.0, 1.0], x_ref=[2.0, 1.0, 0.0, 0.0])
        slow = lambda x, kept, push: torch.cat((x[..., :2], kept * x[..., 2:] + push), -1)
        first = Problem(model, effort, [ControlBounds(-9.0, self.most)], self.start, 6, time=FreeTime(0.2, 2.0))
        then = Problem(model, there, [], torch.tensor([[1.0, 0.5, 0.5, 0.5]], dtype=D), 8)
        return Phases([first, then], [Jump(slow, values={"kept": self.kept, "push": self.push})])


CHANGES: dict[str, Callable[[Numbers], Any]] = {
    "a captured tensor": lambda n: n.drag.fill_(1.5),
    "its data": lambda n: setattr(n.drag, "data", torch.tensor(1.5, dtype=D)),
    "a captured number": lambda n: setattr(n, "weight", 1.0),
    "a jump's array": lambda n: n.kept.fill(0.1),
    "a jump's tensor": lambda n: n.push.fill_(-0.5),
    "a jump's data": lambda n: n.push.numpy().fill(-0.5),
    "a start": lambda n: n.start[0, 3].fill_(1.0),
    "a bound": lambda n: n.most.numpy().fill(0.05),
}


@pytest.mark.sampled(3)
@pytest.mark.parametrize("change", CHANGES)
def test_what_has_changed_counts(change: str) -> None:
    numbers = Numbers()
    phases = numbers.phases()
    first, again = (torchgco.solve(phases) for _ in range(2))
    assert torch.equal(first.found.X, again.found.X)
    CHANGES[change](numbers)
    now, fresh = torchgco.solve(phases), torchgco.solve(numbers.phases())
    assert torch.equal(now.found.X, fresh.found.X) and torch.equal(now.cost, fresh.cost)
    assert float((now.found.X - first.found.X).abs().max()) > 1e-3


def test_code_is_sought_and_costs_are_scaled_once(monkeypatch: pytest.MonkeyPatch) -> None:
    sought, scaled = list[Problem](), list[Problem]()
    seek, scale = choice._engine, Problem.scale_of
    monkeypatch.setattr(choice, "_engine", lambda problem: sought.append(problem) or seek(problem))
    monkeypatch.setattr(Problem, "scale_of", lambda self, *of: scaled.append(self) or scale(self, *of))
    phases = Numbers().phases()
    first = torchgco.solve(phases)
    torchgco.solve(phases)
    warm = torchgco.solve(phases, warm=first)
    assert (len(sought), len(scaled)) == (1, 1)
    torch.testing.assert_close(warm.cost, first.cost, rtol=1e-7, atol=0.0)


def test_threads_that_solve_the_same_phases_find_the_same() -> None:
    phases = Numbers().phases()
    alone = torchgco.solve(phases)
    run: Callable[[int], Tensor] = lambda _: torchgco.solve(phases).found.X
    with ThreadPoolExecutor(3) as pool:
        assert all(torch.equal(X, alone.found.X) for X in pool.map(run, range(6)))
