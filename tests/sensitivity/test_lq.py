"""Bounded linear-quadratic problems: gradients against one dense KKT system in NumPy per problem."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import compiled
from torchgco import ControlBounds, FunctionDynamics, Problem, QuadraticCost
from torchgco.base.status import Differentiability as Why
from torchgco.kernels import current, use_native
from torchgco.sensitivity import attached

D = torch.float64
Array = np.ndarray
B, N, n, m = 12, 20, 8, 4


def numbers() -> dict[str, Tensor]:
    torch.manual_seed(0)
    A = torch.eye(n, dtype=D) + 0.2 * torch.randn(n, n, dtype=D) / n**0.5
    parts = {
        "A": A,
        "B": 0.3 * torch.randn(n, m, dtype=D),
        "Q": torch.eye(n, dtype=D),
        "R": 0.1 * torch.eye(m, dtype=D),
    }
    held = {name: part.repeat(B, 1, 1) for name, part in parts.items()}
    starts, drift = 2 * torch.randn(B, n, dtype=D), 0.05 * torch.randn(B, n, dtype=D)
    return held | {"b": drift, "x0": starts, "high": torch.ones(B, m, dtype=D), "low": -torch.ones(B, m, dtype=D)}


def problem(th: dict[str, Tensor]) -> Problem:
    step = lambda x, u, A, B, b: (A * x.unsqueeze(-2)).sum(-1) + (B * u.unsqueeze(-2)).sum(-1) + b
    model = FunctionDynamics(step, n, m, 0.1, "none", values={name: th[name] for name in ("A", "B", "b")})
    cost = QuadraticCost(th["Q"].unsqueeze(1), th["R"].unsqueeze(1), th["Q"])
    return Problem(model, cost, [ControlBounds(th["low"], th["high"])], th["x0"], N)


def dense(
    th: dict[str, np.ndarray], X: np.ndarray, U: np.ndarray, by_X: np.ndarray, by_U: np.ndarray
) -> dict[str, np.ndarray]:
    """Gradients of sum(by_X X) + sum(by_U U) of one problem; w = [x_1 .. x_N, u_0 .. u_{N-1}]."""
    size = N * (n + m)
    xs = lambda k: slice((k - 1) * n, k * n)
    us = lambda k: slice(N * n + k * m, N * n + (k + 1) * m)
    H, E, g = np.zeros((size, size)), np.zeros((N * n, size)), np.zeros(size)
    for k in range(N):
        H[xs(k + 1), xs(k + 1)], H[us(k), us(k)] = th["Q"], th["R"]
        g[xs(k + 1)], g[us(k)] = by_X[k + 1], by_U[k]
        row = slice(k * n, (k + 1) * n)
        E[row, xs(k + 1)], E[row, us(k)] = -np.eye(n), th["B"]
        if k > 0:
            E[row, xs(k)] = th["A"]
    held = [
        (k, j, sign)
        for k in range(N)
        for j in range(m)
        for sign, at in ((1, th["high"]), (-1, th["low"]))
        if abs(U[k, j] - at[j]) < 1e-7
    ]
    C = np.zeros((len(held), size))
    for row, (k, j, sign) in zip(C, held, strict=True):
        row[N * n + k * m + j] = sign
    both = np.vstack((E, C))
    K = np.block([[H, both.T], [both, np.zeros((len(both), len(both)))]])
    side = -np.concatenate((g, np.zeros(len(both))))
    w = np.linalg.solve(K, side)
    w += np.linalg.solve(K, side - K @ w)  # to the last digits
    wx, wu = np.vstack((np.zeros(n), w[: N * n].reshape(N, n))), w[N * n : size].reshape(N, m)
    wy, wc = w[size : size + N * n].reshape(N, n), w[size + N * n :]
    y = np.zeros((N + 2, n))  # costates
    for k in range(N, 0, -1):
        y[k] = th["Q"] @ X[k] + (th["A"].T @ y[k + 1] if k < N else 0)
    found = {
        "A": sum(np.outer(wy[k], X[k]) + np.outer(y[k + 1], wx[k]) for k in range(N)),
        "B": sum(np.outer(wy[k], U[k]) + np.outer(y[k + 1], wu[k]) for k in range(N)),
        "Q": sum(np.outer(wx[k], X[k]) for k in range(1, N + 1)), "R": sum(np.outer(wu[k], U[k]) for k in range(N)),
        "b": wy.sum(0), "x0": th["A"].T @ wy[0] + by_X[0], "high": np.zeros(m), "low": np.zeros(m),
    }  # fmt: skip
    for (_, j, sign), v in zip(held, wc, strict=True):
        found["high" if sign > 0 else "low"][j] -= sign * v
    return found


def test_gradients_are_those_of_a_dense_system() -> None:
    th = numbers()
    leaves = {name: part.clone().requires_grad_() for name, part in th.items()}
    solution = torchgco.solve(problem(leaves), verbose=False)
    assert bool(solution.differentiable.all())
    by_X, by_U = torch.randn(B, N + 1, n, dtype=D), torch.randn(B, N, m, dtype=D)
    mine = torch.autograd.grad((by_X * solution.X).sum() + (by_U * solution.U).sum(), list(leaves.values()))
    slopes, held = dict(zip(leaves, mine, strict=True)), 0
    for b in range(B):
        one = {name: part[b].numpy() for name, part in th.items()}
        X, U = solution.X[b].detach().numpy(), solution.U[b].detach().numpy()
        held += int((np.abs(np.abs(U) - 1) < 1e-7).sum())
        for name, want in dense(one, X, U, by_X[b].numpy(), by_U[b].numpy()).items():
            slope = slopes[name][b].numpy()
            if name in ("Q", "R"):  # the cost reads the symmetric part alone
                want, slope = want + want.T, slope + slope.T
            np.testing.assert_allclose(slope, want, rtol=0, atol=1e-11 * max(1.0, np.abs(want).max()), err_msg=name)
    assert held > 20 * B


STAGES = 170  # over which the fall of an upright pendulum grows by 1e15


def upright(x0: Tensor) -> Problem:
    step = lambda x, u: x + 0.05 * torch.cat((x[..., 1:], 20.0 * x[..., :1] + u), -1)
    cost = QuadraticCost([1.0, 0.1], [0.1], [5.0, 1.0], x_ref=[0.2, 0.0])
    return Problem(FunctionDynamics(step, 2, 1, 0.05, "none"), cost, [ControlBounds(-99, 99)], x0, STAGES)


def slopes_of_cost(x0: Array) -> Array:
    """P [x - x_ref, 1] of the least cost, by the recursion of Riccati."""
    A, M = np.array([[1.0, 0.05, 0.0], [1.0, 1.0, 0.2], [0.0, 0.0, 1.0]]), np.array([[0.0], [0.05], [0.0]])
    P = np.diag([5.0, 1.0, 0.0])
    for _ in range(STAGES):
        K = np.linalg.solve(0.1 + M.T @ P @ M, M.T @ P @ A)
        P = np.diag([1.0, 0.1, 0.0]) + A.T @ P @ (A - M @ K)
    return np.hstack((x0 - [0.2, 0.0], np.ones((len(x0), 1)))) @ P[:, :2]


@pytest.mark.parametrize("in_c", [pytest.param(True, marks=compiled), pytest.param(False, marks=pytest.mark.slow)])
def test_unstable_dynamics_magnify_no_rounding(in_c: bool) -> None:
    """Costates that are passed from stage to stage without feedback are off by a share of 1e15 roundings."""
    x0 = torch.tensor([[0.3, -0.2], [-0.1, 0.4]], dtype=D, requires_grad=True)
    use_native(in_c)
    try:
        found = torchgco.solve(upright(x0), solver="interior_point", verbose=False)
        assert bool(found.differentiable.all())
        (slope,) = torch.autograd.grad(found.cost.sum(), x0)
        np.testing.assert_allclose(slope.numpy(), slopes_of_cost(x0.detach().numpy()), rtol=1e-9)
        blind = replace(found.detach(), K=torch.zeros_like(found.K))
        reason = attached(upright(x0), current(upright(x0)), blind).reason
        assert reason is not None and reason.tolist() == [Why.NOT_STATIONARY] * 2
    finally:
        use_native(True)
