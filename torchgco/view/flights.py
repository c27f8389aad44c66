"""Trajectories as the page draws them: the path, the attitude, and where what is violated or touched."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.judging.contact import contacts
from torchgco.judging.worst import kind_of
from torchgco.obstacles.base import Obstacles
from torchgco.plotting.silhouettes import body_of
from torchgco.problem.problem import Problem
from torchgco.view.packing import LARGEST_HALF, Packing, number
from torchgco.view.sensed import Sensed
from torchgco.view.vehicles import Look, turned

Rows = list[tuple[str, str]]


@dataclass(frozen=True)
class ShownFlight:
    """One solver's trajectory through one layout.

    Args:
        solver: its name.
        path: positions (K, d) at the knots, m, up to the first that isn't finite.
        attitude: unit quaternions (K, 4) from the body to space; None: nothing turns the body.
        result: "success", "reached", "feasible" or "failed".
        rows: what is known about it, labels and texts, for the table and the hover.
        violation: (K,) the largest violation at each knot; m for lengths.
        worst: (K,) int: of which constraint; -1 where nothing is violated.
        contacts: (C, d) places where bodies touch, between knots too.
        plan: (K, P, d) what the vehicle planned at each knot, of missions; None: nothing.
        notes: one text per knot for the hover, of missions; none: nothing to say.
        sensed: what the vehicle saw and sought, of missions with a sensor.
    """

    solver: str
    path: np.ndarray
    attitude: np.ndarray | None
    result: str
    rows: Rows
    violation: np.ndarray
    worst: np.ndarray
    contacts: np.ndarray
    plan: np.ndarray | None = None
    notes: list[str] = field(default_factory=list)
    sensed: Sensed | None = None

    def until(self, last: int) -> ShownFlight:
        """The same up to a knot."""
        kept = slice(0, last + 1)
        attitude = None if self.attitude is None else self.attitude[kept]
        return replace(
            self, path=self.path[kept], attitude=attitude, violation=self.violation[kept], worst=self.worst[kept]
        )

    def packed(self, packing: Packing, number_of: int) -> dict[str, Any]:
        """As the page reads it, under the number of its solver."""
        entry: dict[str, Any] = {
            "solver": number_of, "result": self.result, "rows": self.rows, "notes": self.notes,
            "contacts": np.round(self.contacts, 3).tolist(), "path": packing.put(self.path, steps=True),
        }  # fmt: skip
        if self.attitude is not None:
            entry["attitude"] = packing.put(self.attitude)
        bad = np.flatnonzero(self.violation > 0)
        entry["violated"] = [[int(k), number(self.violation[k], 3), int(self.worst[k])] for k in bad]
        if self.plan is not None:
            entry["plan"] = packing.put(np.nan_to_num(self.plan), steps=True)
        if self.sensed is not None:
            entry["sensed"] = self.sensed.until(len(self.path)).packed(packing, self.path[:, 2])
        return entry


def violated(problem: Problem, X: Tensor, U: Tensor, admitted: float) -> tuple[np.ndarray, np.ndarray]:
    """The largest violation (B, N+1) of each knot above `admitted`, and of which constraint; 0 and -1 elsewhere."""
    most = X.new_full((problem.B, problem.N + 1), admitted)
    worst = torch.full_like(most, -1, dtype=torch.int64)
    for index, constraint in enumerate(problem.constraints):
        rows = constraint.violation(X, U)
        if rows.numel() == 0:
            continue
        knots = torch.arange(problem.N + 1, device=X.device)[constraint.knots]
        largest = rows.flatten(2).amax(-1).nan_to_num(0.0)
        more = largest > most[:, knots]
        most[:, knots] = torch.where(more, largest, most[:, knots])
        worst[:, knots] = torch.where(more, index, worst[:, knots])
    return torch.where(worst < 0, 0.0, most).cpu().numpy(), worst.cpu().numpy()


def worst_row(problem: Problem, violation: np.ndarray, worst: np.ndarray) -> Rows:
    """Which constraint is violated most, where and by how much, from the violations (K,) at the knots."""
    k = int(violation.argmax()) if len(violation) else 0
    if not len(violation) or worst[k] < 0:
        return []
    constraint = problem.constraints[worst[k]]
    unit = " m" if isinstance(constraint, Obstacles) else ""
    return [("worst", f"{kind_of(constraint)}, knot {k}: {violation[k]:.2g}{unit}")]


def whole(X: np.ndarray) -> np.ndarray:
    """The knots (K, n) of states (N+1, n) before the first that isn't finite, or is too far to be drawn."""
    good = np.isfinite(X).all(axis=1) & (np.abs(np.nan_to_num(X)) < LARGEST_HALF).all(axis=1)
    return X if good.all() else X[: int(good.argmin())]


def flights_of(
    problem: Problem,
    look: Look,
    X: Tensor,
    U: Tensor,
    solver: str,
    results: list[str],
    rows: list[Rows],
    admitted: float,
    touching: np.ndarray,
) -> list[ShownFlight]:
    """The trajectories X (B, N+1, n), U (B, N, m) of one solver.

    Args:
        results, rows: of each problem, as in `ShownFlight`.
        admitted: the violation up to which nothing is marked.
        touching: (B,) bool: where contact is looked for.
    """
    (violation, worst), flights = violated(problem, X, U, admitted), []
    dt = getattr(problem.dynamics, "dt", None) or 1.0
    states, body = X.detach().cpu().double().numpy(), body_of(problem)
    for b in range(problem.B):
        kept = whole(states[b])
        path, knots = kept[:, problem.position], slice(0, len(kept))
        places = path[:0]
        bad, which = violation[b, knots], worst[b, knots]
        if touching[b] and len(path):
            single = problem.take(torch.tensor([b], device=X.device))
            places = contacts(single.obstacles, path, dt, kept)
        told = [*rows[b], *worst_row(problem, bad, which)]
        attitude = look.attitude(kept) if body is None else turned(body, kept)
        flights.append(ShownFlight(solver, path, attitude, results[b], told, bad, which, places))
    return flights
