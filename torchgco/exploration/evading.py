"""A way around moving bodies: the motion along a path, delayed and moved aside, by a search in space and time.

At every third step of a motion stand nodes: the motion's place some time before, moved aside and up or down. A way
leads from node to node; it waits where the delay grows. Dynamic programming finds the cheapest one.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np

from torchgco.exploration.movers import Moving

STRIDE = 3  # steps between two layers of nodes
ASIDE, LIFT = 4, 2  # nodes to each side, and above and below
APART = 0.5  # m between them
DELAYS = 5  # of which each is a layer longer
HALO = 0.3  # m beyond the distance to keep, within which nodes cost more
BLOCKED, GRAZE, AWAY, TURN, LATE = 1e3, 4.0, 0.05, 0.3, 0.4  # costs of a node: closeness, offsets; of moves; of a delay
SMOOTH = 3  # steps before and after, over which a way is averaged

Gaps = Callable[[np.ndarray], np.ndarray]  # distances (K,), m, of points (K, 3) from what is at rest


def evaded(points: np.ndarray, moving: Moving, static: Gaps, keep: float, dt: float, hold: float) -> np.ndarray:
    """Positions (N+1, 3), m, that follow `points` (N+1, 3), one every dt, s, and keep away from moving bodies.

    The points themselves where they are clear already. Where there is no way, the one that is blocked least.

    Args:
        keep: distance from bodies, m.
        hold: s after the last point, in which that has to stay clear.
    """
    t, aside = dt * np.arange(len(points)), APART * np.array([ASIDE, ASIDE, LIFT]) + keep + HALO
    moving = moving.within(points.min(axis=0) - aside, points.max(axis=0) + aside, t[-1] + hold)
    if len(moving.radii) == 0:
        return points
    late = t[-1] + np.linspace(0.0, hold, 6)
    clear = moving.gaps(points, t).min(), moving.gaps(np.repeat(points[-1:], 6, axis=0), late).min()
    if min(clear) >= keep:
        return points
    layers = np.arange(0, len(points), STRIDE)
    sides = offsets(points)
    cost = _costs(points, layers, sides, moving, static, keep, dt, hold)
    delays, places = _cheapest(cost, sides)
    way = points[layers[np.maximum(np.arange(len(layers)) - delays, 0)]] + sides[places]
    fine = np.column_stack([np.interp(np.arange(len(points)), layers, way[:, i]) for i in range(3)])
    return _smoothed(fine)


def offsets(points: np.ndarray) -> np.ndarray:
    """Offsets (S, 3), m, across the way from the first point (N+1, 3) to the last, the middle one 0."""
    along = points[-1, :2] - points[0, :2]
    length = float(np.linalg.norm(along))
    x, y = along / length if length > 0.1 else (1.0, 0.0)
    grid = [(i, j) for i in range(-ASIDE, ASIDE + 1) for j in range(-LIFT, LIFT + 1)]
    return APART * np.array([(-i * y, i * x, j) for i, j in grid])


def _costs(
    points: np.ndarray,
    layers: np.ndarray,
    sides: np.ndarray,
    moving: Moving,
    static: Gaps,
    keep: float,
    dt: float,
    hold: float,
) -> np.ndarray:
    """Costs (L, D, S) of nodes: at layer l, delayed by d layers, moved aside by sides (S, 3)."""
    count, S = len(layers), len(sides)
    aside = points[layers][:, None] + sides  # (L, S, 3)
    rest = static(aside.reshape(-1, 3)).reshape(count, S)
    behind = np.maximum(np.arange(count)[:, None] - np.arange(DELAYS), 0)  # (L, D): which layer
    nodes = aside[behind]  # (L, D, S, 3)
    times = np.repeat(dt * layers, DELAYS * S)
    gaps = moving.gaps(nodes.reshape(-1, 3), times).reshape(count, DELAYS, S)
    for t in np.linspace(0.0, hold, 4)[1:]:
        last = nodes[-1].reshape(-1, 3)
        after = moving.gaps(last, np.full(len(last), dt * layers[-1] + t)).reshape(DELAYS, S)
        gaps[-1] = np.minimum(gaps[-1], after)
    gaps = np.minimum(gaps, rest[behind])
    cost = np.where(gaps < keep, BLOCKED * (1.0 + keep - gaps), GRAZE * np.clip(1.0 - (gaps - keep) / HALO, 0.0, 1.0))
    cost[0] = 0.0  # where the vehicle is
    return cost + AWAY * np.square(sides).sum(axis=1) + LATE * np.arange(DELAYS)[:, None]


def _cheapest(cost: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The delays and sides (L,) of the cheapest way that begins without either."""
    L, D, _ = cost.shape
    shape = (D, 2 * ASIDE + 1, 2 * LIFT + 1)
    moves = list(product((0, 1), (-1, 0, 1), (-1, 0, 1)))  # of delay, aside, up
    total = np.full(shape, np.inf)
    total[0, ASIDE, LIFT] = 0.0
    came = np.zeros((L, *shape), np.int8)
    for layer in range(1, L):
        padded = np.pad(total, ((1, 0), (1, 1), (1, 1)), constant_values=np.inf)
        ways = np.stack(
            [
                padded[1 - a : 1 - a + D, 1 - b : 1 - b + shape[1], 1 - c : 1 - c + shape[2]] + TURN * (b * b + c * c)
                for a, b, c in moves
            ]
        )
        came[layer] = ways.argmin(axis=0)
        total = ways.min(axis=0) + cost[layer].reshape(shape)
    node = np.unravel_index(int(total.argmin()), shape)
    delays, places = np.zeros(L, np.int64), np.zeros(L, np.int64)
    for layer in range(L - 1, -1, -1):
        delays[layer], places[layer] = node[0], node[1] * shape[2] + node[2]
        node = tuple(i - step for i, step in zip(node, moves[came[layer][node]], strict=True)) if layer else node
    return delays, places


def _smoothed(way: np.ndarray) -> np.ndarray:
    """Means (N+1, 3) over some steps around each; the first and the last remain."""
    wide = np.concatenate([np.repeat(way[:1], SMOOTH, axis=0), way, np.repeat(way[-1:], SMOOTH, axis=0)])
    sums = np.concatenate([np.zeros((1, 3)), wide.cumsum(axis=0)])
    mean = (sums[2 * SMOOTH + 1 :] - sums[: -2 * SMOOTH - 1]) / (2 * SMOOTH + 1)
    fade = np.exp(-np.arange(len(mean)) / SMOOTH)[:, None]
    return mean + fade * (way[0] - mean[0]) + fade[::-1] * (way[-1] - mean[-1])
