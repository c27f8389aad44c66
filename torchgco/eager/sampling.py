"""MPPI's rounds in PyTorch (Algorithm 3): samples of all problems side by side, stage by stage.

Costs and collisions are kept apart, so that single precision loses neither.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from torchgco.base.draws import DrawKey, standard_normal
from torchgco.problem.problem import Problem

SAMPLES_AT_ONCE = 8192  # samples rolled out together on a CPU: memory stays bounded
SAMPLES_ON_GPU = 131072  # the same on a GPU, which a stage of fewer doesn't fill


@dataclass(frozen=True)
class Sampling:
    """How to sample around controls: the options of `guidance.MPPI`, which explains them, for given problems."""

    samples: int
    rounds: int
    decay: float
    elite: int
    temperature: float
    collision_penalty: float
    dwell_cost: float
    dtype: torch.dtype
    key: DrawKey
    sigma: Tensor  # (B|1, 1, m): variances
    bounds: tuple[Tensor, Tensor] | None  # (N|1, B|1, 1, m) each
    noise_knots: int
    left: Tensor | None  # (N,) int64: the knot of the noise before each stage; None: white
    share: Tensor | None  # (N,): share of the interval to the next knot

    def noise(self, problem: Problem, key: DrawKey, scale: Tensor, stream: int, samples: range) -> Noise:
        """The noise of some samples in a round, of standard deviation `scale` (B|1, 1, m)."""
        rows = self.noise_knots or problem.N
        z = standard_normal(key, rows * problem.m, samples, scale.dtype, stream).unflatten(0, (rows, problem.m))
        share = None if self.share is None else self.share.to(scale.dtype)
        return Noise(z.movedim(1, -1).contiguous(), scale, self.left, share)

    def weights(self, S: Tensor) -> Tensor:
        """w (B, S) from the samples' costs."""
        gap = S - S.amin(dim=1, keepdim=True)
        if self.elite == 0:
            return torch.softmax(-gap / self.temperature, dim=1)
        spread = gap.kthvalue(self.elite, dim=1, keepdim=True).values
        return torch.softmax(-gap / spread.clamp(min=self.temperature), dim=1)

    def scores(self, problem: Problem, flight: Rollouts) -> Tensor:
        """S (B, S) in float64 of a block of samples."""
        cost = flight.cost + problem.cost.terminal(flight.x)
        if self.dwell_cost > 0:
            cost = cost + self.dwell_cost * problem.N * problem.cost.stage(flight.x, flight.V[-1], problem.N - 1)
        cost = cost + self.temperature * flight.likelihood
        S = cost.double() + self.collision_penalty * flight.hits.double()
        # A sample that isn't finite must not spoil the others.
        return torch.where(torch.isfinite(S), S, torch.finfo(S.dtype).max)


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
class Rollouts:
    """Rolled-out samples."""

    V: Tensor  # (N, B, S, m) controls
    x: Tensor  # (B, S, n) final states
    cost: Tensor  # (B, S) of all stages, without the terminal cost
    hits: Tensor  # (B, S) obstacles touched, counted at every knot
    likelihood: Tensor  # (B, S): sum_k u' Sigma^-1 eps, zero for smooth noise


def sample(problem: Problem, U: Tensor, how: Sampling) -> Tensor:
    """Controls (B, N, m): the weighted mean of the last round's samples, the first drawn around U."""
    quick, plans = problem.cast(how.dtype), []
    for rows in torch.arange(problem.B, device=U.device).split(max(1, _at_once(U) // how.samples)):
        spread = how.sigma if how.sigma.shape[0] == 1 else how.sigma[rows]
        part = quick if rows.numel() == problem.B else quick.take(rows)
        plans.append(_rounds(part, U[rows].to(how.dtype), spread.to(how.dtype), rows, how))
    return torch.cat(plans).to(U.dtype)


def _rounds(problem: Problem, U: Tensor, sigma: Tensor, rows: Tensor, how: Sampling) -> Tensor:
    """All rounds for the problems at `rows` of the batch; U (B, N, m), sigma (B|1, 1, m)."""
    mean, key = U.transpose(0, 1).unsqueeze(2).contiguous(), how.key.take(rows)  # (N, B, 1, m)
    bounds = None if how.bounds is None else _of_rows(how.bounds, rows, how.dtype)
    size = _at_once(U)
    blocks = [range(s, min(s + size, how.samples)) for s in range(0, how.samples, size)]
    for i in range(how.rounds):
        draws = partial(how.noise, problem, key, how.decay**i * sigma.sqrt(), i)
        scores = [how.scores(problem, fly(problem, mean, draws(block), bounds)) for block in blocks]
        weights = how.weights(torch.cat(scores, dim=-1)).to(U.dtype)
        new = torch.zeros_like(mean)
        for block in blocks:  # drawn again rather than kept: bounds the memory for any S
            new = new + average(draw(mean, draws(block), bounds), weights[:, block.start : block.stop])
        mean = new
    return mean.squeeze(2).transpose(0, 1)


def _at_once(U: Tensor) -> int:
    """Samples that are rolled out together around controls U."""
    return SAMPLES_AT_ONCE if U.device.type == "cpu" else SAMPLES_ON_GPU


def _of_rows(bounds: tuple[Tensor, Tensor], rows: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Bounds (N|1, B|1, 1, m) of the problems at `rows`."""
    lower, upper = ((side if side.shape[1] == 1 else side[:, rows]).to(dtype) for side in bounds)
    return lower, upper


def draw(mean: Tensor, noise: Noise, bounds: tuple[Tensor, Tensor] | None) -> Tensor:
    """Controls V (N, B, S, m) around mean (N, B, 1, m), clamped to bounds (N|1, B|1, 1, m)."""
    V = mean + noise.eps
    return V if bounds is None else torch.clamp(V, *bounds)


def fly(problem: Problem, mean: Tensor, noise: Noise, bounds: tuple[Tensor, Tensor] | None) -> Rollouts:
    """The samples of `draw`, rolled out (Algorithm 3, lines 5-11)."""
    V = draw(mean, noise, bounds)
    x = problem.x0.unsqueeze(1).expand(-1, V.shape[2], -1)
    cost, hits = x.new_zeros(2, *x.shape[:2]).unbind(0)
    for k, u in enumerate(V.unbind(0)):
        cost = cost + problem.cost.stage(x, u, k)
        x = problem.dynamics.at(k).step(x, u).contiguous()  # so that sums over components add in the same order
        for constraint in problem.geometric:
            if constraint.holds_at(k + 1):
                hits = hits + (constraint.at(x, k + 1) >= 0).sum(-1)
    likelihood = torch.zeros_like(cost)
    if noise.left is None:
        likelihood = sum((mean / noise.scale.square() * noise.eps).sum(-1).unbind(0), likelihood)
    return Rollouts(V, x, cost, hits, likelihood)


def average(V: Tensor, weights: Tensor) -> Tensor:
    """sum_s w_s v_s (N, B, 1, m) of controls V (N, B, S, m) with weights (B, S)."""
    return weights.unsqueeze(1) @ V
