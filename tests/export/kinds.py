"""Problems of every kind of rows, costs and models that exported C serves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from tests.native.users import PROBLEMS
from torchgco import (
    Body,
    Boxes,
    Capsules,
    Cone,
    ControlBounds,
    Ellipsoids,
    Field,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Goal,
    Moved,
    NormBounds,
    OccupancyGrid,
    Planar,
    Problem,
    QuadraticCost,
    Spheres,
    StateBounds,
)

N, DT = 12, 0.1


def car_rates(x: Tensor, u: Tensor) -> Tensor:
    """Of position, heading and speed, by acceleration and steering angle."""
    heading, speed = x[..., 2], x[..., 3]
    return torch.stack((speed * heading.cos(), speed * heading.sin(), speed * u[..., 1].tan() / 2.5, u[..., 0]), -1)


CAR = FunctionDynamics(car_rates, n=4, m=2, dt=DT, integrator="rk4", position=slice(0, 2))
START = [0.0, 0.0, 0.0, 3.0]
# An actuator that follows within a tenth of a stage.
LAGGING = FunctionDynamics(
    lambda x, u: torch.stack((x[..., 1], x[..., 2], 100.0 * (u[..., 0] - x[..., 2])), -1), 3, 1, DT, "radau5"
)
BODY = Body([[0.0, 0.0], [0.5, 0.0]], [0.2, 0.2], lambda x: turned(x[..., 2]))


def turned(angle: Tensor) -> Tensor:
    """Rotation matrices (..., 2, 2)."""
    rows = (angle.cos(), -angle.sin()), (angle.sin(), angle.cos())
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def reference(t: float = 0.0) -> np.ndarray:
    """A sine that the car follows at 3 m/s, (N+1, 4), from a time on, s."""
    times = t + DT * np.arange(N + 1)
    return np.stack((3 * times, 2 * np.sin(0.5 * times), 0 * times, 3 + 0 * times), -1)


def car(*parts: Any, **more: Any) -> Problem:
    """Driven along the reference."""
    cost = QuadraticCost([1, 1, 0.1, 0.1], [0.1, 1], [10, 10, 1, 1], x_ref=reference())
    return Problem(CAR, cost, [ControlBounds([-3.0, -0.5], [3.0, 0.5]), *parts], START, N, **more)


def point(*parts: Any, d: int = 2, **more: Any) -> Problem:
    """A point that moves freely to the other side of what lies between."""
    model = FunctionDynamics(
        lambda x, u: torch.cat((x[..., d:], u), -1), 2 * d, d, DT, integrator="rk4", position=slice(0, d)
    )
    cost = QuadraticCost(
        [1.0] * d + [0.1] * d, [0.1] * d, [50.0] * d + [1.0] * d, x_ref=[1.5, 0.3, 0.2][:d] + [0.0] * d
    )
    return Problem(model, cost, [ControlBounds(-8.0, 8.0), *parts], [-1.0, 0.0, 0.0][:d] + [0.0] * d, N, **more)


def learned() -> Problem:
    """A model whose drag is a network's."""
    torch.manual_seed(3)
    drag = nn.Sequential(nn.Linear(2, 24), nn.Tanh(), nn.Linear(24, 2)).double()
    model = FunctionDynamics(
        lambda x, u: torch.cat((x[..., 2:], u - 0.3 * drag(x[..., 2:])), -1), 4, 2, DT, position=slice(0, 2)
    )
    cost = QuadraticCost([1.0, 1.0, 0.1, 0.1], [0.1, 0.1], [50.0, 50.0, 1.0, 1.0], x_ref=[1.0, 0.3, 0.0, 0.0])
    return Problem(model, cost, [ControlBounds(-8.0, 8.0)], [-1.0, 0.0, 0.0, 0.0], N)


def mapped() -> Problem:
    grid = np.zeros((40, 40), dtype=bool)
    grid[18:22, 12:20] = True
    return point(Field(OccupancyGrid(grid, [-2.0, -2.2], 0.1), 0.15))


def valued() -> Problem:
    """Numbers of functions, of all parts."""
    model = FunctionDynamics(
        lambda x, u, drag: torch.cat((x[..., 2:], u - drag * x[..., 2:]), -1), 4, 2, DT, position=slice(0, 2),
        values={"drag": torch.tensor([[0.4]]).double()},
    )  # fmt: skip
    cost = FunctionCost(
        lambda x, u, target: (x[..., :2] - target).square().sum(-1) + 0.1 * u.square().sum(-1),
        lambda x, target: 20.0 * (x[..., :2] - target).square().sum(-1) + x[..., 2:].square().sum(-1),
        values={"target": torch.tensor([[1.0, 0.3]]).double()},
    )
    room = FunctionConstraint(
        lambda x, width: x[..., 1:2].square() - width.square(), values={"width": torch.tensor([[0.5]]).double()}
    )
    return Problem(model, cost, [ControlBounds(-8.0, 8.0), room], [-1.0, 0.1, 0.0, 0.0], N)


# Of a car among rows of other kinds, from starts that can be solved.
OTHERS = (
    "smooth",
    "per problem",
    "by knot",
    "dense",
    "kinks",
    "overridden expand",
    "scales itself",
    "shifted",
    "bounds by knot",
)
KINDS: dict[str, Callable[[], Problem]] = {
    "bounds": lambda: car(StateBounds([-np.inf, -1.0, -1.0, 0.0], [np.inf, 1.5, 1.0, 3.4])),
    "no constraints": lambda: Problem(CAR, QuadraticCost([1, 1, 0.1, 0.1], [0.1, 1], [10, 10, 1, 1]), [], START, N),
    "discs": lambda: car(Spheres([[2.5, 0.4], [5.0, -1.0]], [0.3, 0.4], 0.2)),
    "spheres": lambda: point(Spheres([[0.0, 0.1, 0.0]], [0.3], 0.1), d=3),
    "moving spheres": lambda: point(Spheres([[0.0, 0.4]], [0.3], 0.1, velocities=[[0.1, -0.3]])),
    "moved": lambda: point(Moved(np.linspace([[0.0, 0.6]], [[0.0, 0.3]], N + 1), radii=[0.2], vehicle_radius=0.1)),
    "boxes": lambda: point(Boxes([[0.0, 0.2]], [[0.3, 0.2]], 0.1)),
    "turned boxes": lambda: point(Boxes([[0.1, 0.2, 0.0]], [[0.3, 0.2, 0.4]], 0.1), d=3),
    "capsules": lambda: point(Capsules([[0.0, -0.6]], [[0.1, -0.2]], [0.15], 0.1)),
    "ellipsoids": lambda: point(Ellipsoids([[0.0, 0.1]], [[0.4, 0.2]], 0.1)),
    "norms": lambda: point(NormBounds(("x", [2, 3]), upper=2.5), NormBounds("u", upper=6.0)),
    "cones": lambda: point(Cone([1.0, 0.0, 0.0], 1.2, ("x", [3, 4, 5])), d=3),
    "a function": lambda: point(FunctionConstraint(lambda x, u: x[..., 2:3] * u[..., :1] - 2.0, of="xu")),
    "a required goal": lambda: point(goal=Goal(state=[0.8, 0.2, 0.0, 0.0], required=True)),
    "a goal with free states": lambda: point(goal=Goal(state=[0.8, 0.2, np.nan, 0.1], required=True)),
    "a body": lambda: car(Spheres([[2.5, 0.8]], [0.3], BODY)),
    "a map": mapped,
    "a network": learned,
    "values": valued,
    "an implicit step": lambda: Problem(
        LAGGING, QuadraticCost([1, 0, 0], [0.1], [10, 1, 0], [1, 0, 0]), [ControlBounds(-1.0, 1.0)], [0.0] * 3, N
    ),
    "planar": lambda: Problem(
        Planar(dt=0.05), QuadraticCost([5, 5, 0, 1, 1, 0], [0.1, 0.1], [50, 50, 0, 1, 1, 0], [1, 0.4, 0, 0, 0, 0]),
        [Spheres([[0.2, 0.1]], [0.1], 0.06), ControlBounds(-10.0, 10.0)], [-1.0, 0, 0, 0, 0, 0], 20,
    ),
    **{name: lambda make=make: make().take([0]) for name, make in PROBLEMS.items() if name in OTHERS},
}  # fmt: skip
