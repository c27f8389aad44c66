"""Problems of OptimalControlProblems.jl: one statement for both solvers, and what is known of the optima."""

import casadi as ca
import numpy as np
import pytest
import torch

import torchgco
from benchmarks.outside.control_toolbox import PROBLEMS, row, straight
from tests.slow import mostly
from torchgco import Status

SHORT = ("beam", "Jackson")


@pytest.mark.parametrize("name", PROBLEMS)
def test_both_solvers_get_the_same_problem(name: str) -> None:
    form, first, N, _ = PROBLEMS[name]
    problem, n, m = form.problem(N, first), len(form.start), len(form.control[0])
    assert (problem.dynamics.n, problem.dynamics.m, problem.N) == (n, m, N) and len(form.end) == n
    x, u = 0.1 + torch.rand(3, n, dtype=torch.float64), torch.rand(3, m, dtype=torch.float64)
    at, by = ca.SX.sym("x", n), ca.SX.sym("u", m)
    rates = ca.Function("rates", [at, by], [ca.vertcat(*form.rates(ca.vertsplit(at), ca.vertsplit(by), ca))])
    for i, ahead in enumerate(problem.dynamics.field(x, u)):
        np.testing.assert_allclose(ahead, np.array(rates(x[i].numpy(), u[i].numpy())).ravel(), rtol=1e-12, atol=1e-12)


def test_the_cart_and_its_rod_keep_their_energy() -> None:
    form = PROBLEMS["cart pendulum"][0]
    x, inertia = torch.tensor([0.1, 0.7, 0.8, -1.3], dtype=torch.float64), 1 / 12 + 0.25

    def energy(x: torch.Tensor) -> torch.Tensor:
        v, angle, rate = x[1:].unbind()
        return 0.75 * v**2 + 0.5 * v * rate * angle.cos() + 0.5 * inertia * rate**2 - 0.5 * 9.81 * angle.cos()

    rates = torch.stack(form.rates(x.unbind(), [torch.zeros(())], torch))
    slope = torch.func.grad(energy)(x)
    assert abs(float(slope @ rates)) < 1e-12


@pytest.mark.parametrize("name", mostly(PROBLEMS, *set(PROBLEMS) - set(SHORT)))
def test_ends_are_met_and_known_optima_found(name: str) -> None:
    form, first, N, known = PROBLEMS[name]
    solution = torchgco.solve(form.problem(N, first), verbose=False)
    assert solution.statuses == [Status.CONVERGED] and float(solution.violation) <= 1e-6
    assert known is None or abs(float(solution.cost)) == pytest.approx(known, rel=1e-3)


def test_a_row_has_both_values() -> None:
    cells = row("beam")
    value, count, _ = cells[-1].split("; ")
    assert cells[:3] == ["beam", "3, 1, 100", "8.88889"] and float(cells[3]) == pytest.approx(float(value), rel=1e-6)
    assert int(count) > 0 and straight(PROBLEMS["beam"][0]).guess(0.5) == [0, 0, 0]
