"""Rows of the state within stages, where only knots bind them."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.constraints.base import Constraint
from torchgco.problem.between import states_within
from torchgco.problem.problem import Problem

POINTS = 20  # of each stage: a parabola that rises by e within it is at most e / 441 higher between two of them


def violation_between(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """The largest violation (B,) of inequalities of the state within stages, at 20 instants of each.

    Of trajectories X (B, N+1, n), U (B, N, m), by the model's own integrator. A stage counts for a row that holds at
    its last knot, and at its first; where this is the given start, at the knot after. Rows that hold along the way
    anyway, such as distances, and a required goal don't count. NaN where rows would count, but the model doesn't
    integrate a field.
    """
    worst = torch.zeros_like(X[:, 0, 0])
    counted = path_rows(problem)
    if not counted or not problem.dynamics.stretches:
        return torch.full_like(worst, torch.nan) if counted else worst
    within = states_within(problem, X, U, POINTS + 1)
    for i in range(POINTS):
        from_first, to_last = (torch.cat(z, 1) for z in ((within[:, :, i], X[:, -1:]), (X[:, :1], within[:, :, i])))
        for row, numbers, stages in counted:
            values = row.violation(from_first if _reads_controls(row, problem.N) else to_last, U)[:, numbers].amax(-1)
            runs = torch.tensor(stages, device=X.device) < problem.stages.unsqueeze(-1)
            worst = torch.maximum(worst, torch.where(runs, values, 0.0).amax(-1))
    return worst


def path_rows(problem: Problem) -> list[tuple[Constraint, list[int], list[int]]]:
    """The constraints that count, at which of their knots, and within which stages."""
    shapes = zip(problem.constraints, problem.row_shapes, strict=True)
    rows = [(row, *_stages(row, problem.N)) for row, (_, width) in shapes if width and _is_of_path(row)]
    return [(row, numbers, stages) for row, numbers, stages in rows if stages]


def _is_of_path(row: Constraint) -> bool:
    is_of_controls = getattr(row.bare, "of", "x") == "u"
    return row.sense == "inequality" and not (
        row.joins_knots or row.bare.on_its_way or row.bare.is_goal or is_of_controls
    )


def _reads_controls(row: Constraint, N: int) -> bool:
    return getattr(row.bare, "of", "x" if row.holds_at(N) else "xu") == "xu"


def _stages(row: Constraint, N: int) -> tuple[list[int], list[int]]:
    """Where among a row's knots those of the stages are through which it holds, and which stages these are."""
    knots = list(range(N + 1)[row.knots]) if isinstance(row.knots, slice) else row.knots.tolist()
    if _reads_controls(row, N):
        pairs = [(i, k) for i, k in enumerate(knots) if k + 1 in knots or (k == N - 1 and (N == 1 or k - 1 in knots))]
    else:
        pairs = [(i, k - 1) for i, k in enumerate(knots) if k - 1 in knots or (k == 1 and (N == 1 or 2 in knots))]
    return [i for i, _ in pairs], [k for _, k in pairs]
