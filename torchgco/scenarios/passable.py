"""Whether a point that moves at a pace gets through a layout whose obstacles move: reachable cells, time by time.

Scenarios redraw layouts that none gets through. Model and solver have no part in it: a point may turn at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from torchgco.scenarios.layouts import Layouts

DIAGONAL = np.sqrt(2.0)  # cells from one to the next, at most: along one or two axes


class Way(NamedTuple):
    """Where a point is, (T, d), m, at times (T,), s; it moves evenly between them."""

    points: np.ndarray
    times: np.ndarray


def way_through(
    layout: Layouts, region: Sequence[Sequence[float]], pace: float, room: float, grace: float, cell: float
) -> Way | None:
    """A way from start to goal through one layout, with its start, goal, radius and horizon; None where none is found.

    The point rests at the start for `grace` seconds, and at the goal for as many at the end. Each step takes it to a
    cell beside its own; there and half-way it is `room` farther from all obstacles than the vehicle's radius.

    Args:
        region: d pairs [low, high] within which it stays, m.
        pace: its speed at most, m/s.
        cell: side of the cells, m.
    """
    assert layout.start is not None and layout.goal is not None and layout.dt is not None
    low, high = np.array(region, np.float64).T
    d, shape = len(low), np.floor((high - low) / cell + 1e-9).astype(int) + 1
    step = DIAGONAL * cell / pace
    count = int(layout.dt * int(np.max(layout.stages)) / step)  # type: ignore[arg-type]
    waits, moves = int(np.ceil(grace / step)), _moves(d)
    first, last = (np.clip(np.rint((s[0, :d] - low) / cell), 0, shape - 1) for s in (layout.start, layout.goal))
    first, last = tuple(first.astype(int)), tuple(last.astype(int))

    def free(size: float, counts: np.ndarray, time: float, ends: Sequence[np.ndarray]) -> np.ndarray:
        """Which cells (counts) are, of those from one end to the other; none beside these."""
        ranges = [np.arange(max(a, 0), min(b + 1, n)) for a, b, n in zip(*ends, counts, strict=True)]
        cells, clear = np.stack(np.meshgrid(*ranges, indexing="ij"), axis=-1).reshape(-1, d), np.zeros(counts, bool)
        clear[tuple(cells.T)] = (
            distances(layout, low + size * cells, time) >= float(layout.vehicle_radius or 0.0) + room
        )
        return clear

    here = np.zeros(shape, bool)
    here[first] = free(cell, shape, 0.0, [np.array(first)] * 2)[first]
    steps = list[tuple[np.ndarray, np.ndarray]]()  # what was reached before each, and what is free half-way
    for k in range(1, count + 1):
        if not here.any():
            return None
        reached = np.argwhere(here)
        ends = reached.min(axis=0), reached.max(axis=0)
        half = free(0.5 * cell, 2 * shape - 1, (k - 0.5) * step, [2 * ends[0] - 1, 2 * ends[1] + 1])
        steps.append((here, half))
        here = _reached(here, half, moves[:1] if k <= waits or k > count - waits else moves)
        here &= free(cell, shape, k * step, [ends[0] - 1, ends[1] + 1])
        if k > count - waits - 1:  # it has to be there by now
            at_goal = np.zeros(shape, bool)
            at_goal[last] = here[last]
            here = at_goal
    if not here.any():
        return None
    return Way(low + cell * _backwards(steps, last), step * np.arange(count + 1))


def _moves(d: int) -> np.ndarray:
    """Steps (K, d) along at most two axes, in cells; none comes first."""
    every = np.stack(np.meshgrid(*[(0, -1, 1)] * d, indexing="ij"), axis=-1).reshape(-1, d)
    length = np.abs(every).sum(axis=1)
    return every[length.argsort(kind="stable")][: int((length <= 2).sum())]


def _reached(here: np.ndarray, half: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """The cells to which a move leads from some, over places half-way that are free."""
    then = np.zeros_like(here)
    for move in moves:
        froms = tuple(slice(max(0, -m), min(n, n - m)) for m, n in zip(move, here.shape, strict=True))
        tos = tuple(slice(s.start + m, s.stop + m) for m, s in zip(move, froms, strict=True))
        ways = tuple(slice(2 * s.start + m, 2 * s.stop + m - 1, 2) for m, s in zip(move, froms, strict=True))
        then[tos] |= here[froms] & half[ways]
    return then


def _backwards(steps: Sequence[tuple[np.ndarray, np.ndarray]], last: tuple[int, ...]) -> np.ndarray:
    """The cells (T, d) of a way that ends at `last`."""
    cells, moves = [np.array(last)], _moves(len(last))
    for here, half in reversed(steps):
        before = cells[-1] - moves
        inside = ((before >= 0) & (before < here.shape)).all(axis=1)
        cells.append(next(cell for cell in before[inside] if here[tuple(cell)] and half[tuple(cell + cells[-1])]))
    return np.array(cells[::-1])


def distances(layout: Layouts, points: np.ndarray, t: float) -> np.ndarray:
    """The distances (P,) of points (P, d) from the obstacles of one layout, none of them turned, at a time, m."""
    from scipy.spatial.distance import cdist  # slow to load

    there = ~np.isnan(layout.radii[0])
    moved = layout.centers[0, there] + (0.0 if layout.velocities is None else t * layout.velocities[0, there])
    radii, least = layout.radii[0, there], np.full(len(points), np.inf)
    if layout.box_centers is not None and layout.box_half_sizes is not None:
        center, half = layout.box_centers[0], layout.box_half_sizes[0]
        if layout.box_amplitudes is not None:
            assert layout.box_rates is not None and layout.box_phases is not None
            sines = np.sin(layout.box_rates[0] * t + layout.box_phases[0])
            center = center + (layout.box_amplitudes[0] * sines).sum(axis=1)
        rounded = np.zeros(len(center)) if layout.box_radii is None else layout.box_radii[0]
        balls = (half == 0.0).all(axis=1)
        moved, radii = np.vstack([moved, center[balls]]), np.append(radii, rounded[balls])
        squares, inmost = 0.0, np.float64(-np.inf)
        for x, c, h in zip(points.T, center[~balls].T, half[~balls].T, strict=True):  # NumPy reduces short axes slowly
            off = np.abs(x[:, None] - c) - h
            squares, inmost = squares + np.maximum(off, 0.0) ** 2, np.maximum(inmost, off)
        away = np.sqrt(squares) + np.minimum(inmost, 0.0) - rounded[~balls]
        least = away.min(axis=1, initial=np.inf)
    return np.minimum(least, (cdist(points, moved) - radii).min(axis=1, initial=np.inf))
