"""Sampled controls and what they cost: thousands of rollouts side by side, components first, stage by stage.

With the components apart, every operation runs over all samples at once on memory that lies together, and what a few
stages need stays in the cache. Costs and collisions are kept apart, so that single precision loses neither.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.problem import Problem
from torchgco.shapes import sum_rows

STAGES = 5  # drawn and flown together


@dataclass(frozen=True)
class Noise:
    """scale times unit noise z: white, or linear between knots."""

    z: Tensor  # (N, m, B, S) white, (knots, m, B, S) else
    scale: Tensor  # (m, B|1, 1): standard deviations
    left: Tensor | None  # (N,) int64: the knot before each stage; None: white
    share: Tensor | None  # (N, 1, 1, 1): how far on to the next

    def between(self, first: int, last: int) -> tuple[Tensor, Tensor | None, Tensor | None]:
        """z, left and share of the stages first..last-1."""
        if self.left is None or self.share is None:
            return self.z[first:last], None, None
        return self.z, self.left[first:last], self.share[first:last]


@dataclass(frozen=True)
class Flight:
    """What a block of samples did."""

    V: Tensor  # (N, m, B, S) controls
    x: Tensor  # (n, B, S) where they end
    cost: Tensor  # (B, S) of all stages
    hits: Tensor  # (B, S) obstacles touched, counted at every knot
    likelihood: Tensor  # (B, S): sum_k u' Sigma^-1 eps, zero for smooth noise


def fly(problem: Problem, mean: Tensor, noise: Noise, bounds: tuple[Tensor, Tensor] | None) -> Flight:
    """Samples drawn around mean (N, m, B, 1), clamped to bounds (m, B|1, 1), rolled out (Algorithm 3, lines 5-11)."""
    x = problem.x0.mT.unsqueeze(-1).expand(-1, -1, noise.z.shape[-1]).contiguous()
    sums, controls = torch.zeros(3, *x.shape[1:], dtype=x.dtype, device=x.device), []
    for k in range(0, problem.N, STAGES):
        stages = (problem, x, sums, mean[k : k + STAGES], noise.scale, bounds, *noise.between(k, k + STAGES))
        V, x, sums = _fly_stages(*stages, first=k)
        controls.append(V)
    return Flight(torch.cat(controls), x, *sums)


def draw(mean: Tensor, noise: Noise, bounds: tuple[Tensor, Tensor] | None) -> Tensor:
    """V (N, m, B, S) alone."""
    return torch.cat(
        [
            _draw_stages(mean[k : k + STAGES], noise.scale, bounds, *noise.between(k, k + STAGES))[0]
            for k in range(0, mean.shape[0], STAGES)
        ]
    )


def average(V: Tensor, weights: Tensor) -> Tensor:
    """sum_s w_s v_s (N, m, B, 1) of controls V (N, m, B, S) with weights (B, S)."""
    return (V * weights).sum(-1, keepdim=True)


def _draw_stages(
    mean: Tensor,
    scale: Tensor,
    bounds: tuple[Tensor, Tensor] | None,
    z: Tensor,
    left: Tensor | None,
    share: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Controls and noise (c, m, B, S) of c stages."""
    if left is not None and share is not None:
        z = torch.lerp(z[left], z[left + 1], share)
    eps = z * scale
    V = mean + eps
    return V if bounds is None else torch.clamp(V, *bounds), eps


def _fly_stages(
    problem: Problem,
    x: Tensor,
    sums: Tensor,
    mean: Tensor,
    scale: Tensor,
    bounds: tuple[Tensor, Tensor] | None,
    z: Tensor,
    left: Tensor | None,
    share: Tensor | None,
    first: int = 0,
) -> tuple[Tensor, Tensor, Tensor]:
    """Some stages of all samples, the first of them being stage `first`: controls, states and the three sums."""
    V, eps = _draw_stages(mean, scale, bounds, z, left, share)
    cost, hits, likelihood = sums.unbind(0)
    for j, u in enumerate(V.unbind(0)):
        k = first + j
        cost = cost + problem.cost.stage_rows(x, u, k)
        x = problem.dynamics.step(x.movedim(0, -1), u.movedim(0, -1)).movedim(-1, 0)
        for constraint in problem.geometric:
            if constraint.holds_at(k + 1):
                hits = hits + constraint.hits(x, k + 1)
        if left is None:
            likelihood = likelihood + sum_rows(mean[j] / scale.square() * eps[j])
    return V, x, torch.stack((cost, hits, likelihood))

