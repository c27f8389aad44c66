"""MPPI over B problems x S samples (Algorithm 3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from torchgco.constraints.bounds import ControlBounds
from torchgco.draws import DrawKey, standard_normal
from torchgco.problem import Problem
from torchgco.rollout import open_loop
from torchgco.shapes import InputError, check_shape, tensor


@dataclass(frozen=True)
class MPPI:
    """Model predictive path integral: a weighted mean of sampled controls, rolled out.

        eps ~ N(0, Sigma),  v = saturate(u + eps)
        S   = J_var + rho_mp (collisions) + sum_k lambda u' Sigma^-1 eps,   w = softmax(-(S - min S)/lambda)

    One round with white noise is Algorithm 3. Beyond the paper, rounds can follow each other with smoother and
    shrinking noise, and with a temperature that follows the spread of the better samples.

    Args:
        samples: S per problem and round.
        covariance: diagonal of Sigma (m,), or one number for all controls; in squared units of u. None: a standard
            deviation of a quarter of the range that the control bounds leave, 1 where they leave it open.
        temperature: lambda, in units of cost.
        collision_penalty: rho_mp, per knot and obstacle touched.
        saturation: "bounds" clamps samples to the problem's control bounds; "symmetric" to [-upper, upper], wider
            than the bounds on purpose (planar study); None leaves them.
        rounds: how often; each draws around the mean of the one before.
        knots: noise is drawn at so many knots and linear between them; 0: white, at every stage. Smooth noise moves the
            vehicle where white noise averages out. Its likelihood term (u' Sigma^-1 eps) is left out.
        decay: factor of the noise's standard deviation from round to round.
        linger: horizons that a sample is charged for staying where it ends, at its last stage's cost. A plan that
            stops before an obstacle is cheap within the horizon; this makes it dear.
        elite: the temperature is raised to the gap between the best sample and the elite-th best; 0 leaves it.

    Raises:
        InputError: a field out of its range; on `improve`, a covariance that doesn't fit the controls.
    """

    samples: int = 100
    covariance: Any = 1.0
    temperature: float = 1.0
    collision_penalty: float = 1e8
    saturation: Literal["bounds", "symmetric"] | None = "bounds"
    rounds: int = 1
    knots: int = 0
    decay: float = 1.0
    linger: float = 0.0
    elite: int = 0

    def __post_init__(self) -> None:
        for name, least in (("samples", 1), ("rounds", 1), ("knots", 0), ("elite", 0)):
            if getattr(self, name) < least:
                raise InputError(f"mppi.{name}", f"at least {least}", getattr(self, name))
        if self.elite > self.samples:
            raise InputError("mppi.elite", f"at most the {self.samples} samples", self.elite)
        if self.knots == 1:
            raise InputError("mppi.knots", "0, or at least 2", self.knots)
        if not 0 < self.decay <= 1:
            raise InputError("mppi.decay", "above 0, at most 1", self.decay)
        if not self.temperature > 0:
            raise InputError("mppi.temperature", "above 0", self.temperature)
        if not self.linger >= 0:
            raise InputError("mppi.linger", "at least 0 horizons", self.linger)
        if not self.collision_penalty >= 0:
            raise InputError("mppi.collision_penalty", "at least 0", self.collision_penalty)
        if self.saturation not in ("bounds", "symmetric", None):
            raise InputError("mppi.saturation", "bounds, symmetric or null", repr(self.saturation))

    def improve(self, problem: Problem, U: Tensor, key: DrawKey, stream: int = 0) -> tuple[Tensor, Tensor]:
        """X (B, N+1, n) and U (B, N, m): the mean of the last round's samples, the first drawn around U."""
        sigma = self._sigma(problem).sqrt()
        for i in range(self.rounds):
            noise = self.decay**i * sigma * self._draw(problem, key, U.dtype, stream * self.rounds + i)
            V = self.saturate(problem, U.unsqueeze(1) + noise)
            weights = self._weights(self.sample_costs(problem, U, V, noise))
            U = torch.bmm(weights.unsqueeze(1), V.flatten(2)).view_as(U)
        return open_loop(problem.dynamics, problem.x0, U), U

    def _draw(self, problem: Problem, key: DrawKey, dtype: torch.dtype, stream: int) -> Tensor:
        """Unit noise (B, S, N, m): white, or linear between the knots."""
        if self.knots == 0:
            return standard_normal(key, (self.samples, problem.N, problem.m), dtype, stream)
        z = standard_normal(key, (self.samples, self.knots, problem.m), dtype, stream)
        place = torch.linspace(0, self.knots - 1, problem.N, dtype=dtype, device=z.device)
        left = place.floor().clamp(max=self.knots - 2)
        share = (place - left).unsqueeze(-1)
        left = left.long()
        return z[:, :, left] * (1 - share) + z[:, :, left + 1] * share

    def _weights(self, S: Tensor) -> Tensor:
        """w (B, S) from the samples' costs."""
        gap = S - S.amin(dim=1, keepdim=True)
        if self.elite == 0:
            return torch.softmax(-gap / self.temperature, dim=1)
        spread = gap.kthvalue(self.elite, dim=1, keepdim=True).values
        return torch.softmax(-gap / spread.clamp(min=self.temperature), dim=1)

    def sample_costs(self, problem: Problem, U: Tensor, V: Tensor, noise: Tensor) -> Tensor:
        """S (B, S) of controls V (B, S, N, m) drawn around U with `noise` (lines 5-11)."""
        likelihood = torch.zeros_like(V[:, :, 0, 0])
        if self.knots == 0:
            # u' Sigma^-1 eps as products and two sums, which keep an element's bits apart from the batch's.
            likelihood = (U.unsqueeze(1) / self._sigma(problem) * noise).sum(-1).sum(-1)
        x = problem.x0.unsqueeze(1).expand(-1, V.shape[1], -1).contiguous()
        cost, collisions = torch.zeros_like(likelihood), torch.zeros_like(likelihood)
        for k in range(problem.N):
            u = V[:, :, k]
            cost = cost + problem.cost.stage(x, u, k)
            x = problem.dynamics.step(x, u)
            for constraint in problem.geometric:
                if constraint.holds_at(k + 1):
                    collisions = collisions + (constraint.at(x, k + 1) >= 0).sum(-1)
        cost = cost + problem.cost.terminal(x)
        if self.linger > 0:
            cost = cost + self.linger * problem.N * problem.cost.stage(x, V[:, :, -1], problem.N - 1)
        S = cost + self.temperature * likelihood + self.collision_penalty * collisions
        # A sample that left the finite numbers must not take the others with it.
        return torch.where(torch.isfinite(S), S, torch.finfo(S.dtype).max)

    def saturate(self, problem: Problem, V: Tensor) -> Tensor:
        """Samples (B, S, N, m) clamped as `saturation` says (line 7)."""
        if self.saturation is None:
            return V
        for constraint in problem.constraints:
            if isinstance(constraint, ControlBounds):
                upper = constraint.upper[:, None, None, :]
                lower = constraint.lower[:, None, None, :] if self.saturation == "bounds" else -upper
                V = V.clamp(lower, upper)
        return V

    def _sigma(self, problem: Problem) -> Tensor:
        """Diagonal of Sigma, (m,), or (B, 1, 1, m) where it comes from bounds per problem."""
        if self.covariance is None:
            return _from_bounds(problem)
        sigma = tensor(self.covariance, "mppi.covariance", problem.x0)
        sigma = sigma.expand(problem.m) if sigma.dim() == 0 else sigma
        check_shape(sigma, (problem.m,), "mppi.covariance")
        if not bool((sigma > 0).all()):
            raise InputError("mppi.covariance", "variances above 0", sigma.tolist())
        return sigma


def _from_bounds(problem: Problem) -> Tensor:
    for constraint in problem.constraints:
        if isinstance(constraint, ControlBounds):
            spread = 0.25 * (constraint.upper - constraint.lower)
            return torch.where(spread < 1e10, spread.square(), 1.0)[:, None, None, :]
    return problem.x0.new_ones(problem.m)
