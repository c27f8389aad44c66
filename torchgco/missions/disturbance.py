"""What disturbs a mission: wind with gusts, and noise of the measured state. Draws are keyed by seed and mission."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchgco.base.options import Checked, NonNegative, Seconds

NOISY = slice(0, 13)  # position, velocity, quaternion and body rates are measured with noise, thrusts without


@dataclass(frozen=True)
class Disturbance(Checked, named="disturbance"):
    """Wind and noise, drawn for each mission from (seed, mission).

    Args:
        wind: constant horizontal force, N, in a direction drawn for each mission.
        gust: standard deviation of a further force in each direction, N, that is correlated over `gust_time`, s.
        position_noise, velocity_noise, attitude_noise, rate_noise: standard deviations of the measured state, m, m/s,
            components of the quaternion, rad/s.

    Raises:
        InputError: a field out of its range.
    """

    wind: NonNegative = 0.0
    gust: NonNegative = 0.0
    gust_time: Seconds = 1.0
    position_noise: NonNegative = 0.0
    velocity_noise: NonNegative = 0.0
    attitude_noise: NonNegative = 0.0
    rate_noise: NonNegative = 0.0

    def draw(self, seed: int, ids: Sequence[int], steps: int, period: float) -> tuple[Tensor, Tensor]:
        """Forces (B, steps, 3), N, and noise (B, steps, 13) of every control step."""
        drawn = [self._draw_one(np.random.SeedSequence(seed, spawn_key=(i, 1)), steps, period) for i in ids]
        force, noise = (torch.from_numpy(np.stack(draws)) for draws in zip(*drawn, strict=True))
        return force, noise

    def _draw_one(self, key: np.random.SeedSequence, steps: int, period: float) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.Generator(np.random.Philox(key))
        angle = rng.uniform(0.0, 2.0 * math.pi)
        force = np.tile(self.wind * np.array([math.cos(angle), math.sin(angle), 0.0]), (steps, 1))
        white, keep = rng.normal(size=(steps, 3)), math.exp(-period / self.gust_time)
        gust = np.zeros(3)
        for k in range(steps):
            gust = keep * gust + math.sqrt(1.0 - keep * keep) * white[k]
            force[k] += self.gust * gust
        sizes = np.repeat(
            [self.position_noise, self.velocity_noise, self.attitude_noise, self.rate_noise], [3, 3, 4, 3]
        )
        return force, sizes * rng.normal(size=(steps, 13))


def measured(x: Tensor, noise: Tensor) -> Tensor:
    """States (B, 17) as they are measured: with noise (B, 13), and a quaternion of length 1."""
    seen = x.clone()
    seen[:, NOISY] += noise
    seen[:, 6:10] /= seen[:, 6:10].square().sum(-1, keepdim=True).sqrt()
    return seen
