"""A time limit of a solve: passes and attempts stop, every problem keeps a trajectory and a status."""

from collections.abc import Callable
from itertools import count
from types import SimpleNamespace

import pytest
import torch

from tests.problems import assert_same_bits, planar_batch, quick_gco
from tests.slow import mostly
from torchgco import ILQR, AugmentedLagrangian, InputError, MultiStart, Problem, Spheres, Status
from torchgco.obstacles.spheres import BoundSpheres
from torchgco.solvers import contracts
from torchgco.solvers.contracts import Solver

LOCAL = AugmentedLagrangian(ILQR(max_iterations=2), initial_penalty=0.1, max_outer_iterations=8)
SOLVERS: dict[str, Callable[[Problem], Solver]] = {
    "al_ilqr": lambda problem: LOCAL,
    "restarts": lambda problem: quick_gco(problem, LOCAL),
    "multistart": lambda problem: MultiStart(LOCAL, starts=4),
}
# How a solve may end that the time limit has cut short.
ENDS = {Status.TIME_LIMIT, Status.CONVERGED, Status.FEASIBLE, Status.INFEASIBLE}


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A clock that is one second later at every look; the list counts the looks."""
    looks: list[int] = []
    seconds = count()

    def later() -> float:
        looks.append(1)
        return float(next(seconds))

    monkeypatch.setattr(contracts, "clock", SimpleNamespace(seconds=later))
    return looks


@pytest.mark.parametrize("name", mostly(SOLVERS, "restarts"))
def test_a_tiny_limit_leaves_finite_trajectories(name: str, clock: list[int]) -> None:
    problem, U0 = planar_batch(B=5, N=30, obstacles=9, seed=4)
    solver, passes = SOLVERS[name](problem), []
    full = solver.solve(problem, U0, seed=3, callback=lambda now: now.row or passes.append(now.passes))
    assert not clock  # nobody looks at a clock without a limit
    cut = []
    solution = solver.solve(
        problem, U0, seed=3, max_seconds=0.5, callback=lambda now: now.row or cut.append(now.passes)
    )
    assert len(cut) == 1 < len(passes)
    assert set(solution.statuses) <= ENDS and Status.CONVERGED not in solution.statuses
    assert Status.TIME_LIMIT not in full.statuses
    for values in (solution.X, solution.U, solution.K, solution.cost, solution.violation):
        assert bool(torch.isfinite(values).all())
    assert bool((solution.iterations <= full.iterations).all()) and int(solution.iterations.min()) >= 1
    torch.testing.assert_close(solution.X[:, 0], problem.x0)
    torch.testing.assert_close(solution.cost, problem.cost.total(solution.X, solution.U))


@pytest.mark.parametrize("name", mostly(SOLVERS, "restarts"))
def test_a_limit_that_is_not_reached_changes_no_bit(name: str, clock: list[int]) -> None:
    problem, U0 = planar_batch(B=4, N=30, obstacles=9, seed=4)
    solver = SOLVERS[name](problem)
    assert_same_bits(
        solver.solve(problem, U0, seed=3, max_seconds=1e9), solver.solve(problem, U0, seed=3, max_seconds=None)
    )
    assert clock


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", ["restarts", "multistart"])
def test_attempts_stop(name: str, clock: list[int]) -> None:
    """The more time, the more passes; all in all fewer than without a limit."""
    problem, U0 = planar_batch(B=3, N=30, obstacles=9, seed=4)
    solver, passes = SOLVERS[name](problem), []
    for limit in (2.5, 7.5, None):
        seen: list[int] = []
        solver.solve(problem, U0, seed=3, max_seconds=limit, callback=lambda now, seen=seen: now.row or seen.append(1))
        passes.append(len(seen))
    assert passes[0] == 2 < passes[1] < passes[2] and passes[1] <= 8


def test_waiting_problems_have_a_status_too(clock: list[int]) -> None:
    problem, U0 = planar_batch(B=5, N=20, obstacles=9, seed=4)
    solution = LOCAL.in_slots(1).solve(problem, U0, max_seconds=0.5)
    assert set(solution.statuses) <= ENDS and solution.iterations.tolist() == [2] * 5
    assert bool(torch.isfinite(solution.X).all()) and not bool((solution.X[:, 1:] == 0).all(-1).all(-1).any())


def test_problems_that_cannot_start_keep_their_own_status(clock: list[int]) -> None:
    problem, U0 = planar_batch(B=3, N=20, obstacles=9, seed=4)
    spheres = problem.constraints[0]
    assert isinstance(spheres, BoundSpheres)
    x0 = problem.x0.clone()
    x0[1, :2], x0[2, 0] = spheres.centers[1, 0], torch.nan
    broken = Problem(problem.dynamics, problem.cost, problem.constraints, x0, problem.N)
    statuses = LOCAL.solve(broken, U0, max_seconds=0.5).statuses
    assert statuses[0] in ENDS and statuses[1:] == [Status.INVALID_START, Status.NON_FINITE]


def test_a_feasible_trajectory_is_no_failure_of_the_limit(clock: list[int]) -> None:
    """The first pass solves a problem without obstacles nearby: its status is better than TIME_LIMIT."""
    problem, U0 = planar_batch(B=1, N=20)
    far = Spheres([[9.0, 9.0]], [0.1], 0.06)
    free = Problem(problem.dynamics, problem.cost, [far, problem.constraints[1]], problem.x0, problem.N)
    solver = AugmentedLagrangian(ILQR(max_iterations=100, tolerance=1e-6))
    assert solver.solve(free, U0, max_seconds=0.5).statuses == [Status.CONVERGED]


@pytest.mark.parametrize("limit", [0.0, -1.0, float("nan")])
def test_bad_limits_are_named(limit: float) -> None:
    problem, U0 = planar_batch(B=1, N=5)
    with pytest.raises(InputError) as caught:
        LOCAL.solve(problem, U0, max_seconds=limit)
    assert caught.value.field == "max_seconds"


def test_the_status_has_a_sentence() -> None:
    assert "time limit" in Status.TIME_LIMIT.sentence.lower()
