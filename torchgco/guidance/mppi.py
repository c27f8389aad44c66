"""MPPI over B problems x S samples (Algorithm 3): its options, and what it makes of controls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch
from torch import Tensor

from torchgco.base.draws import DrawKey
from torchgco.base.errors import InputError
from torchgco.base.options import Above, AtMost, Count, Natural, NonNegative, Positive, check_options
from torchgco.base.shapes import check_shape, tensor
from torchgco.eager.sampling import Sampling, draw
from torchgco.kernels import kernels_of, open_loop
from torchgco.problem.problem import Problem

COLLISION_PENALTY = 1e8  # rho_mp, per knot and obstacle touched


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
        if self.covariance is not None:
            self._sigma(problem)

    def improve(self, problem: Problem, U: Tensor, key: DrawKey) -> tuple[Tensor, Tensor]:
        """The weighted mean of the last round's samples, X (B, N+1, n) and U (B, N, m); round 1 draws around U."""
        plan = self.improved(problem, U, key)
        return open_loop(problem, plan), plan

    def improved(self, problem: Problem, U: Tensor, key: DrawKey) -> Tensor:
        """The same controls alone, (B, N, m)."""
        return kernels_of(problem).sample(problem, U, self.sampling(problem, key))

    def first_samples(self, problem: Problem, U: Tensor, key: DrawKey, count: int) -> Tensor:
        """Controls (count, B, N, m) of the first samples of round 1, as `improve` draws them in PyTorch."""
        how = self.sampling(problem, key)
        noise = how.noise(problem, key, how.sigma.sqrt(), 0, range(count))
        return draw(U.transpose(0, 1).unsqueeze(2), noise, how.bounds).permute(2, 1, 0, 3).contiguous()

    def sampling(self, problem: Problem, key: DrawKey) -> Sampling:
        """The options for these problems, as kernels read them."""
        left, share = self._places(problem)
        return Sampling(
            self.samples, self.rounds, self.decay, self.elite, self.temperature, COLLISION_PENALTY, self.dwell_cost,
            problem.x0.dtype if self.dtype is None else getattr(torch, self.dtype), key, self._sigma(problem),
            self._bounds(problem), self.noise_knots, left, share,
        )  # fmt: skip

    def _places(self, problem: Problem) -> tuple[Tensor | None, Tensor | None]:
        """The knot of the noise before each stage (N,), and the share of the interval to the next; None: white."""
        if self.noise_knots == 0:
            return None, None
        knot = torch.linspace(0, self.noise_knots - 1, problem.N, dtype=problem.x0.dtype, device=problem.x0.device)
        left = knot.floor().clamp(max=self.noise_knots - 2)
        return left.long(), knot - left

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
        return diagonal(self.covariance, problem, "mppi.covariance").view(1, 1, -1)

    def _from_bounds(self, problem: Problem) -> Tensor:
        if problem.control_bounds is None:
            return problem.x0.new_ones(1, 1, problem.m)
        deviation = self.spread * problem.control_bounds.range
        return torch.where(torch.isfinite(deviation), deviation.square(), 1.0).unsqueeze(1)


def diagonal(covariance: Any, problem: Problem, name: str) -> Tensor:
    """The variance of each control, (m,), of a diagonal covariance or one number; InputError where it isn't one."""
    sigma = tensor(covariance, name, problem.x0)
    sigma = sigma.expand(problem.m) if sigma.dim() == 0 else sigma
    check_shape(sigma, (problem.m,), name)
    if not bool(((sigma > 0) & torch.isfinite(sigma)).all()):
        raise InputError(name, "finite variances above 0", sigma.tolist())
    return sigma
