"""Equilibria at which the conditions of first order hold, and from which the cost falls, are left."""

from __future__ import annotations

from itertools import chain, repeat

import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import compiled
from torchgco import ControlBounds, FreeTime, FunctionCost, FunctionDynamics, Goal, InteriorPoint, Problem, Status
from torchgco.kernels import use_native
from torchgco.solvers.contracts import Call

D = torch.float64
CART = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), -1), 2, 1, 0.1)
POINT = FunctionDynamics(lambda x, u: u, 2, 2, 0.1)


def pendulum(x: Tensor, u: Tensor) -> Tensor:
    return torch.stack((x[..., 1], -9.81 * x[..., 0].sin() + u[..., 0]), -1)


def raised(x: Tensor) -> Tensor:
    return 20 * (x[..., 0].cos() + 1)


PROBLEMS = {  # the cost at rest, and one that is known to exist
    "hanging pendulum": (FunctionDynamics(pendulum, 2, 1, 0.05, "rk4"), 20, 30, 100.0, 40.51,
        FunctionCost(lambda x, u: x[..., 0].cos() + 1 + 0.01 * u[..., 0].square(), raised)),
    "concave": (CART, 1, 10, 0.0, -9.98,
        FunctionCost(lambda x, u: 0.1 * x.square().sum(-1) - u[..., 0].square(), None)),
    "double well": (CART, 5, 30, 0.0, -5.47,
        FunctionCost(lambda x, u: x[..., 0] ** 4 - x[..., 0] ** 2 + 0.01 * u[..., 0].square(), None)),
    "product": (POINT, 1, 10, 0.0, -9.98,
        FunctionCost(lambda x, u: u[..., 0] * u[..., 1] + 0.01 * x.square().sum(-1), None)),
}  # fmt: skip


@pytest.mark.sampled(3)
@pytest.mark.parametrize("solver", ["gco", "interior_point"])
@pytest.mark.parametrize("native", [pytest.param(True, marks=compiled), pytest.param(False, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", PROBLEMS)
def test_a_solve_leaves_points_from_which_the_cost_falls(name: str, native: bool, solver: str) -> None:
    model, most, N, at_rest, known, cost = PROBLEMS[name]
    problem = Problem(model, cost, [ControlBounds(-most, most)], torch.zeros(2, 2, dtype=D), N)
    rest = torch.zeros(2, N, problem.m, dtype=D)
    assert torch.allclose(problem.cost.total(torch.zeros(2, N + 1, 2, dtype=D), rest), torch.tensor(at_rest, dtype=D))
    use_native(native)
    try:
        found = torchgco.solve(problem, solver=solver, verbose=False)
        alone = torchgco.solve(problem.take(torch.tensor([1])), solver=solver, verbose=False)
    finally:
        use_native(True)
    assert found.statuses == [Status.CONVERGED] * 2 and bool((found.cost < known).all())
    assert torch.equal(found.U[1], alone.U[0]), "the same bits alone and in a batch"


def test_where_no_time_is_left_to_leave_one_the_solve_is_late(monkeypatch) -> None:
    """A first solve in time, and none from beside it."""
    late = chain([False], repeat(True))
    monkeypatch.setattr(Call, "late", property(lambda _: next(late)))
    model, most, N, *_, cost = PROBLEMS["hanging pendulum"]
    problem = Problem(model, cost, [ControlBounds(-most, most)], torch.zeros(1, 2, dtype=D), N)
    call = Call.checked(problem, torch.zeros(1, N, problem.m, dtype=D))
    end = InteriorPoint().solved(call, escapes=True)
    assert Status(int(end.status)) is Status.TIME_LIMIT and not bool(end.best.U.any())


@compiled
def test_goals_behind_what_only_drives_forwards_are_reached_in_a_free_time() -> None:
    """The straight guess is a saddle at any time: none of 24 distances may end there, or later than by a turn."""
    away = torch.linspace(0.2, 1.5, 24, dtype=D)

    def rates(x: Tensor, u: Tensor) -> Tensor:
        return torch.stack((u[..., 0] * x[..., 2].cos(), u[..., 0] * x[..., 2].sin(), u[..., 1]), -1)

    problem = Problem(
        FunctionDynamics(rates, 3, 2, 0.1, "rk4", position=slice(0, 2)),
        FunctionCost(lambda x, u: 1e-3 * u.square().sum(-1)),
        [ControlBounds([0.0, -1.5], [1.0, 1.5])],
        torch.zeros(24, 3, dtype=D),
        N=20,
        goal=Goal(torch.stack((-away, 0.0 * away), dim=-1), 0.01, required=True),
        time=FreeTime(0.2, 6.0, weight=1.0),
    )
    found = torchgco.solve(problem)
    assert [b for b, status in enumerate(found.statuses) if status != Status.CONVERGED] == []
    assert bool((found.duration <= torch.pi / 1.5 + away).all())
