"""Equilibria at which the conditions of first order hold, and from which the cost falls, are left."""

from __future__ import annotations

from itertools import chain, repeat

import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import compiled
from torchgco import (
    ControlBounds,
    FreeTime,
    FunctionCost,
    FunctionDynamics,
    Goal,
    InteriorPoint,
    Problem,
    Spheres,
    Status,
)
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


# Drawn costs without constraints --------------------------------------------------------------------------------------


def drawn(seed: int, quartic: float) -> Problem:
    """Costs at whose stationary start all slopes vanish, from concave to convex; a quartic term bounds the fall."""
    draws = torch.Generator().manual_seed(seed)
    A, B, S, T = (torch.randn(shape, generator=draws, dtype=D) for shape in ((2, 2), (2, 2), (4, 4), (2, 2)))
    added = 8.0 * torch.rand(12, generator=draws, dtype=D) - 4.0

    def stage(x: Tensor, u: Tensor, k: Tensor, added: Tensor) -> Tensor:
        z = torch.cat((x, u), dim=-1)
        return ((z @ S) * z).sum(-1) + added * z.square().sum(-1) + quartic * z.pow(4).sum(-1)

    def terminal(x: Tensor, k: Tensor, added: Tensor) -> Tensor:
        return ((x @ T) * x).sum(-1) + added * x.square().sum(-1) + quartic * x.pow(4).sum(-1)

    model = FunctionDynamics(lambda x, u: x.sin() @ A + u @ B, 2, 2, 0.1)
    cost = FunctionCost(stage, terminal, values={"added": added})
    return Problem(model, cost, [], torch.zeros(12, 2, dtype=D), 6)


def least_curvature(problem: Problem, U: Tensor) -> Tensor:
    """The least eigenvalue (B,) of the Hessian of the cost by the controls U (B, N, m), as a share of the largest."""
    U = U.clone().requires_grad_()
    X = [problem.x0]
    for k in range(problem.N):
        X.append(problem.dynamics.step(X[-1], U[:, k]))
    (slope,) = torch.autograd.grad(problem.cost.total(torch.stack(X, dim=1), U).sum(), U, create_graph=True)
    rows = [torch.autograd.grad(one.sum(), U, retain_graph=True)[0].flatten(1) for one in slope.flatten(1).unbind(1)]
    values = torch.linalg.eigvalsh(torch.stack(rows, dim=1))
    return values[:, 0] / values.abs().amax(-1)


@compiled
@pytest.mark.parametrize("solver", ["gco", "gco_max", "interior_point"])
@pytest.mark.parametrize("seed", range(3))
def test_stationary_starts_without_constraints_are_left_unless_they_are_minima(solver: str, seed: int) -> None:
    """What has a least cost ends at a minimum, what hasn't is told."""
    problem, rest = drawn(seed, quartic=0.1), torch.zeros(12, 6, 2, dtype=D)
    at_rest = least_curvature(problem, rest)
    convex = at_rest > 0
    assert bool(convex.any()) and not bool(convex.all())
    found = torchgco.solve(problem, solver=solver, verbose=False)
    assert found.statuses == [Status.CONVERGED] * 12
    assert bool((least_curvature(problem, found.U) > -1e-6).all()) and bool((found.cost[~convex] < -1e-3).all())
    endless = drawn(seed, quartic=0.0)
    found = torchgco.solve(endless, solver=solver, verbose=False)
    expected = [Status.CONVERGED if minimum else Status.UNBOUNDED for minimum in convex.tolist()]
    assert found.statuses == expected and not bool(found.U[convex].any())
    alone = torchgco.solve(endless.take(torch.tensor([3])), solver=solver, verbose=False)
    assert torch.equal(alone.U[0], found.U[3]) and alone.iterations[0] == found.iterations[3]


@compiled
@pytest.mark.parametrize("solver", ["gco", "interior_point"])
def test_a_fall_without_end_along_what_no_row_bounds_is_told(solver: str) -> None:
    """One control of two is bounded, and the cost is concave along the other."""
    cost = FunctionCost(lambda x, u: u[..., 0].square() - u[..., 1].square())
    bounds = ControlBounds([-1.0, -torch.inf], [1.0, torch.inf])
    found = torchgco.solve(Problem(POINT, cost, [bounds], torch.zeros(2, 2, dtype=D), 10), solver=solver, verbose=False)
    assert found.statuses == [Status.UNBOUNDED] * 2 and bool((found.violation <= 1e-6).all())


@compiled
@pytest.mark.filterwarnings("ignore::torchgco.GuidanceWarning")
def test_a_start_on_top_is_left_among_obstacles_near_and_far() -> None:
    """Both sides of a ridge fall alike, and an obstacle lies far away, on one side, or on the other."""
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.1, "rk4", position=slice(0, 2))
    cost = FunctionCost(lambda x, u: 0.01 * u.square().sum(-1) + x[..., 0].cos() + x[..., 1].square(), None)
    centers = torch.tensor([[[50.0, 50.0]], [[2.0, 0.0]], [[-2.0, 0.0]]], dtype=D)
    obstacles = Spheres(centers, [1.0], 0.3)
    problem = Problem(model, cost, [obstacles, ControlBounds(-3.0, 3.0)], torch.zeros(3, 4, dtype=D), 20)
    found = torchgco.solve(problem, verbose=False)
    assert found.statuses == [Status.CONVERGED] * 3 and bool((found.cost < 10.0).all())
    assert float(torchgco.certify(problem, found.X, found.U).clearance.min()) >= 0
