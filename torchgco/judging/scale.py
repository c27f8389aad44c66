"""Violations that are small in their unit and large for the problem."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.judging.worst import NONE
from torchgco.problem.horizons import within_horizons
from torchgco.problem.problem import Problem

SHARE = 0.05  # of a constraint's values: a larger violation leaves little of the constraint
MET = 1e-15  # values of rows that the guess meets up to rounding say nothing of a constraint's size: in such rows, ...
ROUGH = 1e-6  # ... and in equalities, no violation up to this counts as large, which the interior point may leave


def dwarfed(problem: Problem, guess: tuple[Tensor, Tensor], found: tuple[Tensor, Tensor]) -> Tensor:
    """The place (B,) of a constraint whose violation is large beside all its values, `NONE` where there is none.

    A constraint's size is the largest value of its rows along the guess. Rows that have the value of the guess still,
    such as those of a given start, say nothing; obstacles have sizes of their own.

    Args:
        guess, found: states (B, N+1, n) and controls (B, N, m).
    """
    place = torch.full((problem.B,), NONE, device=problem.x0.device)
    for number, constraint in enumerate(within_horizons(problem).constraints):
        if constraint.geometric:
            continue
        before, now = constraint.value(*guess), constraint.value(*found)
        if before.numel() == 0:
            continue
        size = before.abs().flatten(1).amax(-1).view(-1, 1, 1)
        rough = (size <= MET) | (constraint.sense == "equality")
        admitted = torch.where(rough, (SHARE * size).clamp(min=ROUGH), SHARE * size)
        large = (constraint.violation(*found) > admitted) & (now != before)
        place[large.flatten(1).any(-1)] = number
    return place
