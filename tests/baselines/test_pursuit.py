"""A grid path that is pursued: it arrives, for unicycles and points, and each step does what it says."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from torchgco import (
    Boxes,
    ControlBounds,
    Field,
    FunctionDynamics,
    Goal,
    InputError,
    OccupancyGrid,
    Planar,
    Problem,
    QuadraticCost,
    RateBounds,
    Spheres,
    Unicycle,
    judge,
)
from torchgco.baselines import PathPursuit, pursuit
from torchgco.baselines.drivers import WITHIN, Track, drive_unicycle
from torchgco.baselines.pursuit import evenly, smoothed
from torchgco.dynamics import Dynamics
from torchgco.dynamics.rollout import open_loop
from torchgco.experiments.config.build import compose
from torchgco.kernels import chord_clearance
from torchgco.scenarios import Floors

D = torch.float64
UNICYCLE = Unicycle(dt=0.1)
STEPS = FunctionDynamics(lambda x, u: x + 0.1 * u, 2, 2, 0.1, "none", slice(0, 2))
VELOCITY = FunctionDynamics(lambda x, u: u, 2, 2, 0.1, "euler", slice(0, 2))
FORCE = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u - 0.3 * x[..., 2:]), -1), 4, 2, 0.1, "rk4", slice(0, 2))
RADIUS = 0.25


def two_rooms(door: int = 12) -> Field:
    """A wall across the way with a door of `door` cells of 0.1 m at one end."""
    cells = np.zeros((60, 50), bool)
    cells[29:31, door:] = True
    return Field(OccupancyGrid(cells, [0.0, 0.0], 0.1).enclosed(), RADIUS)


def task(model: Dynamics = UNICYCLE, parts: list[Any] | None = None, N: int = 120, **more: Any) -> Problem:
    """Two problems from one room to the other."""
    n = model.n
    goal = [5.0, 4.0, *[0.0] * (n - 2)]
    weights = [1.0, 1.0, *[0.1] * (n - 2)]
    cost = QuadraticCost(weights, [0.5, 0.5], [200.0, 200.0, *[1.0] * (n - 2)], x_ref=goal)
    x0 = torch.zeros(2, n, dtype=D)
    x0[:, :2] = torch.tensor([[1.0, 4.0], [1.5, 3.0]])
    bounds = ControlBounds([-2.0, -1.5], [2.0, 1.5])
    return Problem(
        model, cost, [*([two_rooms()] if parts is None else parts), bounds], x0, N, Goal(goal[:2], 0.2), **more
    )


def rest(problem: Problem) -> Tensor:
    return problem.x0.new_zeros(problem.B, problem.N, problem.m)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "model",
    [UNICYCLE, VELOCITY, pytest.param(FORCE, marks=pytest.mark.slow), pytest.param(STEPS, marks=pytest.mark.slow)],
    ids=["unicycle", "velocity", "force", "steps"],
)
def test_it_arrives_through_the_door(model: Dynamics) -> None:
    problem = task(model)
    U, found = PathPursuit().guess(problem, rest(problem))
    assert bool(found.all())
    X = open_loop(model, problem.x0, U)
    lower, upper = problem.control_bounds.by_knot  # type: ignore[union-attr]
    assert bool((lower < U).all() & (upper > U).all()) and WITHIN < 1
    assert bool((problem.goal.distance(X[:, -1, :2]) < 0.2).all())  # type: ignore[union-attr]
    solution = torchgco.solve(problem, solver="path_pursuit")
    verdict = judge(problem, solution.U)
    assert bool(verdict.reached.all()) and solution.guided.tolist() == [1, 1]
    assert bool((judge(problem, torchgco.solve(problem, solver="interior_point").U).cost > verdict.cost).all())


def test_shapes_are_obstacles_too() -> None:
    wall = Boxes([[[3.0, 3.5]]] * 2, [[[0.2, 2.5]]] * 2, RADIUS)
    problem = task(parts=[wall, Spheres([[[2.5, 0.4]]] * 2, [[0.2]] * 2, RADIUS)])
    verdict = judge(problem, PathPursuit().solve(problem, rest(problem)).U)
    assert bool(verdict.reached.all())


@pytest.mark.slow
def test_the_rest_of_the_batch_changes_nothing() -> None:
    setup = compose(["scenario=floors", "scenario.size=[9,7]", "scenario.apart=4", "scenario.stages=120", "seed=1"])
    held = setup.task(setup.layouts(3))
    whole = PathPursuit().solve(held.problem, held.U0)
    for rows in ([1], [2, 0]):
        index = torch.tensor(rows)
        alone = PathPursuit().solve(held.problem.take(index), held.U0[index])
        assert torch.equal(alone.U, whole.U[index]) and torch.equal(alone.status, whole.status[index])


@pytest.mark.parametrize("model", [UNICYCLE, VELOCITY], ids=["unicycle", "velocity"])
def test_changes_of_controls_may_be_bounded(model: Dynamics) -> None:
    problem = task(model, parts=[two_rooms(), RateBounds([-0.4, -0.4], [0.4, 0.4])])
    solution = torchgco.solve(problem, solver="path_pursuit")
    assert bool(judge(problem, solution.U).reached.all())


@pytest.mark.slow
def test_a_bad_start_affects_its_own_problem_alone() -> None:
    good = task(FORCE)
    x0 = good.x0.repeat(2, 1)
    x0[0, 0], x0[3, :2] = torch.nan, torch.tensor([3.0, 4.0])  # in the wall
    bad = Problem(FORCE, QuadraticCost([1.0] * 4, [0.5] * 2, [9.0] * 4, [5.0, 4.0, 0.0, 0.0]),
                  [two_rooms(), ControlBounds([-2.0] * 2, [2.0] * 2)], x0, 120, Goal([5.0, 4.0], 0.2))  # fmt: skip
    solution = PathPursuit().solve(bad, rest(bad))
    assert solution.guided.tolist() == [0, 1, 1, 0]
    assert [status.name for status in solution.statuses][::3] == ["NON_FINITE", "INVALID_START"]
    index = torch.tensor([1, 2])
    assert torch.equal(PathPursuit().solve(bad.take(index), rest(bad)[index]).U, solution.U[index])


@pytest.mark.slow
def test_horizons_may_differ() -> None:
    problem = task(horizon=[120, 90])
    solution = PathPursuit().solve(problem, rest(problem))
    assert bool(judge(problem, solution.U).reached.all())
    U, _ = PathPursuit().guess(problem, rest(problem))
    assert not U[1, 90:].any() and U[1, 80:90].any()


def test_without_a_way_it_is_the_interior_point() -> None:
    problem = task(parts=[two_rooms(door=0)])
    U, found = PathPursuit().guess(problem, rest(problem))
    assert not found.any() and torch.equal(U, rest(problem))
    solution = PathPursuit().solve(problem, rest(problem))
    verdict = judge(problem, solution.U)
    assert solution.guided.tolist() == [0, 0] and bool(verdict.feasible.all()) and not bool(verdict.reached.any())


def test_without_obstacles_it_drives_straight() -> None:
    problem = task(FORCE, parts=[])
    solution = PathPursuit().solve(problem, rest(problem))
    same = torchgco.solve(problem, solver="interior_point")
    torch.testing.assert_close(solution.cost, same.cost, rtol=1e-6, atol=0)


def test_what_touches_between_knots_is_cleared(monkeypatch: pytest.MonkeyPatch) -> None:
    """A post that a long stage steps over."""
    problem = task(VELOCITY, parts=[Spheres([[[3.0, 3.97]]] * 2, [[0.02]] * 2, 0.05)], N=25)
    problem = replace(problem, constraints=[*problem.constraints[:1], ControlBounds([-4.0] * 2, [4.0] * 2)])
    with monkeypatch.context() as patched:
        patched.setattr(pursuit, "ROUNDS", 0)
        cut = PathPursuit().solve(problem, rest(problem))
    clear = PathPursuit().solve(problem, rest(problem))
    assert bool((chord_clearance(problem, cut.X) < 0).any()), "or there is nothing to clear"
    assert bool((chord_clearance(problem, clear.X) >= 0).all()) and bool(judge(problem, clear.U).reached.all())
    assert bool((clear.iterations >= cut.iterations).all()) and bool((clear.iterations > cut.iterations).any())


CONSTANTS = {"NEAR": 0.5, "NEARNESS": 20.0, "SMOOTHING": 0.0, "LOOKAHEAD": 1.0, "DRIVEN": 0.4}


@pytest.mark.parametrize("name", CONSTANTS)
def test_every_constant_of_the_recipe_counts(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = task().take(torch.tensor([0]))
    usual = PathPursuit().guess(problem, rest(problem))[0]
    monkeypatch.setattr(pursuit, name, CONSTANTS[name])
    assert not torch.equal(PathPursuit().guess(problem, rest(problem))[0], usual)


MOVING = Spheres([[[3.0, 2.0]]] * 2, [[0.2]] * 2, RADIUS, velocities=[[[0.1, 0.0]]] * 2)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (
            lambda: task(Planar(dt=0.1)),
            "problem.dynamics: expected a Unicycle, or a model whose position can be pushed",
        ),
        (lambda: task(parts=[MOVING]), "problem.constraints: expected obstacles at rest"),
        (
            lambda: compose(["scenario=forest", "study.layouts=1"]).task().problem,
            "problem.dynamics: expected a Unicycle",
        ),
    ],
    ids=["planar", "moving", "quadrotor"],
)
def test_other_problems_are_refused_in_one_line(make: Any, said: str) -> None:
    problem = make()
    with pytest.raises(InputError) as caught:
        torchgco.solve(problem, solver="path_pursuit")
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_a_unicycle_turns_before_it_drives() -> None:
    """Its path lies behind it."""
    problem = task(parts=[]).take(torch.tensor([0]))
    points = evenly(np.array([[1.0, 4.0], [-3.0, 4.0]]), 0.05)
    U = drive_unicycle(problem, Track(points, 0.05, 12, speed=1.0, braking=0.5))
    X = open_loop(UNICYCLE, problem.x0, torch.from_numpy(U)[None])[0].numpy()
    assert np.abs(X[-1, :2] - [-3.0, 4.0]).max() < 0.1 and abs(X[-1, 3]) < 0.05
    turned = int((np.abs(X[:, 2]) > 0.5 * np.pi).argmax())
    assert turned > 3 and (X[:turned, 3] < 0.05).all(), "it stands while it looks away"


def test_paths_are_spaced_evenly_and_smoothed_between_their_ends() -> None:
    corner = evenly(np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0]]), 0.1)
    steps = np.linalg.norm(np.diff(corner, axis=0), axis=1)
    assert len(corner) == 31 and np.ptp(steps) < 1e-9
    round_ = smoothed(corner, 4.0)
    np.testing.assert_allclose(round_[[0, -1]], corner[[0, -1]], atol=1e-12)
    assert 0.05 < np.linalg.norm(round_ - corner, axis=1).max() < 0.5
    straight = evenly(np.array([[0.0, 0.0], [2.0, 1.0]]), 0.1)
    np.testing.assert_allclose(smoothed(straight, 3.0), straight, atol=1e-9)


@pytest.mark.slow
def test_it_reaches_nearly_all_drawn_floor_plans() -> None:
    setup, sound = compose(["scenario=floors", "seed=3"]), 0
    for number in range(12):
        held = setup.task(Floors().draw([number], 3))
        sound += int(judge(held.problem, PathPursuit().solve(held.problem, held.U0).U).reached)
    assert sound >= 11
