"""Trajectories as the page draws them: the path, the attitude, and where what is violated or touched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.obstacles.base import CONTACT_FACTOR, Obstacles
from torchgco.problem.problem import Problem
from torchgco.view.packing import LARGEST, Packing, number
from torchgco.view.vehicles import Look

BETWEEN = 4  # places per stage at which contact is looked for
Rows = list[tuple[str, str]]


@dataclass(frozen=True)
class Flight:
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

    def packed(self, packing: Packing, number_of: int) -> dict[str, Any]:
        """As the page reads it, under the number of its solver."""
        held: dict[str, Any] = {
            "solver": number_of, "result": self.result, "rows": self.rows, "notes": self.notes,
            "contacts": np.round(self.contacts, 3).tolist(), "path": packing.put(self.path, steps=True),
        }  # fmt: skip
        if self.attitude is not None:
            held["attitude"] = packing.put(self.attitude)
        bad = np.flatnonzero(self.violation > 0)
        held["violated"] = [[int(k), number(self.violation[k], 3), int(self.worst[k])] for k in bad]
        if self.plan is not None:
            held["plan"] = packing.put(np.nan_to_num(self.plan), steps=True)
        return held


@dataclass(frozen=True)
class Knots:
    """What holds at the knots of B trajectories: violation and worst constraint, (B, N+1) each."""

    violation: np.ndarray
    worst: np.ndarray


def violated(problem: Problem, X: Tensor, U: Tensor, admitted: float) -> Knots:
    """The largest violation of every knot above `admitted`, and of which constraint (its place); 0 and -1 elsewhere."""
    most = X.new_full((problem.B, problem.N + 1), admitted)
    worst = torch.full_like(most, -1, dtype=torch.int64)
    for place, part in enumerate(problem.constraints):
        rows = part.violation(X, U)
        if rows.numel() == 0:
            continue
        knots = torch.arange(problem.N + 1, device=X.device)[part.knots]
        largest = rows.flatten(2).amax(-1).nan_to_num(0.0)
        more = largest > most[:, knots]
        most[:, knots] = torch.where(more, largest, most[:, knots])
        worst[:, knots] = torch.where(more, place, worst[:, knots])
    return Knots(torch.where(worst < 0, 0.0, most).cpu().numpy(), worst.cpu().numpy())


def contacts(obstacles: Sequence[Obstacles], path: np.ndarray, dt: float) -> np.ndarray:
    """Places (C, d) where a path (K, d) touches obstacles of a batch of one: the deepest of each contact.

    Bodies touch at CONTACT_FACTOR of their radii, as the judge has it; between the knots the path is straight.
    """
    if len(path) == 0:
        return path
    fine = np.linspace(0, len(path) - 1, BETWEEN * (len(path) - 1) + 1)
    places = np.stack([np.interp(fine, np.arange(len(path)), column) for column in path.T], axis=-1)
    p, t = torch.from_numpy(places).unsqueeze(0), torch.from_numpy(dt * fine)
    depth = torch.full((len(places),), -torch.inf, dtype=torch.float64)
    for part in obstacles:
        distance = part.signed_distance(p, t) + (1.0 - CONTACT_FACTOR) * part.margins.unsqueeze(1)
        if distance.shape[-1] > 0:
            depth = torch.maximum(depth, -distance[0].amin(-1))
    touching = np.flatnonzero(depth.numpy() > 0)
    runs = np.split(touching, np.flatnonzero(np.diff(touching) > 1) + 1)
    return places[[run[depth.numpy()[run].argmax()] for run in runs if len(run)]]


def whole(X: np.ndarray) -> np.ndarray:
    """The knots (K, n) of states (N+1, n) before the first that isn't finite, or is too far to be drawn."""
    good = np.isfinite(X).all(axis=1) & (np.abs(np.nan_to_num(X)) < LARGEST).all(axis=1)
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
) -> list[Flight]:
    """The trajectories X (B, N+1, n), U (B, N, m) of one solver.

    Args:
        results, rows: of each problem, as in `Flight`.
        admitted: the violation up to which nothing is marked.
        touching: (B,) bool: where contact is looked for.
    """  # fmt: skip
    knots, found, dt = violated(problem, X, U, admitted), [], float(problem.dynamics.dt)
    states = X.detach().cpu().double().numpy()
    for b in range(problem.B):
        kept = whole(states[b])
        path, at = kept[:, problem.position], slice(0, len(kept))
        places = path[:0]
        if touching[b] and len(path):
            part = problem.take(torch.tensor([b], device=X.device))
            places = contacts(part.obstacles, path, dt)
        found.append(
            Flight(
                solver, path, look.attitude(kept), results[b], rows[b], knots.violation[b, at], knots.worst[b, at],
                places,
            )
        )  # fmt: skip
    return found
