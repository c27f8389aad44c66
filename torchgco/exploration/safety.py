"""The judge of safe plans: from the log alone, whether each period held a plan that comes to rest in known free space.

It shares no code with the planner: cells are rebuilt from the changes that were logged, and distances are those of
points along the plan from all cubes near it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from torchgco.exploration.sensing.grid import FREE
from torchgco.missions.log import MissionLog, SeenLog
from torchgco.obstacles.base import CONTACT_FACTOR
from torchgco.problem.problem import Problem

AT_REST = 0.1  # m/s at most, where a plan has come to rest
SPACING = 0.05  # m between the points of a plan that are tested


def safe_arrays(log: MissionLog, problem: Problem) -> dict[str, np.ndarray]:
    """`safe` (B, K) of missions: 1 where safe, 0 where not, NaN after their ends; no array without a sensor."""
    if not log.seen:
        return {}
    safe = np.full(tuple(log.cost.shape), np.nan)
    for b, seen in enumerate(log.seen):
        radius = max((float(part.vehicle_radius[b]) for part in problem.obstacles), default=0.0)
        found = safe_periods(seen, CONTACT_FACTOR * radius, log.period)
        safe[b, : len(found)] = found
    return {"safe": safe}


def safe_periods(log: SeenLog, radius: float, dt: float) -> np.ndarray:
    """Whether the plan of each period (K,) keeps `radius`, m, from all that isn't known to be free, and comes to rest.

    Args:
        dt: between two positions of a plan, s.
    """
    state, found = np.zeros(log.shape, np.uint8), []
    for (cells, new), plan in zip(log.changes, log.safe, strict=True):
        state.reshape(-1)[cells] = new
        rests = np.linalg.norm(plan[-1] - plan[-2]) <= AT_REST * dt
        found.append(bool(rests and least_gap(log, state, plan, radius) >= radius))
    return np.array(found, bool)


def least_gap(log: SeenLog, state: np.ndarray, plan: Sequence[np.ndarray] | np.ndarray, reach: float) -> float:
    """The smallest distance, m, of a polyline (K, 3) from cells that aren't free, at most `reach`.

    A lower bound: between the tested points it may be smaller by half their distance at most, which is taken off.
    """
    plan = np.asarray(plan)
    parts = [
        a + np.linspace(0, 1, 1 + int(np.ceil(np.linalg.norm(b - a) / SPACING)), endpoint=False)[:, None] * (b - a)
        for a, b in pairwise(plan)
    ]
    points = np.concatenate([*parts, plan[-1:]])
    slack = 0.5 * np.linalg.norm(np.diff(points, axis=0), axis=1).max(initial=0.0)
    wide = int(np.ceil((reach + slack) / log.resolution))
    near = np.stack(np.meshgrid(*[np.arange(-wide, wide + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    cells = np.floor((points - log.corner) / log.resolution).astype(int)[:, None] + near
    outside = ((cells < 0) | (cells >= log.shape)).any(axis=-1)
    at = np.clip(cells, 0, np.array(log.shape) - 1)
    blocked = outside | (state[at[..., 0], at[..., 1], at[..., 2]] != FREE)
    centers = log.corner + (cells + 0.5) * log.resolution
    away = np.maximum(np.abs(points[:, None] - centers) - 0.5 * log.resolution, 0.0)
    gap = np.where(blocked, np.linalg.norm(away, axis=-1), np.inf).min()
    # Along a straight piece the distance from a convex cube is convex: its least value between two points that are
    # `d` apart lies below theirs by less than d / 2.
    return float(min(gap - slack, reach))
