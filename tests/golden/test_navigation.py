"""jaxipm's navigation: its form and its derivatives; test_jaxipm.py solves it."""

from __future__ import annotations

import numpy as np
import torch

from benchmarks.outside.navigation_problem import FASTEST, HOVER, SLOWEST, fan, line_guess, navigation
from torchgco import ControlBounds, StateBounds


def test_the_form_of_the_problem() -> None:
    problem = navigation(fan(5, 90.0))
    assert (problem.n, problem.m, problem.N, problem.dynamics.dt) == (13, 4, 29, 0.1)
    cylinders, controls, states = problem.constraints
    assert isinstance(controls, ControlBounds) and isinstance(states, StateBounds)
    X, U = problem.x0.unsqueeze(1).expand(-1, 30, -1).contiguous(), problem.x0.new_ones(5, 29, 4)
    assert cylinders.value(X, U).shape == (5, 28, 4)
    np.testing.assert_allclose(controls.lower[0] * HOVER, SLOWEST)
    np.testing.assert_allclose(controls.upper[0] * HOVER, FASTEST)
    assert states.upper[0].tolist() == [10.0] * 3 + [np.inf] * 4 + [10.0] * 6
    np.testing.assert_allclose(problem.x0[:, :2].norm(dim=-1), 32**0.5)
    np.testing.assert_allclose(problem.x0[2, :3], [4.0, 4.0, 0.0], atol=1e-12)


def test_the_cylinders_grow() -> None:
    """r^2 grows by a tenth per second: after 2 s, that of the largest is 0.95^2 * 1.2."""
    problem = navigation(fan(1, 90.0))
    X = problem.x0.new_zeros(1, 30, 13)
    X[..., :2] = 3.0
    rows = problem.constraints[0].value(X, X.new_ones(1, 29, 4))
    np.testing.assert_allclose(rows[0, [0, 19], 3], [0.95**2 * 1.01, 0.95**2 * 1.2])


def test_the_derivatives_of_the_cylinders() -> None:
    problem = navigation(fan(3, 90.0))
    X0, U0 = line_guess(problem.x0)
    cylinders = problem.constraints[0]
    g = torch.randn(3, 28, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    H = X0.new_zeros(3, 30, 18, 18)
    cylinders.accumulate(X0, U0, g, torch.zeros_like(g), H)
    X = X0.clone().requires_grad_()
    (slope,) = torch.autograd.grad((g * cylinders.value(X, U0)).sum(), X)
    torch.testing.assert_close(H[..., :13, 13], slope)
    H.zero_()
    cylinders.accumulate(X0, U0, torch.zeros_like(g), g, H)
    rows = torch.func.jacrev(lambda x: cylinders.value(x.unsqueeze(0), U0[:1])[0])(X0[0])  # (28, 4, 30, 13)
    for k in (0, 13, 27):
        J = rows[k, :, k + 1]
        torch.testing.assert_close(H[0, k + 1, :13, :13], J.mT @ (g[0, k].unsqueeze(-1) * J))
