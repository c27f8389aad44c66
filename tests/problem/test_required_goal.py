"""Goals that are constraints: their rows, what solver, search, judge and explanation make of them, and errors."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import compiled
from torchgco import (
    ControlBounds,
    Cost,
    FunctionCost,
    FunctionDynamics,
    Goal,
    HorizonWarning,
    InputError,
    InteriorPoint,
    Problem,
    QuadraticCost,
    RateBounds,
    Spheres,
    StateBounds,
    Status,
    judge,
)
from torchgco.kernels import measured
from torchgco.lagrangian.quality import goal_tolerance, has_arrived
from torchgco.problem.covered import covered_goals
from torchgco.problem.goal import GoalBall, GoalState

D, NAN = torch.float64, torch.nan
N = 30
POINT = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.1, "rk4", slice(0, 2))
LAZY = QuadraticCost([0.1] * 4, [1.0] * 2, [0.1] * 4)  # stops short of every goal
X0 = torch.tensor([[3.0, 1.0, 0, 0], [2.0, 2.0, 0, 0], [1.5, -1.0, 0.2, 0]], dtype=D)
BALL = Goal([0.5, 0.5], [0.2, 0.3, 0.1], required=True)
STATE = Goal(state=[0.8, 0.8, 0.0, NAN], required=True)
DISC = Spheres([[1.5, 1.0]], [0.4], 0.1)


def points(goal: Goal | None, *parts: Any, cost: Cost = LAZY, x0: Tensor = X0, **more: Any) -> Problem:
    return Problem(POINT, cost, [ControlBounds(-2.0, 2.0), *parts], x0, more.pop("N", N), goal, **more)


def test_its_row_is_the_last_constraint_and_in_metres() -> None:
    problem = points(BALL)
    assert [type(part) for part in problem.constraints] == [ControlBounds, GoalBall]
    X = X0.unsqueeze(1).repeat(1, N + 1, 1)
    away = np.hypot(*(X0[:, :2].numpy() - 0.5).T)
    found = measured(problem, X, X.new_zeros(3, N, 2))
    np.testing.assert_allclose(found, away - [0.2, 0.3, 0.1], rtol=1e-12)  # at rest at the start
    row = points(STATE).constraints[-1]
    assert isinstance(row, GoalState) and row.value(X, X.new_zeros(3, N, 2)).shape == (3, 1, 3)
    np.testing.assert_allclose(row.value(X, X)[:, 0], X0[:, :3].numpy() - [0.8, 0.8, 0.0])


def test_derivatives_of_a_required_state_are_those_of_autodiff() -> None:
    row = points(STATE).constraints[-1]
    X, U = torch.randn(3, N + 1, 4, dtype=D), torch.randn(3, N, 2, dtype=D)
    g, h = torch.randn(3, 1, 3, dtype=D), torch.randn(3, 1, 3, dtype=D)
    H = X.new_zeros(3, N + 1, 7, 7)
    row.accumulate(X, U, g, h, H)
    J = torch.func.jacrev(lambda x: row.value(x, U)[0])(X)[:, :, 0, N]  # (1, 3, 4)
    expected = torch.zeros_like(H)
    expected[:, N, :4, 4] = expected[:, N, 4, :4] = (g @ J)[:, 0]
    expected[:, N, :4, :4] = J.mT @ (h.mT * J)
    torch.testing.assert_close(H, expected)


@pytest.mark.sampled(1)
@compiled
@pytest.mark.parametrize(
    ("native", "parts"),
    [("native", ()), ("native", (DISC,)), ("eager", ()), pytest.param("eager", (DISC,), marks=pytest.mark.slow)],
    indirect=["native"],
)
def test_what_a_cost_stops_short_of_is_reached(parts: tuple[Any, ...], native: bool) -> None:
    stated = points(replace(BALL, required=False), *parts)
    alone, found = (torchgco.solve(stated, solver=solver) for solver in (InteriorPoint(), "gco"))
    assert not bool(judge(stated, alone.U).reached.any())
    assert bool(judge(stated, found.U).reached.all()) and bool((found.cost > alone.cost).all()), "arriving counts first"
    for goal in (BALL, STATE):
        problem = points(goal, *parts)
        found = torchgco.solve(problem)
        verdict = judge(problem, found.U)
        assert found.statuses == [Status.CONVERGED] * 3 and bool(verdict.reached.all())
        assert found.to_frame(problem).reached.all() and bool(has_arrived(problem, found.X).all())
        assert "goal reached" in found.explain(0, problem)
        best = torchgco.solve(problem, solver=InteriorPoint())
        assert bool(((found.cost <= best.cost * (1 + 1e-4)) | (best.violation > 1e-6)).all())
    torch.testing.assert_close(found.X[:, -1, :3], torch.tensor([[0.8, 0.8, 0.0]] * 3, dtype=D), atol=1e-6, rtol=0)


@pytest.mark.slow
def test_each_problems_own_last_knot_arrives_where_horizons_differ() -> None:
    ends = torch.tensor([30, 22, 27])
    for goal in (BALL, STATE):
        problem = points(goal, DISC, horizon=ends)
        found = torchgco.solve(problem)
        last = found.X[torch.arange(3), ends]
        assert found.statuses == [Status.CONVERGED] * 3 and bool(judge(problem, found.U).reached.all())
        torch.testing.assert_close(found.X[:, -1], last)
        alone = [torchgco.solve(points(goal, DISC).take(torch.tensor([b])), seed=0) for b in (0,)]
        torch.testing.assert_close(alone[0].cost[0], found.cost[0], rtol=1e-4, atol=0)
    late = points(Goal(state=[0.8, 0.8, 0, 0], required=True), RateBounds(-0.5, 0.5), horizon=ends)
    assert torchgco.solve(late).statuses == [Status.CONVERGED] * 3


def test_copies_keep_it_once() -> None:
    problem = points(BALL, DISC)
    again = Problem(POINT, LAZY, problem.constraints, X0, N, problem.goal)
    other = replace(problem, goal=replace(problem.goal, required=False))
    assert [len(p.constraints) for p in (problem, again, other, problem.take(slice(1, 2)))] == [3, 3, 2, 3]
    for given in (problem.constraints, problem.constraints[:2]):
        moved = problem.started_at(X0 + 0.1, given)
        assert isinstance(moved.constraints[-1], GoalBall) and len(moved.constraints) == 3
    sent = pickle.loads(pickle.dumps(points(STATE, cost=QuadraticCost([0.1] * 4, [1.0] * 2, [0.1] * 4)).constraints))
    assert torch.equal(sent[-1].state[:, :3], STATE_ROWS) and problem.cast(torch.float32).goal.required
    state = points(STATE)
    assert isinstance(replace(state, x0=X0 + 0.1).constraints[-1], GoalState)
    near = goal_tolerance(problem)
    assert near is not None and near.tolist() == pytest.approx([0.201, 0.301, 0.101])


STATE_ROWS = torch.tensor([[0.8, 0.8, 0.0]] * 3, dtype=D)


def test_gradients_pass_through_rows_that_bind() -> None:
    x0 = X0.clone().requires_grad_()
    found = torchgco.solve(points(STATE, x0=x0), solver=InteriorPoint(tolerance=1e-10))
    assert bool(found.differentiable.all())
    (slope,) = torch.autograd.grad(found.X[:, -1, 0].sum(), x0)
    torch.testing.assert_close(slope, torch.zeros_like(slope), atol=1e-6, rtol=0)  # the end is where it must be


def test_models_without_a_position_take_states() -> None:
    model = FunctionDynamics(lambda x, u: torch.stack((x[..., 1], u[..., 0] - x[..., 0].sin()), -1), 2, 1, 0.1, "rk4")
    cost = FunctionCost(lambda x, u: u.square().sum(-1), lambda x: 0.0 * x[..., 0])
    problem = Problem(model, cost, [], torch.zeros(2, 2, dtype=D), 40, Goal(state=[torch.pi, 0.0], required=True))
    found = torchgco.solve(problem)
    assert problem.goal is None and found.statuses == [Status.CONVERGED] * 2
    torch.testing.assert_close(found.X[:, -1], torch.tensor([[torch.pi, 0.0]] * 2, dtype=D), atol=1e-6, rtol=0)


@pytest.mark.slow
def test_one_out_of_reach_or_covered_is_infeasible_and_told() -> None:
    with pytest.warns(HorizonWarning, match="3 of 3 horizons are too short"):
        far = torchgco.solve(points(BALL, N=5))
    assert far.statuses == [Status.INFEASIBLE] * 3
    told = " ".join(far.explain(0).split())
    assert "goal is required, and no trajectory that was found meets it" in told
    missed = float((far.X[0, -1, :2] - 0.5).norm()) - 0.2
    assert f"misses it by {missed:.4g} m" in told and "A longer horizon: the way to the goal is" in told
    place = torch.tensor([[0.5, 0.5], [0.5, 0.5], [-1.0, -1.0]], dtype=D)
    cover = Spheres(place.unsqueeze(1), [[0.6]] * 3, 0.1)
    mixed = torchgco.solve(points(BALL, cover))
    assert mixed.statuses == [Status.INFEASIBLE] * 2 + [Status.CONVERGED]
    assert "an obstacle, grown by the vehicle's radius, covers all of it" in " ".join(mixed.explain(1).split())


def test_covered_goals_are_known_at_each_problems_own_last_knot() -> None:
    """A disc moves away from the goal at 1 m/s: it covers it at knot 4, and no longer at the others' last ones."""
    ball = Spheres([[0.5, 0.5]], [0.6], 0.1, velocities=[[1.0, 0.0]])
    ends = [4, N, 5]
    by_hand = [0.1 * k <= 0.6 + 0.1 - radius for k, radius in zip(ends, BALL.radius, strict=True)]
    held = points(BALL, ball, horizon=torch.tensor(ends))
    assert covered_goals(held).tolist() == by_hand == [True, False, True]


def test_compiled_numbers_move_it() -> None:
    for goal, name, value in ((BALL, "position", [0.2, 0.9]), (STATE, "state", [0.6, 0.9, 0.1, NAN])):
        mpc = torchgco.compile(points(goal, DISC))
        mpc()
        answer = mpc(numbers={f"goal.{name}": [value] * 3})
        other = replace(goal, **{name: value})
        fresh = torchgco.solve(points(other, DISC))
        np.testing.assert_allclose(answer.X[:, -1], fresh.X[:, -1], atol=1e-4)
        for wrong in ([value[0], NAN, *value[2:]], [torch.inf] * len(value)):
            with pytest.raises(InputError, match=rf"goal.{name}: expected"):
                mpc(numbers={f"goal.{name}": [wrong] * 3})


def test_a_goal_that_the_cost_names_does_not_rank_before_the_cost() -> None:
    """Behind a disc, the cheapest trajectory ends outside of the radius that is assumed around the cost's reference."""
    cost = QuadraticCost([0.0] * 4, [0.3] * 2, [1.0, 1, 0, 0], x_ref=[0.0, 0, 0, 0])
    bare = points(None, Spheres([[[0.9, 0.3]], [[0.9, 0.9]], [[0.7, -0.5]]], [[0.35]] * 3, 0.1), cost=cost, N=20)
    assert bare.goal is not None and bare.goal.assumed
    cheap = torchgco.solve(bare, solver=InteriorPoint())
    found = torchgco.solve(bare)
    assert not bool(has_arrived(bare, cheap.X).any())
    assert bool((found.cost <= cheap.cost * (1 + 1e-6)).all())


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        (Goal([0.5, 0.5], required=True), "goal.radius: expected numbers, got None"),
        (Goal(radius=0.5, required=True), "goal.position: expected numbers, got None"),
        (Goal([0.5, 0.5], 0.1, required=1), "goal.required: expected True or False, got 1"),  # type: ignore[arg-type]
        (Goal(state=[0.5, 0.5, 0, 0]), "goal.state: expected a state with required=True"),
        (Goal([0.5, 0.5], state=[0.5, 0.5, 0, 0], required=True), "goal.position: expected none beside a state"),
        (Goal(state=[0.5, 0.5], required=True), r"goal.state: expected shape \(3, 4\)"),
        (Goal(state=[NAN] * 4, required=True), "goal.state: expected finite numbers, NaN in the same"),
        (Goal(state=[0.5, torch.inf, 0, 0], required=True), "goal.state: expected finite numbers"),
        (Goal(state=[[0.5, 0.5, 0, 0], [0.5, 0.5, 0, NAN], [0.0] * 4], required=True), "goal.state: expected finite"),
        (Goal(state=[NAN, 0.5, 0, 0], required=True), "goal.state: expected a position that isn't free"),
        (Goal(state=[0.5, 0.5, 0, 0], radius=0.0, required=True), "goal.radius: expected finite numbers above 0 m"),
    ],
)
def test_wrong_input_is_named(goal: Goal, message: str) -> None:
    with pytest.raises(InputError, match=f"^{message}"):
        points(goal)


def test_beside_bounds_on_states_at_the_end() -> None:
    slow = StateBounds([-torch.inf] * 2 + [-0.1] * 2, [torch.inf] * 2 + [0.1] * 2, knots=[N])
    found = torchgco.solve(points(BALL, slow, DISC))
    assert found.statuses == [Status.CONVERGED] * 3 and float(found.X[:, -1, 2:].abs().max()) < 0.1 + 1e-5
