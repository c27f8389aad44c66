"""Violations that are small in their unit and large for the problem."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.base.draws import scattered
from torchgco.judging.worst import NO_PLACE
from torchgco.problem.horizons import within_horizons
from torchgco.problem.problem import Problem

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
