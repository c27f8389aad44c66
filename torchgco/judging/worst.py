"""Which row of which constraint a trajectory violates most, and where its states are lost."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchgco.constraints.base import Constraint
from torchgco.problem.horizons import within_horizons
from torchgco.problem.in_time import at_times
from torchgco.problem.problem import Problem

NO_PLACE = -1  # the place of what isn't there


def worst_rows(problem: Problem, X: Tensor, U: Tensor, times: Tensor | None = None) -> dict[str, list[Any]]:
    """The columns of `Solution.worst_rows` for X (B, N+1, n), U (B, N, m); NaN violates most.

    Args:
        times: (B, N+1), s, of the knots where the time is free. Its bounds then come after the constraints, as "time".
    """
    user = problem
    problem, X, U = at_times(problem, X, U, times)
    lost = ~torch.isfinite(X).all(-1)
    first = torch.where(lost.any(-1), lost.long().argmax(-1), NO_PLACE)
    largest = X.new_zeros(problem.B)
    worst = torch.full((3, problem.B), NO_PLACE, device=X.device)
    for number, constraint in enumerate(within_horizons(problem).constraints):
        rows = constraint.violation(X, U)
        if rows.shape[0] == 0 or rows[0].numel() == 0:
            continue
        most, index = rows.nan_to_num(torch.inf, torch.inf).flatten(1).max(-1)
        knots = torch.arange(problem.N + 1, device=X.device)[constraint.knots]
        more = most > largest
        entry = torch.stack((torch.full_like(index, number), knots[index // rows.shape[-1]], index % rows.shape[-1]))
        worst, largest = torch.where(more, entry, worst), torch.where(more, most, largest)
    where, knot, row = worst.tolist()
    kinds = [kind_of(constraint) for constraint in user.constraints]
    names = ["" if i == NO_PLACE else kinds[i] if i < len(kinds) else "time" for i in where]
    return {
        "constraint": where, "name": names, "knot": knot, "row": row, "violation": largest.tolist(),
        "lost_at": first.tolist(),
    }  # fmt: skip


def kind_of(constraint: Constraint) -> str:
    """The user's name of a constraint, else its kind as a user writes it."""
    name = getattr(constraint, "name", None)
    if isinstance(name, str) and name != "constraint":
        return name
    return type(constraint).__name__.removeprefix("Bound")
