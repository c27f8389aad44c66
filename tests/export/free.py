"""Problems with a free time, a free start or several elements that exported C serves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from tests.export.kinds import N, car_rates
from torchgco import (
    Boxes,
    Capsules,
    Cone,
    ControlBounds,
    Ellipsoids,
    Field,
    FreeTime,
    FunctionConstraint,
    FunctionDynamics,
    Goal,
    NormBounds,
    OccupancyGrid,
    Problem,
    QuadraticCost,
    Spheres,
    StateBounds,
)

SWEPT = FunctionDynamics(car_rates, n=4, m=2, dt=0.2, integrator="rk4", position=slice(0, 2))


def timed(*parts: Any, d: int = 2, x0: Any = None, most: float = 4.0, segments: Any = None, **more: Any) -> Problem:
    """A point that comes to rest on the other side as soon as it can."""
    model = FunctionDynamics(
        lambda x, u: torch.cat((x[..., d:], u), -1), 2 * d, d, 0.2, integrator="rk4", position=slice(0, d)
    )
    cost = QuadraticCost([0.0] * 2 * d, [0.02] * d, [0.0] * 2 * d)
    goal = Goal(state=[2.0, 0.3, 0.2][:d] + [0.0] * d, required=True)
    more = {"goal": goal, "time": FreeTime(0.2, most, 1.0, segments=segments)} | more
    start: Any = [-1.0, 0.0, 0.0][:d] + [0.0] * d if x0 is None else x0
    return Problem(model, cost, [ControlBounds(-2.0, 2.0), *parts], start, N, **more)


def grid() -> OccupancyGrid:
    cells = np.zeros((40, 40), dtype=bool)
    cells[24:28, 12:22] = True
    return OccupancyGrid(cells, [-2.0, -2.2], 0.1)


def follower(**more: Any) -> Problem:
    """A car along a path whose knots are its own: how fast is free."""
    path = np.stack((np.linspace(0, 6, N + 1), 0.5 * np.sin(np.linspace(0, 3, N + 1)), *np.zeros((2, N + 1))), -1)
    cost = QuadraticCost([1.0, 1, 0, 0], [0.05, 0.5], [5.0, 5, 0, 0], path)
    bounds = [ControlBounds([-3.0, -0.5], [3.0, 0.5]), StateBounds(-np.inf, [np.inf, np.inf, np.inf, 4.0])]
    start: Any = [0.0, 0.0, 0.0, 2.0]
    return Problem(SWEPT, cost, bounds, start, N, time=FreeTime(0.4, 2.0, 0.1), **more)


TIMES: dict[str, Callable[[], Problem]] = {
    "a goal": timed,
    "discs": lambda: timed(Spheres([[0.5, 0.3]], [0.3], 0.1)),
    "boxes": lambda: timed(Boxes([[0.5, 0.55]], [[0.2, 0.1]], 0.15)),
    "capsules": lambda: timed(Capsules([[0.5, -0.8]], [[0.6, -0.2]], [0.15], 0.15)),
    "ellipsoids": lambda: timed(Ellipsoids([[0.5, 0.3]], [[0.4, 0.2]], 0.1)),
    "a map": lambda: timed(Field(grid(), 0.1)),
    "moving discs": lambda: timed(Spheres([[0.5, 0.9]], [0.3], 0.1, velocities=[[0.0, -0.3]])),
    "norms": lambda: timed(NormBounds(("x", [2, 3]), upper=1.5), NormBounds("u", upper=2.0)),
    "cones": lambda: timed(Cone([1.0, 0.0, 0.0], 1.2, ("x", [3, 4, 5])), d=3),
    "a function": lambda: timed(FunctionConstraint(lambda x, u: x[..., 2:3] + 0.2 * u[..., :1] - 1.4, of="xu")),
    "segments": lambda: timed(StateBounds(-np.inf, [np.inf, np.inf, 1.2, np.inf], knots=[5, 6, 7]), segments=2),
    "three segments": lambda: timed(StateBounds(-np.inf, [np.inf, np.inf, 1.3, np.inf]), segments=[3, 8]),
    "a path": follower,
    "a free start": lambda: timed(free_start=[False, False, False, True]),
}
