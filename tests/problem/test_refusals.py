"""A user's guard that raises in a solve: the problem that goes there is lost, and no other one."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from torchgco import (
    ControlBounds,
    Cost,
    Dynamics,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    InputError,
    InteriorPoint,
    Problem,
    RefusalWarning,
    Solution,
    Status,
    certify,
    judge,
)
from torchgco.native.compiler import find_compiler

COMPILER = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
N, DT, LIMIT = 12, 0.1, 60.0
pytestmark = pytest.mark.filterwarnings("ignore::torchgco.kernels.EagerWarning", "ignore::torchgco.StepWarning")
# The second point falls away faster than its controls can hold it.
STARTS = [[0.5, 0.0], [7.0, 3.0], [-0.5, 0.3]]


def field(x: Tensor, u: Tensor) -> Tensor:
    return torch.stack((x[..., 1], u[..., 0] + 9.0 * x[..., 0]), -1)


def stage(x: Tensor, u: Tensor) -> Tensor:
    return 0.1 * x.square().sum(-1) + 0.1 * u.square().sum(-1)


def end(x: Tensor) -> Tensor:
    return 5.0 * (x[..., 0] - 2.0).square()


def rows(x: Tensor) -> Tensor:
    return x[..., 1:] - 5.0


def asserted(x: Tensor) -> None:
    assert x.abs().max() < LIMIT, "far away"


def raised(x: Tensor) -> None:
    if bool((x.abs() >= LIMIT).any()):
        raise ValueError("far away")


def looked_up(x: Tensor) -> None:
    list(range(int(LIMIT)))[int(x.abs().max())]


GUARDS: list[Callable[[Tensor], None]] = [asserted, raised, looked_up]


class Model(Dynamics):
    n, m, dt, integrator = 2, 1, DT, "rk4"

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        asserted(x)
        return field(x, u)


class Stepped(Dynamics):
    n, m, dt = 2, 1, DT

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        asserted(x)
        return x + DT * field(x, u)


class Price(Cost):
    def stage(self, x: Tensor, u: Tensor, k: Any) -> Tensor:
        asserted(x)
        return stage(x, u)

    def terminal(self, x: Tensor) -> Tensor:
        return end(x)


def made(guarded: str, guard: Callable[[Tensor], None], starts: Sequence[Sequence[float]] = STARTS) -> Problem:
    """Three points; one of their parts is guarded."""
    own: dict[str, Any] = {"model": field, "stage": stage, "end": end, "rows": rows}
    before = own.get(guarded)
    own |= {guarded: lambda *z: (guard(z[0]), before(*z))[1]} if before else {}  # type: ignore[misc]
    model: Any = FunctionDynamics(own["model"], n=2, m=1, dt=DT, integrator="rk4")
    cost: Any = FunctionCost(own["stage"], own["end"])
    classes = {"Model": Model, "Stepped": Stepped}
    model, cost = classes.get(guarded, lambda: model)(), Price() if guarded == "Price" else cost
    parts = [ControlBounds(-20.0, 20.0), FunctionConstraint(own["rows"])]
    return Problem(model, cost, parts, starts, N)


def solved(problem: Problem, solver: Any) -> tuple[Solution, list[str]]:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        found = torchgco.solve(problem, solver=solver, verbose=False)
    return found, [str(one.message) for one in told if one.category is RefusalWarning]


PARTS = "model", "stage", "end", "rows", "Model", "Stepped", "Price"


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("part", "guard", "solver"),
    [(part, GUARDS[i % 3], "al_ilqr") for i, part in enumerate(PARTS)]
    + [pytest.param("rows", asserted, InteriorPoint(max_iterations=12), marks=COMPILER)],
)
def test_one_problem_is_lost_and_no_other(part: str, guard: Callable[[Tensor], None], solver: Any) -> None:
    problem = made(part, guard)
    found, told = solved(problem, solver)
    fields = {"stage": "cost", "end": "cost", "Price": "cost", "rows": "constraint.function"}
    assert found.statuses[1] is Status.NON_FINITE
    assert any(text.startswith(f"{fields.get(part, 'dynamics')} refuses a state of problem 1, ") for text in told), told
    assert all(found.statuses[b] in (Status.CONVERGED, Status.FEASIBLE) for b in (0, 2))
    with pytest.warns(RefusalWarning):
        verdict = judge(problem, found.U)
    assert verdict.feasible.tolist() == [True, False, True]
    torch.testing.assert_close(verdict.cost[[0, 2]], found.cost[[0, 2]])
    for b in (0, 2):  # alone, it is solved alike
        alone = torchgco.solve(problem.take([b]), solver=solver, ids=torch.tensor([b]), verbose=False)
        torch.testing.assert_close(alone.U[0], found.U[b], rtol=0.0, atol=0.0)
        assert alone.statuses[0] is found.statuses[b]


def test_a_problem_alone_that_is_lost_says_so() -> None:
    problem = made("stage", asserted, STARTS[1:2])
    found, told = solved(problem, "al_ilqr")
    assert found.statuses == [Status.NON_FINITE]
    assert any("refuses a state of problem 0" in text and "AssertionError: far away" in text for text in told)
    with pytest.warns(RefusalWarning, match="refuses a state of what is judged"):
        assert not bool(judge(problem, found.U).feasible)
    with pytest.warns(RefusalWarning):
        assert not bool(torch.isfinite(certify(problem, found.X, found.U).kkt_residual))


@pytest.mark.slow
def test_a_guard_that_a_solve_crosses_on_its_way_costs_no_solution() -> None:
    """The guess is admitted, and so is the optimum; iterates between them may be refused."""
    rng = np.random.default_rng(0)
    starts = np.column_stack((rng.uniform(-0.1, 0.1, 6), rng.uniform(-0.1, 0.1, 6))).tolist()

    def near(x: Tensor) -> None:
        assert x.abs().max() < 7.0, "far away"

    plain, problem = made("none", near, starts), made("model", near, starts)
    due = torchgco.solve(plain, solver="al_ilqr", verbose=False)
    assert float(due.X.abs().max()) < 7.0
    found, told = solved(problem, "al_ilqr")
    assert not told and all(status is Status.CONVERGED for status in found.statuses)
    torch.testing.assert_close(found.cost, due.cost, rtol=1e-3, atol=1e-6)


def test_code_that_does_not_look_at_values_raises_what_it_raises() -> None:
    """A mistake of a user's isn't a state that is refused."""
    calls = []

    def broken(x: Tensor, u: Tensor) -> Tensor:
        calls.append(None)
        if len(calls) > 200:
            raise RuntimeError("no more")
        return stage(x, u)

    problem = Problem(FunctionDynamics(field, 2, 1, DT), FunctionCost(broken, end), [], STARTS[:1], N)
    with pytest.raises((RuntimeError, InputError), match="no more"):
        for _ in range(200):
            torchgco.solve(problem, solver="ilqr", verbose=False)
            problem.cost.stage(problem.x0, problem.x0[:, :1], 0)
