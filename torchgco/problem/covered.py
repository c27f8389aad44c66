"""Required goals that no trajectory can meet, as an obstacle covers all of them."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.base.tree import take
from torchgco.problem.problem import Problem


def covered_goals(problem: Problem) -> Tensor:
    """Whether one obstacle that holds at its last knot covers all of each problem's required goal, (B,) bool."""
    covered, goal = torch.zeros_like(problem.x0[:, 0], dtype=torch.bool), problem.goal
    if goal is None or not goal.required:
        return covered
    for last in problem.stages.unique().tolist():
        rows = (problem.stages == last).nonzero().flatten()
        center, radius = goal.position[rows].unsqueeze(1), goal.radius[rows].unsqueeze(-1)
        for obstacles in (each.inscribed for each in problem.obstacles):  # of a body, what it holds about the position
            if obstacles.holds_at(last) and obstacles.absent.shape[1] > 0:
                taken = obstacles if rows.numel() == problem.B else take(obstacles, rows)
                t = last * (taken.dt or 0.0) * torch.ones_like(center[0, :, 0])
                deep = taken.signed_distance(center, t)[:, 0] <= -radius
                covered[rows] |= (deep & ~taken.absent).any(-1)
    return covered
