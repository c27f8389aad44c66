"""Integrators: from rates(x) -> x' on (..., n) and a time step dt in seconds to x at the next knot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

Rates = Callable[[Tensor], Tensor]
Integrator = Literal["euler", "midpoint", "rk4"]


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


INTEGRATORS = {"euler": euler, "midpoint": midpoint, "rk4": rk4}
