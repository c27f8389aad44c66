"""Linear-quadratic problems against one dense KKT system each, and convex problems against an exact QP solver."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
import torch

import torchgco
from benchmarks.outside.golden import FINE
from tests.golden.linear import LinearQuadratic, saddle
from torchgco import Constraint, ControlBounds, FunctionConstraint, Solution, StateBounds, Status, certify
from torchgco.dynamics.rollout import open_loop

SIZES = [(1, 1, 1), (4, 2, 13)]  # n, m, N
MORE = [(n, m, N) for n in (1, 2, 5, 8) for m in (1, 3, 4) for N in (2, 11, 40)]
CASES = SIZES + [pytest.param(*size, marks=pytest.mark.slow) for size in MORE]


def solved(lq: LinearQuadratic, constraints: list[Constraint]) -> tuple[torchgco.Problem, Solution]:
    problem = lq.problem(constraints)
    return problem, torchgco.solve(problem, solver=FINE, warm=torchgco.solve(problem))


def goal_of(lq: LinearQuadratic) -> FunctionConstraint:
    """x_N = the origin, in as many components as the controls can steer."""
    reach = min(lq.n, lq.m * lq.N)
    return FunctionConstraint(lambda x: x[..., :reach], "equality", knots=[lq.N], name="goal")


@pytest.mark.parametrize("n, m, N", CASES)
def test_controls_cost_and_gains_are_those_of_the_dense_kkt_system(n: int, m: int, N: int, native: bool) -> None:
    lq = LinearQuadratic(n, m, N)
    problem = lq.problem()
    solution = torchgco.solve(problem)
    assert solution.statuses == [Status.CONVERGED] * lq.B
    for b in range(lq.B):
        H, g, constant = lq.quadratic(b)
        z, _, slopes = saddle(H, g, *lq.dynamics(b))
        U = lq.controls(z)
        np.testing.assert_allclose(solution.U[b], U, rtol=0, atol=1e-8 * np.abs(U).max())
        cost = 0.5 * z @ H @ z + g @ z + constant
        np.testing.assert_allclose(solution.cost[b], cost, rtol=1e-10, atol=1e-10 * abs(constant))
        gain = slopes[n : n + m, :n]  # du_0/dx_0
        np.testing.assert_allclose(solution.K[b, 0], gain, rtol=0, atol=1e-8 * np.abs(gain).max())
    assert float(certify(problem, solution.X, solution.U).kkt_residual.max()) < 1e-8


@pytest.mark.parametrize("n, m, N", CASES)
def test_a_terminal_equality_and_its_multipliers_against_the_dense_kkt_system(n: int, m: int, N: int) -> None:
    lq = LinearQuadratic(n, m, N)
    reach = min(n, m * N)
    problem, solution = solved(lq, [goal_of(lq)])
    assert solution.statuses == [Status.CONVERGED] * lq.B and float(solution.violation.max()) < 1e-8
    last = np.eye(lq.size)[-n:][:reach]
    for b in range(lq.B):
        H, g, constant = lq.quadratic(b)
        E, e = lq.dynamics(b)
        z, multipliers, _ = saddle(H, g, np.r_[E, last], np.r_[e, np.zeros(reach)])
        U, lam = lq.controls(z), multipliers[-reach:]
        np.testing.assert_allclose(solution.U[b], U, rtol=0, atol=1e-8 * np.abs(U).max())
        np.testing.assert_allclose(solution.multipliers.lam[0][b, 0], lam, rtol=0, atol=1e-6 * np.abs(lam).max())
        np.testing.assert_allclose(solution.cost[b], 0.5 * z @ H @ z + g @ z + constant, rtol=1e-8)
    assert float(certify(problem, solution.X, solution.U).kkt_residual.max()) < 1e-7


@pytest.mark.sampled(1)
@pytest.mark.parametrize("n, m, N", [(2, 1, 8), (4, 2, 20), pytest.param(8, 4, 40, marks=pytest.mark.slow)])
def test_bounds_and_half_spaces_against_an_exact_quadratic_program(n: int, m: int, N: int) -> None:
    lq = LinearQuadratic(n, m, N)
    normal = np.random.default_rng(n).normal(size=(2, n))
    walls = torch.from_numpy(normal)
    free = torchgco.solve(lq.problem())
    reach = float(0.5 * free.U.abs().max())
    within = open_loop(lq.problem().dynamics, lq.problem().x0, 0.8 * free.U.clamp(-reach, reach))  # a feasible choice
    beyond, height = float((within[:, 1:] @ walls.T).max()), within[..., 0].amax(-1)
    between = FunctionConstraint(lambda x: (walls * x.unsqueeze(-2)).sum(-1) - beyond, knots=slice(1, None))
    top = torch.cat((height.unsqueeze(-1), torch.full((lq.B, n - 1), torch.inf)), dim=-1)
    above = StateBounds([-np.inf] * n, top, knots=slice(1, None))
    problem, solution = solved(lq, [ControlBounds([-reach] * m, [reach] * m), between, above])
    assert solution.statuses == [Status.CONVERGED] * lq.B and float(solution.violation.max()) < 1e-6
    active = np.zeros(3, dtype=int)
    for b in range(lq.B):
        z, cost = exact(lq, b, reach, normal, beyond, float(height[b]))
        np.testing.assert_allclose(solution.cost[b], cost, rtol=1e-6)
        np.testing.assert_allclose(solution.U[b], lq.controls(z), rtol=0, atol=1e-5 * reach)
        X = np.r_[z, np.zeros(m)].reshape(N + 1, n + m)[1:, :n]
        slacks = reach - np.abs(lq.controls(z)), beyond - X @ normal.T, float(height[b]) - X[:, 0]
        active += [int((slack < 1e-9).sum()) for slack in slacks]
    assert (active > 0).all()  # else a kind of constraint tests nothing
    assert float(certify(problem, solution.X, solution.U).kkt_residual.max()) < 1e-5


def exact(
    lq: LinearQuadratic, b: int, reach: float, normal: np.ndarray, beyond: float, height: float
) -> tuple[np.ndarray, float]:
    """z and its cost by CasADi's active-set solver: |u| <= reach, normal x <= beyond, x_0 <= height from knot 1 on."""
    H, g, constant = lq.quadratic(b)
    E, e = lq.dynamics(b)
    s = lq.n + lq.m
    half = np.zeros((2 * lq.N, lq.size))
    lower, upper = np.full(lq.size, -np.inf), np.full(lq.size, np.inf)
    for k in range(lq.N + 1):
        if k > 0:
            half[2 * (k - 1) : 2 * k, k * s : k * s + lq.n] = normal
            upper[k * s] = height
        if k < lq.N:
            lower[k * s + lq.n : (k + 1) * s], upper[k * s + lq.n : (k + 1) * s] = -reach, reach
    A = np.r_[E, half]
    quiet = {"print_iter": False, "print_header": False, "print_info": False}
    solver = ca.conic("qp", "qrqp", {"h": ca.DM(H).sparsity(), "a": ca.DM(A).sparsity()}, quiet)
    found = solver(
        h=H, g=g, a=A, lba=np.r_[e, np.full(len(half), -np.inf)], uba=np.r_[e, np.full(len(half), beyond)],
        lbx=lower, ubx=upper,
    )  # fmt: skip
    assert solver.stats()["success"]
    z = np.array(found["x"]).ravel()
    return z, float(0.5 * z @ H @ z + g @ z + constant)
