"""Between the knots: clearances are those of the model's path, and statuses say what the judge does."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import compiled
from torchgco import (
    ControlBounds,
    FreeTime,
    FunctionDynamics,
    Goal,
    Problem,
    QuadraticCost,
    RateBounds,
    Spheres,
    Status,
)
from torchgco.kernels import open_loop, path_clearance
from torchgco.maps import Field, OccupancyGrid
from torchgco.problem.horizons import for_solvers

DOUBLE = torch.float64
CLAIMS = Status.CONVERGED, Status.FEASIBLE
POINTS = 200  # of a stage, at which a path is measured here
SPEED = 1.5  # m/s, of moving discs


def rates(x: Tensor, u: Tensor) -> Tensor:
    """A double integrator in the plane."""
    return torch.cat((x[..., 2:], u), dim=-1)


def scene(seed: int, B: int = 4, dt: float = 0.3, N: int = 16, speed: float = 0.0) -> Problem:
    """Discs around the straight way from the origin to (4, 0)."""
    draw = np.random.default_rng(seed)
    centers = np.stack((draw.uniform(0.8, 3.2, (B, 5)), draw.uniform(-1.2, 1.2, (B, 5))), axis=-1)
    velocities = speed * draw.uniform(-1, 1, (B, 5, 2))
    discs = Spheres(centers, draw.uniform(0.1, 0.4, (B, 5)), 0.1, velocities=velocities if speed else None)
    model = FunctionDynamics(rates, n=4, m=2, dt=dt, integrator="rk4", position=slice(0, 2))
    cost = QuadraticCost(Q=[0.0] * 4, R=[0.05] * 2, Qf=[200.0] * 4, x_ref=[4.0, 0, 0, 0])
    return Problem(
        model, cost, [discs, ControlBounds(-6.0, 6.0)], torch.zeros(B, 4, dtype=DOUBLE), N, goal=Goal([4.0, 0.0], 0.3)
    )


def dense_clearance(problem: Problem, U: np.ndarray, lengths: Any) -> np.ndarray:
    """The smallest distance to contact (B,) on `POINTS` points of each stage, in closed form."""
    discs = problem.constraints[0]
    least = np.full(problem.B, np.inf)
    for b in range(problem.B):
        c, size = discs.centers[b].numpy(), 0.95 * discs.inflated_radii[b].numpy()
        v = np.zeros_like(c) if discs.velocities is None else discs.velocities[b].numpy()
        p, w, t = np.zeros(2), np.zeros(2), 0.0
        for k, h in enumerate(lengths[b]):
            for s in np.linspace(0.0, h, POINTS + 1):
                here = p + s * w + 0.5 * s * s * U[b, k]
                least[b] = min(least[b], (np.linalg.norm(here - c - (t + s) * v, axis=-1) - size).min())
            p, w, t = p + h * w + 0.5 * h * h * U[b, k], w + h * U[b, k], t + h
    return least


@pytest.mark.sampled(1)
@pytest.mark.parametrize("speed", [0.0, SPEED])
def test_clearance_is_that_of_the_path(speed: float) -> None:
    """Chords of stages of 0.3 s are off by up to 7 cm at 6 m/s^2."""
    off = []
    for seed in range(4):
        problem = scene(seed, speed=speed)
        U = 6.0 * torch.as_tensor(np.random.default_rng(seed + 100).uniform(-1, 1, (4, 16, 2)))
        found = torchgco.judge(problem, U).clearance.numpy()
        exact = dense_clearance(problem, U.numpy(), np.full((4, 16), 0.3))
        off.append(np.abs(found - exact).max())
    assert max(off) < 1.1e-3, off


@pytest.mark.sampled(1)
@pytest.mark.parametrize("speed", [0.0, SPEED])
def test_clearance_in_the_form_for_solvers_is_that_of_the_path(speed: float) -> None:
    """How deep it is, of horizons that differ and of bounded rates, which make states of the controls before."""
    ends, off, touching = [6, 9, 12, 16], [], 0
    for seed in range(4):
        given = scene(seed, speed=speed)
        parts = [given.constraints[0], RateBounds(-9.0, 9.0)]
        problem = for_solvers(replace(given, constraints=parts, horizon=ends))
        U = 6.0 * torch.as_tensor(np.random.default_rng(seed + 100).uniform(-1, 1, (4, 16, 2)))
        found = path_clearance(problem, open_loop(problem, U), U).numpy()
        exact = dense_clearance(given, U.numpy(), [[0.3] * end for end in ends])
        off.append(np.abs(found.clip(max=0.0) - exact.clip(max=0.0)).max())
        touching += int((exact < 0).sum())
    assert max(off) < 1.1e-3 and touching > 2, off


@pytest.mark.slow
@compiled
def test_clearance_in_free_time_is_that_of_the_path() -> None:
    fixed = scene(7, B=3)
    problem = replace(fixed, goal=Goal([4.0, 0.0], 0.3, required=True), time=FreeTime(0.3, 2.0, weight=2.0))
    found = torchgco.solve(problem, verbose=False)
    verdict = torchgco.judge(problem, found.U, times=found.t)
    exact = dense_clearance(problem, found.U.numpy(), np.diff(found.t.numpy(), axis=1))
    np.testing.assert_allclose(verdict.clearance.numpy(), exact, atol=1.1e-3)


@pytest.mark.sampled(1)
@compiled
@pytest.mark.parametrize("solver", ["gco", "interior_point", "al_ilqr"])
def test_statuses_say_what_the_judge_does(solver: str) -> None:
    """At coarse steps: what claims to be feasible is, and what touches between the knots alone is INFEASIBLE."""
    touched = 0
    for seed in range(6):
        problem = scene(seed, dt=0.45, N=10)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = torchgco.solve(problem, solver=solver, verbose=False)
        verdict = torchgco.judge(problem, found.U)
        claims = [status in CLAIMS for status in found.statuses]
        assert [c for c, good in zip(claims, verdict.feasible.tolist(), strict=True) if c and not good] == []
        held = (verdict.violation <= 1e-3) & (verdict.clearance < -1e-6)
        assert all(found.statuses[b] not in CLAIMS for b in held.nonzero().flatten().tolist())
        touched += int(held.sum())
    assert touched > 0 or solver == "gco", "or nothing is tried here"


@compiled
def test_a_touching_result_is_explained() -> None:
    problem = scene(2, dt=0.6, N=8)
    with pytest.warns(torchgco.ContactWarning, match="INFEASIBLE"):
        found = torchgco.solve(problem, solver="interior_point", verbose=False)
    b = found.statuses.index(Status.INFEASIBLE)
    told = found.explain(b)
    assert "touches an obstacle between two" in told and "smaller dt" in told


def beside_a_wall(gap: float, B: int = 1) -> tuple[Problem, Tensor]:
    """A disc of 0.25 m that drives along a wall of cells below it, `gap` (m) from the wall."""
    cells = np.zeros((60, 40), bool)
    cells[:, :10] = True  # up to y = 0.5
    model = FunctionDynamics(lambda x, u: u, n=2, m=2, dt=0.1, integrator="rk4", position=slice(0, 2))
    x0 = torch.tensor([[0.5, 0.5 + gap]] * B, dtype=DOUBLE)
    wall = Field(OccupancyGrid(cells, [0.0, 0.0], 0.05), 0.25)
    cost = QuadraticCost([1.0, 1], [1.0, 1], [1.0, 1], [2.0, 0.5 + gap])
    problem = Problem(model, cost, [wall], x0, 10, Goal([2.0, 0.5 + gap], 0.3))
    return problem, torch.tensor([1.5, 0.0], dtype=DOUBLE).expand(B, 10, 2)


@pytest.mark.parametrize(("gap", "feasible"), [(0.2505, True), (0.2495, True), (0.2485, False), (0.24, False)])
def test_a_map_is_touched_at_the_full_radius(gap: float, feasible: bool) -> None:
    problem, U = beside_a_wall(gap)
    verdict = torchgco.judge(problem, U)
    assert bool(verdict.feasible) is feasible
    away = gap - 0.25 + 1e-3  # from contact; the first stage may be as near as the start
    assert float(verdict.clearance) == pytest.approx(away, abs=1e-6)


def test_a_start_that_is_too_near_may_leave() -> None:
    """A robot that noise has brought 5 mm too near a wall: what leads away from there touches nothing."""
    problem, _ = beside_a_wall(0.245)
    U = torch.zeros(1, 10, 2, dtype=DOUBLE)
    U[0, 0] = torch.tensor([1.0, 0.2])
    U[0, 1:, 0] = 1.0
    assert bool(torchgco.judge(problem, U).feasible)
    U[0, 0, 1] = -0.1  # deeper first
    U[0, 1, 1] = 0.3
    assert not bool(torchgco.judge(problem, U).feasible)
    assert math.isclose(float(torchgco.judge(problem, U).violation), 0.015, abs_tol=2e-3)


def test_a_model_that_looks_at_values_is_judged_between_the_knots() -> None:
    """Whatever the number of pieces: also where chords are close enough."""

    def guarded(x: Tensor, u: Tensor) -> Tensor:
        if bool(torch.isnan(x).any()):
            raise ValueError("not a number")
        return rates(x, u)

    model = FunctionDynamics(guarded, n=4, m=2, dt=0.3, integrator="rk4", position=slice(0, 2))
    plain = scene(1, B=2)
    problem = replace(plain, dynamics=model)
    for size in (0.0, 3.0):
        U = size * torch.as_tensor(np.random.default_rng(5).uniform(-1, 1, (2, 16, 2)))
        found, expected = torchgco.judge(problem, U), torchgco.judge(plain, U)
        torch.testing.assert_close(found.clearance, expected.clearance)


def test_a_body_that_turns_within_a_stage_is_followed() -> None:
    """A bar of 2 m turns by a quarter in each stage: halfway its tip passes a post that both knots are far from."""
    bar = torchgco.Body([[-1.0, 0.0], [0.0, 0.0], [1.0, 0.0]], 0.05)
    field = lambda x, u: torch.stack((0 * x[..., 0], 0 * x[..., 1], x[..., 3], u[..., 0]), -1)
    model = FunctionDynamics(
        field, n=4, m=1, dt=1.0, integrator="rk4", position=slice(0, 2), state_names=("x", "y", "heading", "rate")
    )
    turned = 0.25 * math.pi * 0.5  # of the heading, halfway through a stage that begins at rest
    post = [[math.cos(turned), math.sin(turned)]]
    cost = QuadraticCost([0.0] * 4, [1.0], [0.0] * 4)
    x0 = torch.zeros(1, 4, dtype=DOUBLE)
    problem = Problem(model, cost, [Spheres(post, 0.05, bar)], x0, 2)
    verdict = torchgco.judge(problem, torch.full((1, 2, 1), math.pi, dtype=DOUBLE))
    assert float(verdict.clearance_knots) > 0.2 and float(verdict.clearance) < 0.0


@pytest.mark.sampled(2)
@pytest.mark.parametrize("share", [0.96, 0.98])
@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@compiled
def test_a_way_out_of_the_band_at_a_wall_is_feasible(share: float, integrator: str) -> None:
    """From 0.96 of the radius away from a map the way leads straight out: solvers and judge agree."""
    problem, _ = beside_a_wall(0.25 * share)
    model = replace(problem.dynamics, integrator=integrator)
    away = QuadraticCost([1.0, 1], [0.1, 0.1], [10.0, 10], [1.0, 1.6])
    problem = replace(problem, dynamics=model, cost=away, goal=Goal([1.0, 1.6], 0.3))
    found = torchgco.solve(problem, verbose=False)
    assert found.statuses[0] in CLAIMS and bool(torchgco.judge(problem, found.U).feasible)
