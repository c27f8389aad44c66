"""A linear problem that tests of the solvers share."""

from __future__ import annotations

import torch

from torchgco import FunctionDynamics, Problem, QuadraticCost


def linear_problem(B: int = 2, N: int = 8, constraints=()) -> Problem:
    """A double integrator: x = [position, velocity]."""
    dynamics = FunctionDynamics(lambda x, u: torch.stack((x[..., 1], u[..., 0]), -1), 2, 1, 0.2)
    x0 = torch.tensor([[1.0, 0.0], [-2.0, 0.5]], dtype=torch.float64)[:B]
    return Problem(dynamics, QuadraticCost(Q=[1, 0.1], R=[0.1], Qf=[5, 1]), list(constraints), x0, N)


def zeros(problem: Problem) -> torch.Tensor:
    return torch.zeros(problem.B, problem.N, problem.m, dtype=torch.float64)
