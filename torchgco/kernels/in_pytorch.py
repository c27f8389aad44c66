"""Kernels in PyTorch: any device, any dtype, any code that PyTorch can differentiate."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchgco.constraints.separation import Separation
from torchgco.dynamics import rollout
from torchgco.eager import sampling
from torchgco.eager.kernels import EagerInterior
from torchgco.ilqr.descent import Descent
from torchgco.ilqr.riccati import BackwardPass, backward
from torchgco.ilqr.step import iterate
from torchgco.kernels.base import InteriorKernels
from torchgco.lagrangian.expansion import linearise
from torchgco.lagrangian.lagrangian import Lagrangian
from torchgco.lagrangian.quality import violation
from torchgco.lagrangian.state import InnerState, PassEnd, State
from torchgco.obstacles.base import Obstacles
from torchgco.problem.problem import Problem


class TorchKernels:
    """See `kernels.base.Kernels`."""

    name = "pytorch"
    compiled = False
    affine = False

    def open_loop(self, problem: Problem, U: Tensor) -> Tensor:
        return rollout.open_loop(problem.dynamics, problem.x0, U)

    def closed_loop(self, problem: Problem, X: Tensor, U: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
        G = torch.nn.functional.pad(K, (0, 1)).transpose(0, 1).contiguous()
        return rollout.closed_loop(problem.dynamics, X, U, G, torch.zeros_like(X[:, 0, 0]))

    def value(self, lagrangian: Lagrangian, X: Tensor, U: Tensor) -> tuple[Tensor, Tensor]:
        return lagrangian.value(X, U)

    def scale(self, problem: Problem) -> None:
        """Its property computes it when it is asked for."""

    def violation(self, problem: Problem, X: Tensor, U: Tensor, obstacles: bool = False) -> Tensor:
        return violation(problem.geometric if obstacles else problem.constraints, X, U)

    def chord_clearance(self, problem: Problem, X: Tensor, share: float) -> Tensor:
        return clearance_of([c.bare for c in problem.constraints], X, share)

    def slack(self, lagrangian: Lagrangian, X: Tensor, U: Tensor) -> Tensor:
        return lagrangian.slack(X, U)

    def optimality_pass(self, lagrangian: Lagrangian, X: Tensor, U: Tensor) -> Callable[[Tensor], BackwardPass]:
        F, H = linearise(lagrangian.problem, X, U), lagrangian.expand_optimality(X, U)
        return lambda mu: backward(F, H, mu)

    def descend(self, lagrangian: Lagrangian, s: InnerState, how: Descent, limit: int) -> PassEnd:
        return iterate(how, s, lagrangian)

    def kept_descent(self, problem: Problem, how: Descent, phr: bool) -> None:
        return None

    def outer_passes(self, problem: Problem, s: State, how: Descent, **limits: Any) -> None:
        return None

    def interior(self, problem: Problem) -> InteriorKernels:
        known = problem.known
        if known.interior is None:
            known.interior = EagerInterior.of(problem)
        return known.interior

    def sample(self, problem: Problem, U: Tensor, how: sampling.Sampling) -> Tensor:
        return sampling.sample(problem, U, how)

    def differing(self, problem: Problem, X: Tensor, U: Tensor) -> Tensor:
        return torch.zeros(0, dtype=torch.int64, device=X.device)


def clearance_of(parts: list[Any], X: Tensor, share: float, least: Tensor | None = None) -> Tensor:
    """Smallest distance (B,) from the lines between knots to those of the parts that keep a distance; or `least`."""
    least = X.new_full(X.shape[:1], torch.inf) if least is None else least
    for part in parts:
        if isinstance(part, Obstacles | Separation):
            least = torch.minimum(least, part.chord_clearance(X, share))
    return least
