"""Integrators as combinators: a vector field in, a discrete step (and its derivatives) out.

Each takes a state as a tuple of tensors (all components apart, or one tensor that holds them), `rates(x) -> x'` in the
same form, a time step dt in seconds, and returns x at the next knot. The `linearise_*` twins take `field(x, u)` on
(..., n), (..., m) and `jacobians(x, u) -> (field_x, field_u)`, and return (fx, fu) of the step.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Parts = tuple[Tensor, ...]
Rates = Callable[[Parts], Parts]
Field = Callable[[Tensor, Tensor], Tensor]
FieldJacobians = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


def euler(rates: Rates, x: Parts, dt: float) -> Parts:
    return _ahead(x, dt, rates(x))


def midpoint(rates: Rates, x: Parts, dt: float) -> Parts:
    return _ahead(x, dt, rates(_ahead(x, 0.5 * dt, rates(x))))


def rk4(rates: Rates, x: Parts, dt: float) -> Parts:
    k1 = rates(x)
    k2 = rates(_ahead(x, 0.5 * dt, k1))
    k3 = rates(_ahead(x, 0.5 * dt, k2))
    k4 = rates(_ahead(x, dt, k3))
    slopes = tuple(a + 2.0 * b + 2.0 * c + d for a, b, c, d in zip(k1, k2, k3, k4, strict=True))
    return _ahead(x, dt / 6.0, slopes)


def _ahead(x: Parts, h: float, slope: Parts) -> Parts:
    return tuple(torch.add(a, b, alpha=h) for a, b in zip(x, slope, strict=True))


def linearise_euler(field: Field, jacobians: FieldJacobians, x: Tensor, u: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    ax, au = jacobians(x, u)
    fx = dt * ax
    fx.diagonal(dim1=-2, dim2=-1).add_(1.0)
    return fx, dt * au


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
