"""Code of a function whose numbers differ from knot to knot is made in time proportional to the horizon."""

from __future__ import annotations

from typing import Any

import casadi
import pytest
import torch

from torchgco import FunctionConstraint, FunctionCost, FunctionDynamics, Problem, QuadraticCost
from torchgco.native.codegen import knot
from torchgco.native.codegen.cost import spans_of_cost
from torchgco.native.codegen.knot import Span
from torchgco.native.codegen.source import INTERIOR
from torchgco.native.engine import Engine


def problem(N: int) -> Problem:
    prices = torch.rand(1, N + 1, 2, generator=torch.Generator().manual_seed(N), dtype=torch.float64)
    cost = FunctionCost(lambda x, u, price: (price * u).sum(-1) + price[..., 0] * x[..., 0] ** 2,
                        knot_values={"price": prices})  # fmt: skip
    model = FunctionDynamics(lambda x, u: x + u.sum(-1, keepdim=True), n=1, m=2, dt=1.0, integrator="none")
    return Problem(model, cost, [], [0.0], N)


@pytest.mark.parametrize("N", [3, 40, 333])
def test_a_knot_reads_its_own_numbers_alone(N: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """No function of a knot has the numbers of all: together they would be as long as the square of the horizon."""
    made, plain = [], casadi.Function

    def noted(*given: Any) -> casadi.Function:
        made.append(plain(*given))
        return made[-1]

    span = spans_of_cost(problem(N))[0]
    monkeypatch.setattr(casadi, "Function", noted)
    (single,), places = span.forms
    assert single.numbers.numel() == 3 and len({tuple(place) for place in places}) == N
    assert len({at for place in places for at in place}) == 3 * N
    assert len(made) >= N and max(function.nnz_in() for function in made) <= 9


def test_code_of_values_and_of_curvatures_replays_a_function_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replaying a function at all knots is what takes long."""
    replays: list[Span] = []

    def noted(span: Span) -> Any:
        replays.append(span)
        return forms(span)

    forms = knot._forms
    monkeypatch.setattr(knot, "_forms", noted)
    within = FunctionConstraint(lambda x: (x * x).sum(-1, keepdim=True) - 4.0)
    cost = QuadraticCost([1.0], [0.1, 0.1], [1.0])
    engine = Engine(Problem(problem(5).dynamics, cost, [within], [0.0], 5), compiles=False)
    engine.form.units(INTERIOR)
    assert len(replays) == 1
