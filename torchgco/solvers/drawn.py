"""Drawn guesses of controls."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.problem.problem import Problem

KNOTS = 4  # of the noise: with 8, guesses are bent more often than optima are, and lead to fewer of them
STREAM = 1 << 21  # outer iteration that keys the noise: no solve makes so many


def half_ranges(problem: Problem, U: Tensor) -> Tensor:
    """Half the range of each control between its bounds, (B, 1, m); 1 or the largest control where it is unbounded."""
    size = U.abs().amax(1, keepdim=True).clamp(min=1.0)
    if problem.control_bounds is None:
        return size
    half = 0.5 * problem.control_bounds.range.unsqueeze(1)
    return torch.where(torch.isfinite(half), half, size)


def controls_of(problem: Problem, U: Tensor, noise: Tensor) -> Tensor:
    """Controls (B, N, m) within their bounds, by noise in units of half their range from the middle, else from U."""
    bounds, half = problem.control_bounds, half_ranges(problem, U)
    if bounds is None:
        return U + half * noise
    lower, upper = bounds.over(problem.N)
    middle = torch.where(torch.isfinite(upper - lower), 0.5 * (lower + upper), U)
    return torch.clamp(middle + half * noise, lower, upper)
