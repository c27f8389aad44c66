"""Slopes whose terms cancel within the code of a cost are measured by its curvature, not by their own rounding."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import compiled
from torchgco import ControlBounds, FunctionCost, FunctionDynamics, Problem, Status, certify
from torchgco.base.autodiff import gradients
from torchgco.dynamics.rollout import open_loop
from torchgco.judging.certificate import _curvatures

D = torch.float64
N = 5


def residual(problem: Problem, U: Tensor) -> float:
    return float(certify(problem, open_loop(problem.dynamics, problem.x0, U), U).kkt_residual)


def slope_and_hessian(problem: Problem, U: Tensor) -> tuple[Tensor, Tensor]:
    """Of the cost by all controls of a problem."""

    def cost(u: Tensor) -> Tensor:
        X, V = [problem.x0], u.view_as(U)
        for k in range(problem.N):
            X.append(problem.dynamics.step(X[-1], V[:, k]))
        return problem.cost.total(torch.stack(X, dim=1), V).sum()

    u = U.flatten().requires_grad_()
    (slope,) = torch.autograd.grad(cost(u), u, create_graph=True)
    rows = [torch.autograd.grad(one, u, retain_graph=True)[0] for one in slope]
    return slope.detach(), torch.stack(rows)


def sum_of_squares(seed: int, of: str, by_control: float = 1.0, by_cost: float = 1.0) -> Problem:
    """Drawn squares of linear forms of the controls alone, or of the next state alone, in drawn units: every slope is a
    sum of terms that cancel at the optimum."""
    draws = torch.Generator().manual_seed(seed)
    forms, aims, B = (torch.randn(shape, generator=draws, dtype=D) for shape in ((2, 4), (4,), (2, 2)))
    B = (B + 3.0 * torch.eye(2, dtype=D)) / by_control
    squares = lambda z: by_cost * (z @ forms - aims).square().sum(-1)
    model = FunctionDynamics(lambda x, u: -0.3 * x + u @ B, 2, 2, 0.5, "rk4")
    if of == "controls":
        cost = FunctionCost(lambda x, u: squares(u / by_control), lambda x: 0.0 * x[..., 0])
    else:
        cost = FunctionCost(lambda x, u: squares(x), squares)
    return Problem(model, cost, [], torch.randn(1, 2, generator=draws, dtype=D), N)


def at_optimum(problem: Problem) -> Tensor:
    """The optimum (1, N, m) of a cost that is quadratic in the controls."""
    zero = torch.zeros(1, N, problem.m, dtype=D)
    slope, hessian = slope_and_hessian(problem, zero)
    U = -torch.linalg.solve(hessian, slope)
    return (U - torch.linalg.solve(hessian, slope_and_hessian(problem, U.view_as(zero))[0])).view_as(zero)


@pytest.mark.parametrize("of", ["controls", "states"])
@pytest.mark.parametrize("seed", range(4))
def test_optima_of_sums_of_squares_have_no_residual_in_any_unit(seed: int, of: str) -> None:
    found, beside = list[float](), list[float]()
    for by_control, by_cost in ((1.0, 1.0), (1e-6, 1.0), (1e6, 1e9), (1.0, 1e-9)):
        problem = sum_of_squares(seed, of, by_control, by_cost)
        U = at_optimum(problem)
        found.append(residual(problem, U))
        beside.append(residual(problem, U * (1.0 + 1e-5)))
        assert residual(problem, U * (1.0 + 1e-2)) > 0.3, "a hundredth of the controls is far away"
    assert max(found) < 1e-9
    assert min(beside) > 1e-4 and beside == pytest.approx([beside[0]] * 4, rel=1e-3)


COSTS: dict[str, Callable[[Tensor], Tensor]] = {
    "exponential": lambda u: u.exp() - 3.0 * u,
    "two wells": lambda u: u**4 - u**2,
    "hyperbolic": lambda u: u.cosh(),
    "two squares": lambda u: (u - 0.1).square() + (u - 0.3).square(),
}


@compiled
@pytest.mark.parametrize("bounds", [(), (ControlBounds(-2.0, 2.0),)], ids=["free", "bounded"])
@pytest.mark.parametrize("name", COSTS)
def test_what_a_solver_calls_converged_is_certified(name: str, bounds: tuple[ControlBounds, ...]) -> None:
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), -1), 2, 1, 0.1)
    cost = FunctionCost(lambda x, u: COSTS[name](u[..., 0]))
    problem = Problem(model, cost, bounds, torch.tensor([[1.0, 0.0]], dtype=D), 20)
    for guess in (0.0, 0.1):
        found = torchgco.solve(problem, torch.full((1, 20, 1), guess, dtype=D), verbose=False)
        assert found.statuses == [Status.CONVERGED]
        certificate = certify(problem, found.X, found.U, multipliers=found.multipliers.lam)
        assert max(float(certificate.kkt_residual), residual(problem, found.U)) < 1e-4
        assert residual(problem, found.U + 0.05) > 0.5 or bool(bounds)


def drawn(seed: int) -> tuple[Problem, Tensor, Tensor]:
    """A problem whose slopes by each control depend on states and controls of all kinds, and a trajectory."""
    draws = torch.Generator().manual_seed(seed)
    A, B, S = (torch.randn(shape, generator=draws, dtype=D) for shape in ((3, 3), (2, 3), (5, 5)))

    def stage(x: Tensor, u: Tensor) -> Tensor:
        z = torch.cat((x, u), dim=-1).sin()
        return ((z @ S) * z).sum(-1)

    model = FunctionDynamics(lambda x, u: (x @ A).sin() + u.sin() @ B, 3, 2, 0.2)
    cost = FunctionCost(stage, lambda x: x[..., 0].exp() * x[..., 1] ** 2)
    problem = Problem(model, cost, [], torch.randn(1, 3, generator=draws, dtype=D), N)
    U = torch.randn(1, N, 2, generator=draws, dtype=D)
    return problem, open_loop(model, problem.x0, U), U


@pytest.mark.parametrize("seed", range(3))
def test_curvatures_are_those_of_finite_differences(seed: int) -> None:
    """One number after the other, by central differences of the cost's slopes and of the model."""
    problem, X, U = drawn(seed)
    h, expected = 1e-6, torch.zeros(N, 2, 2, dtype=D)
    slopes = lambda x, u: gradients(problem.cost.total, x, u)
    fu = torch.zeros(N, 3, 2, dtype=D)
    for j in range(2):
        move = h * torch.eye(2, dtype=D)[j]
        ends = [problem.dynamics.step(X[:, :-1], U + sign * move)[0] for sign in (1, -1)]
        fu[:, :, j] = (ends[0] - ends[1]) / (2 * h)
    for j in range(2):
        by_state = torch.zeros_like(X)
        by_state[0, 1:] = h * fu[:, :, j]
        by_control = (h * torch.eye(2, dtype=D)[j]).expand_as(U)
        for dx, du in ((by_state, torch.zeros_like(U)), (torch.zeros_like(X), by_control)):
            upper, lower = slopes(X + dx, U + du), slopes(X - dx, U - du)
            of_x, of_u = ((a - b)[0].abs() / (2 * h) for a, b in zip(upper, lower, strict=True))
            for k in range(N):
                for i in range(2):
                    expected[k, i, j] += of_u[k, i] + sum(of_x[k + 1, s] * fu[k, s, i].abs() for s in range(3))
    torch.testing.assert_close(_curvatures(problem, X, U), expected.amax(0), rtol=1e-6, atol=1e-8)


def test_a_cost_without_second_derivatives_is_measured_by_the_terms_that_are_seen() -> None:
    class Square(torch.autograd.Function):
        @staticmethod
        def forward(z: Tensor) -> Tensor:
            return z.square()

        @staticmethod
        def setup_context(ctx, inputs, output) -> None:
            ctx.save_for_backward(*inputs)

        @staticmethod
        def backward(ctx, slope: Tensor) -> Tensor:  # type: ignore[override]
            return 2.0 * slope * ctx.saved_tensors[0]

    cost = FunctionCost(lambda x, u: Square.apply(u[..., 0] - 0.5), lambda x: x[..., 0].square())
    problem = Problem(FunctionDynamics(lambda x, u: u, 1, 1, 1.0), cost, [], torch.zeros(1, 1, dtype=D), 1)
    assert residual(problem, torch.full((1, 1, 1), 0.25, dtype=D)) < 1e-12  # 2 (u - 0.5) + 2 u
    assert residual(problem, torch.full((1, 1, 1), 0.75, dtype=D)) == pytest.approx(1.0)
