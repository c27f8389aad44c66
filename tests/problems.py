"""Small problems that many tests share, and the same problems for the NumPy reference."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from tests.reference import models
from tests.reference.problem import ReferenceProblem
from torchgco import (
    GCO,
    AugmentedLagrangian,
    Boxes,
    ControlBounds,
    Planar,
    Problem,
    QuadraticCost,
    QuadrotorPlanning,
    Restarts,
    Solution,
    Spheres,
    Status,
    judge,
    presets,
)
from torchgco.search import Tube

FIELDS = ("X", "U", "K", "d", "cost", "violation", "status", "iterations", "outer_iterations", "guided")
HOVER = [0.0, 0.0, 0.0, 9.81]
START = [-1.0, 1.0, 0.0, 0, 0, 0, 1.0, 0, 0, 0, 0, 0, 0, 9.81]


def planar_batch(B: int = 4, N: int = 60, obstacles: int = 5, seed: int = 0) -> tuple[Problem, Tensor]:
    """Planar problems with discs between start and goal, one of them absent in every other problem."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform([-0.6, -0.4], [0.7, 0.6], (B, obstacles, 2))
    radii = rng.uniform(0.06, 0.12, (B, obstacles))
    centers[1::2, -1], radii[1::2, -1] = np.nan, np.nan
    problem = Problem(
        dynamics=Planar(dt=0.1),
        cost=QuadraticCost(
            Q=[5, 5, 1e-8, 1, 1, 1e-8], R=[0.1, 0.1], Qf=[50, 50, 1e-8, 1, 1, 1e-8], x_ref=[1, 0.4, 0, 0, 0, 0]
        ),
        constraints=[Spheres(centers, radii, 0.06), ControlBounds([-10, -10], [10, 10])],
        x0=torch.tensor([[-1.0, 0, 0, 0, 0, 0]], dtype=torch.float64).repeat(B, 1),
        N=N,
    )
    return problem, torch.zeros(B, N, 2, dtype=torch.float64)


def quadrotor_batch(B: int = 3, N: int = 40, obstacles: int = 6, seed: int = 0) -> tuple[Problem, Tensor]:
    """Quadrotor problems with spheres on the way to a goal some metres ahead."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform([0.2, -0.2, -0.7], [5.0, 2.2, 0.7], (B, obstacles, 3))
    radii = rng.uniform(0.3, 0.6, (B, obstacles))
    near = np.linalg.norm(centers - np.array(START[:3]), axis=-1) < 1.1
    centers[near], radii[near] = np.nan, np.nan
    goal = torch.tensor(START, dtype=torch.float64)
    goal[0] = 6.0
    problem = Problem(
        dynamics=QuadrotorPlanning(dt=0.1),
        cost=QuadraticCost(
            Q=[1, 1, 100, 1, 1, 1, 1, 1, 1, 1, 10, 10, 10, 10],
            R=[10, 10, 10, 1],
            Qf=[1, 1, 10, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1],
            x_ref=goal,
            u_ref=HOVER,
        ),
        constraints=[Spheres(centers, radii, 0.36), ControlBounds([-5, -5, -5, 0.26], [5, 5, 5, 14.9])],
        x0=torch.tensor([START], dtype=torch.float64).repeat(B, 1),
        N=N,
    )
    return problem, torch.tensor(HOVER, dtype=torch.float64).repeat(B, N, 1)


def boxed_batch(
    d: int = 2, B: int = 4, N: int = 30, boxes: int = 4, seed: int = 0, rounded: bool = False
) -> tuple[Problem, Tensor]:
    """Planar (d = 2) or quadrotor problems with rotated boxes too; in every other problem one box is absent.

    rounded  the boxes have radii: one is a sphere, one a capsule, one a plate, the others are boxes
    """
    plain, U = planar_batch(B, N, 3, seed) if d == 2 else quadrotor_batch(B, N, 3, seed)
    rng = np.random.default_rng(seed + 1)
    scale, start = (1.0, plain.x0[0, :2].numpy()) if d == 2 else (4.0, plain.x0[0, :3].numpy())
    middle = start + scale * np.array([1.0, 0.2, 0.0])[:d]
    centers = middle + scale * rng.uniform(-0.5, 0.5, (B, boxes, d))
    half = scale * rng.uniform(0.03, 0.15, (B, boxes, d))
    turns = rng.normal(size=(B, boxes, 4))
    rotations = turns[..., 0] if d == 2 else turns / np.linalg.norm(turns, axis=-1, keepdims=True)
    radii = None
    if rounded:
        radii = scale * rng.uniform(0.03, 0.1, (B, boxes))
        half[:, 0], half[:, 1, 1:], half[:, 2, 0], radii[1::2, -1] = 0, 0, 0, np.nan
    centers[1::2, -1], half[1::2, -1], rotations[1::2, -1] = np.nan, np.nan, np.nan
    radius = float(plain.constraints[0].vehicle_radius[0])
    parts = [*plain.constraints, Boxes(centers, half, radius, rotations, radii)]
    return Problem(plain.dynamics, plain.cost, parts, plain.x0, N), U


def quick_gco(problem: Problem, local: AugmentedLagrangian | None = None) -> Restarts:
    """The default solver with few paths, offsets and samples: it solves in tenths of a second.

    local  makes the solves instead of the preset's, with the same guidance
    """
    solver = presets.gco(problem)
    paths = solver.passes.paths
    follow = replace(paths.follow, initial_offsets=paths.follow.initial_offsets[:2])
    paths = replace(paths, num_paths=2, follow=follow, relax_iterations=20, relax_top=None, refined=2)
    guidance = solver.local.guidance
    assert isinstance(guidance, GCO)
    guidance = replace(guidance, sampler=replace(guidance.sampler, samples=48, rounds=4))
    passes = solver.passes.changed(paths=paths, maps=Tube("maps", 2), tube=Tube("bodies", 2))
    return replace(solver, local=replace(local or solver.local, guidance=guidance), passes=passes)


def random_trajectory(problem: Problem, seed: int = 0, spread: float = 0.3) -> tuple[Tensor, Tensor]:
    """X (B, N+1, n) and U (B, N, m) near the start that do not satisfy the dynamics: for derivative tests."""
    generator = torch.Generator().manual_seed(seed)
    shape_X, shape_U = (problem.B, problem.N + 1, problem.n), (problem.B, problem.N, problem.m)
    X = problem.x0.unsqueeze(1) + spread * torch.randn(shape_X, generator=generator, dtype=torch.float64)
    U = spread * torch.randn(shape_U, generator=generator, dtype=torch.float64)
    X[:, 0] = problem.x0
    return X, U


def reference_of(problem: Problem, b: int) -> ReferenceProblem:
    """Problem b of a planar or quadrotor batch for the NumPy reference, without its absent spheres."""
    spheres, bounds = problem.constraints[0], problem.constraints[1]
    present = ~spheres.absent[b].numpy()
    planar = problem.n == 6
    field = models.planar_field if planar else models.quadrotor_planning_field
    cost = problem.cost
    return ReferenceProblem(
        step=models.euler(field, problem.dynamics.dt),
        x0=problem.x0[b].numpy(),
        N=problem.N,
        Q=np.diag(cost.Q[0, 0].numpy()),
        R=np.diag(cost.R[0, 0].numpy()),
        S=np.diag(cost.Qf[0].numpy()),
        x_ref=cost.xf_ref[0].numpy(),
        u_ref=cost.u_ref[0, 0].numpy(),
        position=(0, 1) if planar else (0, 1, 2),
        centers=spheres.centers[b].numpy()[present],
        contact=spheres.inflated_radii[b].numpy()[present],
        u_lower=bounds.lower[0].numpy(),
        u_upper=bounds.upper[0].numpy(),
    )


def assert_same_bits(a: Solution, b: Solution) -> None:
    """Assert that two solutions are equal bit by bit in every field, multipliers included."""
    for name in FIELDS:
        assert torch.equal(getattr(a, name), getattr(b, name)), name
    for lam_a, lam_b in zip(a.multipliers.lam, b.multipliers.lam, strict=True):
        assert torch.equal(lam_a, lam_b)
    assert torch.equal(a.multipliers.mu, b.multipliers.mu)


def at_knots(problem: Problem, solution: Solution) -> list[Status]:
    """The statuses, CONVERGED for what is INFEASIBLE only because it touches an obstacle between two knots."""
    verdict = judge(problem, solution.U)
    alone = (verdict.violation <= 1e-3) & (verdict.clearance < 0.0)
    pairs = zip(solution.statuses, alone.tolist(), strict=True)
    return [Status.CONVERGED if touches and one is Status.INFEASIBLE else one for one, touches in pairs]
