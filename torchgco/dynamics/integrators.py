"""Integrators: from rates(x) -> x' on (..., n) and a time step dt in seconds to x at the next knot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import sqrt
from typing import Literal

import torch
from torch import Tensor

from torchgco.base.roots import root

Rates = Callable[[Tensor], Tensor]
Integrator = Literal["euler", "midpoint", "rk4", "implicit_euler", "radau3", "radau5"]


def euler(rates: Rates, x: Tensor, dt: float) -> Tensor:
    return torch.add(x, rates(x), alpha=dt)


def midpoint(rates: Rates, x: Tensor, dt: float) -> Tensor:
    return torch.add(x, rates(torch.add(x, rates(x), alpha=0.5 * dt)), alpha=dt)


def rk4(rates: Rates, x: Tensor, dt: float) -> Tensor:
    k1 = rates(x)
    k2 = rates(torch.add(x, k1, alpha=0.5 * dt))
    k3 = rates(torch.add(x, k2, alpha=0.5 * dt))
    k4 = rates(torch.add(x, k3, alpha=dt))
    return torch.add(x, k1 + 2.0 * k2 + 2.0 * k3 + k4, alpha=dt / 6.0)


def implicit(weights: Sequence[Sequence[float]]) -> Callable[[Rates, Tensor, float], Tensor]:
    """A Radau IIA method of s stages with these weights (s, s), whose last stage is the next knot: Hairer and Wanner,
    Solving Ordinary Differential Equations II, section IV.5.

    The states at the stages are the root, from x itself, of x_i - x - dt sum_j a_ij rates(x_j); NaN where Newton's
    method finds none.
    """

    def step(rates: Rates, x: Tensor, dt: float) -> Tensor:
        def residual(stages: Tensor) -> Tensor:
            each = stages.chunk(len(weights), dim=-1)
            slopes = [rates(stage) for stage in each]
            ways = (sum(w * slope for w, slope in zip(row, slopes, strict=True)) for row in weights)
            return torch.cat([stage - torch.add(x, way, alpha=dt) for stage, way in zip(each, ways, strict=True)], -1)

        return root(residual, torch.cat([x] * len(weights), -1))[..., -x.shape[-1] :]

    return step


_R = sqrt(6.0)
IMPLICIT = {
    "implicit_euler": implicit([[1.0]]),
    "radau3": implicit([[5.0 / 12.0, -1.0 / 12.0], [3.0 / 4.0, 1.0 / 4.0]]),
    "radau5": implicit(
        [
            [(88.0 - 7.0 * _R) / 360.0, (296.0 - 169.0 * _R) / 1800.0, (-2.0 + 3.0 * _R) / 225.0],
            [(296.0 + 169.0 * _R) / 1800.0, (88.0 + 7.0 * _R) / 360.0, (-2.0 - 3.0 * _R) / 225.0],
            [(16.0 - _R) / 36.0, (16.0 + _R) / 36.0, 1.0 / 9.0],
        ]
    ),
}
INTEGRATORS = {"euler": euler, "midpoint": midpoint, "rk4": rk4} | IMPLICIT
