"""Violations: which row is violated most, also within stages, and what is small in its unit but not for the problem."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchgco.base.draws import scattered
from torchgco.constraints.base import Constraint
from torchgco.problem.horizons import within_horizons
from torchgco.problem.in_time import at_times
from torchgco.problem.problem import Problem
from torchgco.problem.times import states_within

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


SHARE = 0.05  # of a row's values: a larger violation leaves little of the row
STATE_NOISE = 1e-9  # of states and controls: what this changes a row by is rounding, and doesn't say the row's size
LARGE_VIOLATION = 1e-6  # where a row has no others, no violation up to this counts as large, which solves may leave


def noise(X: Tensor, U: Tensor) -> Tensor:
    """Violations (B,) up to which no row's can be large, of trajectories X (B, N+1, n), U (B, N, m)."""
    sizes = torch.cat((X.abs().amax(1), U.abs().amax(1)), dim=-1)
    least = torch.where(sizes > 0, sizes, torch.inf).amin(-1)
    return STATE_NOISE * torch.where(torch.isinf(least), 0.0, least)


def dwarfed(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """The place (B,) of a constraint with a violation that is large beside a row's values; `NO_PLACE` without one.

    The size of a row is its largest value at rest, and of inequalities along the trajectory, too, where equalities are
    met; the two sides of a bound have one size, and where they are equal that at rest alone. Rows that have the value
    at rest still, such as those of a given start, say nothing, nor do rows of two knots that are 0 there, as
    differences are; obstacles have sizes of their own.

    Args:
        X, U: trajectories, (B, N+1, n) and (B, N, m).
    """
    where = torch.full((problem.B,), NO_PLACE, device=problem.x0.device)
    free = torch.zeros_like(X[:, :1, :1]) if problem.free_start is None else _of_start(problem, X, U)
    problem = within_horizons(problem.held_at(X[:, 0]))
    moved = tuple(_moved(z, problem.N) for z in (X, U))
    for number, constraint in enumerate(problem.constraints):
        if constraint.geometric:
            continue
        before, now = constraint.value(*problem.at_rest), constraint.value(X, U)
        if before.numel() == 0:
            continue
        least = (constraint.value(*moved) - now).abs().amax(1, keepdim=True)
        rows = constraint.row_sizes(before, now)
        size = torch.where(rows > least, rows, rows.amax(-1, keepdim=True))
        known = size > torch.maximum(least, free)
        unknown = torch.inf if constraint.joins_knots else LARGE_VIOLATION
        admitted = torch.where(known, torch.maximum(SHARE * size, least), unknown)
        large = (constraint.violation(X, U) > admitted) & (now != before)
        where[large.flatten(1).any(-1)] = number
    return where


def _moved(z: Tensor, N: int) -> Tensor:
    """States or controls z (B, K, n) with changes that say nothing: of themselves, and by what N stages round off."""
    rounding = N * torch.finfo(z.dtype).eps * z.abs().amax(1, keepdim=True)
    return z + (STATE_NOISE * z.abs() + rounding) * scattered(z[:1])


def _of_start(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """How far free starts are from those that keep the equalities of knot 0, (B, 1, 1), in units of these."""
    rows = [c for c in problem.constraints if c.sense == "equality" and c.holds_at(0)]
    worst = [torch.zeros_like(X[:, 0, 0]), *(c.worst(X, U) for c in rows)]
    return torch.stack(worst).amax(0).view(-1, 1, 1)


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
