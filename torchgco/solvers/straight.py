"""States to begin with where the time is free: on the straight line to what is asked of the last knot."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.base.autodiff import jacobian
from torchgco.base.shapes import MISTAKES
from torchgco.constraints.base import Constraint
from torchgco.obstacles.base import Obstacles
from torchgco.problem.problem import Problem

STEPS = 20  # of Gauss and Newton towards the rows of the last knot
SOFT = 1e-12  # regularisation of a step, as a share of the largest entry of J J'


def straight_line(problem: Problem) -> Tensor:
    """States X (B, N+1, n), evenly from the start to `asked_of_the_end`."""
    share = torch.linspace(0.0, 1.0, problem.N + 1, dtype=problem.x0.dtype, device=problem.x0.device).view(1, -1, 1)
    x0 = torch.where(torch.isfinite(problem.x0), problem.x0, 0.0).unsqueeze(1)
    X = (1.0 - share) * x0 + share * asked_of_the_end(problem).unsqueeze(1)
    settled = problem.dynamics.settled(X)
    return torch.where(torch.isfinite(settled), settled, X)


def asked_of_the_end(problem: Problem) -> Tensor:
    """States (B, n) near the start that keep the rows of the last knot, as far as steps of Gauss and Newton find any.

    They begin at the state that the cost draws to, with the position of a stated goal, else at the start. Obstacles
    don't count.
    """
    x0 = torch.where(torch.isfinite(problem.x0), problem.x0, 0.0)
    drawn = problem.cost.goal(problem.x0)
    z = x0.clone() if drawn is None else torch.where(torch.isfinite(drawn), drawn, x0)
    if problem.goal is not None and not problem.goal.assumed:
        z[:, problem.position] = problem.goal.position
    parts = [c for c in problem.constraints if c.holds_at(problem.N) and not isinstance(c, Obstacles)]
    if not parts:
        return z
    rows = lambda z: torch.cat([last_rows(part, problem, z) for part in parts], dim=-1)
    for _ in range(STEPS):
        try:
            c, (J,) = rows(z), jacobian(rows, z)
        except MISTAKES:  # rows that PyTorch can't differentiate forwards: the guess stays where it is
            return z
        if not bool((c != 0).any()):
            return z
        A = J @ J.mT
        A = A + torch.diag_embed((SOFT * A.abs().amax((1, 2)) + 1e-300).unsqueeze(-1).expand_as(c))
        step = (J.mT @ torch.linalg.lstsq(A, c.unsqueeze(-1)).solution).squeeze(-1)
        z = torch.where(torch.isfinite(step).all(-1, keepdim=True), z - step, z)
    return z


def last_rows(part: Constraint, problem: Problem, z: Tensor) -> Tensor:
    """The rows (B, p) of the last knot at z (B, n): of inequalities, by how much they are violated."""
    X = z.unsqueeze(1).expand(-1, problem.N + 1, -1)
    knots = torch.arange(problem.N + 1, device=z.device)[part.knots]
    place = int((knots == problem.N).nonzero()[0, 0])
    c = part.value(X, z.new_zeros(len(z), problem.N, problem.m))[:, place]
    return c if part.sense == "equality" else c.clamp(min=0.0)
