"""A way around moving bodies: the cheapest one from a motion's start to rest, through a lattice in space and time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.interpolate import CubicSpline

from torchgco.exploration.movers import Moving
from torchgco.exploration.reference import Pace
from torchgco.roadmap.timed import FAR, PARTS, Surroundings, TimedLattice, TimedScene, timed_ways

LAYER = 6  # steps of a motion between two layers of the lattice
ASIDE = np.array([2.0, 2.0, 1.0])  # m beside, above and below a motion, within which ways lead
SWERVE = 2  # cells per layer along each axis by which moves may differ from the motion's
LOOKS = 4  # moments at which the end is looked at while it stays clear

Gaps = Callable[[np.ndarray], np.ndarray]  # distances (K,), m, of points (K, 3) from what is at rest


def evaded(
    points: np.ndarray,
    velocity: np.ndarray,
    weights: Sequence[float],
    moving: Moving,
    static: Gaps,
    keep: float,
    dt: float,
    hold: float,
    pace: Pace,
) -> np.ndarray:
    """Positions (N+1, 3), m, near `points` (N+1, 3), one every dt, s, that keep away from moving bodies.

    The points themselves where they are clear already, and where there is no way. Where all are blocked by what bodies
    may do, those are tried that are blocked by what they do now.

    Args:
        velocity: at the first point, (3,), m/s.
        weights: of squared distances from the points along each axis, for each step.
        keep: distance from bodies, m.
        hold: s after the last point, in which that has to stay clear.
        pace: of ways along each axis at most.
    """  # fmt: skip
    t = dt * np.arange(len(points))
    moving = moving.within(points.min(axis=0) - ASIDE - keep, points.max(axis=0) + ASIDE + keep, t[-1] + hold)
    if len(moving.radii) == 0:
        return points
    late = t[-1] + np.linspace(0.0, hold, LOOKS)
    clear = moving.gaps(points, t).min(), moving.gaps(np.repeat(points[-1:], LOOKS, axis=0), late).min()
    if min(clear) >= keep:
        return points
    lattice = _lattice(points, LAYER * dt, pace)
    for bodies in (moving, replace(moving, growth=0.0)):
        scene = _scene(lattice, points, velocity, weights, bodies, static, keep, hold)
        ways = timed_ways([scene], 1, 0.0)[0].points
        if ways:
            times = lattice.tau * np.arange(len(ways[0]))
            return CubicSpline(times, ways[0], bc_type=((1, velocity), (1, np.zeros(3))))(np.minimum(t, times[-1]))
    return points


def _lattice(points: np.ndarray, tau: float, pace: Pace) -> TimedLattice:
    """Cells around points (N+1, 3), of which one is the first; moves differ by a cell at the acceleration, about."""
    fastest = max(1, round(pace.speed / (pace.acceleration * tau)))
    spacing = pace.speed * tau / fastest
    before = np.ceil((points[0] - points.min(axis=0) + ASIDE) / spacing)
    after = np.ceil((points.max(axis=0) + ASIDE - points[0]) / spacing)
    moves = np.diff(points[::LAYER], axis=0) / spacing
    least = np.maximum(np.floor(moves.min(axis=0)) - SWERVE, -fastest).astype(np.int64)
    most = np.minimum(np.ceil(moves.max(axis=0)) + SWERVE, fastest).astype(np.int64)
    counts = (before + after + 1).astype(np.int64)
    return TimedLattice(points[0] - spacing * before, counts, spacing, tau, (len(points) - 1) // LAYER, least, most)


def _scene(
    lattice: TimedLattice,
    points: np.ndarray,
    velocity: np.ndarray,
    weights: Sequence[float],
    moving: Moving,
    static: Gaps,
    keep: float,
    hold: float,
) -> TimedScene:
    """What is in the way, and what ways cost: squared distances from the points (N+1, 3), and rest at the end."""
    cells, times = lattice.points, lattice.tau / PARTS * np.arange(lattice.layers * PARTS + 1)
    centers, radii = moving.at(times)
    field = Surroundings(
        _float(static(cells)).expand(len(times), -1).contiguous(),
        _float(centers - lattice.origin),
        _float(moving.half_sizes),
        _float(moving.sides),
        _float(radii),
        0,
    )
    cost = LAYER * (np.square(cells - points[::LAYER, None]) @ np.asarray(weights))  # (layers + 1, cells)
    end, v = cost[-1:].copy(), np.abs(lattice.velocities)
    for late in times[-1] + np.linspace(0.0, hold, LOOKS):
        end[0, moving.gaps(cells, np.full(len(cells), late)) < keep] = FAR
    move, last = np.zeros(len(v)), np.where(v.max(axis=1) > 0, FAR, 0.0)
    costs = _float(cost[:-1]), _float(end), _float(move), _float(last), _float(np.zeros(3))
    return TimedScene(
        lattice=lattice, field=field, cell_cost=costs[0], end_cost=costs[1], move_cost=costs[2], last_cost=costs[3],
        change=costs[4], start=lattice.cell(points[0]), first=lattice.move(velocity), margin=keep,
    )  # fmt: skip


def _float(values: np.ndarray) -> torch.Tensor:
    """Numbers as C takes them."""
    return torch.from_numpy(np.array(values, np.float32))
