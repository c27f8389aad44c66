"""A trajectory that touches an obstacle between two knots is returned with a warning, and only such a one."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import compiled
from torchgco import (
    AugmentedLagrangian,
    ContactWarning,
    ControlBounds,
    Cost,
    FunctionDynamics,
    Goal,
    Planar,
    Problem,
    QuadraticCost,
    RateBounds,
    Solution,
    Spheres,
    Status,
    judge,
)

pytestmark = pytest.mark.filterwarnings("ignore::torchgco.StepWarning")  # steps of 0.5 s
FAST = AugmentedLagrangian()


def row_of_discs(B: int = 8, thin: tuple[int, ...] = (1, 3, 4, 5, 6, 7), dt: float = 0.5) -> Problem:
    """Vehicles that drive 4 m straight ahead; in the way of some lies a disc that fits between two of their knots."""
    start = torch.zeros(B, 6, dtype=torch.float64)
    cost = QuadraticCost(Q=[0, 0, 0, 0, 0, 0], R=[1, 1], Qf=[500, 500, 1, 1, 1, 1], x_ref=[4, 0, 0, 0, 0, 0])
    free = FAST.solve(Problem(Planar(dt=dt), cost, [], start, N=8), start.new_zeros(B, 8, 2))
    centers = free.X[:, 3:5, :2].mean(1, keepdim=True)
    centers[[i for i in range(B) if i not in thin]] += torch.tensor([0.0, 5.0])
    return Problem(
        Planar(dt=dt), cost, [Spheres(centers, torch.full_like(centers[..., 0], 0.05), vehicle_radius=0.02)], start, N=8
    )


@compiled
def test_contact_between_knots_comes_with_one_warning_that_names_the_problems() -> None:
    problem = row_of_discs()
    with pytest.warns(ContactWarning) as caught:
        solution = torchgco.solve(problem, solver=FAST)
    (warning,) = [one for one in caught if one.category is ContactWarning]
    assert Path(warning.filename) == Path(__file__), "it points at the call"
    assert re.search(r"^6 of 8 trajectories .*: problem 1, 3, 4, 5, 6, \.\.\. \(", str(warning.message))
    ended = [Status.INFEASIBLE if i in (1, 3, 4, 5, 6, 7) else Status.CONVERGED for i in range(8)]
    assert solution.statuses == ended and float(solution.violation.max()) <= 1e-3
    assert judge(problem, solution.U).feasible.tolist() == [status is Status.CONVERGED for status in ended]
    frame = solution.to_frame(problem)
    assert (frame.clearance < 0).tolist() == [i in (1, 3, 4, 5, 6, 7) for i in range(8)]


def with_rates(problem: Problem) -> Problem:
    return replace(problem, constraints=[*problem.constraints, RateBounds(-50.0, 50.0, previous=0.0)])


@compiled
@pytest.mark.filterwarnings("error::torchgco.kernels.choice.EagerWarning")
def test_contact_beside_limited_rates_is_measured_by_the_solvers_own_kernels() -> None:
    """Rows of two knots can't be compiled as the user gives them, and distances don't ask for them."""
    problem = with_rates(row_of_discs())
    with pytest.warns(ContactWarning, match="6 of 8"):
        torchgco.solve(problem, solver=FAST)
    mpc = torchgco.MPC(problem, period=0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactWarning)
        mpc.step(problem.x0)
    assert mpc.feasible.shape == (8,)


@compiled
def test_no_warning_without_contact() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", ContactWarning)
        torchgco.solve(row_of_discs(thin=()), solver=FAST)


@pytest.mark.sampled(1)
@pytest.mark.filterwarnings("ignore::torchgco.ContactWarning")
@pytest.mark.parametrize("kind", ["rates", "horizons", "both"])
def test_statuses_are_the_judges_along_the_models_own_path(kind: str) -> None:
    """With limited rates and horizons of their own, too: chords of steps of 0.2 s come closer to discs."""
    field = lambda x, u: torch.cat((x[..., 2:], u), dim=-1)
    model = FunctionDynamics(field, 4, 2, 0.2, "rk4", position=slice(0, 2))
    x0 = torch.zeros(12, 4, dtype=torch.float64)
    x0[:, 1] = torch.linspace(0.0, 0.3, 12)
    cost = QuadraticCost([0.1, 0.1, 0, 0], [0.1, 0.1], [50, 50, 5, 5], [1.44, 0, 0, 0])
    parts = [ControlBounds(-4.0, 4.0), Spheres([[0.72, 0.1]], [0.2], vehicle_radius=0.1)]
    parts += [RateBounds(-3.0, 3.0)] if kind != "horizons" else []
    horizon = torch.tensor([12, 10] * 6) if kind != "rates" else None
    problem = Problem(model, cost, parts, x0, 12, goal=Goal([1.44, 0.0], 0.3), horizon=horizon)
    found = torchgco.solve(problem, solver="interior_point")
    verdict = judge(problem, found.U)
    claims = [status in (Status.CONVERGED, Status.FEASIBLE) for status in found.statuses]
    assert claims == verdict.feasible.tolist() and any(claims)
    assert all("Result" in str(found.explain(b)) for b in (0, 1))


def test_columns_of_the_judge_come_with_the_problem() -> None:
    problem = row_of_discs(B=3, thin=(1,))
    solution = FAST.solve(problem, torch.zeros(3, 8, 2, dtype=torch.float64))
    plain, judged = solution.to_frame(), solution.to_frame(problem)
    assert "clearance" not in plain and judged.columns.tolist() == [*plain.columns, "clearance", "reached"]
    verdict = torchgco.judge(problem, solution.U)
    assert judged.clearance.tolist() == verdict.clearance.tolist() and judged.clearance[1] < 0 < judged.clearance[0]
    assert judged.reached.tolist() == verdict.reached.tolist() == [True, False, True]
    with pytest.raises(torchgco.InputError, match=r"U: expected a tensor \(2, 8, 2\)"):
        solution.to_frame(problem.take(slice(0, 2)))


class Effort(Cost):
    """Asks for no state, and so for no goal."""

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return u.square().sum(-1)

    def terminal(self, x: Tensor) -> Tensor:
        return x[..., 3:].square().sum(-1)


@pytest.mark.parametrize(
    ("cost", "obstacles", "names"),
    [
        (QuadraticCost(Q=[1] * 6, R=[1, 1], Qf=[1] * 6, x_ref=[1, 0, 0, 0, 0, 0]), [], {"reached"}),
        (Effort(), [Spheres([[1.0, 0.0]], [0.1])], {"clearance"}),
        (Effort(), [], set()),
    ],
)
def test_columns_follow_what_the_problem_has(cost: Cost, obstacles: list[Spheres], names: set[str]) -> None:
    problem = Problem(Planar(dt=0.1), cost, obstacles, torch.zeros(2, 6, dtype=torch.float64), N=8)
    solution = FAST.solve(problem, problem.x0.new_zeros(2, 8, 2))
    frame = solution.to_frame(problem)
    assert set(frame.columns) - set(solution.to_frame().columns) == names
    if "clearance" in names:
        assert frame.clearance.tolist() == pytest.approx([1.0 - 0.95 * 0.1] * 2)


def test_a_problem_in_single_precision_is_judged_in_double() -> None:
    problem = row_of_discs(B=2, thin=())
    solution = FAST.solve(problem, problem.x0.new_zeros(2, 8, 2))
    single = replace(solution, X=solution.X.float(), U=solution.U.float())
    frame = single.to_frame(problem.cast(torch.float32))
    assert frame.clearance.tolist() == pytest.approx(solution.to_frame(problem).clearance.tolist(), abs=1e-4)


def test_a_solution_is_shown_in_one_line() -> None:
    problem = row_of_discs(B=3, thin=())
    solution: Solution = FAST.solve(problem, torch.zeros(3, 8, 2, dtype=torch.float64))
    solution.status[2], solution.cost[2] = Status.NON_FINITE, torch.nan
    low, high = solution.cost[:2].min(), solution.cost[:2].max()
    expected = f"Solution(B=3, N=8, n=6, m=2: 2 CONVERGED, 1 NON_FINITE; cost {low:.6g} to {high:.6g})"
    assert repr(solution) == expected
    solution.cost[:] = torch.nan
    assert repr(solution).endswith("; no finite cost)")
