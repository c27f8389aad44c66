"""How large the slopes and curvatures of a cost are, in units that suit its variables.

The interior point scales a cost to slopes and curvatures of 1 at most. In a variable of small units, a length in tens
of kilometres, curvatures are large though the variable moves little: the scaled cost would be tiny beside barrier and
multipliers. So a variable whose numbers are all small counts in units of the largest of them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.constraints.bounds import bounds_of
from torchgco.eager.model import Model

ORDINARY = 1e-2  # sizes from here on are those of ordinary units
LEAST_SIZE = 1e-6  # sizes below may be rounding of larger numbers


def steepest(model: Model, X: Tensor, U: Tensor, slopes: Tensor, H: Tensor) -> tuple[Tensor, Tensor]:
    """The largest slope or curvature (b,) of the cost in any variable, in units of its size where this is small.

    Beside it, the same (b,) in the problem's own units.

    A size is the largest number of a variable in the guess, in its bounds, and in the step to the minimum of the cost
    alone; where all are 0, the change that moves a state by its size within a step.

    Args:
        slopes, H: of the cost, (b, N+1, S) and (b, N+1, S, S).
    """
    slopes, curvature = slopes.abs(), H.diagonal(dim1=-2, dim2=-1).abs()
    size = torch.where(curvature > 0.0, slopes / curvature, 0.0).amax(1)
    size = torch.maximum(size, torch.cat((X.abs().amax(1), U.abs().amax(1)), dim=-1))
    _measure_bounds(model, size)
    _infer(model, X, U, size)
    by = torch.where((size > 0.0) & (size < ORDINARY), size.clamp(min=LEAST_SIZE), 1.0)
    slopes, curvature = slopes.amax(1), curvature.amax(1)
    largest = lambda by: torch.maximum(slopes * by, curvature * by * by).amax(-1)
    return largest(by), largest(torch.ones_like(by))


def _measure_bounds(model: Model, size: Tensor) -> None:
    """Sizes (b, S) of bounds join those of their variables, in place."""
    for part in bounds_of(model.problem.constraints):
        first, width = model.problem.n if part.of == "u" else 0, part.lower.shape[-1]
        own = size[:, first : first + width]
        for limits, variables in zip(part.limits(), (part.above, part.below), strict=True):
            own[:, variables] = torch.maximum(own[:, variables], limits.abs().amax(1))


def _infer(model: Model, X: Tensor, U: Tensor, size: Tensor) -> None:
    """Sizes (b, S) that no number tells, 0, follow from those of the states that these variables move; in place."""
    n, S = X.shape[-1], size.shape[-1]
    if not bool((size == 0.0).any()):
        return
    F = torch.cat(model.problem.along.jacobians(X[:, :-1], U), dim=-1)[:, 0].abs()  # (b, n, S)
    others = ~torch.eye(n, S, dtype=torch.bool, device=X.device)
    for _ in range(n):
        for v in range(S):
            by = size[:, :n] / F[..., v]
            by = torch.where((by > 0.0) & others[:, v], by, torch.inf).amin(-1)
            size[:, v] = torch.where((size[:, v] == 0.0) & torch.isfinite(by), by, size[:, v])
