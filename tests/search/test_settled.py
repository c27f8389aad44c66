"""What was sound before a search, or within it, isn't lost at its end."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.problems import planar_batch
from tests.search.gates import LOCAL
from torchgco import (
    Boxes,
    ControlBounds,
    FunctionCost,
    FunctionDynamics,
    Goal,
    InteriorPoint,
    NormBounds,
    OscillatingBoxes,
    Problem,
    QuadraticCost,
    Spheres,
    StateBounds,
    judge,
    presets,
    solve,
)
from torchgco.base.status import Status
from torchgco.lagrangian.lagrangian import SolveEnd
from torchgco.search.search import Best, is_sound
from torchgco.solvers.contracts import Call

ROUNDING = 1e-8  # share of the cost
SIDES, HALF = ((2.5, -1.0), (5.0, 1.0)), 3.0  # walls, with the place of their opening; half the width of the room


def sliding(B: int = 1) -> Problem:
    """A point between two walls, each with an opening of 0.6 m that a box closes at times."""
    centers, sizes, amplitudes, phases = [], [], [], []
    for x, y in SIDES:
        low, high = y - 0.3, y + 0.3
        centers += [[x, (low - HALF) / 2], [x, (high + HALF) / 2], [x, high]]
        sizes += [[0.1, (low + HALF) / 2], [0.1, (HALF - high) / 2], [0.12, 0.3]]
        amplitudes += [[[0.0, 0.0]]] * 2 + [[[0.0, 0.3]]]
        phases += [[[0.0, 0.0]]] * 2 + [[[0.0, y]]]
    slides = torch.tensor(amplitudes, dtype=torch.float64)
    boxes = Boxes(centers, sizes, 0.15)
    walls = OscillatingBoxes(boxes, slides, 1.6 * (slides > 0).double(), torch.tensor(phases, dtype=torch.float64))
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.1, "rk4", slice(0, 2))
    cost = QuadraticCost([0.1, 0.1, 0.01, 0.01], [0.01, 0.01], [50.0, 50, 5, 5], x_ref=[7.5, 0, 0, 0])
    room = StateBounds([-1, -2.8, -math.inf, -math.inf], [9, 2.8, math.inf, math.inf])
    parts = [walls, ControlBounds(-2.0, 2.0), room, NormBounds(("x", [2, 3]), upper=2.5)]
    return Problem(model, cost, parts, torch.zeros(B, 4, dtype=torch.float64), 90, Goal([7.5, 0.0], 0.3))


@cache
def guessed() -> tuple[Problem, Tensor]:
    """The same problem several times, and sound controls for each, found among larger boxes from timed ways."""
    t, (first, second) = np.arange(91) * 0.1, (y for _, y in SIDES)
    ways = []
    for begins in np.arange(1.8, 5.0, 0.2):
        at = [0.0, begins, begins + 2.2, 9.0]
        ways.append(np.stack([np.interp(t, at, to) for to in ([0, 2.5, 5, 7.5], [0, first, second, 0])], -1))
    X0 = torch.from_numpy(np.concatenate([np.stack(ways), np.zeros((len(ways), 91, 2))], -1))
    problem = sliding(len(ways))
    larger = problem.grown(torch.full((len(ways),), 0.03, dtype=torch.float64))
    found = solve(larger, U0=0 * X0[:, :-1, :2], X0=X0, solver=InteriorPoint(initial_barrier=1e-3), verbose=False)
    sound = judge(problem, found.U).reached.nonzero().flatten()
    assert sound.numel() >= 4, "ways to begin with"
    return problem.take(sound[:4]), found.U[sound[:4]]


@pytest.mark.slow
def test_a_sound_guess_comes_back_sound_and_costs_no_more() -> None:
    """Before, trajectories came back that arrive, and touch a box between two knots by up to 9 mm."""
    problem, U = guessed()
    before, found = judge(problem, U), solve(problem, U0=U, verbose=False)
    after = judge(problem, found.U)
    assert bool(before.reached.all()) and bool(after.reached.all())
    assert bool((after.cost <= before.cost + ROUNDING * before.cost.abs()).all())
    assert {status.name for status in found.statuses} <= {"CONVERGED", "FEASIBLE"}


@pytest.mark.slow
def test_the_interior_point_goes_on_from_a_guess_that_is_better() -> None:
    problem, U = guessed()
    before, after = judge(problem, U).cost, judge(problem, solve(problem, U0=U, verbose=False).U).cost
    assert bool((after < 0.999 * before).any()), "cheaper, among boxes that are smaller than those of the guess"


@pytest.mark.slow
def test_a_problem_keeps_its_guess_alike_in_every_batch() -> None:
    problem, U = guessed()
    whole, order = solve(problem, U0=U, verbose=False), torch.tensor([2, 0])
    part = solve(problem.take(order), U0=U[order], ids=order, verbose=False)
    assert torch.equal(part.U, whole.U[order]) and torch.equal(part.status, whole.status[order])


def test_a_sound_guess_is_returned_where_the_time_is_over() -> None:
    problem, U = guessed()
    found = solve(problem, U0=U, max_seconds=1e-6, verbose=False)
    assert bool(judge(problem, found.U).reached.all())


def test_a_guess_that_is_worse_changes_nothing() -> None:
    """Rest is sound, too, and doesn't arrive."""
    problem, U0 = planar_batch(B=2, N=25, obstacles=2, seed=1)
    solver = presets.gco(problem)
    found = solver.solve(problem, U0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torchgco.search.restarts.settle", lambda search, chords: None)
        without = solver.solve(problem, U0)
    assert torch.equal(found.U, without.U) and torch.equal(found.iterations, without.iterations)


def ends(problem: Problem, U: Tensor, status: Status) -> SolveEnd:
    """Trajectories of controls as the end of a solve."""
    end = SolveEnd.blank(problem, U)
    X = [problem.x0]
    for k in range(problem.N):
        X.append(problem.dynamics.step(X[-1], U[:, k]))
    end.best.X[:], end.best.U[:], end.status[:] = torch.stack(X, 1), U, int(status)
    end.best.cost[:] = problem.cost.total(end.best.X, U)
    for part in problem.constraints:
        end.best.violation[:] = torch.maximum(end.best.violation, part.worst(end.best.X, U))
    return end


def test_a_sound_trajectory_that_waits_is_taken_back_from_one_in_contact_only_at_the_end() -> None:
    """A ball so small that a fast point steps over it: one trajectory arrives through it, the other stays."""
    model = FunctionDynamics(lambda x, u: u, 1 + 1, 2, 0.5, "euler", slice(0, 2))
    cost = QuadraticCost([1.0, 1.0], [0.1, 0.1], [10.0, 10.0], x_ref=[2.0, 0.0])
    ball = Spheres([[0.5, 0.0]], [0.2], 0.05)
    problem = Problem(model, cost, [ball], torch.zeros(1, 2, dtype=torch.float64), 2, Goal([2.0, 0.0], 0.3))
    stays = ends(problem, torch.zeros(1, 2, 2, dtype=torch.float64), Status.FEASIBLE)
    goes = ends(problem, torch.tensor([[[2.0, 0.0], [2.0, 0.0]]], dtype=torch.float64), Status.FEASIBLE)
    call, row = Call.checked(problem, stays.best.U), torch.tensor([0])
    best = Best(call, stays, LOCAL)
    best.keep(row, goes)
    assert torch.equal(best.end.best.U, goes.best.U) and not bool(is_sound(problem, goes.best, 1e-3))
    best.restore(row, torch.tensor([True]))
    assert torch.equal(best.end.best.U, goes.best.U), "it arrives, and may still be cleared"
    best.settle()
    assert torch.equal(best.end.best.U, stays.best.U) and not bool(best.arrived())
    clear = replace(problem, constraints=[Spheres([[0.5, 3.0]], [0.2], 0.05)])
    best = Best(Call.checked(clear, stays.best.U), stays, LOCAL)
    best.keep(row, goes)
    best.settle()
    assert torch.equal(best.end.best.U, goes.best.U), "which touches nothing here"


def turned_boxes(B: int, seed: int) -> tuple[Problem, np.ndarray]:
    """Points and robots among sharp boxes that are turned at random, which may be too fast for what lies ahead but for
    braking; and the controls that brake, by hand."""
    draw, centers, sizes, angles, speeds = np.random.default_rng(seed), [], [], [], []
    while len(speeds) < B:
        c, h, a = draw.uniform([0.8, -3], [7, 3], (12, 2)), draw.uniform(0.1, 0.8, (12, 2)), draw.uniform(0, np.pi, 12)
        v = draw.uniform(0.0, 3.0)
        turn = np.stack((np.stack((np.cos(a), np.sin(a)), -1), np.stack((-np.sin(a), np.cos(a)), -1)), -2)
        way = np.linspace([0.0, 0.0], [v * v / 8.0, 0.0], 20)
        off = np.abs((turn @ (way[:, None] - c)[..., None])[..., 0]) - h
        away = np.linalg.norm(off.clip(0.0), axis=-1) + off.max(-1).clip(max=0.0)
        if away.min() > 0.35:
            speeds.append(v)
            for whole, one in ((centers, c), (sizes, h), (angles, a)):
                whole.append(one)
    x0, U = np.zeros((B, 4)), np.zeros((B, 40, 2))
    x0[:, 2], left = speeds, np.array(speeds)
    for k in range(40):
        U[:, k, 0] = np.clip(-left / 0.1, -4.0, 4.0)
        left = left + 0.1 * U[:, k, 0]
    boxes = Boxes(np.array(centers), np.array(sizes), 0.2, np.array(angles))
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.1, "rk4", slice(0, 2))
    cost = QuadraticCost([0.1, 0.1, 0, 0.1], [0.1, 0.1], [50.0, 50, 0, 5], x_ref=[8.0, 0, 0, 0])
    return Problem(model, cost, [boxes, ControlBounds(-4.0, 4.0)], x0.tolist(), 40, Goal([8.0, 0.0], 0.3)), U


def settled_in_turned_boxes(B: int, seed: int) -> None:
    problem, U = turned_boxes(B, seed)
    assert bool(judge(problem, torch.from_numpy(U)).feasible.all())
    found = solve(problem, verbose=False)
    assert bool(judge(problem, found.U).feasible.all())
    assert {status.name for status in found.statuses} <= {"CONVERGED", "FEASIBLE"}


def test_where_nothing_else_is_sound_a_vehicle_comes_to_rest() -> None:
    """Before, of 64 such scenes 6 ended INFEASIBLE, although the goal isn't required and braking serves."""
    problem, _ = turned_boxes(26, 0)
    problem = problem.take(torch.tensor([8, 24, 25]))
    found = solve(problem, verbose=False)
    assert bool(judge(problem, found.U).feasible.all())


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_where_nothing_else_is_sound_vehicles_come_to_rest(seed: int) -> None:
    settled_in_turned_boxes(64, seed)


def test_a_guess_that_costs_less_by_rounding_does_not_replace_what_converged() -> None:
    """Resting is the least cost there is, 0: it was FEASIBLE beside a solved trajectory of cost 1e-18."""
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), -1), 2, 1, 0.1)
    cost = FunctionCost(lambda x, u: 0.12 * u[..., 0])
    x0 = torch.tensor([[0.5, 0.03], [-0.9, 0.0]]).double()
    found = solve(Problem(model, cost, [ControlBounds(0.0, 1.4), StateBounds(-4.0, 4.0)], x0, N=80), verbose=False)
    assert found.statuses == [Status.CONVERGED] * 2 and float(found.cost.abs().max()) < 1e-12
