"""A trap that several tests share: a wall of discs on the straight path, bent towards the vehicle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from torchgco import ControlBounds, PathProposals, Planar, Problem, QuadraticCost, Spheres
from torchgco.search import Follow

QUICK = PathProposals(follow=(Follow(depart=0.1, arrive=0.8, iterations=8),), max_penetration=1.0)
GOAL = torch.tensor([1.0, 0.4], dtype=torch.float64)
WEIGHTS = [5, 5, 1e-8, 1, 1, 1e-8]


def cup(B: int = 2, N: int = 100, closed: bool = False, **spheres) -> Problem:
    """B problems with the same trap; `closed`: a ring of discs around the start."""
    if closed:
        angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        centers, radius = np.stack((-1 + 0.5 * np.cos(angle), 0.5 * np.sin(angle)), axis=-1), 0.08
    else:
        y = np.linspace(-0.35, 0.55, 5)
        centers, radius = np.stack((0.2 - 1.2 * (y - 0.1) ** 2, y), axis=-1), 0.14
    discs = Spheres(np.tile(centers, (B, 1, 1)), np.full((B, len(centers)), radius), 0.06, **spheres)
    return Problem(
        dynamics=Planar(dt=0.05),
        cost=cost(),
        constraints=[discs, ControlBounds([-10, -10], [10, 10])],
        x0=torch.tensor([[-1.0, 0, 0, 0, 0, 0]], dtype=torch.float64).repeat(B, 1),
        N=N,
    )


def cups(N: int = 100) -> Problem:
    """Three cups with different starts."""
    x0 = torch.tensor([[-1.0, y, 0, 0, 0, 0] for y in (-0.2, 0.0, 0.1)], dtype=torch.float64)
    return replace(cup(B=3, N=N), x0=x0)


def cost(controls: float = 0.1, unit: float = 1.0) -> QuadraticCost:
    """A quadratic cost; `controls` is the weight of the controls, `unit` multiplies all weights."""
    Q = [unit * w for w in WEIGHTS]
    return QuadraticCost(Q=Q, R=[unit * controls] * 2, Qf=Q, x_ref=[1, 0.4, 0, 0, 0, 0])


def controls(problem: Problem) -> Tensor:
    """Controls (B, N, m) of vehicles at rest."""
    return torch.zeros(problem.B, problem.N, problem.m, dtype=torch.float64)
