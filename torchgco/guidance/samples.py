"""Sampled controls and their costs: the samples of all problems side by side, stage by stage.

Costs and collisions are kept apart, so that single precision loses neither.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.problem.problem import Problem


@dataclass(frozen=True)
class Noise:
    """scale times unit noise z: white, or linear between knots."""

    z: Tensor  # (N, B, S, m) white, (knots, B, S, m) else
    scale: Tensor  # (B|1, 1, m): standard deviations
    left: Tensor | None  # (N,) int64: the knot before each stage; None: white
    share: Tensor | None  # (N,): share of the interval to the next knot

    @property
    def eps(self) -> Tensor:
        """The noise of all stages, (N, B, S, m)."""
        if self.left is None or self.share is None:
            return self.scale * self.z
        return self.scale * torch.lerp(self.z[self.left], self.z[self.left + 1], self.share.view(-1, 1, 1, 1))


@dataclass(frozen=True)
class Flight:
    """Rolled-out samples."""

    V: Tensor  # (N, B, S, m) controls
    x: Tensor  # (B, S, n) final states
    cost: Tensor  # (B, S) of all stages, without the terminal cost
    hits: Tensor  # (B, S) obstacles touched, counted at every knot
    likelihood: Tensor  # (B, S): sum_k u' Sigma^-1 eps, zero for smooth noise


def draw(mean: Tensor, noise: Noise, bounds: tuple[Tensor, Tensor] | None) -> Tensor:
    """Controls V (N, B, S, m) around mean (N, B, 1, m), clamped to bounds (B|1, 1, m)."""
    V = mean + noise.eps
    return V if bounds is None else torch.clamp(V, *bounds)


def fly(problem: Problem, mean: Tensor, noise: Noise, bounds: tuple[Tensor, Tensor] | None) -> Flight:
    """The samples of `draw`, rolled out (Algorithm 3, lines 5-11)."""
    V = draw(mean, noise, bounds)
    x = problem.x0.unsqueeze(1).expand(-1, V.shape[2], -1)
    cost, hits = x.new_zeros(2, *x.shape[:2]).unbind(0)
    for k, u in enumerate(V.unbind(0)):
        cost = cost + problem.cost.stage(x, u, k)
        x = problem.dynamics.step(x, u).contiguous()  # so that sums over components add in one order for any batch
        for constraint in problem.geometric:
            if constraint.holds_at(k + 1):
                hits = hits + (constraint.at(x, k + 1) >= 0).sum(-1)
    likelihood = torch.zeros_like(cost)
    if noise.left is None:
        likelihood = sum((mean / noise.scale.square() * noise.eps).sum(-1).unbind(0), likelihood)
    return Flight(V, x, cost, hits, likelihood)


def average(V: Tensor, weights: Tensor) -> Tensor:
    """sum_s w_s v_s (N, B, 1, m) of controls V (N, B, S, m) with weights (B, S)."""
    return weights.unsqueeze(1) @ V
