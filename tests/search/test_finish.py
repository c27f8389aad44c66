"""Constrained problems without obstacles: solved to their end, and infeasible only where nothing can be gained."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

import torchgco
from torchgco import (
    AugmentedLagrangian,
    ControlBounds,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Problem,
    Solution,
    StateBounds,
    Status,
    presets,
)

D, INF = torch.float64, math.inf
LIMITS = torch.tensor([0.08, 0.12, 0.16], dtype=D)  # of Bryson and Denham's problem


def effort(dt: float, *weights: float) -> FunctionCost:
    R = torch.tensor(weights, dtype=D)
    return FunctionCost(lambda x, u: 0.5 * dt * (R * u.square()).sum(-1))


def ends_at(*state: float) -> FunctionConstraint:
    goal = torch.tensor(state, dtype=D)
    return FunctionConstraint(lambda x: x - goal, sense="equality", knots=[-1], name="end")


def bryson_denham() -> Problem:
    """The least effort from (0, 1) to (0, -1) in 1 s with x <= l; known: 4 / (9 l) for l <= 1/6 in continuous time."""
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), dim=-1), 2, 1, 0.01, "rk4")
    upper = torch.stack((LIMITS, torch.full_like(LIMITS, INF)), dim=-1)
    bounds = StateBounds(torch.full_like(upper, -INF), upper)
    x0 = torch.tensor([[0.0, 1.0]], dtype=D).repeat(len(LIMITS), 1)
    return Problem(model, effort(0.01, 1.0), [bounds, ends_at(0.0, -1.0)], x0, 100)


def parking(B: int = 2) -> Problem:
    """A car at rest that should stand beside its place: the violation is stationary there, for any penalty."""

    def field(x: Tensor, u: Tensor) -> Tensor:
        speed, angle = u[..., 0], x[..., 2]
        return torch.stack((speed * angle.cos(), speed * angle.sin(), 2.0 * speed * u[..., 1].tan()), dim=-1)

    x0 = torch.zeros(B, 3, dtype=D)
    x0[:, 1] = torch.linspace(0.7, 1.2, B, dtype=D)
    limits = ControlBounds([-1.0, -0.6], [1.0, 0.6])
    return Problem(FunctionDynamics(field, 3, 2, 0.1, "rk4"), effort(0.1, 2.0, 0.6), [limits, ends_at(0, 0, 0)], x0, 60)


def brachistochrone() -> Problem:
    """The fastest slide to a point: the angle and the logarithm of the stage time are the controls."""

    def step(x: Tensor, u: Tensor) -> Tensor:
        h, slope = 0.02 * u[..., 1:].exp(), u[..., :1]
        field = lambda x: torch.cat((x[..., 2:] * slope.cos(), x[..., 2:] * slope.sin(), -9.81 * slope.sin()), dim=-1)
        half = x + 0.5 * h * field(x)
        return x + h * field(half)

    cost = FunctionCost(lambda x, u: 0.02 * u[..., 1].exp() + 1e-6 * u.square().sum(-1))
    end = FunctionConstraint(lambda x: x[..., :2] - torch.tensor([1.5, -1.0], dtype=D), sense="equality", knots=[-1])
    return Problem(FunctionDynamics(step, 3, 2, 0.02, "none"), cost, [end], torch.zeros(1, 3, dtype=D), 50)


def feasible(problem: Problem, solution: Solution) -> bool:
    X = torchgco.dynamics.rollout.open_loop(problem.dynamics, problem.x0, solution.U)
    return all(float(part.worst(X, solution.U).max()) <= 1e-3 for part in problem.constraints)


def test_the_known_optimum_is_found() -> None:
    problem = bryson_denham()
    cost = torchgco.solve(problem).cost
    # The discrete optimum lies a little above the continuous one: 1.0001 to 1.0008 times, says IPOPT.
    torch.testing.assert_close(cost, 4.0 / (9.0 * LIMITS), rtol=5e-3, atol=0)


def test_a_problem_without_a_solution_is_infeasible_and_soon() -> None:
    """Too far for its controls: the penalty grows until nothing changes any more."""
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), dim=-1), 2, 1, 0.05, "rk4")
    bounds, x0 = ControlBounds(-1.0, 1.0), torch.zeros(1, 2, dtype=D)
    far = Problem(model, effort(0.05, 1.0), [bounds, ends_at(9.0, 0.0)], x0, 40)
    near = replace(far, constraints=[bounds, ends_at(0.9, 0.0)])
    lost, found = torchgco.solve(far), torchgco.solve(near)
    assert lost.statuses == [Status.INFEASIBLE] and found.statuses == [Status.CONVERGED]
    cut = presets.al_ilqr(near).solve(near, torch.zeros(1, 40, 1, dtype=D))
    assert Status.INFEASIBLE not in cut.statuses  # its limit, not the problem, ended the solve


@pytest.mark.slow
def test_a_problem_keeps_its_bits_in_any_batch() -> None:
    whole, part = torchgco.solve(parking(3)), parking(3).take(torch.tensor([1]))
    assert torch.equal(torchgco.solve(part, ids=torch.tensor([1])).U[0], whole.U[1])


def rocket() -> Problem:
    """A rocket whose drag grows a thousandfold where it falls: without thrust the rollout overflows."""

    def field(x: Tensor, u: Tensor) -> Tensor:
        h, v = x.unbind(-1)
        drag = 50.0 * v * v.abs() * torch.exp(-100.0 * h)
        return torch.stack((v, u[..., 0] - drag - 1.0), dim=-1)

    model = FunctionDynamics(field, 2, 1, 0.05, "rk4")
    x0 = torch.tensor([[0.0, 0.0], [0.1, 0.0]], dtype=D)
    return Problem(model, FunctionCost(lambda x, u: 1e-3 * u.square().sum(-1), lambda x: -x[..., 0]),
                   [ControlBounds(0.0, 3.5)], x0, 60)  # fmt: skip


@pytest.mark.slow
def test_a_guess_that_overflows_starts_in_the_middle_of_the_bounds() -> None:
    problem = rocket()
    X = torchgco.dynamics.rollout.open_loop(problem.dynamics, problem.x0, torch.zeros(2, 60, 1, dtype=D))
    assert not bool(torch.isfinite(X).all())
    solution = torchgco.solve(problem)
    assert set(solution.statuses) <= {Status.CONVERGED, Status.FEASIBLE} and feasible(problem, solution)


def test_a_guess_that_breaks_the_bounds_starts_in_their_middle() -> None:
    """The stage time is a control with a positive lower bound: at rest no time would pass."""
    seen = []

    class Watch(AugmentedLagrangian):
        def run(self, call):
            seen.append(call.U0)
            return super().run(call)

    step = lambda x, u: x + u[..., 1:] * torch.cat((x[..., 1:], u[..., :1]), dim=-1)
    model = FunctionDynamics(step, 2, 2, 0.1, "none")
    cost = FunctionCost(lambda x, u: u[..., 1] + 0.1 * u.square().sum(-1), lambda x: x.square().sum(-1))
    bounds = ControlBounds([-INF, 0.1], [2.0, 0.5])
    problem = Problem(model, cost, [bounds], torch.ones(1, 2, dtype=D), 5)
    torchgco.solve(problem, solver=Watch())
    assert torch.equal(seen[0], torch.tensor([0.0, 0.3], dtype=D).expand(1, 5, 2))


def test_what_has_no_constraints_is_solved_to_its_end_too() -> None:
    """The integral of the cost is a state, so that the last knot alone has a cost: AL-iLQR crawls."""

    def rates(x: Tensor, u: Tensor) -> Tensor:
        p, v, u = x[..., 0], x[..., 1], u[..., 0]
        return torch.stack((v, (1 - p.square()) * v - p + u, 0.5 * (p.square() + v.square() + u.square())), dim=-1)

    x0 = torch.cat((torch.randn(16, 2, generator=torch.Generator().manual_seed(0), dtype=D), torch.zeros(16, 1)), -1)
    cost = FunctionCost(lambda x, u: 0.0 * u[..., 0], lambda x: x[..., 2])
    solution = torchgco.solve(Problem(FunctionDynamics(rates, 3, 1, 0.02, "rk4"), cost, [], x0, 100), verbose=False)
    assert solution.statuses == [Status.CONVERGED] * 16
