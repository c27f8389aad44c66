"""Starts that are variables: optima that are known, bounds, batches, peers, and what holds the start."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from torch import Tensor

import torchgco
from tests.problems import assert_same_bits
from torchgco import (
    ControlBounds,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    InputError,
    InteriorPoint,
    Problem,
    QuadraticCost,
    StartWarning,
    StateBounds,
    Status,
    certify,
    judge,
)
from torchgco.baselines import CasADiSolver
from torchgco.native.compiler import find_compiler

pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="no C compiler"),
]  # fmt: skip

D, INF = torch.float64, torch.inf
Q, R, LAST, REF = [1.0, 2, 0.5, 1], [0.1, 0.2], [5.0, 5, 5, 5], [1.0, -1, 0.5, 2]


def linear(B: int = 11, N: int = 12, mask: bool = True) -> tuple[Problem, np.ndarray, np.ndarray, np.ndarray]:
    """Random linear systems with one terminal equality; other components are free in each. Also A, B and its aims."""
    random = np.random.default_rng(1)
    A, by_u = np.eye(4) + 0.2 * random.normal(size=(B, 4, 4)), random.normal(size=(B, 4, 2))
    aim, free, x0 = random.normal(size=(B, 1)), random.random((B, 4)) < 0.5, random.normal(size=(B, 4))
    free[0], free[1] = True, False

    def step(x: Tensor, u: Tensor, A: Tensor, by_u: Tensor) -> Tensor:
        return (A * x.unsqueeze(-2)).sum(-1) + (by_u * u.unsqueeze(-2)).sum(-1)

    values = {"A": torch.from_numpy(A), "by_u": torch.from_numpy(by_u)}
    end = FunctionConstraint(
        lambda x, aim: x[..., :1] + x[..., 1:2] - aim, "equality", knots=[N], values={"aim": torch.from_numpy(aim)}
    )
    problem = Problem(
        FunctionDynamics(step, 4, 2, 1.0, "none", position=slice(0, 2), values=values),
        QuadraticCost(Q, R, LAST, REF), [end], torch.from_numpy(x0), N,
        free_start=torch.from_numpy(free) if mask else None,
    )  # fmt: skip
    return problem, A, by_u, aim


def dense(problem: Problem, A: np.ndarray, by_u: np.ndarray, aim: np.ndarray, free: np.ndarray) -> np.ndarray:
    """States (N+1, 4) from one dense KKT system for states, controls and multipliers; A and others of one problem."""
    N, n, m = problem.N, 4, 2
    states, size = (N + 1) * n, (N + 1) * n + N * m
    curvature = np.concatenate((np.tile(Q, N), LAST, np.tile(R, N)))
    slope = -curvature * np.concatenate((np.tile(REF, N + 1), np.zeros(N * m)))
    rows = np.zeros((N * n + 1, size))
    for k in range(N):
        at = slice(k * n, (k + 1) * n)
        rows[at, at], rows[at, (k + 1) * n : (k + 2) * n] = A, -np.eye(n)
        rows[at, states + k * m : states + (k + 1) * m] = by_u
    rows[-1, N * n : N * n + 2] = 1.0
    rows = np.concatenate((rows, np.eye(size)[:n][~free]))
    right = np.concatenate((np.zeros(N * n), aim, problem.x0[0].numpy()[~free]))
    K = np.block([[np.diag(curvature), rows.T], [rows, np.zeros((len(rows), len(rows)))]])
    return np.linalg.solve(K, np.concatenate((-slope, right)))[:states].reshape(N + 1, n)


def zeros(problem: Problem) -> Tensor:
    return torch.zeros(problem.B, problem.N, problem.m, dtype=D)


@pytest.mark.parametrize("solver", ["interior_point", "gco"])
def test_linear_problems_have_the_states_of_a_dense_system(solver: str) -> None:
    problem, A, by_u, aim = linear()
    solution = torchgco.solve(problem, solver=solver)
    assert solution.statuses == [Status.CONVERGED] * problem.B
    assert problem.free_start is not None
    for b in range(problem.B):
        free = problem.free_start[b].numpy()
        best = dense(problem.take(slice(b, b + 1)), A[b], by_u[b], aim[b], free)
        np.testing.assert_allclose(solution.X[b].numpy(), best, atol=1e-7)
        assert np.array_equal(solution.X[b, 0].numpy()[~free], problem.x0[b].numpy()[~free])


@pytest.mark.slow
def test_free_and_given_starts_in_one_batch_have_the_bits_of_each_alone() -> None:
    problem, *_ = linear()
    together = InteriorPoint().solve(problem, zeros(problem))
    for rows in ([0], [1], [10, 3, 1, 0], list(range(8))):
        part = problem.take(torch.tensor(rows))
        assert_same_bits(InteriorPoint().solve(part, zeros(part)), together.take(torch.tensor(rows)))
    given, *_ = linear(mask=False)
    alone = InteriorPoint().solve(given.take(slice(1, 2)), zeros(given)[:1])
    assert_same_bits(alone, together.take(torch.tensor([1])))


def test_judge_and_certificate_take_the_start_found_and_refuse_others() -> None:
    problem, *_ = linear()
    solution = InteriorPoint().solve(problem, zeros(problem))
    with pytest.raises(InputError, match="start"):
        judge(problem, solution.U)
    start = solution.X[:, 0].clone()
    verdict = judge(problem, solution.U, start=start)
    assert bool(verdict.feasible.all())
    torch.testing.assert_close(verdict.cost, solution.cost, rtol=1e-12, atol=0)
    start[1, 2] += 1e-9  # given in this problem
    assert judge(problem, solution.U, start=start).feasible.tolist() == [True, False] + [True] * 9
    found = certify(problem, solution.X, solution.U)
    assert float(found.dynamics_residual.max()) < 1e-12 and float(found.kkt_residual.max()) < 1e-7
    held = problem.held_at(problem.x0)
    other = InteriorPoint().solve(held, zeros(held))
    assert float(certify(problem, other.X, other.U).kkt_residual[0]) > 1e-3
    assert "feasible" not in solution.to_frame(problem) and len(solution.to_frame(problem)) == 11


def test_a_start_that_is_held_is_named_and_not_called_optimal() -> None:
    problem, *_ = linear(3)
    with pytest.warns(StartWarning, match="AugmentedLagrangian"):
        held = torchgco.solve(problem, solver="al_ilqr")
    assert torch.equal(held.X[:, 0], problem.x0) and held.statuses[0] == Status.FEASIBLE


def denham(limit: float, low: float | list[float] = -INF, v0: float = 0.0) -> Problem:
    """Bryson and Denham's: from p = 0 back to p = 0 with v = -1 in 1 s below a ceiling; the first velocity is free."""
    N = 50

    def exact(x: Tensor, u: Tensor) -> Tensor:
        p, v, a, h = x[..., 0], x[..., 1], u[..., 0], 1.0 / N
        return torch.stack((p + h * v + 0.5 * h * h * a, v + h * a), dim=-1)

    bounds = [StateBounds([-INF, -INF], [limit, INF])] if math.isfinite(limit) else []
    bounds += [StateBounds([-INF, low], [INF, INF], knots=[0])] if math.isfinite(low) else []
    end = FunctionConstraint(lambda x: torch.stack((x[..., 0], x[..., 1] + 1), dim=-1), "equality", knots=[N])
    return Problem(
        FunctionDynamics(exact, 2, 1, 1.0 / N, "none"), FunctionCost(lambda x, u: 0.5 / N * u[..., 0] ** 2),
        [end, *bounds], torch.tensor([[0.0, v0]], dtype=D), N, free_start=[False, True],
    )  # fmt: skip


def test_bryson_denham_with_a_free_velocity() -> None:
    """A free velocity has no costate at the start, so a = -c t; p(1) = v0 - c / 6 = 0 and v(1) = v0 - c / 2 = -1.

    So c = 3, v0 = 1/2, and the cost is c^2 / 6. Below a ceiling IPOPT has the same cost.
    """
    free = InteriorPoint(tolerance=1e-10).solve(denham(INF), zeros(denham(INF)))
    assert free.statuses == [Status.CONVERGED]
    assert float(free.X[0, 0, 1]) == pytest.approx(0.5, abs=1e-3) and float(free.cost) == pytest.approx(1.5, rel=1e-3)
    below = denham(0.1)
    capped, peer = InteriorPoint(tolerance=1e-9).solve(below, zeros(below)), CasADiSolver().solve(below, zeros(below))
    assert capped.statuses == [Status.CONVERGED] and float(capped.X[0, :, 0].max()) <= 0.1 + 1e-6
    torch.testing.assert_close(capped.cost, peer.cost, rtol=1e-6, atol=0)
    assert float(capped.cost) > 1.5 + 1e-3


def test_bounds_of_the_start_bind_and_move_the_guess_inside() -> None:
    """With v0 >= 1 the bound binds: v0 = 1 is the classic problem, u = -2 everywhere, of cost 2."""
    problem = denham(INF, low=1.0)
    assert problem.x0.tolist() == [[0.0, 1.0]]
    for solver in ("interior_point", "gco"):
        found = torchgco.solve(problem, solver=solver)
        assert found.statuses == [Status.CONVERGED]
        assert float(found.X[0, 0, 1]) == pytest.approx(1.0, abs=1e-6)
        assert float(found.cost) == pytest.approx(2.0, abs=1e-5)


def test_a_parameter_is_a_state_that_holds_with_a_free_start() -> None:
    """The decay rate of a measured exponential, and no control that matters."""
    rates, N = torch.tensor([[0.7], [1.9], [0.2]], dtype=D), 40
    measured = (-rates * 0.05 * torch.arange(N + 1, dtype=D)).exp()

    def field(x: Tensor, u: Tensor) -> Tensor:
        return torch.stack((-x[..., 1] * x[..., 0] + u[..., 0], 0 * x[..., 1]), dim=-1)

    cost = FunctionCost(
        lambda x, u, y: (x[..., 0] - y) ** 2 + 100 * u[..., 0] ** 2, lambda x, y: (x[..., 0] - y) ** 2,
        knot_values={"y": measured},
    )  # fmt: skip
    x0 = torch.tensor([[1.0, 1.0]], dtype=D).repeat(3, 1)
    problem = Problem(FunctionDynamics(field, 2, 1, 0.05, "rk4"), cost, [], x0, N, free_start=[False, True])
    for solver in ("interior_point", "gco"):
        found = torchgco.solve(problem, solver=solver)
        assert found.statuses == [Status.CONVERGED] * 3
        torch.testing.assert_close(found.X[:, 0, 1:], rates, rtol=1e-3, atol=0)
        torch.testing.assert_close(found.X[:, -1, 1], found.X[:, 0, 1], rtol=0, atol=0)


def test_a_periodic_orbit_of_a_driven_oscillator() -> None:
    """x_N = x_0 with copies of x_0 that hold; the orbit of x'' = -x - 0.5 x' + u is that of a linear recursion."""
    N, h = 60, math.pi / 60
    drive = (2 * h * torch.arange(N + 1, dtype=D)).cos()

    def field(x: Tensor, u: Tensor) -> Tensor:
        p, v, *_ = x.unbind(-1)
        return torch.stack((v, -p - 0.5 * v + u[..., 0], 0 * p, 0 * p), dim=-1)

    problem = Problem(
        FunctionDynamics(field, 4, 1, h, "rk4"),
        FunctionCost(lambda x, u, d: (u[..., 0] - d) ** 2, knot_values={"d": drive[None]}),
        [FunctionConstraint(lambda x: x[..., :2] - x[..., 2:], "equality", knots=[0, N])],
        torch.zeros(1, 4, dtype=D), N, free_start=[True] * 4,
    )  # fmt: skip
    found = InteriorPoint(tolerance=1e-10).solve(problem, zeros(problem))
    assert found.statuses == [Status.CONVERGED] and float(found.cost) < 1e-12
    whole = expm(h * np.array([[0.0, 1, 0], [-1, -0.5, 1], [0, 0, 0]]))
    A, by_u, x = whole[:2, :2], whole[:2, 2], np.zeros(2)
    for u in drive[:N].numpy():
        x = A @ x + by_u * u
    orbit = np.linalg.solve(np.eye(2) - np.linalg.matrix_power(A, N), x)
    np.testing.assert_allclose(found.X[0, [0, N], :2].numpy(), [orbit, orbit], atol=1e-6)


def test_wrong_masks() -> None:
    problem, *_ = linear(3)
    for mask in ([1, 0, 0, 0], [True], "all", torch.ones(2, 4, dtype=torch.bool)):
        with pytest.raises(InputError, match="free_start"):
            Problem(problem.dynamics, problem.cost, [ControlBounds(-1, 1)], problem.x0, problem.N, free_start=mask)
