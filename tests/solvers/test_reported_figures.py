"""What a solution reports is computed from what it returns, by PyTorch, and a status never hides what isn't finite."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import compiled
from torchgco import (
    ControlBounds,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Planar,
    Problem,
    QuadraticCost,
    ScaleWarning,
    Spheres,
    StateBounds,
    Status,
)
from torchgco.kernels.in_c import NativeKernels
from torchgco.kernels.in_pytorch import Judged
from torchgco.lagrangian.lagrangian import SolveEnd
from torchgco.lagrangian.quality import violation
from torchgco.native.compiler import find_compiler
from torchgco.problem.horizons import within_horizons
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian

D, INF = torch.float64, torch.inf
SOLVERS = "gco", "gco_fast", "gco_max", "interior_point", "al_ilqr", "mppi", "ipopt", "hold"
SLOW = "gco_max", "mppi"
CLAIMS = Status.CONVERGED, Status.FEASIBLE


def cart(x: Tensor, u: Tensor) -> Tensor:
    return torch.stack((x[..., 1], u[..., 0]), dim=-1)


def among_discs(horizon: Tensor | None = None) -> Problem:
    return Problem(
        Planar(dt=0.1),
        QuadraticCost([1, 1, 0, 1, 1, 0], [0.1, 0.1], [50, 50, 0, 1, 1, 0], [1, 0.4, 0, 0, 0, 0]),
        [Spheres([[0.2, 0.1]], [0.1], vehicle_radius=0.06), ControlBounds(-1.0, 1.0)],
        torch.tensor([[-1.0, 0, 0, 0, 0, 0], [-1.0, 0.3, 0, 0, 0, 0]], dtype=D),
        30,
        horizon=horizon,
    )


@pytest.mark.parametrize("solver", [pytest.param(s, marks=[pytest.mark.slow] * (s in SLOW)) for s in SOLVERS])
@pytest.mark.filterwarnings("ignore::torchgco.ContactWarning")
def test_costs_and_violations_are_those_of_what_is_returned(solver: str) -> None:
    for horizon in (None, torch.tensor([30, 20])):
        problem = among_discs(horizon)
        if horizon is not None and solver == "ipopt":
            continue
        found = torchgco.solve(problem, solver=solver)
        whole = within_horizons(problem)
        torch.testing.assert_close(found.violation, violation(whole.constraints, found.X, found.U), rtol=0, atol=1e-15)
        torch.testing.assert_close(found.cost, whole.cost.total(found.X, found.U), rtol=1e-14, atol=0)


@compiled
def test_violations_are_those_that_kernels_measure_but_for_a_users_rows(monkeypatch) -> None:
    problem, U0 = among_discs(), torch.ones(2, 30, 2, dtype=D)
    own = replace(problem, constraints=[*problem.constraints, FunctionConstraint(lambda x: x[..., :1] - 0.5)])
    solver = AugmentedLagrangian(max_outer_iterations=1).in_closed_loop(1)[1]
    for part in (problem, own):
        found = solver.solve(part, U0)
        torch.testing.assert_close(found.violation, violation(part.constraints, found.X, found.U), rtol=0, atol=1e-15)
        assert float(found.violation.min()) > 1e-3
    judged = NativeKernels.judged

    def blind(self: NativeKernels, *parts: Any) -> Judged:
        found = judged(self, *parts)
        return found._replace(worst=torch.zeros_like(found.worst))

    monkeypatch.setattr(NativeKernels, "judged", blind)
    assert not bool(solver.solve(problem, U0).violation.any()) and bool(solver.solve(own, U0).violation.all())


def test_a_kernel_that_measures_wrongly_changes_no_report(monkeypatch) -> None:
    """As one would whose trace isn't the user's code."""
    loop = AugmentedLagrangian.outer_loop

    def blind(self: AugmentedLagrangian, *parts: Any, **options: Any) -> SolveEnd:
        end = loop(self, *parts, **options)
        end.best.violation.zero_()
        return end

    monkeypatch.setattr(AugmentedLagrangian, "outer_loop", blind)
    problem = among_discs()
    found = torchgco.solve(problem, torch.ones(2, 30, 2, dtype=D), AugmentedLagrangian(max_outer_iterations=1))
    assert torch.equal(found.violation, violation(problem.constraints, found.X, found.U))
    assert float(found.violation.min()) > 1e-3 and not set(found.statuses) & set(CLAIMS)


# Costs that are NaN ---------------------------------------------------------------------------------------------------

COSTS = {
    "a table's end": lambda x, u: torch.where(x[..., 1] > 1.2, torch.nan, (x[..., 0] - 3).square()),
    "infinite beyond": lambda x, u: torch.where(x[..., 1] > 1.2, torch.inf, (x[..., 0] - 3).square()),
    "acos without weight": lambda x, u: (x[..., 0] - 3).square() + 0.0 * torch.acos(x[..., 1] / 1.2),
}


@pytest.mark.sampled(4)
@pytest.mark.parametrize("solver", ["gco", "gco_fast", "interior_point", "al_ilqr"])
@pytest.mark.parametrize("name", COSTS)
def test_a_cost_that_is_not_finite_is_no_solution(name: str, solver: str) -> None:
    stage = lambda x, u: COSTS[name](x, u) + 0.1 * u[..., 0].square()
    end = lambda x: 10 * (x[..., 0] - 3).square() + x[..., 1].square()
    x0 = torch.stack((torch.linspace(0, 1, 8, dtype=D), torch.zeros(8, dtype=D)), dim=-1)
    problem = Problem(FunctionDynamics(cart, 2, 1, 0.1), FunctionCost(stage, end), [ControlBounds(-2.0, 2.0)], x0, 30)
    found = torchgco.solve(problem, solver=solver)
    for status, cost in zip(found.statuses, found.cost.tolist(), strict=True):
        assert math.isfinite(cost) or status is Status.NON_FINITE, (status, cost)


@pytest.mark.parametrize("solver", ["gco", "interior_point", "al_ilqr"])
def test_a_model_that_is_not_finite_has_no_solution(solver: str) -> None:
    """A compiler knows that 0 times anything is 0; PyTorch knows better."""
    bounded = lambda x, u: cart(x, u) + 0.0 * (1.2 - x[..., 1:]).log()
    x0 = torch.stack((torch.linspace(0, 1, 8, dtype=D), torch.zeros(8, dtype=D)), dim=-1)
    goal = QuadraticCost([1.0, 0.0], [0.1], [10.0, 1.0], [4.0, 0.0])
    problem = Problem(FunctionDynamics(bounded, 2, 1, 0.1), goal, [ControlBounds(-2.0, 2.0)], x0, 30)
    found = torchgco.solve(problem, solver=solver)
    finite = torch.isfinite(problem.along.step(found.X[:, :-1], found.U)).flatten(1).all(-1)
    assert not bool(finite.all())
    assert [status is Status.NON_FINITE for status in found.statuses] == (~finite).tolist()


def test_a_finite_trajectory_is_preferred_to_one_that_is_cheaper_in_no_number() -> None:
    """The interior point ends where the cost is NaN; what AL-iLQR finds is returned."""
    if find_compiler() is None:
        pytest.skip("no C compiler")
    stage = lambda x, u: COSTS["a table's end"](x, u) + 0.1 * u[..., 0].square()
    end = lambda x: 10 * (x[..., 0] - 3).square() + x[..., 1].square()
    problem = Problem(
        FunctionDynamics(cart, 2, 1, 0.1), FunctionCost(stage, end), [ControlBounds(-2.0, 2.0)], [[0.0, 0.0]], 30
    )
    assert 100 < float(torchgco.solve(problem).cost) < 150


# Units ----------------------------------------------------------------------------------------------------------------


def least_time(unit: float) -> Problem:
    """Three metres to rest at 1 m/s^2, in units of 1 / `unit` m, in a time that is free."""
    rates = lambda x, u: torch.stack((x[..., 2] * x[..., 1], x[..., 2] * u[..., 0], 0 * x[..., 2]), dim=-1)
    goal = torch.tensor([3 * unit, 0.0], dtype=D)
    return Problem(
        FunctionDynamics(rates, 3, 1, 1 / 40, "rk4"),
        FunctionCost(lambda x, u: 0 * u[..., 0], lambda x: x[..., 2]),
        [
            ControlBounds(-unit, unit),
            StateBounds([-INF, -INF, 0.1], [INF, INF, 50.0], knots=[0]),
            FunctionConstraint(lambda x: x[..., :2] - goal, "equality", knots=[40]),
        ],
        [[0.0, 0.0, 5.0]],
        40,
        free_start=[False, False, True],
    )


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e-4, 1e-5, 1e-6])
def test_a_tolerance_that_swallows_the_constraint_is_said(unit: float) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = torchgco.solve(least_time(unit))
    right = abs(float(found.cost) / (2 * math.sqrt(3)) - 1) < 0.01
    said = [str(one.message) for one in caught if issubclass(one.category, ScaleWarning)]
    assert right != bool(said), (float(found.cost), said)
    if said:
        assert "constraints[2] (FunctionConstraint)" in said[0] and "units" in said[0]


@pytest.mark.filterwarnings("error::torchgco.ScaleWarning")
def test_violations_of_ordinary_problems_are_no_matter_of_units() -> None:
    """AL-iLQR ends at violations of up to 1e-3; a start at the goal, and one that breaks a bound by less, too."""
    for x0 in ([-1.0, 0.0], [0.0, 0.0], [0.0, -9e-4]):
        goal = FunctionConstraint(lambda x: x, "equality", knots=[20])
        bounds = StateBounds([-INF, 0.0 if x0[1] else -1.0], [INF, 1.5], knots=slice(0, 21))
        problem = Problem(
            FunctionDynamics(cart, 2, 1, 0.1), QuadraticCost([1, 0], [0.1], [1, 1]),
            [ControlBounds(-2, 2), bounds, goal], [x0], 20,
        )  # fmt: skip
        for solver in ("gco", "al_ilqr"):
            torchgco.solve(problem, solver=solver)
