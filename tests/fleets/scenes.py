"""Discs and other vehicles that swap places."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco import ControlBounds, FunctionDynamics, Goal, NormBounds, Problem, QuadraticCost

D, DT = torch.float64, 0.1


def pushed(x: Tensor, u: Tensor) -> Tensor:
    """Rates of x = [p, v]; u is an acceleration."""
    return torch.cat((x[..., 2:], u), dim=-1)


DISC = FunctionDynamics(pushed, 4, 2, DT, "rk4", position=slice(0, 2))


def disc(starts: Any, ends: Any, *obstacles: Any, N: int = 50, model: Any = DISC, weight: float = 0.1) -> Problem:
    """Discs (B, 2) that go from start to end, m; `weight` of accelerations."""
    starts, ends = (torch.as_tensor(np.array(part), dtype=D).view(-1, 2) for part in (starts, ends))
    rest = torch.zeros(len(starts), 2, dtype=D)
    goal = torch.cat((ends, rest), dim=-1)
    cost = QuadraticCost([0.1, 0.1, 0.01, 0.01], [weight] * 2, [50.0, 50.0, 5.0, 5.0], goal.unsqueeze(1))
    parts = [*obstacles, ControlBounds(-2.0, 2.0), NormBounds(("x", [2, 3]), upper=2.5)]
    return Problem(model, cost, parts, torch.cat((starts, rest), dim=-1), N, Goal(ends, 0.3))


def ring(V: int, B: int = 1, radius: float = 2.0, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Starts and opposite ends (V, B, 2) on a circle, drawn."""
    angle = np.random.default_rng(seed).uniform(-0.1, 0.1, (V, B)) + 2 * math.pi * np.arange(V)[:, None] / V
    starts = radius * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    return starts, -starts


def swaps(V: int, B: int = 1, **more: Any) -> list[Problem]:
    """A problem per vehicle."""
    return [disc(*pair, **more) for pair in zip(*ring(V, B), strict=True)]
