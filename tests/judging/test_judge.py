"""The judge against plain NumPy, and its verdicts against hand-made cases."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import torchgco
from tests.problems import planar_batch, quadrotor_batch, reference_of
from tests.reference.problem import cost as reference_cost
from tests.reference.problem import rollout as reference_rollout
from torchgco import (
    ControlBounds,
    FunctionCost,
    FunctionDynamics,
    InputError,
    Planar,
    Problem,
    QuadraticCost,
    Spheres,
    StateBounds,
    certify,
)
from torchgco.judging.judge import judge
from torchgco.obstacles.measured import segment_distance

DOUBLE = {"dtype": torch.float64}
BATCHES = {"planar": planar_batch, "quadrotor": quadrotor_batch}


def sampled_clearance(problem: Problem, X: np.ndarray, b: int, per_segment: int = 400) -> tuple[float, float]:
    """Clearance at the knots and between them, by brute force."""
    spheres = problem.constraints[0]
    dt = spheres.dt
    at, between = np.inf, np.inf
    for i in range(spheres.centers.shape[1]):
        if spheres.absent[b, i]:
            continue
        o = spheres.centers[b, i].numpy()
        v = np.zeros_like(o) if spheres.velocities is None else spheres.velocities[b, i].numpy()
        R = 0.95 * float(spheres.inflated_radii[b, i])
        for k in range(problem.N + 1):
            p = X[k, : len(o)]
            at = min(at, np.linalg.norm(p - o - v * k * dt) - R)
            if k < problem.N:
                for s in np.linspace(0, 1, per_segment):
                    q = (1 - s) * p + s * X[k + 1, : len(o)]
                    between = min(between, np.linalg.norm(q - o - v * (k + s) * dt) - R)
    return at, between


@pytest.mark.sampled(1)
@pytest.mark.parametrize("batch", BATCHES)
def test_judged_by_numpy(batch: str) -> None:
    problem, U = BATCHES[batch](B=3, N=20)
    U = U + torch.randn(U.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    goal = torch.tensor([1.0, 0.4, 0.0], dtype=torch.float64)[: problem.dynamics.position.stop]
    verdict = judge(problem, U, goal, 0.5)
    for b in range(3):
        twin = reference_of(problem, b)
        X = reference_rollout(twin, U[b].numpy())
        assert float(verdict.cost[b]) == pytest.approx(reference_cost(twin, X, U[b].numpy()), rel=1e-12)
        at, between = sampled_clearance(problem, X, b)
        assert float(verdict.clearance_knots[b]) == pytest.approx(at, abs=1e-12)
        assert between - 1e-4 <= float(verdict.clearance[b]) <= between + 1e-12
        position = X[-1][: len(goal)]
        assert float(verdict.goal_distance[b]) == pytest.approx(np.linalg.norm(position - goal.numpy()))
        depth = max(
            (R - np.linalg.norm(X[k][: len(goal)] - o))
            for k in range(1, 21) for o, R in zip(twin.centers, twin.contact, strict=True)
        )  # fmt: skip
        bounds = np.maximum(U[b].numpy() - twin.u_upper, twin.u_lower - U[b].numpy()).max()
        assert float(verdict.violation[b]) == pytest.approx(max(depth, bounds, 0.0), abs=1e-12)


@pytest.mark.parametrize("stride", [0.02, 0.5, 5.0])  # m, from knot to knot
@pytest.mark.parametrize("moving", [False, True])
def test_spheres_are_measured_as_over_all_segments_one_by_one(
    stride: float, moving: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    problem, _ = quadrotor_batch(B=7, N=30)
    given = Spheres(3.0 * normal(7, 5, 3), normal(7, 5).abs(), 0.3, normal(7, 5, 3) if moving else None)
    (spheres,) = Problem(problem.dynamics, problem.cost, [given], problem.x0, 30).constraints
    X = problem.x0.unsqueeze(1).repeat(1, 31, 1)
    X[..., :3] += (stride * normal(7, 31, 3)).cumsum(1)
    t = spheres.dt * torch.arange(31, dtype=torch.float64).view(1, -1, 1, 1)
    away = X[:, :, None, :3] - spheres.centers.unsqueeze(1) - (t * spheres.velocities.unsqueeze(1) if moving else 0.0)
    contact = 0.95 * spheres.inflated_radii.unsqueeze(1)
    at = (away.norm(dim=-1) - contact).flatten(1).amin(-1)
    between = (segment_distance(away[:, :-1], away[:, 1:]) - contact).flatten(1).amin(-1)
    assert stride < 0.1 or bool((between < at).any())
    measured = spheres.clearances(X)
    torch.testing.assert_close(measured[0], at, rtol=0, atol=1e-14)
    torch.testing.assert_close(measured[1], torch.minimum(at, between), rtol=0, atol=1e-14)


def passing(
    speed: float, offset: float, radius: float = 0.1, velocity: float | None = None
) -> tuple[Problem, torch.Tensor]:
    """A point that crosses x = 0.5 at constant speed, past one disc whose centre is `offset` to the side."""
    dynamics = Planar(dt=0.1, drag=0.0)
    velocities = None if velocity is None else [[velocity, 0.0]]
    problem = Problem(
        dynamics, QuadraticCost([1] * 6, [1, 1], [1] * 6), 
        [Spheres([[0.5, offset]], [radius], 0.0, velocities), ControlBounds([-1, -1], [1, 1])],
        torch.tensor([[0.0, 0, 0, speed, 0, 0]], dtype=torch.float64), 10,
    )  # fmt: skip
    return problem, torch.zeros(1, 10, 2, dtype=torch.float64)


def test_a_collision_between_the_knots_is_seen() -> None:
    problem, U = passing(speed=2.0, offset=0.0, radius=0.09)  # knots at 0.4 and 0.6, the disc between them
    verdict = judge(problem, U, torch.tensor([2.0, 0.0], dtype=torch.float64), 0.1)
    assert float(verdict.clearance_knots) == pytest.approx(0.1 - 0.95 * 0.09)
    assert float(verdict.clearance) == pytest.approx(-0.95 * 0.09)
    assert bool(verdict.clear_95) and not bool(verdict.feasible)  # the paper's notion looks at the knots alone
    assert float(verdict.violation) == 0.0 and not bool(verdict.reached)


def test_a_moving_obstacle_is_followed_between_the_knots() -> None:
    """Disc and point fly towards each other and pass at a distance: the nearest moment lies between two knots."""
    problem, U = passing(speed=1.0, offset=0.3, radius=0.1, velocity=-1.3)
    verdict = judge(problem, U, torch.tensor([1.0, 0.0], dtype=torch.float64), 0.1)
    assert float(verdict.clearance) == pytest.approx(0.3 - 0.095, abs=1e-12)
    assert float(verdict.clearance_knots) > float(verdict.clearance) + 1e-4


def test_feasible_reached_and_success() -> None:
    problem, U = passing(speed=1.0, offset=0.098)  # 0.098 from the centre: inside the full radius, outside 0.95 of it
    goal = torch.tensor([1.0, 0.0], dtype=torch.float64)
    verdict = judge(problem, U, goal, 0.1)
    assert float(verdict.violation) == pytest.approx(0.002) and bool(verdict.clear_95)
    assert not bool(verdict.feasible | verdict.reached) and not bool(judge(problem, U, goal + 0.2, 0.1).reached)
    hard = U.clone()
    hard[:, -1] = 1.01  # moves no later knot, but breaks the bound
    assert not bool(judge(problem, hard, goal, 0.1).feasible)
    free, U = passing(speed=1.0, offset=0.5)
    there = judge(free, U, goal, 0.1)
    assert bool(there.reached)
    assert bool(there.success(there.cost / 1.04)) and not bool(there.success(there.cost / 1.06))
    with pytest.raises(InputError, match="best_cost: expected the best known cost of every problem, got NaN"):
        there.success(torch.full_like(there.cost, torch.nan))


@pytest.mark.parametrize("best", [-100.0, 0.0, 100.0])
def test_the_best_solution_is_a_success_whatever_the_sign_of_its_cost(best: float) -> None:
    free, U = passing(speed=1.0, offset=0.5)
    cost = torch.tensor([best], dtype=torch.float64)
    verdict = replace(judge(free, U, [0.0, 0.0], 0.1), cost=cost, reached=torch.tensor([True]))
    assert bool(verdict.success(cost))
    margin = 0.05 * abs(best)
    assert bool(verdict.success(cost - 0.9 * margin)) or best == -100.0
    assert not bool(verdict.success(cost - 1.2 * margin - 1e-9))
    assert bool(replace(verdict, cost=cost - 1.0).success(cost))  # cheaper than the best known


def test_missing_controls_and_missing_obstacles() -> None:
    problem, U = planar_batch(B=2, N=5)
    U = U.clone()
    U[0] = torch.nan
    goal = torch.tensor([1.0, 0.4], dtype=torch.float64)
    verdict = judge(problem, U, goal, 5.0)
    assert verdict.feasible.tolist() == [False, True] and verdict.reached.tolist() == [False, True]
    empty = Problem(problem.dynamics, problem.cost, [], problem.x0, problem.N)
    assert judge(empty, U, goal, 5.0).clearance.tolist()[1] == float("inf")


def test_bad_calls_are_named() -> None:
    problem, U = planar_batch(B=2, N=5)
    goal = torch.tensor([1.0, 0.4], dtype=torch.float64)
    with pytest.raises(InputError, match="U: expected"):
        judge(problem, U[:1], goal, 0.3)


def heater(**more: object) -> Problem:
    """A room (K above outside) with a heater from 0 to 1, asked to stay between 15 and 25: no position."""
    model = FunctionDynamics(lambda x, u: 20.0 * u - 0.5 * x, 1, 1, 0.25, "euler")
    cost = FunctionCost(lambda x, u: u.square().sum(-1) + 0.01 * (x[..., 0] - 20.0).square(), lambda x: 0.0 * x[..., 0])
    rows = [ControlBounds([0.0], [1.0]), StateBounds([15.0], [25.0])]
    return Problem(model, cost, rows, torch.tensor([[18.0], [16.0]], **DOUBLE), 12, **more)


def test_a_model_without_a_position_is_judged() -> None:
    problem, U = heater(), torch.full((2, 12, 1), 0.45, **DOUBLE)
    U[1, :6] = 0.0
    verdict = judge(problem, U)
    for b in range(2):
        x, cost, worst = problem.x0[b, 0].item(), 0.0, 0.0
        for u in U[b, :, 0].tolist():
            cost += u * u + 0.01 * (x - 20.0) ** 2
            x += 0.25 * (20.0 * u - 0.5 * x)
            worst = max(worst, 15.0 - x, x - 25.0)
        assert verdict.cost[b].item() == pytest.approx(cost) and verdict.violation[b].item() == pytest.approx(worst)
    assert verdict.feasible.tolist() == [True, False]
    assert not bool(verdict.reached.any())
    for name in ("clearance", "clearance_knots", "goal_distance"):
        assert bool(getattr(verdict, name).isnan().all())
    held = torchgco.solve(problem, U, solver="hold")
    torch.testing.assert_close(verdict.cost, held.cost)
    torch.testing.assert_close(verdict.violation, held.violation)
    assert not bool(certify(problem, held.X, held.U).dynamics_residual.any())
    with pytest.raises(InputError, match=r"goal: expected a model with a position, got FunctionDynamics"):
        judge(problem, U, [20.0], 1.0)


def test_without_a_goal_nothing_is_reached() -> None:
    problem, U = planar_batch(B=2, N=5)
    target = problem.goal.position[0]
    free = FunctionCost(lambda x, u: u.square().sum(-1), lambda x: x[..., 0])
    aimless = replace(problem, cost=free, goal=None)
    given, verdict = judge(aimless, U, target, 5.0), judge(aimless, U)
    assert given.reached.all() and not verdict.reached.any() and bool(verdict.goal_distance.isnan().all())
    for name in ("cost", "violation", "clearance_knots", "clearance", "feasible"):
        assert torch.equal(getattr(given, name), getattr(verdict, name))


def test_single_precision_is_judged_in_double() -> None:
    problem, U = planar_batch(B=2, N=8)
    single, goal = problem.cast(torch.float32), torch.tensor([1.0, 0.4])
    double = judge(single.cast(torch.float64), U.float().double(), goal.double(), 5.0)
    for own in (single, single.cast(torch.float64)):
        verdict = judge(own, U.float(), goal.to(own.x0.dtype), 5.0)
        assert all(torch.equal(a, b) for a, b in zip(vars(verdict).values(), vars(double).values(), strict=True))
    assert verdict.cost.dtype == torch.float64 and bool(verdict.reached.all())
