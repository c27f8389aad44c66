"""The seven scenarios of jaxipm as torchgco problems, with their pools of instances and a judge in NumPy.

All numbers are jaxipm's (commit d32c145: tests/quad_params.json, test_params.json and ipopt_*.py in the folders
tests/quad_nav_circle, quad_track_avoid and quad_multi_swap, and initialization.py of the second). Vehicles are the
quadrotor of `navigation_problem`, several of them one after the other in one state.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np
import torch
from torch import Tensor

from benchmarks.outside import navigation_problem as nav
from benchmarks.outside.navigation_problem import DT, FASTEST, HOVER, SLOWEST, N
from torchgco import (
    ControlBounds,
    FunctionConstraint,
    FunctionDynamics,
    Problem,
    QuadraticCost,
    Separation,
    StateBounds,
)
from torchgco.constraints import Constraint

STATES, ROTORS = 13, 4
# Tracking: cylinders swing around places, by amplitudes, at rates (1/s) and phases; all of 1 m, (x, y) each.
PLACES = np.array([[3.0, 3.0], [-3.0, 2.0], [0.0, -3.0]])
SWINGS = np.array([[1.0, 0.5], [0.5, 1.0], [0.8, 0.8]])
RATES = np.array([[0.3, 0.5], [0.4, 0.3], [0.5, 0.4]])
PHASES = np.array([[0.0, 0.0], [1.0, 0.5], [0.5, 1.0]])
RADIUS, LOOP, WAVE = 1.0, 4.0, 2.0  # m: of the cylinders, of the reference in the plane, and of its height
SPREAD, MARGIN = 0.5, 0.1  # m: deviation of starts from the reference; they keep so far from cylinders
NORM = (0.5, 1.5)  # of the quaternion, squared
# Swaps: vehicles on a circle fly to the opposite side, all rotated by two angles that differ between instances.
CIRCLE, KEPT, ROTATED = 3.0, 1.0, np.deg2rad(5.0)  # m, m, rad
STRIDES = (0.6180339887498949, 0.41421356237309515)  # of both angles, as shares of their ranges
SWAP_BOUND = (5.0, 5.0, 1.5)  # m
SWAP_WEIGHTS = (1.0,) * 3 + (0.0,) * 4 + (0.1,) * 3 + (1.0,) * 3


@dataclass(frozen=True)
class Instances:
    """Starts (B, n) and aims (B, N+1, n), at which the cost is 0."""

    x0: Tensor
    aim: Tensor

    def take(self, rows: Tensor) -> Instances:
        return Instances(self.x0[rows], self.aim[rows])


@dataclass(frozen=True)
class Scenario:
    """A scenario: its instances, its constraints besides bounds, and how they are counted.

    Args:
        size: how many instances were published.
        pool: the first so many of them.
        kept: constraints besides bounds.
        missed: by how much they are violated, (B,), along states (B, N+1, n), in NumPy.
        bound: of positions, m.
        to_origin: whether the published guess is a line to (0, 0, -2), else it stays at the start.
    """

    name: str
    size: int
    pool: Callable[[int], Instances]
    kept: Callable[[], list[Constraint]]
    missed: Callable[[np.ndarray], np.ndarray]
    vehicles: int = 1
    bound: tuple[float, ...] = (nav.BOUND,) * 3
    weights: tuple[float, ...] = nav.WEIGHTS
    to_origin: bool = True

    def places(self, count: int) -> Tensor:
        """Where `count` instances lie in the pool, (count,)."""
        return spread(self.size, count)

    @property
    def family(self) -> str:
        """Navigation, tracking or swap."""
        return self.name.split()[0].rstrip(",")

    def at(self, places: Tensor) -> Instances:
        """The instances at places of the pool."""
        return self.pool(self.size).take(places)

    def limits(self) -> np.ndarray:
        """Bounds of one vehicle's states (13,), both ways."""
        return np.array([*self.bound, *[np.inf] * 4, *[nav.BOUND] * 6])

    def problem(self, some: Instances) -> Problem:
        box = self.limits().tolist() * self.vehicles
        double = [2 * weight for weight in self.weights] * self.vehicles  # the published cost has no factor 1/2
        m = ROTORS * self.vehicles
        dynamics = FunctionDynamics(partial(fleet, self.vehicles), STATES * self.vehicles, m, DT, "euler", slice(0, 3))
        return Problem(
            dynamics,
            QuadraticCost(Q=double, R=[0.0] * m, Qf=double, x_ref=some.aim, u_ref=[1.0] * m),
            [
                *self.kept(),
                ControlBounds([SLOWEST / HOVER] * m, [FASTEST / HOVER] * m),
                StateBounds([-b for b in box], box),
            ],
            some.x0,
            N,
        )

    def guess(self, some: Instances) -> tuple[Tensor, Tensor]:
        """The published guess: states (B, N+1, n) and hovering (B, N, m)."""
        U = some.x0.new_ones(len(some.x0), N, ROTORS * self.vehicles)
        if self.to_origin:
            return nav.line_guess(some.x0)[0], U
        return some.x0.unsqueeze(1).repeat(1, N + 1, 1), U

    def counted(self, some: Instances, U: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cost (B,) and largest violation (B,) of controls U (B, N, m), rolled out in NumPy.

        No code is shared with the problem or the solvers. The violation is in m, m/s, rad/s, shares of hovering speed,
        and what the squared norm of a quaternion exceeds.
        """
        B, V = len(U), self.vehicles
        each = U.reshape(B, N, V, ROTORS).swapaxes(1, 2).reshape(B * V, N, ROTORS)
        X = nav.rolled(some.x0.numpy().reshape(B * V, STATES), each).reshape(B, V, N + 1, STATES)
        over = np.where(np.isfinite(self.limits()), np.abs(X) - self.limits(), -np.inf)
        X = X.swapaxes(1, 2).reshape(B, N + 1, V * STATES)
        cost = (X - some.aim.numpy()) ** 2 @ np.array(self.weights * V)
        turning = np.maximum(SLOWEST / HOVER - U, U - FASTEST / HOVER)
        worst = [over.max((1, 2, 3)), turning.max((1, 2)), self.missed(X)]
        return cost.sum(-1), np.maximum(0.0, np.max(worst, axis=0))


def spread(size: int, count: int) -> Tensor:
    """`count` of `size` places, from the first to the last at equal distances, (count,); all where there are fewer."""
    return torch.linspace(0, size - 1, min(count, size), dtype=torch.float64).round().long()


def fleet(vehicles: int, x: Tensor, u: Tensor) -> Tensor:
    """Rates (..., 13 V) of V quadrotors."""
    parts = zip(x.split(STATES, -1), u.split(ROTORS, -1), strict=True)
    return nav.quadrotor(x, u) if vehicles == 1 else torch.cat([nav.quadrotor(*part) for part in parts], dim=-1)


# Navigation: a fan of starts flies past four cylinders that grow.


def _fan(degrees: float, count: int) -> Instances:
    x0 = nav.fan(count, degrees)
    return Instances(x0, x0.new_zeros(count, N + 1, STATES))


def _growing() -> list[Constraint]:
    like = torch.zeros(0, dtype=torch.float64)
    return [nav.GrowingCylinders(like.new_tensor(nav.CENTERS), like.new_tensor(nav.RADII) + nav.VEHICLE)]


def _near_growing(X: np.ndarray) -> np.ndarray:
    squares = (np.array(nav.RADII) + nav.VEHICLE) ** 2 * (1 + nav.GROWTH * DT * np.arange(N)[:, None])
    return (np.sqrt(squares) - np.linalg.norm(X[:, :N, None, :2] - np.array(nav.CENTERS), axis=-1)).max((1, 2))


# Tracking: a reference of constant pace among three cylinders that swing.


def centers(k: np.ndarray) -> np.ndarray:
    """Centres (K, 3, 2) of the cylinders at knots k (K,), m."""
    return PLACES + SWINGS * np.sin(RATES * DT * k[:, None, None] + PHASES)


def reference(s: np.ndarray, pace: float) -> np.ndarray:
    """Aims (..., 13) at parameters s, passed at `pace` per second; attitudes have no weight and stay 0."""
    aim = np.zeros((*s.shape, STATES))
    aim[..., :3] = np.stack((LOOP * np.cos(s), LOOP * np.sin(s), WAVE * np.cos(2 * s)), -1)
    aim[..., 7:10] = pace * np.stack((-LOOP * np.sin(s), LOOP * np.cos(s), -2 * WAVE * np.sin(2 * s)), -1)
    return aim


def _tracks(pace: float, count: int) -> Instances:
    """As published: NumPy's generator with seed 0 draws s, then an offset, again where it is in a cylinder."""
    random, x0, aim = np.random.default_rng(0), np.zeros((count, STATES)), np.zeros((count, N + 1, STATES))
    x0[:, 3] = 1.0
    (here,) = centers(np.zeros(1))
    for i in range(count):
        close = True
        while close:
            s = random.uniform(0.0, 2 * np.pi)
            x0[i, :3] = reference(np.array(s), pace)[:3] + SPREAD * random.standard_normal(3)
            close = bool((np.linalg.norm(x0[i, :2] - here, axis=-1) < RADIUS + MARGIN).any())
        aim[i] = reference(s + pace * DT * np.arange(N + 1), pace)
    return Instances(torch.from_numpy(x0), torch.from_numpy(aim))


def _swinging() -> list[Constraint]:
    at = torch.from_numpy(centers(np.arange(N + 1)))

    def near(x: Tensor, k: Tensor) -> Tensor:
        return RADIUS**2 - (x[..., None, :2] - at[k]).square().sum(-1)

    def norm(x: Tensor) -> Tensor:
        square = x[..., 3:7].square().sum(-1)
        return torch.stack((square - NORM[1], NORM[0] - square), dim=-1)

    return [FunctionConstraint(near), FunctionConstraint(norm)]


def _near_swinging(X: np.ndarray) -> np.ndarray:
    apart = np.linalg.norm(X[..., None, :2] - centers(np.arange(N + 1)), axis=-1)
    square = (X[..., 3:7] ** 2).sum(-1)
    off = np.maximum(NORM[0] - square, square - NORM[1]).max(-1)
    return np.maximum((RADIUS - apart).max((1, 2)), off)


# Swaps: vehicles on a circle change places.


def _circles(vehicles: int, count: int) -> Instances:
    k, places = np.arange(count), 2 * np.pi * np.arange(vehicles) / vehicles
    starts, more = (ROTATED * (2 * np.mod(k * stride, 1.0) - 1) for stride in STRIDES)
    x0, aim = np.zeros((2, count, vehicles, STATES))
    for part, angle in ((x0, starts), (aim, starts + more + np.pi)):
        angles = places + angle[:, None]
        part[..., 0], part[..., 1] = CIRCLE * np.cos(angles), CIRCLE * np.sin(angles)
    x0[..., 3] = 1.0
    aims = torch.from_numpy(aim.reshape(count, 1, -1)).repeat(1, N + 1, 1)
    return Instances(torch.from_numpy(x0.reshape(count, -1)), aims)


def _apart(vehicles: int) -> list[Constraint]:
    return [Separation([range(i * STATES, i * STATES + 3) for i in range(vehicles)], KEPT, knots=range(1, N))]


def _too_close(X: np.ndarray) -> np.ndarray:
    p = X[:, :N].reshape(len(X), N, -1, STATES)[..., :3]
    pairs = combinations(range(p.shape[2]), 2)
    return KEPT - np.min([np.linalg.norm(p[:, :, i] - p[:, :, j], axis=-1).min(-1) for i, j in pairs], axis=0)


def _swap(vehicles: int) -> Scenario:
    kept = partial(_apart, vehicles)
    return Scenario(
        f"swap of {vehicles}",
        75,
        partial(_circles, vehicles),
        kept,
        _too_close,
        vehicles,
        SWAP_BOUND,
        SWAP_WEIGHTS,
        False,
    )


SCENARIOS = [
    *(Scenario(f"navigation, {d} degrees", 2000, partial(_fan, d), _growing, _near_growing) for d in (90, 180)),
    *(Scenario(f"tracking, pace {v}", 1000, partial(_tracks, v), _swinging, _near_swinging) for v in (1.0, 1.5, 2.0)),
    *(_swap(vehicles) for vehicles in (2, 4)),
]
