"""Short missions that the tests of the simulation share."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchgco import (
    ILQR,
    AugmentedLagrangian,
    ControlBounds,
    Goal,
    Problem,
    QuadraticCost,
    QuadrotorPlanning,
    Spheres,
)
from torchgco.missions.mission import Mission
from torchgco.missions.planner import Planner
from torchgco.solution import Solution
from torchgco.solvers.contracts import Solver

DOUBLE: dict[str, Any] = dict(dtype=torch.float64)
DT = 0.05  # s, control period
REST = [0.0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 9.81]
SOLVER = AugmentedLagrangian(
    ILQR(tolerance=1e-4, max_iterations=20), initial_penalty=0.1, max_outer_iterations=8, violation_tolerance=1e-2
)


def scene(
    centers: Tensor, radii: Tensor | float = 0.3, velocities: Tensor | None = None, N: int = 15, goal: float = 2.0
) -> Problem:
    """Planning problems from rest at the origin to a point ahead, among spheres with centres (B, M, 3), m."""
    B, M = centers.shape[:2]
    end = torch.tensor(REST, **DOUBLE)
    end[0] = goal
    cost = QuadraticCost(
        Q=[20, 20, 50, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1],
        R=[1, 1, 1, 1],
        Qf=[100, 100, 100, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1],
        x_ref=end,
        u_ref=[0.0, 0, 0, 9.81],
    )
    sizes = torch.full((B, M), radii, **DOUBLE) if isinstance(radii, float) else radii
    sizes = torch.where(torch.isnan(centers[..., 0]), torch.nan, sizes)
    constraints = [Spheres(centers, sizes, 0.2, velocities), ControlBounds([-5, -5, -5, 0.26], [5, 5, 5, 14.9])]
    x0 = torch.tensor([REST], **DOUBLE).repeat(B, 1)
    return Problem(QuadrotorPlanning(dt=DT), cost, constraints, x0, N, Goal(end[:3], 0.3))


def varied(B: int = 4, moving: bool = False) -> Problem:
    """Different spheres for each vehicle, one of them absent in every other problem."""
    generator = torch.Generator().manual_seed(5)
    centers = torch.rand(B, 3, 3, generator=generator, **DOUBLE)
    centers = torch.tensor([0.6, -0.5, -0.4], **DOUBLE) + centers * torch.tensor([1.0, 1.0, 0.8], **DOUBLE)
    velocities = 0.2 * torch.randn(B, 3, 3, generator=generator, **DOUBLE) if moving else None
    centers[1::2, -1] = torch.nan
    return scene(centers, velocities=velocities, N=25)


def far(B: int = 1, **options: Any) -> Problem:
    """One sphere that no vehicle gets near."""
    return scene(torch.tensor([[[0.0, 50.0, 0.0]]], **DOUBLE).repeat(B, 1, 1), **options)


def mission(
    solver: Solver = SOLVER, duration: float = 0.3, planner: dict[str, Any] | None = None, **parts: Any
) -> Mission:
    """A mission of a few control steps."""
    return Mission(Planner(solver, **(planner or {})), duration=duration, **parts)


@dataclass(frozen=True)
class Recording(Solver):
    """A solver that keeps the arguments and the solutions of another one."""

    inner: Solver = SOLVER
    calls: list[dict[str, Any]] = field(default_factory=list)
    solutions: list[Solution] = field(default_factory=list)

    def solve(self, problem: Problem, U0: Tensor, *arguments: Any, **options: Any) -> Solution:
        assert not arguments
        self.calls.append({"problem": problem, "U0": U0, **options})
        self.solutions.append(self.inner.solve(problem, U0, **options))
        return self.solutions[-1]
