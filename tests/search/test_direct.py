"""The interior point beside the search: what it finds competes, and spares a search that could save little."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.problems import planar_batch, quadrotor_batch
from torchgco import ControlBounds, FunctionDynamics, Problem, QuadraticCost, Restarts, Spheres, presets, solve
from torchgco.search import Direct, IntoGoal, Join, Solve
from torchgco.search.nearby import without_obstacles

D = torch.float64


def bicycle(drift: float, end: float = 1.0) -> Problem:
    """A bicycle with a constant drift, and one disc on its way; stopped millimetres inside it at the optimum.

    The cost of its last state counts `end` times as much.
    """

    def field(x: Tensor, u: Tensor) -> Tensor:
        speed, heading = x[..., 3], x[..., 2]
        turn = speed * u[..., 1].tan() / 2.5
        rate = torch.stack((speed * heading.cos(), speed * heading.sin(), turn, u[..., 0]), dim=-1)
        return rate + drift * torch.tensor([0.1, -0.2, 0.15, 0.1], dtype=D)

    cost = QuadraticCost(Q=[1, 1, 0.1, 0.1], R=[0.1, 1.0], Qf=[10 * end, 10 * end, end, end], x_ref=[10.0, 1, 0, 0])
    rows = [ControlBounds([-3, -0.5], [3, 0.5]), Spheres([[5.0, 0.2]], [0.8], vehicle_radius=0.5)]
    return Problem(
        FunctionDynamics(field, 4, 2, 0.1, "rk4", position=slice(0, 2)), cost, rows, torch.zeros(1, 4, dtype=D), 50
    )


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("drift", "cost"), [(0.01, 780.93), (0.05, 780.14)])
def test_an_optimum_that_a_solve_was_stopped_at_is_found(drift: float, cost: float) -> None:
    """Searches of thousands of iterations ended at 798.9 and 797.7."""
    problem = bicycle(drift)
    found = solve(problem)
    assert float(found.cost[0]) == pytest.approx(cost, abs=0.01) and int(found.iterations[0]) <= 300
    free = solve(without_obstacles(problem), solver="interior_point")
    assert float(free.cost[0]) < float(found.cost[0]) < 1.02 * float(free.cost[0])


def test_results_that_wait_compete_at_the_end() -> None:
    problem = bicycle(0.05)
    rest = problem.x0.new_zeros(1, 50, 2)
    local = presets.gco(problem).local
    first = Solve(single_contact_after=3)
    dear = Restarts(local, (first, Direct(gap=0.0), IntoGoal())).solve(problem, rest)
    both = Restarts(local, (first, Direct(gap=0.0), IntoGoal(), Join())).solve(problem, rest)
    assert float(both.cost[0]) == pytest.approx(780.14, abs=0.01)
    assert not float(dear.violation[0]) <= 1e-3 and torch.equal(both.iterations, dear.iterations)


def test_it_solves_as_tightly_as_its_table() -> None:
    """Its results are never tightened again: at the default's tolerance, multiplier times row was 1e-7 of the cost."""
    problem = bicycle(0.05, end=1e3)
    found = solve(problem, solver="gco_exact")
    assert float(found.cost[0]) == pytest.approx(780.50, abs=0.01)
    for part, lam in zip(problem.constraints, found.multipliers.lam, strict=True):
        assert float((lam * part.value(found.X, found.U)).abs().max()) <= 1e-8 * float(found.cost[0])


def test_it_serves_in_the_plane_among_few_obstacles() -> None:
    few, many = (planar_batch(B=1, obstacles=count)[0] for count in (5, 6))
    assert Direct().serves(few) and not Direct().serves(many) and Direct(most=6).serves(many)
    assert not Direct().serves(quadrotor_batch(B=1, obstacles=3)[0])
    two = replace(few, constraints=[*few.constraints, Spheres([[3.0, 3.0]], [0.1])])
    assert not Direct().serves(two)  # all kinds together
