"""Integrators as combinators: a vector field in, a discrete step (and its derivatives) out.

Each takes `field(x, u) -> x'` on (..., n), (..., m), a time step dt in seconds, and returns x at the next knot with u
held. The `linearise_*` twins take `jacobians(x, u) -> (field_x, field_u)` as well and return (fx, fu) of the step.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Field = Callable[[Tensor, Tensor], Tensor]
FieldJacobians = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


def euler(field: Field, x: Tensor, u: Tensor, dt: float) -> Tensor:
    return x + dt * field(x, u)


def midpoint(field: Field, x: Tensor, u: Tensor, dt: float) -> Tensor:
    return x + dt * field(x + 0.5 * dt * field(x, u), u)


def rk4(field: Field, x: Tensor, u: Tensor, dt: float) -> Tensor:
    k1 = field(x, u)
    k2 = field(x + 0.5 * dt * k1, u)
    k3 = field(x + 0.5 * dt * k2, u)
    k4 = field(x + dt * k3, u)
    return x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def linearise_euler(field: Field, jacobians: FieldJacobians, x: Tensor, u: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    ax, au = jacobians(x, u)
    return _identity(ax) + dt * ax, dt * au


def linearise_midpoint(
    field: Field, jacobians: FieldJacobians, x: Tensor, u: Tensor, dt: float
) -> tuple[Tensor, Tensor]:
    ax, au = jacobians(x, u)
    bx, bu = jacobians(x + 0.5 * dt * field(x, u), u)
    eye = _identity(ax)
    return eye + dt * bx @ (eye + 0.5 * dt * ax), dt * (bu + bx @ (0.5 * dt * au))


def linearise_rk4(field: Field, jacobians: FieldJacobians, x: Tensor, u: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    k1 = field(x, u)
    x2 = x + 0.5 * dt * k1
    k2 = field(x2, u)
    x3 = x + 0.5 * dt * k2
    k3 = field(x3, u)
    x4 = x + dt * k3
    ax, au = jacobians(x, u)
    eye = _identity(ax)
    sum_x, sum_u = ax, au
    # The chain rule through one stage: k_i = f(x + h k_{i-1}, u).
    for at, h, weight in ((x2, 0.5 * dt, 2.0), (x3, 0.5 * dt, 2.0), (x4, dt, 1.0)):
        bx, bu = jacobians(at, u)
        ax, au = bx @ (eye + h * ax), bu + bx @ (h * au)
        sum_x, sum_u = sum_x + weight * ax, sum_u + weight * au
    return eye + dt / 6.0 * sum_x, dt / 6.0 * sum_u


def _identity(like: Tensor) -> Tensor:
    return torch.eye(like.shape[-1], dtype=like.dtype, device=like.device)


INTEGRATORS = {
    "euler": (euler, linearise_euler),
    "midpoint": (midpoint, linearise_midpoint),
    "rk4": (rk4, linearise_rk4),
}
