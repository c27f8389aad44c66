"""Problems of one batch with horizons of different length, compared with each problem alone."""

from dataclasses import replace
from typing import Any

import pytest
import torch

import torchgco
from tests.problems import assert_same_bits
from tests.slow import mostly
from torchgco import (
    Boxes,
    Constraint,
    ControlBounds,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Goal,
    InputError,
    Problem,
    QuadraticCost,
    RateBounds,
    Spheres,
    StateBounds,
    Unicycle,
    kernels,
)
from torchgco.judging.judge import judge

D = torch.float64
HORIZONS = [30, 18, 24]


def cars(N: int, rows: slice, obstacles: bool, horizon: Any = None) -> Problem:
    x0 = torch.tensor([[0.0, 0.0, 0.1, 0.0], [0.1, 0.1, 0.0, 0.2], [0.0, 0.2, 0.2, 0.0]], dtype=D)[rows]
    goal = torch.tensor([1.6, 0.8, 0.0, 0.0], dtype=D)
    cost = QuadraticCost([0.01] * 4, [0.05] * 2, [50.0] * 4, x_ref=goal)
    bounds = [ControlBounds([-3.0, -2.0], [3.0, 2.0]), StateBounds([-9.0, -9.0, -9.0, -0.5], [9.0, 9.0, 9.0, 1.7])]
    moving = [Spheres([[0.8, 0.6]], [0.2], vehicle_radius=0.1, velocities=[[0.05, -0.1]])] if obstacles else []
    return Problem(Unicycle(dt=0.1), cost, [*bounds, *moving], x0, N, horizon=horizon)


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("solver", "obstacles"),
    [("gco", True), ("al_ilqr", True), ("al_ilqr", False), ("interior_point", True), ("interior_point", False)],
)
def test_each_problem_costs_what_it_costs_alone(solver: str, obstacles: bool) -> None:
    whole = cars(30, slice(0, 3), obstacles, HORIZONS)
    found = torchgco.solve(whole, solver=solver)
    assert found.horizon is not None and found.horizon.tolist() == HORIZONS
    torch.testing.assert_close(judge(whole, found.U).cost, found.cost)
    for b, h in enumerate(HORIZONS):
        alone = torchgco.solve(cars(h, slice(b, b + 1), obstacles), solver=solver, ids=torch.tensor([b]))
        torch.testing.assert_close(found.cost[b : b + 1], alone.cost, rtol=1e-6, atol=0.0)
        assert bool((found.X[b, h:] == found.X[b, h]).all())


@pytest.mark.slow
def test_kernels_of_pytorch_agree() -> None:
    problem = cars(30, slice(0, 3), True, HORIZONS)
    native = torchgco.solve(problem, solver="al_ilqr").cost
    kernels.use_native(False)
    try:
        eager = torchgco.solve(problem, solver="al_ilqr").cost
    finally:
        kernels.use_native(True)
    torch.testing.assert_close(eager, native, rtol=1e-6, atol=0.0)


def user_step(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    way = 0.1 * x[..., 3] * torch.stack((x[..., 2].cos(), x[..., 2].sin()))
    return torch.cat((x[..., :2] + way.movedim(0, -1), x[..., 2:] + 0.1 * u.flip(-1)), dim=-1)


GOAL = torch.tensor([1.6, 0.8, 0.0, 0.0], dtype=D)
COSTS = {
    "quadratic": QuadraticCost([0.01] * 4, [0.05] * 2, [50.0] * 4, x_ref=GOAL),
    "function": FunctionCost(
        lambda x, u: 0.01 * (x - GOAL).square().sum(-1) + 0.05 * u.square().sum(-1) + 0.01 * x[..., 2].cos(),
        lambda x: 50.0 * (x - GOAL).square().sum(-1),
    ),
}
PARTS: dict[str, list[Constraint]] = {
    "boxes": [Boxes([[0.8, 0.55]], [[0.15, 0.1]], vehicle_radius=0.1, rotations=[0.4], radii=[0.02])],
    "inequality": [FunctionConstraint(lambda x: x[..., 3:4] - 1.3)],
    "of knots": [FunctionConstraint(lambda x, k: x[..., 1:2] - 0.9 + 0.002 * k.unsqueeze(-1))],
    "of controls": [FunctionConstraint(lambda u: u[..., :1] * u[..., 1:] - 0.5, of="u")],
    "at the end": [FunctionConstraint(lambda x: x[..., 3:4] - 0.1, sense="equality", knots=[-1])],
    "rates": [RateBounds(-0.3, 0.3)],
}


def of_user(parts: str, cost: str, N: int, rows: slice, horizon: Any = None) -> Problem:
    x0 = torch.tensor([[0.0, 0.0, 0.1, 0.0], [0.1, 0.1, 0.0, 0.2], [0.0, 0.2, 0.2, 0.0]], dtype=D)[rows]
    model = FunctionDynamics(user_step, n=4, m=2, dt=0.1, position=slice(0, 2))
    constraints = [ControlBounds([-3.0, -2.0], [3.0, 2.0]), *PARTS[parts]]
    return Problem(model, COSTS[cost], constraints, x0, N, goal=Goal(GOAL[:2], 0.2), horizon=horizon)


ENDED = [("al_ilqr", "inequality"), *(("interior_point", name) for name in PARTS)]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("solver", "parts"), mostly(ENDED, *(("interior_point", name) for name in list(PARTS)[::2]), several=True)
)
def test_a_users_code_ends_early(parts: str, solver: str) -> None:
    cost = "quadratic" if parts in ("boxes", "rates") else "function"
    found = torchgco.solve(of_user(parts, cost, 30, slice(0, 3), HORIZONS), solver=solver)
    for b, h in enumerate(HORIZONS):
        alone = torchgco.solve(of_user(parts, cost, h, slice(b, b + 1)), solver=solver, ids=torch.tensor([b]))
        torch.testing.assert_close(found.cost[b : b + 1], alone.cost, rtol=1e-5, atol=0.0)


@pytest.mark.parametrize("solver", ["gco", "interior_point"])
def test_no_result_depends_on_the_rest_of_the_batch(solver: str) -> None:
    whole = cars(30, slice(0, 3), True, HORIZONS)
    whole = replace(whole, constraints=[*whole.constraints, *PARTS["boxes"]])
    found = torchgco.solve(whole, solver=solver)
    for rows in ([1], [2, 0], [2, 1, 0]):
        index = torch.tensor(rows)
        assert_same_bits(torchgco.solve(whole.take(index), solver=solver, ids=index), found.take(index))


@pytest.mark.parametrize("horizon", [[30, 18], [0, 18, 24], [31, 18, 24], [30.0, 18.0, 24.0], "late"])
def test_bad_horizons(horizon: Any) -> None:
    with pytest.raises(InputError, match="horizon"):
        cars(30, slice(0, 3), False, horizon)


def ends(kind: str, N: int, rows: slice, horizon: Any = None) -> Problem:
    """Points that end at numbers of their own last knots."""
    goals = torch.linspace(0.0, 1.0, 11, dtype=D).view(1, 11, 1)[:, : N + 1]
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), -1), 2, 1, 0.1, "euler")
    stage, constraints = lambda x, u: 0.1 * u.square().sum(-1), []
    if kind == "reference":
        path = torch.cat((goals[0], torch.zeros_like(goals[0])), -1)
        cost: Any = QuadraticCost([0.0, 0.0], [0.2], [10.0, 0.0], x_ref=path)
    elif kind == "terminal cost":
        last = lambda x, goal: 5.0 * (x[..., 0] - goal[..., 0]).square()
        cost = FunctionCost(stage, last, knot_values={"goal": goals})
    else:
        cost = FunctionCost(stage)
        row = lambda x, goal: x[..., :1] - goal
        constraints = [FunctionConstraint(row, "equality", [-1], knot_values={"goal": goals})]
    x0 = torch.tensor([[1.0, 0.0], [-0.2, -0.4]], dtype=D)[rows]
    return Problem(model, cost, constraints, x0, N, horizon=horizon)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", ["reference", "terminal cost", "terminal row"])
def test_last_knots_have_numbers_of_their_own(kind: str) -> None:
    found = torchgco.solve(ends(kind, 10, slice(0, 2), [4, 7]), solver="interior_point")
    for b, h in enumerate((4, 7)):
        alone = torchgco.solve(ends(kind, h, slice(b, b + 1)), solver="interior_point")
        torch.testing.assert_close(found.cost[b : b + 1], alone.cost, rtol=1e-9, atol=0.0)


def test_functions_that_take_the_last_knot_are_refused() -> None:
    base, late = ends("reference", 10, slice(0, 2)), lambda x, k: (x[..., :1] - 0.1 * k).sum(-1)
    cost = FunctionCost(lambda x, u: u.square().sum(-1), late)
    with pytest.raises(InputError, match="a terminal function without an argument k"):
        torchgco.solve(Problem(base.dynamics, cost, [], base.x0, 10, horizon=[4, 7]))
    row = FunctionConstraint(lambda x, k: x[..., :1] - 0.1 * k.view(-1, 1), knots=[-1])
    with pytest.raises(InputError, match=r"without an argument k at the last knots.* constraints\[0\]"):
        torchgco.solve(Problem(base.dynamics, base.cost, [row], base.x0, 10, horizon=[4, 7]))
