"""The navigation problem of jaxipm as a torchgco problem: a fan of starts flies past four cylinders to the origin.

The numbers are those of jaxipm (tests/quad_params.json, tests/quad_nav_circle/test_params.json, ipopt_quad_nav.py in
the same folder, and tests/quad_casadi_dynamics.py; commit 7556f52). Steps are Euler's, as there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from torchgco import ControlBounds, FunctionDynamics, Problem, QuadraticCost, StateBounds
from torchgco.base.shapes import Dimensions
from torchgco.constraints import Constraint
from torchgco.costs.base import add_blocks

KNOTS, DT = 30, 0.1  # s
N = KNOTS - 1
MASS, GRAVITY, DRAG = 1.2, 9.81, 0.1  # kg, m/s^2, N s^2/m^2
ARM = 0.16  # m, along both axes
INERTIA, ROTOR = (0.0123, 0.0123, 0.0224), 2.7e-5  # kg m^2
THRUST, TORQUE = 1.076e-5, 1.632e-7  # N s^2, N m s^2: by the square of a rotor's speed
SLOWEST, FASTEST, HOVER = 75.0, 925.0, 522.9847140714692  # rad/s
BOUND = 10.0  # of positions, velocities and body rates: m, m/s, rad/s
CENTERS = ((1.0, 1.0), (1.0, 3.0), (3.0, 1.0), (3.0, 3.0))  # m
RADII, VEHICLE = (0.5, 0.5, 0.5, 0.75), 0.2  # m
GROWTH = 0.1  # of the squared radii, 1/s
DISTANCE = 32**0.5  # m, of the starts from the origin
WEIGHTS = (1.0,) * 3 + (0.0,) * 4 + (1.0,) * 6


def quadrotor(x: Tensor, u: Tensor) -> Tensor:
    """Rates of x = [p (m, z downwards), quaternion (w, x, y, z), v (m/s), body rates (rad/s)].

    u holds the speeds of the four rotors as shares of that of hovering: all controls are then of order one.
    """
    w, a, b, c = x[..., 3], x[..., 4], x[..., 5], x[..., 6]
    vx, vy, vz, p, q, r = x[..., 7], x[..., 8], x[..., 9], x[..., 10], x[..., 11], x[..., 12]
    s = HOVER * u
    s0, s1, s2, s3 = s[..., 0], s[..., 1], s[..., 2], s[..., 3]
    square = s.square()
    f0, f1, f2, f3 = square[..., 0], square[..., 1], square[..., 2], square[..., 3]
    lift = THRUST / MASS * (f0 + f1 + f2 + f3)
    jx, jy, jz = INERTIA
    gyro = ROTOR * (s0 - s1 + s2 - s3)
    return torch.stack(
        (
            vx, vy, vz,
            -0.5 * (a * p + b * q + c * r), 0.5 * (w * p + b * r - c * q),
            0.5 * (w * q + c * p - a * r), 0.5 * (w * r + a * q - b * p),
            -DRAG / MASS * vx * vx.abs() - 2 * (a * c + w * b) * lift,
            -DRAG / MASS * vy * vy.abs() - 2 * (b * c - w * a) * lift,
            -DRAG / MASS * vz * vz.abs() - (w * w - a * a - b * b + c * c) * lift + GRAVITY,
            ((jy - jz) * q * r - gyro * q + ARM * THRUST * (f0 - f1 - f2 + f3)) / jx,
            ((jz - jx) * p * r + gyro * p + ARM * THRUST * (f0 + f1 - f2 - f3)) / jy,
            ((jx - jy) * p * q + TORQUE * (f1 - f0 + f3 - f2)) / jz,
        ),
        dim=-1,
    )  # fmt: skip


@dataclass(frozen=True)
class GrowingCylinders(Constraint):
    """r^2 (1 + GROWTH t) - |p - c|^2 <= 0 in the plane, at the knots 0..N-1: cylinders that grow with time."""

    centers: Tensor  # (4, 2), m
    radii: Tensor  # (4,), m, with the vehicle's
    knots: Any = None
    geometric: ClassVar[bool] = True

    def bind(self, dims: Dimensions) -> Self:
        return replace(self, knots=slice(1, dims.N))

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return self._rows(X[:, self.knots], self._squares(torch.arange(1, U.shape[1]).to(X)).unsqueeze(0))

    def at(self, x: Tensor, k: int) -> Tensor:
        return self._rows(x, self._squares(x.new_tensor([k])))

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        slope = X.new_zeros(*g.shape, X.shape[-1])
        slope[..., :2] = -2.0 * (X[:, self.knots, None, :2] - self.centers)
        gradient = (g.unsqueeze(-1) * slope).sum(-2)
        add_blocks(H[:, self.knots], X.shape[-1], gradient, None, slope.mT @ (h.unsqueeze(-1) * slope), None)

    def violation(self, X: Tensor, U: Tensor) -> Tensor:
        """Penetration, m."""
        apart = (X[:, self.knots, None, :2] - self.centers).square().sum(-1).sqrt()
        return (self._squares(torch.arange(1, U.shape[1]).to(X)).sqrt() - apart).clamp(min=0.0)

    def _rows(self, x: Tensor, squares: Tensor) -> Tensor:
        return squares - (x[..., None, :2] - self.centers).square().sum(-1)

    def _squares(self, k: Tensor) -> Tensor:
        """Squared radii (K, 4) at the knots k (K,), m^2."""
        return self.radii.square() * (1.0 + GROWTH * DT * k).unsqueeze(-1)


def fan(count: int, degrees: float) -> Tensor:
    """Starts (count, 13) level and at rest on an arc around the origin, at equal angles around the diagonal."""
    half = np.deg2rad(degrees) / 2
    angle = torch.linspace(np.pi / 4 - half, np.pi / 4 + half, count, dtype=torch.float64)
    x0 = torch.zeros(count, 13, dtype=torch.float64)
    x0[:, 0], x0[:, 1], x0[:, 3] = DISTANCE * angle.cos(), DISTANCE * angle.sin(), 1.0
    return x0


def navigation(x0: Tensor) -> Problem:
    """The problem from starts x0 (B, 13)."""
    box = [BOUND] * 3 + [np.inf] * 4 + [BOUND] * 6
    double = [2 * weight for weight in WEIGHTS]  # the published cost has no factor 1/2
    radii = x0.new_tensor(RADII) + VEHICLE
    return Problem(
        FunctionDynamics(quadrotor, 13, 4, DT, "euler", position=slice(0, 2)),
        QuadraticCost(Q=double, R=[0.0] * 4, Qf=double, u_ref=[1.0] * 4),
        [
            GrowingCylinders(x0.new_tensor(CENTERS), radii),
            ControlBounds([SLOWEST / HOVER] * 4, [FASTEST / HOVER] * 4),
            StateBounds([-b for b in box], box),
        ],
        x0,
        N,
    )


def line_guess(x0: Tensor) -> tuple[Tensor, Tensor]:
    """The published guess: states (B, N+1, 13) on the straight line to (0, 0, -2), level; and hovering."""
    share = torch.linspace(0, 1, N + 1, dtype=x0.dtype).view(1, -1, 1)
    end = x0.new_tensor([0.0, 0.0, -2.0, 1.0] + [0.0] * 9)
    return (1 - share) * x0.unsqueeze(1) + share * end, x0.new_ones(x0.shape[0], N, 4)


def rolled(x0: np.ndarray, U: np.ndarray) -> np.ndarray:
    """States (B, N+1, 13) from x0 (B, 13) by controls U (B, N, 4), in NumPy: a second version of `quadrotor`."""
    J, X = np.array(INERTIA), [x0]
    down = np.array([[0.0, 0.0, 1.0]])
    for k in range(N):
        x, speed = X[-1], HOVER * U[:, k]
        q, v, w = x[:, 3:7], x[:, 7:10], x[:, 10:13]
        s, e, f = q[:, :1], q[:, 1:], THRUST * speed**2
        # The body's third axis in the world, by the rotation of a quaternion.
        axis = (s**2 - (e**2).sum(-1, keepdims=True)) * down + 2 * e * e[:, 2:] + 2 * s * np.cross(e, down)
        dq = 0.5 * np.c_[-(e * w).sum(-1), s * w + np.cross(e, w)]
        dv = GRAVITY * down - axis * f.sum(-1, keepdims=True) / MASS - DRAG / MASS * v * np.abs(v)
        spin = ROTOR * (speed @ [1, -1, 1, -1])
        torque = np.c_[ARM * f @ [1, -1, -1, 1], ARM * f @ [1, 1, -1, -1], TORQUE / THRUST * f @ [-1, 1, -1, 1]]
        torque += np.c_[-spin * w[:, 1], spin * w[:, 0], 0 * spin]
        X.append(x + DT * np.c_[v, dq, dv, (torque - np.cross(w, w * J)) / J])
    return np.stack(X, axis=1)
