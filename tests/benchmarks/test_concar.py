"""The notebook's model equals the printed one, and its result holds for some of the layouts."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from benchmarks.outside.concar import EXACT, GOAL, GOAL_RADIUS, main, own_model, read_layouts, zero_controls
from torchgco import judge
from torchgco.obstacles.spheres import BoundSpheres

SOME = [0, 1, 2, 3, 4, 5, 11, 51]  # the last two need guidance


@pytest.fixture(scope="module")
def model() -> SimpleNamespace:
    return own_model()


def random_flight(model: SimpleNamespace):
    problem = model.problem_of(read_layouts().iloc[SOME])
    generator = torch.Generator().manual_seed(0)
    X = torch.randn(problem.B, problem.N + 1, problem.n, generator=generator, dtype=torch.float64)
    U = torch.randn(problem.B, problem.N, problem.m, generator=generator, dtype=torch.float64)
    return problem, X, U


def test_the_car_is_the_printed_one(model) -> None:
    problem, X, U = random_flight(model)
    x, u, h = X[:, 0], U[:, 0], 0.05
    theta, v = x[:, 2] + 0.5 * h * u[:, 1], x[:, 3] + 0.5 * h * u[:, 0]  # at half the step; both are linear in time
    slope = torch.stack((v * theta.cos(), v * theta.sin(), u[:, 1], u[:, 0]), dim=-1)
    torch.testing.assert_close(problem.dynamics.step(x, u), x + h * slope, rtol=1e-14, atol=1e-14)


def test_the_cost_is_the_printed_one(model) -> None:
    problem, X, U = random_flight(model)
    gap = X[:, -1] - torch.tensor([1.0, 1.0, torch.pi / 4, 0.0], dtype=torch.float64)
    stages = 0.05 * (5.0 * U[..., 0].square() + U[..., 1].square())
    expected = 200.0 * gap.square().sum(-1) + stages.sum(-1)
    torch.testing.assert_close(problem.cost.total(X, U), expected, rtol=1e-12, atol=1e-12)


def test_circles_and_limits_are_those_of_the_file(model) -> None:
    layouts = read_layouts().iloc[SOME]
    problem, X, U = random_flight(model)
    spheres, bounds = problem.constraints
    assert isinstance(spheres, BoundSpheres) and spheres.knots == slice(1, 100)
    row = layouts.iloc[3]
    reach = row["r_obs2"] + 0.02
    expected = reach**2 - (X[3, 7, 0] - row["x_obs2"]) ** 2 - (X[3, 7, 1] - row["y_obs2"]) ** 2
    assert float(spheres.value(X, U)[3, 6, 1]) == pytest.approx(float(expected), abs=1e-12)
    assert bounds.upper[3].tolist() == [row["F_lim"], row["tau_lim"]]
    assert problem.x0[3].tolist() == row[["x0", "y0", "theta0", "v0"]].tolist()


def test_some_are_feasible_in_one_batch(model) -> None:
    problem = model.problem_of(read_layouts().iloc[SOME])
    solution = model.solver.solve(problem, zero_controls(problem), ids=torch.tensor(SOME))
    verdict = judge(problem, solution.U, GOAL, GOAL_RADIUS)
    assert verdict.feasible.all() and float(verdict.violation.max()) <= EXACT
    assert (solution.guided > 0).tolist() == [False] * 6 + [True] * 2
    torch.testing.assert_close(verdict.cost, solution.cost)


@pytest.mark.slow
def test_the_table_compares_with_ipopt(capsys) -> None:
    assert main(["--first", "1"]) == 0
    table = [line.split(" | ") for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    ours, peer, *published = table[1:]
    assert len(published) == 3 and {len(line) for line in table} == {9}
    assert ours[2:4] == ["1", "1"] == peer[2:4]
    # Both end in a local optimum; on this layout IPOPT's is not better.
    assert float(ours[5]) <= 1.01 * float(peer[5])
