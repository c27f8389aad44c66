"""Drawn fleets: discs that swap places on a circle, through a door and in a forest, and quadrotors on a circle.

Geometry and weights are those of a study of fleets by prioritised planning; a layout depends on its seed and number.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import numpy as np
import torch
from torch import Tensor

from benchmarks.outside import jaxipm_problems as jaxipm
from torchgco import (
    Boxes,
    Constraint,
    ControlBounds,
    Fleet,
    FunctionDynamics,
    Goal,
    NormBounds,
    Problem,
    QuadraticCost,
    Spheres,
    StateBounds,
)
from torchgco.scenarios import Vehicle

KEPT, RADIUS, FASTEST, PUSH, ARRIVED = 0.4, 0.2, 2.5, 2.0, 0.3  # m, m, m/s, m/s^2 along each axis, m
PACE, SLOW = 1.6, 3.0  # mean speed, m/s, and s beside it, that the horizon leaves
ANGLES = 0.15  # share of the angle between two neighbours by which each may deviate
DOOR, THICK = 0.5, 0.1  # m, half the width and half the depth of the door
LANE, ROWS, BEFORE = 0.9, 4, 1.8  # m between starts at a door, starts beside each other, m from them to the wall
TREES, TREE, PATH = 0.18, (0.2, 0.35), 0.75  # trunks per m^2, radii, m, and room between two trunks, m
FLYING = 0.8, 2.5, 0.3  # m that quadrotors keep, mean speed, m/s, and largest deviation in height, m


def field(x: Tensor, u: Tensor) -> Tensor:
    """Rates of x = [p (m), v (m/s)]; u is an acceleration, m/s^2."""
    return torch.cat((x[..., 2:], u), dim=-1)


@cache
def disc_model(dt: float) -> FunctionDynamics:
    """The model of all discs."""
    return FunctionDynamics(field, 4, 2, dt, "rk4", slice(0, 2))


def disc(starts: np.ndarray, ends: np.ndarray, obstacles: list[Constraint], N: int, dt: float) -> Problem:
    """Discs (B, 2) from start to end, m."""
    rest = torch.zeros(len(starts), 2, dtype=torch.float64)
    x0, goal = (torch.cat((torch.from_numpy(p.copy()), rest), dim=-1) for p in (starts, ends))
    cost = QuadraticCost([dt, dt, 0.1 * dt, 0.1 * dt], [0.1 * dt] * 2, [50.0, 50.0, 5.0, 5.0], goal.unsqueeze(1))
    parts = [*obstacles, ControlBounds(-PUSH, PUSH), NormBounds(("x", [2, 3]), upper=FASTEST)]
    return Problem(disc_model(dt), cost, parts, x0, N, Goal(goal[:, :2], ARRIVED))


def _ring(rng: np.random.Generator, V: int, radius: float) -> np.ndarray:
    angle = 2.0 * np.pi * (np.arange(V) + rng.uniform(-ANGLES, ANGLES, V)) / V
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def _trunks(rng: np.random.Generator, radius: float) -> np.ndarray:
    """Centres and radii (M, 3) of trunks within a circle of starts."""
    found, inner = list[tuple[float, ...]](), radius - 1.2
    while len(found) < int(TREES * np.pi * (radius - 1.0) ** 2):
        center, size = rng.uniform(-inner, inner, 2), rng.uniform(*TREE)
        clear = all(np.hypot(*(center - other[:2])) > size + other[2] + PATH for other in found)
        if np.hypot(*center) < inner and clear:
            found.append((*center, size))
    return np.array(found)


def _beside_door(rng: np.random.Generator, V: int) -> tuple[np.ndarray, np.ndarray]:
    """Starts and ends (V, 2): each ends where one of the other side begins."""
    j = np.arange(V // 2)
    y, x = (j % ROWS - 0.5 * (ROWS - 1)) * LANE, BEFORE + LANE * (j // ROWS)
    left, right = np.column_stack([-x, y]), np.column_stack([x, y])
    rng.shuffle(right)
    to = rng.permutation(V // 2)
    return np.vstack([left, right]), np.vstack([right[to], left[np.argsort(to)]])


def discs(kind: str, V: int, count: int, seed: int) -> Fleet:
    """`count` fleets of V discs: "circle", "door" or "forest"."""
    starts, ends, trunks = [], [], []
    radius = max(2.5, 0.28 * V) if kind == "circle" else max(4.0, 0.33 * V)
    seconds = 2.0 * radius / PACE + SLOW
    if kind == "door":
        seconds = 2.0 * (BEFORE + LANE * ((V // 2 + 3) // ROWS)) / PACE + 2.2 + 0.75 * V
    for number in range(count):
        rng = np.random.default_rng((seed, V, number))
        start, end = _beside_door(rng, V) if kind == "door" else (_ring(rng, V, radius),) * 2
        starts.append(start)
        ends.append(end if kind == "door" else -end)
        trunks.append(_trunks(rng, radius) if kind == "forest" else np.empty((0, 3)))
    N = max(80, int(np.ceil(seconds / 0.11)))
    obstacles: list[Constraint] = []
    if kind == "door":
        obstacles = [Boxes([[0.0, DOOR + 2.0], [0.0, -DOOR - 2.0]], [[THICK, 2.0]] * 2, RADIUS)]
    if kind == "forest":
        padded = np.full((count, max(map(len, trunks)), 3), np.nan)
        for row, some in zip(padded, trunks, strict=True):
            row[: len(some)] = some
        obstacles = [Spheres(torch.from_numpy(padded[..., :2].copy()), torch.from_numpy(padded[..., 2].copy()), RADIUS)]
    S, E = np.stack(starts), np.stack(ends)
    return Fleet([disc(S[:, v], E[:, v], obstacles, N, seconds / N) for v in range(V)], KEPT)


def quadrotors(V: int, count: int, seed: int) -> Fleet:
    """`count` fleets of V planning models of quadrotors (14 states) that swap places on a circle."""
    vehicle, dt, (kept, pace, high) = Vehicle.quadrotor(), 0.05, FLYING
    radius = max(2.5, 0.3 * V)
    N, hover = int(np.ceil((2.0 * radius / pace + 2.0) / dt)), float(vehicle.control_reference[3])
    rest = np.array([0.0, 0, 0, 1, 0, 0, 0, 0, 0, 0, hover])
    rngs = [np.random.default_rng((seed, V, number)) for number in range(count)]
    starts = np.stack([np.column_stack([_ring(rng, V, radius), rng.uniform(-high, high, V)]) for rng in rngs])
    Q, R = [10.0, 10, 20, *[1.0] * 7, *[0.1] * 4], [0.5, 0.5, 0.5, 0.1]
    Qf = [200.0] * 3 + [20.0] * 3 + [1.0] * 4 + [0.1] * 4
    bounds, dynamics = vehicle.limits("control_lower"), replace(vehicle.dynamics, dt=dt)  # type: ignore[type-var]

    def one(v: int) -> Problem:
        x0, goal = (
            torch.from_numpy(np.column_stack([p, np.tile(rest, (count, 1))]))
            for p in (starts[:, v], starts[:, v] * [-1.0, -1.0, 1.0])
        )
        cost = QuadraticCost(
            [dt * q for q in Q], [dt * r for r in R], Qf, x_ref=goal.unsqueeze(1), u_ref=[0.0, 0.0, 0.0, hover]
        )
        limits = ControlBounds(bounds, vehicle.limits("control_upper"))
        return Problem(dynamics, cost, [limits], x0, N, Goal(goal[:, :3], ARRIVED))

    return Fleet([one(v) for v in range(V)], kept)


def swaps(scenario: jaxipm.Scenario, places: Tensor) -> Fleet:
    """Swaps of jaxipm as fleets: vehicles keep their distance at the last knot, and between knots, too."""
    some, limits = scenario.at(places), scenario.limits().tolist()
    double, n = [2.0 * weight for weight in scenario.weights], jaxipm.STATES
    model = FunctionDynamics(partial(jaxipm.fleet, 1), n, jaxipm.ROTORS, jaxipm.DT, "euler", slice(0, 3))
    lower, upper = jaxipm.SLOWEST / jaxipm.HOVER, jaxipm.FASTEST / jaxipm.HOVER
    vehicles = []
    for v in range(scenario.vehicles):
        own = slice(v * n, (v + 1) * n)
        aim = some.aim[..., own].contiguous()
        cost = QuadraticCost(Q=double, R=[0.0] * 4, Qf=double, x_ref=aim, u_ref=[1.0] * 4)
        bounds = ControlBounds([lower] * 4, [upper] * 4), StateBounds([-b for b in limits], limits)
        vehicles.append(Problem(model, cost, list(bounds), some.x0[:, own].contiguous(), jaxipm.N))
    return Fleet(vehicles, jaxipm.KEPT)
