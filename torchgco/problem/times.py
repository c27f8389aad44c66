"""The times of the knots, in seconds."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.values import Values
from torchgco.dynamics.base import FunctionDynamics
from torchgco.problem.problem import Problem

LENGTHS = "dt"  # the knot values of this name are the lengths of stages, s


def times(problem: Problem) -> Tensor:
    """The times t (N+1,) of the knots, s; (B, N+1) where they differ from problem to problem.

    Stages last `dt` of the model at that stage, or of FunctionDynamics the knot values named "dt". After a problem's
    own horizon time stands still.

    Raises:
        InputError: dynamics without a time step.
    """
    lengths = _lengths(problem)
    if bool((lengths == lengths[:1]).all()):
        lengths = lengths[:1]
    same = bool((lengths == lengths[:1, :1]).all())
    if problem.horizon is not None:
        knots = torch.arange(problem.N + 1, device=lengths.device).clamp(max=problem.stages.unsqueeze(-1))
    else:
        knots = torch.arange(problem.N + 1, device=lengths.device).expand(lengths.shape[0], -1)
    if same:  # products round once, sums at every stage
        t = lengths[:1, :1] * knots
    else:
        t = torch.cat((torch.zeros_like(lengths[:, :1]), lengths.cumsum(-1)), dim=-1)
        t = t.expand(knots.shape[0], -1).gather(1, knots)
    return t[0] if t.shape[0] == 1 and problem.horizon is None else t


def _lengths(problem: Problem) -> Tensor:
    """The lengths of the stages, (B, N) or (1, N), s."""
    model = problem.dynamics
    if isinstance(model, FunctionDynamics) and not model.is_integrated and isinstance(model.values, Values):
        lengths = dict(zip(model.values.knot_names, model.values.knot_rows, strict=True)).get(LENGTHS)
        if lengths is not None and lengths[0, 0].numel() == 1:
            return lengths.flatten(1)
    each = [getattr(model.at(k), "dt", None) for k in range(problem.N)]
    if any(dt is None for dt in each):
        raise InputError("dynamics.dt", "a time step, for the times of the knots", "none")
    return problem.x0.new_tensor([each])
