"""Problems of the ALTRO solver: solved to 1e-6 from the published start and from starts around it, against IPOPT."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from benchmarks.outside.golden import FINE, IPOPT, main
from benchmarks.outside.golden_problems import GOLDEN
from torchgco import Problem, Solution, Status, certify, solve
from torchgco.dynamics.rollout import open_loop

# IPOPT's costs from the published starts, the least of several initial guesses (escape: from the solution found here).
KNOWN = {
    "pendulum": 0.0184046, "cartpole": 1.48619, "parallel_park": 0.054067, "three_obstacles": 9.43551, "escape": 0.3227,
}  # fmt: skip
ALL = [name if name == "pendulum" else pytest.param(name, marks=pytest.mark.slow) for name in GOLDEN]
WITHIN = 1.01  # times IPOPT's cost
# From a small barrier: with the usual one IPOPT leaves a solution that it starts from, sometimes for a worse minimum.
PUSHES = ("bound_push", "bound_frac", "slack_bound_push", "slack_bound_frac")
NEAR = {"warm_start_init_point": "yes", "mu_init": 1e-8, **dict.fromkeys(PUSHES, 1e-8)}
CONTINUED = replace(IPOPT, options={**(IPOPT.options or {}), **NEAR})


def solved(name: str, starts: int) -> tuple[Problem, Solution]:
    problem, U0 = GOLDEN[name].batch(starts)
    return problem, solve(problem, solver=FINE, warm=GOLDEN[name].solve(problem, U0))


def assert_solved(problem: Problem, solution: Solution) -> None:
    """Feasible to 1e-6 on a rollout of its own, and stationary."""
    assert solution.statuses == [Status.CONVERGED] * problem.B
    X = open_loop(problem.dynamics, problem.x0, solution.U)
    assert all(float(constraint.worst(X, solution.U).max()) < 1e-6 for constraint in problem.constraints)
    certificate = certify(problem, solution.X, solution.U)
    assert float(certificate.kkt_residual.max()) < 1e-5
    assert float(certificate.dynamics_residual.max()) < 1e-9 and float(certificate.bound_violation.max()) < 1e-6


@pytest.mark.parametrize("name", ALL)
def test_the_published_start_at_its_known_cost(name: str) -> None:
    problem, solution = solved(name, 1)
    assert_solved(problem, solution)
    assert float(solution.cost) <= WITHIN * KNOWN[name]


@pytest.mark.slow
@pytest.mark.parametrize("name", GOLDEN)
def test_eight_starts_and_the_costs_of_ipopt(name: str) -> None:
    problem, solution = solved(name, 8)
    assert_solved(problem, solution)
    few = slice(0, 1 if name == "escape" else 8)  # IPOPT takes seconds for each with 170 discs
    part, U = problem.take(few), GOLDEN[name].U0.expand_as(solution.U)[few].contiguous()
    guessed, continued = IPOPT.solve(part, U), CONTINUED.solve(part, solution.U[few].contiguous())
    assert bool((guessed.violation < 1e-6).all()) and bool((continued.violation < 1e-6).all())
    assert bool((solution.cost[few] <= WITHIN * guessed.cost).all())
    torch.testing.assert_close(solution.cost[few], continued.cost, rtol=1e-6, atol=0)  # the minimum is IPOPT's, too


@pytest.mark.slow
def test_the_table(capsys) -> None:
    assert main(["--problems", "pendulum", "--starts", "2"]) == 0
    lines = [line.split(" | ") for line in capsys.readouterr().out.splitlines()[3:6]]  # of the file's table
    assert [line[2] for line in lines] == ["default", "default, refined", "IPOPT"]
    assert lines[1][3] == "2 of 2" and float(lines[1][5]) < 1e-6
