"""MPPI over B problems x S samples (Algorithm 3): samples of all problems side by side, stage by stage.

Costs and collisions are kept apart, so that single precision loses neither.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import torch
from torch import Tensor

from torchgco.base.draws import DrawKey, standard_normal, words
from torchgco.base.errors import InputError
from torchgco.base.options import Above, AtMost, Count, Natural, NonNegative, Positive, check_options
from torchgco.base.shapes import check_shape, tensor
from torchgco.native.dispatch import open_loop, sampler_of
from torchgco.native.structures import Sampling, array
from torchgco.problem.problem import Problem

CHUNK = 8192  # samples rolled out together: memory stays bounded
COLLISION_PENALTY = 1e8  # rho_mp, per knot and obstacle touched


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


@dataclass(frozen=True)
class MPPI:
    """Model predictive path integral: a weighted mean of sampled controls, rolled out.

        eps ~ N(0, Sigma),  v = saturate(u + eps)
        S   = J_var + rho_mp (collisions) + sum_k lambda u' Sigma^-1 eps,   w = softmax(-(S - min S)/lambda)

    One round with white noise is Algorithm 3. Beyond the paper, rounds can follow each other with smoother and
    shrinking noise, and with a temperature that follows the cost spread of the best samples.

    Args:
        samples: S per problem and round.
        covariance: diagonal of Sigma (m,), or one number for all controls; in squared units of u. None: from `spread`.
        spread: standard deviation as a share of the range between the control bounds, and 1 where there are none; used
            if `covariance` is None.
        temperature: lambda, in the units of the problem's cost.
        saturation: "bounds" clamps samples to the problem's control bounds; "symmetric" to [-upper, upper], wider
            than the bounds on purpose (planar study); None leaves them.
        rounds: number of rounds; each draws around the mean of the round before.
        noise_knots: knots of the noise, which is linear between them; 0: white noise, drawn at every stage. Smooth
            noise moves the vehicle where white noise averages out. Its likelihood term (u' Sigma^-1 eps) is left out.
        decay: factor of the noise's standard deviation from round to round.
        dwell_cost: number of further horizons for which a sample pays the cost of its last stage. A trajectory that
            stops in front of an obstacle is cheap within the horizon; this makes it expensive.
        dtype: "float32" to sample in single precision, twice as fast; None: in the problem's own.
        elite: the temperature is raised to the gap between the best sample and the elite-th best; 0 leaves it.

    Raises:
        InputError: a field out of its range; on `check` and `improve`, a covariance that doesn't fit the controls.
    """

    samples: Count = 100
    covariance: Any = 1.0
    spread: Positive = 0.25
    temperature: Positive = 1.0
    saturation: Literal["bounds", "symmetric"] | None = "bounds"
    rounds: Count = 1
    noise_knots: Natural = 0
    decay: Annotated[float, Above(0), AtMost(1)] = 1.0
    dwell_cost: NonNegative = 0.0
    elite: Natural = 0
    dtype: Literal["float32", "float64"] | None = None

    def __post_init__(self) -> None:
        check_options(self, "mppi")
        if self.elite > self.samples:
            raise InputError("mppi.elite", f"at most the {self.samples} samples", self.elite)
        if self.noise_knots == 1:
            raise InputError("mppi.noise_knots", "0, or at least 2", self.noise_knots)

    def check(self, problem: Problem) -> None:
        """Raise InputError where the covariance doesn't fit the controls."""
        self._sigma(problem)

    def improve(self, problem: Problem, U: Tensor, key: DrawKey) -> tuple[Tensor, Tensor]:
        """The weighted mean of the last round's samples, X (B, N+1, n) and U (B, N, m); round 1 draws around U."""
        dtype = U.dtype if self.dtype is None else getattr(torch, self.dtype)
        sampler = sampler_of(problem, dtype)
        if sampler is not None:
            plan = sampler.improve(problem, U, self._native(problem, key))
        else:
            plan = self._in_chunks(problem, U, key, dtype)
        return open_loop(problem, plan), plan

    def first_samples(self, problem: Problem, U: Tensor, key: DrawKey, count: int) -> Tensor:
        """Controls (count, B, N, m) of the first samples of round 1, as `improve` draws them in PyTorch."""
        noise = self._noise(problem, key, self._sigma(problem).sqrt(), 0, range(count))
        return draw(U.transpose(0, 1).unsqueeze(2), noise, self._bounds(problem)).permute(2, 1, 0, 3).contiguous()

    def _native(self, problem: Problem, key: DrawKey) -> Sampling:
        """The rounds as the native library takes them."""
        bounds = self._bounds(problem)
        if bounds is None:
            wide = problem.x0.new_full((1, 1, 1, problem.m), torch.inf)
            bounds = -wide, wide
        lower, upper = (array(bound.squeeze(2).transpose(0, 1), knots=True) for bound in bounds)
        deviation = array(self._sigma(problem).sqrt(), knots=True)
        sampling = Sampling(
            samples=self.samples, rounds=self.rounds, knots=self.noise_knots, decay=self.decay, elite=self.elite,
            temperature=self.temperature, collision_penalty=COLLISION_PENALTY, dwell_cost=self.dwell_cost,
            keys=torch.stack([words(key, i) for i in range(self.rounds)], dim=-1), deviation=deviation,
            lower=lower, upper=upper,
        )  # fmt: skip
        left, share = self._places(problem)
        if left is not None and share is not None:
            sampling.left, sampling.share = left.to(torch.int32), share.double()
        return sampling

    def _in_chunks(self, problem: Problem, U: Tensor, key: DrawKey, dtype: torch.dtype) -> Tensor:
        """All rounds by PyTorch, some problems at a time."""
        sigma, quick, plans = self._sigma(problem), problem.cast(dtype), []
        at_once = max(1, CHUNK // self.samples)
        for rows in torch.arange(problem.B, device=U.device).split(at_once):
            spread = sigma if sigma.shape[0] == 1 else sigma[rows]
            part = quick if rows.numel() == problem.B else quick.take(rows)
            plans.append(self._rounds(part, U[rows].to(dtype), spread.to(dtype), key.take(rows)))
        return torch.cat(plans).to(U.dtype)

    def _rounds(self, problem: Problem, U: Tensor, sigma: Tensor, key: DrawKey) -> Tensor:
        """All rounds for one chunk of problems; U (B, N, m), sigma (B|1, 1, m)."""
        mean, bounds = U.transpose(0, 1).unsqueeze(2).contiguous(), self._bounds(problem)  # (N, B, 1, m)
        blocks = [range(s, min(s + CHUNK, self.samples)) for s in range(0, self.samples, CHUNK)]
        for i in range(self.rounds):
            scale = self.decay**i * sigma.sqrt()
            draws = partial(self._noise, problem, key, scale, i)
            scores = [self.scores(problem, fly(problem, mean, draws(block), bounds)) for block in blocks]
            weights = self._weights(torch.cat(scores, dim=-1)).to(U.dtype)
            new = torch.zeros_like(mean)
            for block in blocks:  # drawn again rather than kept: bounds the memory for any S
                new = new + average(draw(mean, draws(block), bounds), weights[:, block.start : block.stop])
            mean = new
        return mean.squeeze(2).transpose(0, 1)

    def _noise(self, problem: Problem, key: DrawKey, scale: Tensor, stream: int, samples: range) -> Noise:
        rows = self.noise_knots or problem.N
        z = standard_normal(key, rows * problem.m, samples, scale.dtype, stream).unflatten(0, (rows, problem.m))
        return Noise(z.movedim(1, -1).contiguous(), scale, *self._places(problem))

    def _places(self, problem: Problem) -> tuple[Tensor | None, Tensor | None]:
        """The knot of the noise before each stage (N,), and the share of the interval to the next; None: white."""
        if self.noise_knots == 0:
            return None, None
        place = torch.linspace(0, self.noise_knots - 1, problem.N, dtype=problem.x0.dtype, device=problem.x0.device)
        left = place.floor().clamp(max=self.noise_knots - 2)
        return left.long(), place - left

    def _weights(self, S: Tensor) -> Tensor:
        """w (B, S) from the samples' costs."""
        gap = S - S.amin(dim=1, keepdim=True)
        if self.elite == 0:
            return torch.softmax(-gap / self.temperature, dim=1)
        spread = gap.kthvalue(self.elite, dim=1, keepdim=True).values
        return torch.softmax(-gap / spread.clamp(min=self.temperature), dim=1)

    def scores(self, problem: Problem, flight: Flight) -> Tensor:
        """S (B, S) in float64 of a block of samples."""
        cost = flight.cost + problem.cost.terminal(flight.x)
        if self.dwell_cost > 0:
            cost = cost + self.dwell_cost * problem.N * problem.cost.stage(flight.x, flight.V[-1], problem.N - 1)
        cost = cost + self.temperature * flight.likelihood
        S = cost.double() + COLLISION_PENALTY * flight.hits.double()
        # A sample that isn't finite must not spoil the others.
        return torch.where(torch.isfinite(S), S, torch.finfo(S.dtype).max)

    def _bounds(self, problem: Problem) -> tuple[Tensor, Tensor] | None:
        """Limits of the samples as `saturation` says (Algorithm 3, line 7): two tensors (N|1, B|1, 1, m)."""
        bounds = problem.control_bounds
        if self.saturation is None or bounds is None:
            return None
        lower, upper = (bound.transpose(0, 1).unsqueeze(2) for bound in bounds.over(problem.N))
        return (lower if self.saturation == "bounds" else -upper), upper

    def _sigma(self, problem: Problem) -> Tensor:
        """Diagonal of Sigma, (B|1, 1, m)."""
        if self.covariance is None:
            return self._from_bounds(problem)
        sigma = tensor(self.covariance, "mppi.covariance", problem.x0)
        sigma = sigma.expand(problem.m) if sigma.dim() == 0 else sigma
        check_shape(sigma, (problem.m,), "mppi.covariance")
        if not bool(((sigma > 0) & torch.isfinite(sigma)).all()):
            raise InputError("mppi.covariance", "finite variances above 0", sigma.tolist())
        return sigma.view(1, 1, -1)

    def _from_bounds(self, problem: Problem) -> Tensor:
        if problem.control_bounds is None:
            return problem.x0.new_ones(1, 1, problem.m)
        deviation = self.spread * problem.control_bounds.range
        return torch.where(torch.isfinite(deviation), deviation.square(), 1.0).unsqueeze(1)


def draw(mean: Tensor, noise: Noise, bounds: tuple[Tensor, Tensor] | None) -> Tensor:
    """Controls V (N, B, S, m) around mean (N, B, 1, m), clamped to bounds (N|1, B|1, 1, m)."""
    V = mean + noise.eps
    return V if bounds is None else torch.clamp(V, *bounds)


def fly(problem: Problem, mean: Tensor, noise: Noise, bounds: tuple[Tensor, Tensor] | None) -> Flight:
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
    return Flight(V, x, cost, hits, likelihood)


def average(V: Tensor, weights: Tensor) -> Tensor:
    """sum_s w_s v_s (N, B, 1, m) of controls V (N, B, S, m) with weights (B, S)."""
    return weights.unsqueeze(1) @ V
