"""Published problems of several phases against programs by hand, and how phases are warned of."""

from __future__ import annotations

import warnings

import pytest
import torch

import torchgco
from benchmarks.families.phases import CASES, beside
from tests.engines import compiled
from torchgco import FreeTime, FunctionConstraint, FunctionCost, FunctionDynamics, Phases, Problem, Status
from torchgco.base.errors import StepWarning
from torchgco.judging.steps import step_errors
from torchgco.kernels import costates
from torchgco.phases.solution import _costates

pytestmark = compiled
QUICK = "bouncing ball", "two-burn orbit raise"
PUBLISHED = {"two-burn orbit raise": (0.3995, 1e-3), "Delta III": (-7.529712, 1e-3)}  # cost, and share for other steps


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in CASES]
)
def test_costs_are_those_of_ipopt_by_hand(name: str) -> None:
    solution, theirs, _ = beside(CASES[name])
    assert theirs.status == "Solve_Succeeded" and solution.statuses == [Status.CONVERGED]
    assert float(solution.cost) == pytest.approx(theirs.cost, rel=1e-6)
    assert bool(torchgco.judge(solution.phases, solution).feasible.all())
    if name in PUBLISHED:
        cost, share = PUBLISHED[name]
        assert float(solution.cost) == pytest.approx(cost, rel=share)


@pytest.mark.slow
def test_batches_end_as_their_problems_do() -> None:
    many = CASES["two-burn orbit raise"].phases(5)
    solution = torchgco.solve(many)
    assert solution.statuses == [Status.CONVERGED] * 5
    alone = torchgco.solve(Phases([one.take(torch.tensor([3])) for one in many.members]))
    assert torch.equal(alone[2].X[0], solution[2].X[3])


def oscillating(dt: float) -> Phases:
    """A swing that one phase pushes, and the next lets go to a height."""
    swing = FunctionDynamics(
        lambda x, u: torch.stack((x[..., 1], u[..., 0] - 30.0 * x[..., 0]), -1), n=2, m=1, dt=dt, integrator="rk4"
    )
    cost = FunctionCost(lambda x, u: dt * u[..., 0] ** 2 + 0.1 * dt * x[..., 1] ** 2)
    there = FunctionConstraint(lambda x: x[..., :1] - 1.0, "equality", knots=[-1])
    part = lambda *rows, **more: Problem(swing, cost, rows, torch.tensor([[0.1, 0.0]]).double(), 8, **more)
    return Phases([part(), part(there, time=FreeTime(0.5, 2.0))])


def test_steps_of_phases_are_judged_by_the_slopes_of_all() -> None:
    """In the last phase the slopes are those of autodiff, which sees this phase alone."""
    solution = torchgco.solve(oscillating(0.1))
    whole, found, part = solution.whole, solution.found, solution[1]
    slopes = lambda: costates(whole.problem, found.X, found.U, found.multipliers.lam)
    given = part.X, part.U, part.times, list(part.multipliers.lam)
    mine = step_errors(whole.members[1], *given, kernels=(_costates(whole.members[1], whole.spans[1], slopes), None))
    theirs = step_errors(whole.members[1], *given)
    assert float(theirs.step_cost) > 0.0
    torch.testing.assert_close(mine.step_cost, theirs.step_cost, rtol=1e-6, atol=0.0)


@pytest.mark.slow
def test_steps_that_are_too_long_are_named() -> None:
    with pytest.warns(StepWarning, match="steps that are too long"):
        torchgco.solve(oscillating(0.4))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        torchgco.solve(oscillating(0.05))
