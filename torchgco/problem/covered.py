"""Required goals that no trajectory can meet, as an obstacle covers all of them."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.problem.problem import Problem


def covered_goals(problem: Problem) -> Tensor:
    """Whether one obstacle that holds at the last knot covers all of each problem's required goal, (B,) bool."""
    covered, goal = torch.zeros_like(problem.x0[:, 0], dtype=torch.bool), problem.goal
    if goal is None or not goal.required or problem.horizon is not None:  # whose last knots differ
        return covered
    center, N = goal.position.unsqueeze(1), problem.N
    for part in problem.obstacles:
        if part.holds_at(N) and part.absent.shape[1] > 0:
            t = N * (part.dt or 0.0) * torch.ones_like(center[0, :, 0])
            part = part.inscribed  # of a body, what is deep inside of an obstacle with the ball about the position
            deep = part.signed_distance(center, t)[:, 0] <= -goal.radius.unsqueeze(-1)
            covered |= (deep & ~part.absent).any(-1)
    return covered
