"""Stages of a receding horizon: their length, and how many lie between two steps of a loop."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.constraints.gates import has_gates
from torchgco.lagrangian.lagrangian import shifted
from torchgco.problem.problem import Problem
from torchgco.problem.times import times

STAGE_ROUNDING = 1e-6  # of the stages between two steps: times are sums of periods


def stage_of(problem: Problem) -> float:
    """The length of all stages, s.

    Raises:
        InputError: dynamics without a time step, or with several, a free time, or gates.
    """
    if has_gates(problem):
        raise InputError("problem", "one without Gates in a loop, whose plans begin again at their knot 0", "Gates")
    if problem.time is not None:
        raise InputError("problem", "one of fixed times in a loop", "a free time")
    lengths = times(problem).diff()
    if not torch.allclose(lengths, lengths.flatten()[0], rtol=1e-9):
        raise InputError("dynamics.dt", "stages of one length in a loop", "several")
    return float(lengths.flatten()[0])


def stages_between(count: float) -> float:
    """A number of stages, whole where it is but for rounding."""
    whole = round(count)
    return whole if abs(count - whole) <= STAGE_ROUNDING * max(1.0, count) else count


def moved(values: Tensor, stages: float) -> Tensor:
    """Values (B, K, ...) of knots that follow each other, so many stages later; see `Kept.shift`."""
    whole = int(stages)
    values = shifted(values, whole) if whole else values
    part = stages - whole
    return torch.lerp(values, shifted(values), part) if part > 0 else values
