"""Numbers that a problem was given are read again where they have been changed in place: every field by one rule."""

from __future__ import annotations

import pickle
from array import array
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from torch import Tensor

import torchgco
from tests.slow import mostly
from torchgco import (
    ControlBounds,
    FunctionConstraint,
    FunctionDynamics,
    Planar,
    Problem,
    QuadraticCost,
    RateBounds,
    Spheres,
    StateBounds,
)

D = torch.float64
NUMBERS: dict[str, Callable[[], Tensor]] = {
    "x0": lambda: torch.zeros(2, 6, dtype=D),
    "Q": lambda: torch.ones(6, dtype=D),
    "R": lambda: torch.full((2,), 0.1, dtype=D),
    "Qf": lambda: torch.eye(6, dtype=D),
    "x_ref": lambda: torch.tensor([1.0, 1.0, 0, 0, 0, 0], dtype=D),
    "q": lambda: torch.full((6,), 0.1, dtype=D),
    "centers": lambda: torch.tensor([[0.5, 0.45]], dtype=D),
    "radii": lambda: torch.tensor([0.1], dtype=D),
    "vehicle_radius": lambda: torch.tensor([0.05, 0.1], dtype=D),
    "lower": lambda: torch.tensor([-4.0, -5.0], dtype=D),
    "upper": lambda: torch.full((6,), 3.0, dtype=D),
    "line": lambda: torch.full((2,), 2.0, dtype=D),
}


def problem(given: dict[str, Any]) -> Problem:
    cost = QuadraticCost(given["Q"], given["R"], given["Qf"], x_ref=given["x_ref"], q=given["q"])
    rows = [
        ControlBounds(given["lower"], 5.0),
        StateBounds(-9.0, given["upper"]),
        Spheres(given["centers"], given["radii"], given["vehicle_radius"]),
        FunctionConstraint(lambda x, line: x[..., :1] - line.unsqueeze(-1), values={"line": given["line"]}),
    ]
    return Problem(Planar(dt=0.1), cost, rows, given["x0"], 10)


def as_tensor(value: Tensor) -> Tensor:
    return value


def as_array(value: Tensor) -> np.ndarray:
    return value.numpy()


def as_list(value: Tensor) -> list[Any]:
    return value.tolist()


def change(value: Any) -> None:
    if isinstance(value, list) and isinstance(value[0], list):
        value[0] = [0.9 * v - 0.01 for v in value[0]]
    elif isinstance(value, list):
        value[0] = 0.9 * value[0] + 0.02
    elif isinstance(value, Tensor):
        value.data.mul_(0.9)  # an optimiser's step, seen by the tensor's version or not
        value.data.flatten()[0] += 0.02
    else:
        value *= 0.9
        value.flat[0] += 0.02


@pytest.mark.sampled(8)
@pytest.mark.parametrize("kind", mostly([as_tensor, as_array, as_list], as_list))
@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_changed_in_place_are_those_of_the_next_solve(name: str, kind: Callable[[Tensor], Any]) -> None:
    if kind is as_list and name == "Qf":
        pytest.skip("a matrix whose first row changes is no longer symmetric")
    given = {key: kind(make()) for key, make in NUMBERS.items()}
    kept = problem(given)
    before = torchgco.solve(kept, solver="interior_point")
    part = kept.take(torch.tensor([1]))
    change(given[name])
    found, alone = (torchgco.solve(p, solver="interior_point") for p in (kept, part))
    due = torchgco.solve(problem(given), solver="interior_point")
    assert torch.equal(found.U, due.U) and torch.equal(alone.U, due.U[1:])
    assert name in ("upper", "line", "lower", "vehicle_radius") or not torch.equal(found.U, before.U)
    assert torchgco.judge(kept, found.U).feasible.all()
    torch.testing.assert_close(kept.current().cost.total(found.X, found.U), found.cost, rtol=1e-12, atol=0)
    assert kept.current() is kept.current()


@pytest.mark.parametrize("name", [name for name in NUMBERS if name != "x0"])
def test_a_problem_started_elsewhere_follows_too(name: str) -> None:
    given = {key: make() for key, make in NUMBERS.items()}
    kept = problem(given)
    x0 = kept.x0 + 0.1
    early = kept.started_at(x0, kept.constraints).started_at(x0, kept.constraints)
    torchgco.solve(early, solver="interior_point")
    change(given[name])
    late = kept.started_at(x0, kept.constraints)
    due = torchgco.solve(problem(given | {"x0": x0}), solver="interior_point")
    for each in (early, late):
        assert torch.equal(torchgco.solve(each, solver="interior_point").U, due.U)


@pytest.mark.parametrize("make", [deque, lambda w: array("d", w), pd.Series, lambda w: list(np.float32(w)), tuple])
def test_other_sequences_of_numbers_are_followed_too(make: Callable[[list[float]], Any]) -> None:
    given: dict[str, Any] = {key: make_one() for key, make_one in NUMBERS.items()}
    weights = make([1.0] * 6)
    kept = problem(given | {"Q": weights})
    torchgco.solve(kept, solver="interior_point")
    if isinstance(weights, tuple):
        return  # nothing can change
    weights[0] = type(weights[0])(3.0)
    due = torchgco.solve(problem(given | {"Q": [3.0] + [1.0] * 5}), solver="interior_point")
    assert torch.equal(torchgco.solve(kept, solver="interior_point").U, due.U)


@pytest.mark.slow
def test_a_list_of_constraints_is_followed() -> None:
    given = {key: make() for key, make in NUMBERS.items()}
    base = problem(given)
    speed = lambda most: FunctionConstraint(lambda x: x[..., 2:4].abs() - most)
    rows: list[Any] = [speed(0.6)]
    kept = Problem(base.dynamics, base.cost, rows, base.x0, base.N)
    torchgco.solve(kept, solver="interior_point")
    rows[0] = speed(0.4)
    found = torchgco.solve(kept, solver="interior_point")
    assert float(found.X[..., 2:4].abs().max()) < 0.4 + 1e-6


def line(N: int, rows: list[Any]) -> Problem:
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), -1), 2, 1, 0.1, "euler")
    x0 = torch.tensor([[0.0, 0.0], [0.3, -0.2]], dtype=D)
    return Problem(model, QuadraticCost([1.0, 0.1], [0.05], [9.0, 1.0], x_ref=[1.0, 0.0]), rows, x0, N)


ROWS: dict[str, Callable[[], list[Any]]] = {
    "states": lambda: [StateBounds(-0.5, 0.5), ControlBounds(-2.0, 2.0)],
    "function": lambda: [FunctionConstraint(lambda x: x[..., 1:] - 0.5)],
    "last": lambda: [FunctionConstraint(lambda x: x[..., :1] - 0.8, "equality", [-1])],
    "rates": lambda: [RateBounds(-0.2, 0.2)],
}


@pytest.mark.sampled(2)
@pytest.mark.parametrize("kind", ROWS)
@pytest.mark.parametrize("N", mostly([6, 25], 6))
def test_parts_of_a_problem_are_bound_anew_to_another_one(kind: str, N: int) -> None:
    old = line(12, ROWS[kind]())
    due = torchgco.solve(line(N, ROWS[kind]()), solver="interior_point")
    for other in (replace(old, N=N), Problem(old.dynamics, old.cost, old.constraints, old.x0, N)):
        assert torch.equal(torchgco.solve(other, solver="interior_point").U, due.U)


@pytest.mark.parametrize("name", [name for name in NUMBERS if name != "x0"])
def test_a_problem_made_of_another_one_has_its_numbers_of_now(name: str) -> None:
    given = {key: make() for key, make in NUMBERS.items()}
    old = problem(given)
    change(given[name])
    due = torchgco.solve(problem(given), solver="interior_point")
    for other in (replace(old, x0=old.x0), pickle.loads(pickle.dumps(replace(old, constraints=old.constraints[:3])))):
        found = torchgco.solve(other, solver="interior_point")
        assert len(other.constraints) < 4 or torch.equal(found.U, due.U)


def test_gradients_survive() -> None:
    Q = torch.tensor([1.0, 0.1], dtype=D, requires_grad=True)
    old = line(12, [])
    asks = Problem(old.dynamics, QuadraticCost(Q, [0.05], [9.0, 1.0], x_ref=[1.0, 0.0]), [], old.x0, 12)
    torchgco.solve(replace(asks, x0=old.x0 + 0.1)).cost.sum().backward()
    assert Q.grad is not None and bool((Q.grad > 0).all())
