"""jaxipm's navigation: its form, and a few starts at the costs of the source's own script."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import torch

from benchmarks.outside.navigation import COMPARISON, TOLERANCE, local, main
from benchmarks.outside.navigation_problem import FASTEST, HOVER, SLOWEST, fan, line_guess, navigation, recount
from torchgco import ControlBounds, StateBounds
from torchgco.dynamics.rollout import open_loop
from torchgco.lagrangian.quality import violation

# Costs of the source's script with IPOPT, by the place among 80 starts of the fan of 180 degrees.
KNOWN = {0: 497.919359, 20: 498.304044, 60: 498.304012, 79: 497.919359}


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


def test_the_problem_is_the_one_that_is_judged() -> None:
    problem = navigation(fan(6, 180.0))
    U = 1 + 0.02 * torch.randn(6, 29, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    U[1] += 1.0  # beyond the bounds
    X = open_loop(problem.dynamics, problem.x0, U)
    X[2, :, :2] = 1.2
    cost, worst, states = recount(problem.x0.numpy(), U.numpy())
    rest = [0, 1, 3, 4, 5]
    torch.testing.assert_close(torch.from_numpy(states)[rest], X[rest], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(problem.cost.total(X, U)[rest], torch.from_numpy(cost)[rest], rtol=1e-9, atol=1e-9)
    found = violation(problem.constraints, X, U)
    torch.testing.assert_close(found[rest], torch.from_numpy(worst)[rest], rtol=1e-9, atol=1e-9)
    assert worst[1] > 0.2 and float(found[2]) > 0.4


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


def test_a_few_starts_reach_the_known_costs() -> None:
    problem = navigation(fan(80, 180.0)[list(KNOWN)])
    solution = local(problem, torch.arange(problem.B))()
    cost, worst, _ = recount(problem.x0.numpy(), solution.U.numpy())
    assert worst.max() <= TOLERANCE
    np.testing.assert_allclose(cost, list(KNOWN.values()), rtol=1e-4)


def test_a_row_compares_costs_where_both_solve_and_rates_core_by_core() -> None:
    flight = pd.DataFrame(
        {"fan": "90 degrees", "solver": "IPOPT", "cost": [1.0, 2.0, 4.0], "violation": [0.0, 0.0, 1.0]}
    )
    peer = flight.assign(iterations=9, alone=10.0, shared=20.0)
    own = peer.assign(
        solver="AL-iLQR", cost=[1.5, 2.0, 8.0], violation=[1e-7, 5e-4, 0.0], iterations=[3, 4, 5], alone=200.0,
        shared=300.0,
    )  # fmt: skip
    (row,) = COMPARISON.rows([own], peer)
    assert row[:6] == ["90 degrees", "AL-iLQR", 3, "2 of 3 [20.8, 93.9] %", "3 of 3", "5e-04"]
    assert row[6:] == ["1.5000, 1.5000, 1.5000", "4", "200", "300", "20.0", "15.0"]


@pytest.mark.slow
def test_the_table(capsys) -> None:
    assert main(["--starts", "4", "--sectors", "180"]) == 0
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines()[2:]]
    assert len(rows) == 3 and rows[1][3].startswith("4 of 4") and rows[2][3].startswith("4 of 4")
    assert 0.98 < float(rows[1][6].split(", ")[2]) < 1.02
