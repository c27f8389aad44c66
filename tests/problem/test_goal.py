"""The goal of a problem: given or derived, shared by solver, search and judge."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from tests.problems import planar_batch, quick_gco
from torchgco import Cost, FunctionDynamics, Goal, InputError, Planar, Problem, Spheres, judge
from torchgco.lagrangian.quality import goal_tolerance, has_arrived
from torchgco.problem.goal import RADIUS_SHARE
from torchgco.roadmap.geometry import arrives, scene_of

CUP = [[0.0, -0.25], [0.1, 0.0], [0.12, 0.25], [0.0, 0.5], [-0.2, 0.6], [-0.2, -0.35]]


@dataclass(frozen=True)
class AtTheEnd(Cost):
    """Effort, and the distance from (1, 0.4) at the last knot alone: a cost that names no goal."""

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return 0.05 * (u.square().sum(-1) + x[..., 3:].square().sum(-1))

    def terminal(self, x: Tensor) -> Tensor:
        away = x[..., :2] - x.new_tensor((1.0, 0.4))
        return 400.0 * away.square().sum(-1) + 5.0 * x[..., 3:].square().sum(-1)


def terminal_problem(goal: Goal | None, N: int = 100) -> tuple[Problem, Tensor]:
    """A planar vehicle in front of a cup that opens towards it; its cost draws it to a goal behind the cup."""
    x0 = torch.tensor([[-1.0, 0, 0, 0, 0, 0]], dtype=torch.float64)
    problem = Problem(Planar(dt=0.1), AtTheEnd(), [Spheres(CUP, [0.1] * 6, 0.06)], x0, N, goal)
    return problem, torch.zeros(1, N, 2, dtype=torch.float64)


def ending(problem: Problem, *points: tuple[float, float]) -> Tensor:
    """Paths (B, N+1, n) that end at one point each."""
    X = problem.x0.unsqueeze(1).repeat(1, problem.N + 1, 1)
    X[:, -1, :2] = torch.tensor(points, dtype=torch.float64)
    return X


def test_a_quadratic_cost_names_its_goal() -> None:
    problem, U = planar_batch(B=2, N=5)
    assert problem.goal is not None and problem.goal.assumed
    assert problem.goal.position.tolist() == [[1.0, 0.4]] * 2
    apart = (4.0 + 0.16) ** 0.5
    assert problem.goal.radius.tolist() == pytest.approx([RADIUS_SHARE * apart] * 2)
    X = ending(problem, (1.0, 0.4 + 0.089 * apart), (1.0, 0.4 + 0.091 * apart))
    assert has_arrived(problem, X).tolist() == [True, False]
    assert has_arrived(problem, X, 2.0).tolist() == [True, True]
    verdict = judge(problem, U)
    assert verdict.goal_distance.tolist() == pytest.approx([apart] * 2) and not bool(verdict.reached.any())


def test_a_given_goal_prevails_over_the_cost_and_is_aimed_at_closely() -> None:
    given = Goal([[1.0, 0.3], [0.9, 0.4]], [0.01, 5.0])
    problem, U = planar_batch(B=2, N=5)
    problem = Problem(problem.dynamics, problem.cost, problem.constraints, problem.x0, 5, given)
    assert problem.goal is not None and problem.goal.position.tolist() == [[1.0, 0.3], [0.9, 0.4]]
    near = goal_tolerance(problem)
    assert near is not None and float(near[0]) == 0.01  # a goal radius below 9 % is the tolerance,
    assert float(near[1]) == pytest.approx(RADIUS_SHARE * (1.9**2 + 0.16) ** 0.5)  # a larger one is reduced to 9 %
    X = ending(problem, (1.0, 0.32), (0.9, 0.5))
    assert has_arrived(problem, X).tolist() == [False, True] and arrives(problem, X).tolist() == [True, True]
    assert judge(problem, U).reached.tolist() == [False, bool(judge(problem, U).feasible[1])]
    assert judge(problem, U, problem.goal.position, 0.01).reached.tolist() == [False, False]


def test_copies_of_a_problem_keep_its_goal() -> None:
    problem, _ = planar_batch(B=3, N=5)
    centers = torch.tensor([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]], dtype=torch.float64)
    given = replace(problem, goal=Goal(centers, 0.5))
    part = given.take(torch.tensor([2, 0])).cast(torch.float32).in_cost_units()
    assert part.goal is not None and part.goal.position[:, 0].tolist() == [3.0, 1.0]
    assert part.goal.position.dtype == torch.float32
    again = replace(given, constraints=[])
    assert again.goal is not None and torch.equal(again.goal.position, centers)
    other = replace(problem, cost=AtTheEnd())  # a goal derived from the cost is not kept for another cost
    assert other.goal is None and not bool(has_arrived(other, ending(other, *[(1.0, 0.4)] * 3)).any())


@pytest.mark.slow
def test_a_terminal_function_with_a_goal_is_guided() -> None:
    problem, U0 = terminal_problem(Goal([1.0, 0.4], 0.15))
    assert scene_of(problem, U0) is not None
    solution = quick_gco(problem).solve(problem, U0)
    verdict = judge(problem, solution.U)
    assert bool(verdict.reached.all()) and int(solution.guided[0]) > 0
    blind, U0 = terminal_problem(None)
    assert blind.goal is None and scene_of(blind, U0) is None
    unaimed = judge(blind, U0)
    assert bool(unaimed.goal_distance.isnan().all()) and not bool(unaimed.reached.any())


WITHOUT_POSITION = FunctionDynamics(lambda x, u: x + u, n=1, m=1, dt=0.1)


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        (Goal([1.0], 0.1), r"goal.position: expected shape \(2, 2\), got \(2, 1\)"),
        (Goal([[1.0, 0.0]] * 3, 0.1), r"goal.position: expected shape \(2, 2\), got \(3, 2\)"),
        (Goal([1.0, float("nan")], 0.1), "goal.position: expected finite numbers"),
        (Goal([1.0, 0.0], [0.1]), r"goal.radius: expected shape \(2\), got \(1,\)"),
        (Goal([1.0, 0.0], 0.0), "goal.radius: expected finite numbers above 0 m, got 0.0"),
        (Goal("there", 0.1), "goal.position: expected numbers"),
        ([1.0, 0.0], "goal: expected a Goal, or None, got list"),
    ],
)
def test_a_malformed_goal_is_named(goal: object, message: str) -> None:
    problem, _ = planar_batch(B=2, N=5)
    with pytest.raises(InputError, match=message):
        Problem(problem.dynamics, problem.cost, problem.constraints, problem.x0, 5, goal)  # type: ignore[arg-type]


def test_a_goal_needs_a_position() -> None:
    with pytest.raises(InputError, match=r"goal: expected dynamics with a position: set `position = slice\(0, 2\)`"):
        Problem(WITHOUT_POSITION, AtTheEnd(), [], torch.zeros(1, 1, dtype=torch.float64), 3, Goal([0.0], 0.1))
