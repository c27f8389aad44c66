"""Knots, rows and obstacles in words: where a trajectory is caught, and which row it violates most."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.constraints.base import Constraint
from torchgco.constraints.gates import GateSquares
from torchgco.judging.gates import passages
from torchgco.judging.worst import NO_PLACE, kind_of, worst_rows
from torchgco.problem.problem import Problem

PLACES_SHOWN = 4  # runs of knots, or obstacles, that are named


def number(value: float) -> str:
    """A number with as many digits as a reader compares."""
    return f"{value:,.0f}" if 1e4 <= abs(value) < 1e9 else f"{value:.4g}"


def listed(words: Sequence[object], most: int = PLACES_SHOWN) -> str:
    """The first of some words, and how many follow."""
    more = f" and {len(words) - most} more" if len(words) > most else ""
    return ", ".join(map(str, words[:most])) + more


def knots_told(knots: Sequence[int], t: Tensor | None) -> str:
    """Knots as runs, with their times t (N+1,), s, where these are known."""
    runs = np.split(np.array(knots), np.flatnonzero(np.diff(knots) != 1) + 1)

    def told(run: np.ndarray) -> str:
        ends = list(dict.fromkeys((int(run[0]), int(run[-1]))))
        seconds = "" if t is None else f" (t = {' to '.join(f'{float(t[k]):.3g}' for k in ends)} s)"
        return " to ".join(map(str, ends)) + seconds

    return f"knot{'s' if len(knots) > 1 else ''} {listed([told(run) for run in runs])}"


def caught_told(problem: Problem, X: Tensor, U: Tensor, t: Tensor | None, depth: float = 0.0) -> str | None:
    """Where X (1, N+1, n), U (1, N, m) lies deeper than `depth`, m, in obstacles; None where it doesn't.

    Knots inside two obstacles or more come first: there their gradients can cancel. Start and end are left out.
    """
    counts = torch.zeros(problem.N + 1, dtype=torch.int64)
    rows: list[tuple[int, Tensor]] = []
    for i, constraint in enumerate(problem.constraints):
        if constraint.geometric:
            deep = (constraint.violation(X, U)[0] > depth).cpu()
            deep = constraint.by_obstacle(deep)
            inside = torch.zeros(problem.N + 1, deep.shape[-1], dtype=torch.bool)
            inside[constraint.knots] = deep
            inside[0] = inside[-1] = False
            counts += inside.sum(-1)
            rows.append((i, inside))
    for least, words in ((2, "inside two obstacles or more, whose gradients can cancel"), (1, "inside an obstacle")):
        knots = (counts >= least).nonzero().flatten().tolist()
        if knots:
            named = [
                f"{listed(which)} of {constraint_told(problem.constraints[i], i)}"
                for i, inside in rows
                if (which := inside[knots].any(0).nonzero().flatten().tolist())
            ]
            return f"{words}, at {knots_told(knots, t)}: number {'; '.join(named)}"
    return None


def place_told(problem: Problem, X: Tensor, U: Tensor, t: Tensor | None) -> str | None:
    """The row that X (1, N+1, n), U (1, N, m) violates most; None where it violates none."""
    times = None if problem.time is None or t is None else t.unsqueeze(0)
    worst = {name: column[0] for name, column in worst_rows(problem, X, U, times).items()}
    if (i := worst["constraint"]) == NO_PLACE:
        return None
    if i >= len(problem.constraints):
        return f"the bounds of the time, by a factor of {number(worst['violation'])}"
    constraint = problem.constraints[i]
    length = " m" if constraint.in_metres else ""
    where = knots_told([worst["knot"]], t)
    row = f"{constraint_told(constraint, i)}, {constraint.told(worst['row'], worst['knot'], problem.dynamics)}"
    return f"{row}, {where}, by {number(worst['violation'])}{length}"


def lost_told(problem: Problem, X: Tensor, U: Tensor, t: Tensor | None) -> str | None:
    """The first part that isn't finite along finite X (1, N+1, n), U (1, N, m), and its first knot; None: all are.

    Values come before derivatives.
    """
    cost, every, s = problem.cost, torch.arange(X.shape[1], device=X.device), X.shape[-1] + 1 + U.shape[-1]
    parts: list[tuple[str, Tensor, Tensor]] = []
    with cost.precision(X.dtype):
        parts.append(("cost.stage", every[:-1], cost.stage(X[:, :-1], U, every[:-1])))
        parts.append(("cost.terminal", every[-1:], cost.terminal(X[:, -1:])))
    H = X.new_zeros(1, len(every), s, s)
    cost.expand(X, U, H)
    slopes = [("the derivative of the cost", every, H)]
    for i, row in enumerate(problem.constraints):
        value, H = row.value(X, U), torch.zeros_like(H)
        row.accumulate(X, U, torch.ones_like(value), torch.zeros_like(value), H)
        parts.append((constraint_told(row, i), every[row.knots], value))
        slopes.append((f"the derivative of {constraint_told(row, i)}", every, H))
    for name, knots, values in (*parts, *slopes):
        lost = values.isnan().reshape(len(knots), -1).any(-1)
        if bool(lost.any()):
            return f"{name} is NaN at {knots_told([int(knots[lost][0])], t)}"
    return None


def constraint_told(constraint: Constraint, i: int) -> str:
    """A constraint by its place, and its name or kind."""
    return f"constraints[{i}] ({kind_of(constraint)})"


def gates_told(problem: Problem, X: Tensor, U: Tensor) -> list[str]:
    """The first of each constraint's gates that X (1, N+1, n), U (1, N, m) don't pass after others, and why."""
    lines = []
    for i, way in passages(problem, X, U).items():
        gates: Any = problem.constraints[i].bare
        if bool(way.passed.all()):
            continue
        g = int((~way.passed[0]).nonzero()[0])
        away, size, square = float(way.distance[0, g]), float(gates.sizes[0, g]), isinstance(gates, GateSquares)
        told = f"{number(away)} m from its middle, {'half width' if square else 'radius'} {number(size)} m"
        if square:
            told = f"crossed {told}" if away < np.inf else "not crossed from behind to ahead of its normal"
        after = "" if g == 0 else " after those before it"
        lines.append(f"gate {g + 1} of {way.passed.shape[1]} isn't passed{after}: {told}")
    return lines
