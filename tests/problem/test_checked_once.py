"""A user's code is tried once for the same dimensions; what changes the trial, or the code, has it tried again."""

from __future__ import annotations

import gc
from collections import Counter
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

import torchgco
from torchgco import FunctionConstraint, FunctionCost, FunctionDynamics, InputError, Problem
from torchgco.problem import tried

D = torch.float64
X0 = torch.tensor([[0.0, 0.1]], dtype=D)


class Parts:
    """A model, a cost and a constraint whose functions are counted."""

    def __init__(self) -> None:
        self.calls: Counter[str] = Counter()
        self.model = FunctionDynamics(self.field, 2, 1, 0.1)
        self.cost = FunctionCost(self.stage, lambda x: x.square().sum(-1))
        self.rows = FunctionConstraint(self.value)

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        self.calls["dynamics"] += 1
        return torch.cat((x[..., 1:], u), dim=-1)

    def stage(self, x: Tensor, u: Tensor) -> Tensor:
        self.calls["cost"] += 1
        return u.square().sum(-1)

    def value(self, x: Tensor) -> Tensor:
        self.calls["constraint"] += 1
        return x[..., :1] - 5.0

    def problem(self, x0: Tensor = X0, N: int = 8, **others: Any) -> Problem:
        return Problem(**{"dynamics": self.model, "cost": self.cost, "constraints": [self.rows], **others}, x0=x0, N=N)

    def tried(self, make: Any) -> set[str]:
        """The functions that a trial calls: more often than once, as binding a problem makes one step."""
        self.calls.clear()
        make()
        return {name for name, count in self.calls.items() if count > 1}


ALL = {"dynamics", "cost", "constraint"}


def test_the_same_objects_are_not_tried_again() -> None:
    parts = Parts()
    assert parts.tried(parts.problem) == ALL
    assert parts.tried(parts.problem) == parts.tried(lambda: parts.problem(X0 + 1.0)) == set()
    bound = parts.problem()
    again = {"dynamics": bound.dynamics, "cost": bound.cost, "constraints": bound.constraints}
    assert parts.tried(lambda: parts.problem(**again)) == set()
    assert parts.tried(lambda: bound.started_at(X0, [parts.rows], parts.cost, parts.model)) == set()


@pytest.mark.parametrize(
    "other",
    [{"N": 9}, {"x0": X0.repeat(2, 1)}, {"x0": X0.float()}],
    ids=["stages", "batch", "precision"],
)
def test_other_dimensions_are_tried(other: dict[str, Any]) -> None:
    parts = Parts()
    parts.problem()
    assert parts.tried(lambda: parts.problem(**other)) == ALL
    assert parts.tried(parts.problem) == parts.tried(lambda: parts.problem(**other)) == set()


def test_other_objects_are_tried() -> None:
    parts = Parts()
    parts.problem()
    assert parts.tried(lambda: parts.problem(dynamics=replace(parts.model))) == {"dynamics"}
    assert parts.tried(lambda: parts.problem(dynamics=replace(parts.model, dt=0.2))) == ALL  # of another time step
    assert parts.tried(lambda: parts.problem(constraints=[replace(parts.rows)])) == {"constraint"}


def doubled(x: Tensor, u: Tensor, by: Tensor) -> Tensor:
    return torch.cat((x[..., 1:], FACTOR * u * by), dim=-1)


FACTOR: Any = 2.0


def test_new_parts_over_the_same_functions_are_not_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also with other numbers of problems; but where something has changed that the functions read."""
    tried_parts, check = list[Any](), tried.check_dynamics
    monkeypatch.setattr(tried, "check_dynamics", lambda *given: (tried_parts.append(given[0]), check(*given)))

    def made(by: float) -> int:
        model = FunctionDynamics(doubled, 2, 1, 0.1, values={"by": torch.full((1, 1), by, dtype=D)})
        Problem(model, torchgco.QuadraticCost([1, 1], [1], [1, 1]), [], X0, 5)
        return len(tried_parts)

    assert [made(1.0), made(1.0), made(3.0)] == [1, 1, 1]
    monkeypatch.setitem(globals(), "FACTOR", 3.0)
    assert [made(1.0), made(1.0)] == [2, 2]
    monkeypatch.setitem(globals(), "FACTOR", torch.ones(3, dtype=torch.float32))
    for _ in range(2):
        with pytest.raises(InputError, match=r"dynamics"):
            made(1.0)


def test_a_mistake_is_told_each_time_and_a_mended_object_passes() -> None:
    wrong = [True]
    model = FunctionDynamics(lambda x, u: u if wrong[0] else torch.cat((x[..., 1:], u), dim=-1), 2, 1, 0.1)
    for _ in range(2):
        with pytest.raises(InputError, match=r"dynamics.field: expected derivatives \(..., 2\)"):
            Parts().problem(dynamics=model)
    wrong[0] = False
    Parts().problem(dynamics=model)


def test_a_mistake_that_arises_later_ends_the_solve() -> None:
    network = torch.nn.Sequential(torch.nn.Linear(3, 2, dtype=D), torch.nn.Dropout(0.5)).eval()
    model = FunctionDynamics(lambda x, u: network(torch.cat((x, u), dim=-1)), 2, 1, 0.1)
    cost = torchgco.QuadraticCost([1, 1], [1], [1, 1])
    Problem(model, cost, [], X0, 5)
    network.train()
    problem = Problem(model, cost, [], X0, 5)
    with pytest.raises(InputError, match=r"dynamics\.step: .*random"):
        torchgco.solve(problem)


def test_nothing_is_kept_of_objects_that_are_gone() -> None:
    gc.collect()
    before = len(tried._passed)
    parts = Parts()
    parts.problem()
    assert len(tried._passed) > before
    del parts
    gc.collect()
    assert len(tried._passed) == before
