"""The planner: what it solves, from which guess, with which margins, and when it keeps the former plan."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.missions.missions import DOUBLE, DT, SOLVER, Recording, far, mission, scene, varied
from tests.reference import models
from torchgco import (
    Airframe,
    ControlBounds,
    FirstStepRates,
    Goal,
    InputError,
    Planar,
    Problem,
    QuadraticCost,
    Restarts,
    kernels,
)
from torchgco.baselines import Hold
from torchgco.dynamics.rollout import open_loop
from torchgco.kernels import followed
from torchgco.lagrangian.quality import has_arrived
from torchgco.missions.disturbance import Disturbance
from torchgco.missions.planner import MissionPlan, Planner
from torchgco.missions.planning_problem import Margin
from torchgco.missions.plant import RotorPlant, hovering
from torchgco.obstacles.spheres import BoundSpheres
from torchgco.search import Solve, Tighten
from torchgco.solution import Solution
from torchgco.solvers.contracts import Call, Solver

FRAME = Airframe()
FIRM = replace(SOLVER, max_outer_iterations=30, violation_tolerance=1e-3)
RADIUS = 0.5  # m, of sphere and vehicle together in `scene`


def first_plan(planner: Planner, problem: Problem, x: Tensor | None = None) -> tuple[MissionPlan, Problem]:
    """The plan of control step 0 from plants x (B, 17), by default hovering at the start; and its problem."""
    x = hovering(FRAME, problem.x0[:, :3]) if x is None else x
    plan, now, seconds = planner.plan(
        problem, planner.problem(problem, x), x, 0, None, 0, torch.arange(problem.B)
    )  # fmt: skip
    assert seconds > 0
    return plan, now


def next_plan(
    planner: Planner, problem: Problem, now: Problem, before: MissionPlan, x: Tensor
) -> tuple[MissionPlan, Problem]:
    """The plan of the control step after `before`."""
    plan, now, _ = planner.plan(
        problem, now, x, round(float(before.start[0]) / DT) + 1, before, 1, torch.arange(problem.B)
    )
    return plan, now


def spheres_of(problem: Problem) -> list[tuple[list[int], Tensor]]:
    """Knots and radii (B, M) of every group of spheres."""
    parts = [part for part in problem.constraints if isinstance(part, BoundSpheres)]
    return [(torch.arange(problem.N + 1)[part.knots].tolist(), part.inflated_radii) for part in parts]


@pytest.mark.slow
def test_the_first_plan_is_the_solvers_own_solution() -> None:
    problem = varied()
    x = hovering(FRAME, problem.x0[:, :3])
    plan, _ = first_plan(Planner(SOLVER, estimation=0.0, margin=0.0), problem)
    bounds = problem.constraints[1]
    assert isinstance(bounds, ControlBounds)
    lower, upper = bounds.lower, bounds.upper
    w = x[:, 10:13]
    reachable = (w + DT / 1.5 * (lower[:, :3] - w), w + DT / 1.5 * (upper[:, :3] - w))
    first = FirstStepRates(x[:, 13:], DT, FRAME, reachable)
    x0 = torch.cat((x[:, :13], x[:, 13:].sum(-1, keepdim=True) / FRAME.mass), dim=-1)
    alone = Problem(problem.dynamics, problem.cost, [*problem.constraints, first], x0, problem.N, problem.goal)
    U0 = torch.tensor([0, 0, 0, 9.81], **DOUBLE).repeat(4, problem.N, 1)
    solution = SOLVER.solve(alone, U0)
    for name in ("X", "U", "cost", "violation"):
        torch.testing.assert_close(getattr(plan, name), getattr(solution, name), rtol=1e-7, atol=1e-9)
    assert not bool(plan.start.any()) and not bool(plan.shifted.any()) and torch.equal(plan.measured, x)
    biased, _ = first_plan(Planner(SOLVER, margin=0.0), problem)  # an estimate of zero changes nothing
    torch.testing.assert_close(biased.X, plan.X, rtol=1e-7, atol=1e-9)
    assert not bool(biased.bias.any())


@pytest.mark.slow
def test_plans_are_not_finished_beyond_the_limits_of_the_solver(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a limit cuts off, the next plan continues: longer limits would only make this one late."""
    made = []
    monkeypatch.setattr(Tighten, "run", lambda *words: made.append(words))
    problem = varied()
    whole = Restarts(replace(SOLVER, max_outer_iterations=1), (Solve(), Tighten()))
    first_plan(Planner(whole), problem)
    assert not made
    whole.solve(problem, problem.x0.new_zeros(problem.B, problem.N, problem.m))
    assert made


def test_rates_that_the_rotors_lead_to_are_planned() -> None:
    problem, x = far(), hovering(FRAME, torch.zeros(1, 3, **DOUBLE))
    x[0, 13:] = torch.tensor([3.8, 4.0, 4.05, 3.9], **DOUBLE)
    plan, _ = first_plan(Planner(FIRM, tolerance=1e-3), problem, x)
    expected = models.angular_acceleration(np.zeros(3), x[0, 13:].numpy(), models.QuadrotorParameters()) * DT
    assert 0.02 < np.abs(expected).max() < 5.0 * DT / 1.5  # within reach
    np.testing.assert_allclose(plan.X[0, 1, 10:13].numpy(), expected, rtol=0, atol=2e-3)
    free, _ = first_plan(Planner(FIRM, tolerance=1e-3, first_step=False), problem, x)
    assert np.abs(free.X[0, 1, 10:13].numpy() - expected).max() > 2e-2


def test_rates_beyond_the_planning_models_reach_lead_to_the_nearest() -> None:
    problem, x = far(), hovering(FRAME, torch.zeros(1, 3, **DOUBLE))
    x[0, 10:13] = torch.tensor([0.3, -0.2, 0.0], **DOUBLE)
    x[0, 13:] = torch.tensor([5.5, 2.4, 2.4, 5.5], **DOUBLE)  # about 50 rad/s^2 of roll
    plan, now = first_plan(Planner(FIRM, tolerance=1e-3), problem, x)
    w = x[0, 10:13].numpy()
    wanted = w + DT * models.angular_acceleration(w, x[0, 13:].numpy(), models.QuadrotorParameters())
    nearest = np.clip(wanted, w + DT / 1.5 * (-5 - w), w + DT / 1.5 * (5 - w))
    assert wanted[0] > nearest[0] + 1.0
    first = now.constraints[-1]
    assert isinstance(first, FirstStepRates) and first.target is not None
    np.testing.assert_allclose(first.target[0].numpy(), nearest, rtol=0, atol=1e-12)
    assert float(plan.violation) <= 1e-3
    np.testing.assert_allclose(plan.X[0, 1, 10:13].numpy(), nearest, rtol=0, atol=2e-3)


def at_start(planner: Planner, problem: Problem) -> Problem:
    """The planning problem of a mission's start, which has nothing compiled yet."""
    return planner.problem(problem, hovering(FRAME, problem.x0[:, :3]))


def test_obstacles_are_grown_more_at_later_knots() -> None:
    problem = far(N=27)
    now = at_start(Planner(SOLVER, margin=0.1, margin_growth=0.2), problem)
    groups = spheres_of(now)
    knots = [list(range(1, 11)), [11, 12, 13, 14, 15], [16, 17, 18, 19, 20], [21, 22, 23, 24, 25], [26, 27]]
    assert [group for group, _ in groups] == knots
    for group, radii in groups:
        by = 0.1 if group[0] == 1 else 0.1 + 0.2 * float(np.mean(group)) * DT
        torch.testing.assert_close(radii, torch.full((1, 1), RADIUS + by, **DOUBLE), rtol=0, atol=1e-12)
    plain = at_start(Planner(SOLVER, margin=0.1), problem)
    assert [group for group, _ in spheres_of(plain)] == [knots[0], list(range(11, 28))]
    assert all(float(radii) == pytest.approx(RADIUS + 0.1, abs=1e-12) for _, radii in spheres_of(plain))


@pytest.mark.parametrize("N", [2, 10, 11])
def test_short_horizons_have_margins_too(N: int) -> None:
    planner = Planner(SOLVER, margin=0.1, margin_growth=0.2)
    problem = far(N=N, velocities=torch.ones(1, 1, 3, **DOUBLE))
    now = at_start(planner, problem)
    assert [k for knots, _ in spheres_of(now) for k in knots] == list(range(1, N + 1))
    if N == 2:
        kernels.use_native(False)  # nothing to compile
        try:
            plan, _ = first_plan(planner, problem)
        finally:
            kernels.use_native(True)
        assert bool(torch.isfinite(plan.X).all())


def test_a_margin_that_was_entered_shrinks_at_the_early_knots() -> None:
    """Outside it, 0.04 m within, 0.01 m beneath the full surface, and almost in contact at 0.95 of the radius."""
    distance = torch.tensor([1.0, 0.56, 0.49, 0.476], **DOUBLE)
    centers = torch.zeros(4, 1, 3, **DOUBLE)
    centers[:, 0, 1] = distance
    problem = scene(centers)
    _, now = first_plan(Planner(SOLVER, margin=0.1), problem)
    (early, radii), (late, full) = spheres_of(now)
    assert (early[0], early[-1], late[0]) == (1, 10, 11)
    # A vehicle at rest stays where it is; a quarter of the way from contact to the full surface is kept in any case.
    least = 0.95 * RADIUS + 0.25 * 0.05 * RADIUS
    expected = torch.minimum(torch.full_like(distance, 0.6), distance).clamp(min=least)
    torch.testing.assert_close(radii[:, 0], expected, rtol=0, atol=1e-6)
    assert float(radii[3]) == pytest.approx(least, abs=1e-12) and least > 0.95 * RADIUS
    # Nor do late knots keep so much that the start would count as in contact.
    room = (distance / 0.95).clamp(max=0.6)
    torch.testing.assert_close(full[:, 0], room, rtol=0, atol=1e-8)
    assert bool(now.start_is_clear.all())


def test_moving_spheres_are_planned_where_they_will_be() -> None:
    velocities = torch.tensor([[[0.0, -1.0, 0.0]]], **DOUBLE)
    problem = scene(torch.tensor([[[1.0, 2.0, 0.0]]], **DOUBLE), velocities=velocities)
    planner = Planner(SOLVER, margin=0.0)
    plan, now = first_plan(planner, problem)
    for _ in range(3):
        plan, now = next_plan(planner, problem, now, plan, plan.measured)
    part = now.constraints[0]
    assert isinstance(part, BoundSpheres)
    torch.testing.assert_close(part.centers[0, 0], torch.tensor([1.0, 2.0 - 3 * DT, 0.0], **DOUBLE))
    moved = scene(part.centers, velocities=velocities).constraints[0]
    torch.testing.assert_close(part.value(plan.X, plan.U), moved.value(plan.X, plan.U)[:, :10], rtol=1e-12, atol=1e-12)


def by_feedback(problem: Problem, plan: MissionPlan, x: Tensor) -> Tensor:
    """The controls of a plan one stage later, from states x (B, 14), step by step."""
    controls, last = [], problem.N - 1
    for k in range(problem.N):
        old = min(k + 1, last)
        away = x - plan.X[:, k + 1]
        controls.append(plan.U[:, old] + (plan.K[:, old] @ away.unsqueeze(-1)).squeeze(-1))
        x = problem.dynamics.step(x, controls[-1])
    return torch.stack(controls, dim=1)


@pytest.mark.parametrize("feedback", [True, False])
@pytest.mark.parametrize("multipliers", ["shifted", "reset"])
def test_the_next_plan_starts_from_the_former_one(multipliers: Any, feedback: bool) -> None:
    solver, problem = Recording(), varied()
    planner = Planner(solver, feedback=feedback, multipliers=multipliers, max_seconds=100.0)
    plan, now = first_plan(planner, problem)
    x = plan.measured.clone()
    x[:, :3] += torch.tensor([0.04, -0.03, 0.02], **DOUBLE)
    next_plan(planner, problem, now, plan, x)
    first, second = solver.calls
    rest = torch.tensor([0, 0, 0, 9.81], **DOUBLE).expand(4, problem.N, 4)
    assert first["warm"] is None and torch.equal(first["U0"], rest)
    later = torch.cat((plan.U[:, 1:], plan.U[:, -1:]), dim=1)
    if feedback:
        later = by_feedback(second["problem"], plan, second["problem"].x0)
    torch.testing.assert_close(second["U0"], later, rtol=1e-9, atol=1e-9)
    assert all(99.0 < call["max_seconds"] <= 100.0 for call in (first, second))
    if multipliers == "reset":
        assert second["warm"] is None
    else:
        for mine, old in zip(second["warm"].lam, plan.multipliers.lam, strict=True):
            assert torch.equal(mine[:, :-1], old[:, 1:])
        largest = torch.stack([part.abs().flatten(1).amax(-1) for part in plan.multipliers.lam if part.numel()]).amax(0)
        margin = Margin(planner.margin, planner.margin_growth, torch.zeros(4, **DOUBLE))
        torch.testing.assert_close(second["warm"].mu, largest / (planner.tolerance + margin.between(problem)))


class Idle(Recording):
    """A solver whose constraints were never in the way: all multipliers are zero."""

    def solve(self, problem: Problem, U0: Tensor, *arguments: Any, **options: Any) -> Solution:
        solution = super().solve(problem, U0, *arguments, **options)
        lam = tuple(torch.zeros_like(part) for part in solution.multipliers.lam)
        return replace(solution, multipliers=replace(solution.multipliers, lam=lam))


@pytest.mark.parametrize(("solver", "tolerance"), [(Idle(), 0.01), (Recording(), math.inf)])
def test_without_a_measure_plans_continue_from_the_solves_own_penalty(solver: Recording, tolerance: float) -> None:
    """Where all multipliers are zero, or plans are flown whatever their violation."""
    problem, planner = varied(), Planner(solver, tolerance=tolerance)
    plan, now = first_plan(planner, problem)
    next_plan(planner, problem, now, plan, plan.measured)
    assert torch.equal(solver.calls[-1]["warm"].mu, plan.multipliers.mu)


@pytest.mark.parametrize("native", [True, False])
def test_feedback_brings_a_vehicle_back_to_its_plan(native: bool) -> None:
    """Over four seconds the controls alone lead a tilted vehicle far away; the same bits in any batch."""
    problem = far(3, N=80, goal=6.0)
    kernels.use_native(native)
    try:
        solution = FIRM.solve(problem, problem.cost.rest_controls(problem.x0.new_zeros(3, 80, 4)))
        x0 = problem.x0.clone()
        x0[:, 7] += torch.tensor([0.02, -0.01, 0.0], **DOUBLE)
        tilted = problem.started_at(x0, problem.constraints)
        U = followed(tilted, solution.X, solution.U, solution.K)[1]
        index = torch.tensor([1])
        alone = followed(tilted.take(index), *(part[index] for part in (solution.X, solution.U, solution.K)))[1]
    finally:
        kernels.use_native(True)
    assert torch.equal(alone, U[1:2]) and torch.equal(U[2], solution.U[2])
    away = [
        (open_loop(problem.dynamics, x0, held) - solution.X)[..., :3].norm(dim=-1).amax(-1) for held in (U, solution.U)
    ]
    assert bool((away[0][:2] < 0.1).all()) and bool((away[1][:2] > 5 * away[0][:2]).all())


def test_gains_that_lead_away_are_not_used() -> None:
    solver, problem = Recording(), varied()
    plan, now = first_plan(Planner(solver), problem)
    x = plan.measured.clone()
    x[:, :3] += 0.05
    for gains in (1e6 * plan.K, torch.full_like(plan.K, 1e300)):
        next_plan(Planner(solver), problem, now, replace(plan, K=gains), x)
        assert torch.equal(solver.calls[-1]["U0"], torch.cat((plan.U[:, 1:], plan.U[:, -1:]), dim=1))


def test_penalties_do_not_pile_up_over_a_mission() -> None:
    """What one period raises the penalty by is forgotten in the next one."""
    solver, problem = Recording(replace(SOLVER, violation_tolerance=1e-9)), varied()
    planner = Planner(solver)
    plan, now = first_plan(planner, problem)
    first = plan.penalty.clone()
    for _ in range(3):
        plan, now = next_plan(planner, problem, now, plan, plan.measured)
        assert bool((plan.multipliers.mu > first).any())
        assert torch.equal(solver.calls[-1]["warm"].mu, first)


def test_a_knot_that_joins_the_next_group_brings_its_multipliers() -> None:
    """Early and late knots are constraints of their own: the tenth knot one stage later is the eleventh now."""
    plan, now = first_plan(Planner(SOLVER), varied())
    lam = tuple(torch.arange(part.numel(), **DOUBLE).view(part.shape) for part in plan.multipliers.lam)
    held = replace(plan, multipliers=replace(plan.multipliers, lam=lam)).continued(now)
    early, late = held.lam[:2]
    assert isinstance(now.constraints[0], BoundSpheres) and early.shape[1] == 10
    assert torch.equal(early, torch.cat((lam[0][:, 1:], lam[1][:, :1]), dim=1))
    for mine, old in zip((late, *held.lam[2:]), lam[1:], strict=True):  # the last of a horizon keeps its own
        assert torch.equal(mine, torch.cat((old[:, 1:], old[:, -1:]), dim=1))


def test_the_margin_covers_what_a_straight_step_cuts_off() -> None:
    """Points at the full radius and margin, a step apart: the middle of their chord is outside the sphere."""
    spheres = scene(torch.tensor([[[1.0, 0.0, 0.0], [5.0, 0, 0]]], **DOUBLE), torch.tensor([[0.3, 1.0]], **DOUBLE))
    obstacles, step = spheres.constraints[0], torch.tensor([0.3], **DOUBLE)
    assert isinstance(obstacles, BoundSpheres)
    more = float(Margin(0.01, 0.0, step).of(obstacles))
    assert more == pytest.approx(0.01 + 0.3**2 / (8 * RADIUS))  # of the smaller one
    middle = math.sqrt((RADIUS + more) ** 2 - 0.15**2)
    assert RADIUS + 0.009 < middle < RADIUS + 0.012
    assert (
        float(Margin(0.0, 0.0, step).of(obstacles)) == 0.0 and float(Margin(0.01, 0.0, 0 * step).of(obstacles)) == 0.01
    )
    assert float(Margin(0.01, 0.0, step).between(spheres)) == pytest.approx(more - 0.01)
    none = scene(torch.zeros(1, 0, 3, **DOUBLE)).constraints[0]
    assert isinstance(none, BoundSpheres) and float(Margin(0.01, 0.0, step).of(none)) == 0.01


class Failing(Solver):
    """The first answer is right. In the second, problem 0 is right, 1 far off, 2 is NaN, 3 off by less than before."""

    def __init__(self) -> None:
        self.calls = 0

    def solve(self, problem: Problem, U0: Tensor, *arguments: Any, **options: Any) -> Solution:
        self.calls += 1
        solution = SOLVER.solve(problem, U0, *arguments, **options)
        if self.calls == 1:
            return solution
        X, U, violation = solution.X.clone(), solution.U.clone(), solution.violation.clone()
        U[1:], X[1:], violation[1] = 77.0, 77.0, 9.0
        X[2], violation[2] = torch.nan, torch.nan
        violation[3] = 0.02
        return replace(solution, X=X, U=U, violation=violation)


def test_the_former_plan_is_kept_where_the_new_one_is_infeasible_and_worse() -> None:
    problem, planner = far(4), Planner(Failing(), feedback=False)
    plan, now = first_plan(planner, problem)
    x = plan.measured.clone()
    x[3, 13:] = torch.tensor([4.1, 3.7, 3.7, 4.1], **DOUBLE)  # its former plan is far off, too
    kept, now = next_plan(planner, problem, now, plan, x)
    assert kept.shifted.tolist() == [False, True, True, False] and kept.guided.tolist() == [0] * 4
    later = torch.cat((plan.U[:, 1:], plan.U[:, -1:]), dim=1)
    assert torch.equal(kept.U[1:3], later[1:3]) and bool((kept.U[3] == 77.0).all())
    X = open_loop(now.dynamics, now.x0, later)
    torch.testing.assert_close(kept.X[1:3], X[1:3], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(kept.cost[1:3], now.cost.total(X, later)[1:3])
    worst = torch.stack([part.worst(X, later) for part in now.constraints]).amax(0)
    torch.testing.assert_close(kept.violation[1:3], worst[1:3], rtol=1e-7, atol=1e-9)
    assert float(worst[3]) > 0.02
    for mine, old in zip(kept.multipliers.lam, plan.multipliers.lam, strict=True):
        assert torch.equal(mine[1:3, :-1], old[1:3, 1:])


def test_with_an_infinite_tolerance_every_new_plan_is_flown() -> None:
    problem, planner = far(4), Planner(Failing(), tolerance=torch.inf)
    plan, now = first_plan(planner, problem)
    kept, now = next_plan(planner, problem, now, plan, plan.measured)
    assert kept.shifted.tolist() == [False, False, True, False]  # but for one that is not a number
    assert bool((kept.U[[1, 3]] == 77.0).all()) and kept.violation[[1, 3]].tolist() == [9.0, 0.02]


@pytest.mark.slow
def test_the_estimated_bias_is_the_acceleration_that_the_model_lacks() -> None:
    solver, heavier = Recording(), torch.tensor([0.1, -0.1, 0.0], **DOUBLE)
    wind = Disturbance(wind=1.0)
    plant = RotorPlant(mass_error=heavier)
    flown = mission(solver, 1.0, {"estimation": 0.4}, plant=plant, disturbance=wind, goal_radius=0.01)
    log = flown.fly(far(3, goal=0.5), seed=2)
    force, _ = wind.draw(2, [0, 1, 2], 20, DT)
    x = log.x[:, -1, 0]
    mass, q = FRAME.mass * (1.0 + heavier).unsqueeze(-1), x[:, 6:10].T
    axis = torch.stack(
        (
            2 * (q[1] * q[3] + q[0] * q[2]),
            2 * (q[2] * q[3] - q[0] * q[1]),
            q[0] ** 2 - q[1] ** 2 - q[2] ** 2 + q[3] ** 2,
        )
    ).T
    lift = x[:, 13:].sum(-1, keepdim=True) * axis
    lacking = lift / mass - lift / FRAME.mass + force[:, -1] / mass
    assert float(lacking.norm(dim=-1).min()) > 0.3
    bias = solver.calls[-1]["problem"].dynamics.bias
    torch.testing.assert_close(bias, lacking, rtol=0, atol=0.05)
    assert not bool(solver.calls[0]["problem"].dynamics.bias.any())


BAD = {
    "multipliers": "kept", "max_seconds": 0.0, "margin": -0.1, "margin_growth": -1.0, "estimation": 1.5,
    "tolerance": 0.0,
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_fields_are_named(name: str) -> None:
    with pytest.raises(InputError) as caught:
        Planner(SOLVER, **{name: BAD[name]})
    assert caught.value.field == f"planner.{name}"


def test_another_model_is_refused() -> None:
    cost = QuadraticCost([1] * 6, [1, 1], [1] * 6)
    planar = Problem(Planar(dt=DT), cost, [], torch.zeros(1, 6, **DOUBLE), 5)
    with pytest.raises(InputError) as caught:
        Planner(SOLVER).problem(planar, torch.zeros(1, 17, **DOUBLE))
    assert caught.value.field == "model"


class Waits(Solver):
    """Solves as another one at first; later plans hover, and are feasible."""

    def in_closed_loop(self, limit: int) -> tuple[Solver, Solver]:
        return FIRM, Hold()

    def run(self, call: Call) -> Solution:
        return FIRM.run(call)


def test_where_a_plan_has_arrived_one_that_waits_is_not_the_last_word() -> None:
    problem, planner = far(), Planner(Waits())
    problem = replace(problem, goal=Goal(first_plan(planner, problem)[0].X[:, -1, :3], 0.03))  # within the horizon
    first, now = first_plan(planner, problem)
    assert bool(first.arrived.all()) and bool(has_arrived(now, first.X).all())
    for step, known, arrives in ((8, True, False), (9, True, True), (9, False, False)):
        before = replace(
            first,
            start=torch.full_like(first.start, step * DT),
            arrived=first.arrived & known,
            violation=first.violation * 0.0,
        )
        before = replace(before, X=now.x0.unsqueeze(1).repeat(1, now.N + 1, 1), U=now.cost.rest_controls(first.U))
        plan, later = next_plan(planner, problem, now, before, hovering(FRAME, problem.x0[:, :3]))
        assert bool(has_arrived(later, plan.X).all()) == arrives and bool((plan.violation <= 1e-2).all())
        assert bool(plan.arrived.all()) == known and bool((plan.iterations > 5).all()) == arrives
