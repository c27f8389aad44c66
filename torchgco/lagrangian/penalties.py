"""Penalties that guidance adds to the Lagrangian: balls that attract knots, or a path that knots are tied to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import torch
from torch import Tensor


@dataclass(frozen=True)
class GuideRegion:
    """Balls that knots are drawn into: a pure penalty on f_k = |p_k - center_k|^2 - radius_k^2 (Equations 62-65).

    A knot without guidance has an infinite radius (the paper's r_F, larger than the whole scene).
    """

    center: Tensor  # (B, N+1, d), m
    radius: Tensor  # (B, N+1), m
    weight: Tensor  # (B,): mu_gco
    position: slice

    @classmethod
    def inactive(cls, X: Tensor, weight: Tensor, position: slice) -> GuideRegion:
        """No guidance along X (B, N+1, n)."""
        center = X[..., position].clone()
        return cls(center, torch.full_like(center[..., 0], torch.inf), weight, position)

    @property
    def is_active(self) -> Tensor:
        """Whether any knot is guided, (B,) bool."""
        return torch.isfinite(self.radius).any(-1)

    def value(self, X: Tensor) -> Tensor:
        """J_gco (B,) = sum_k 1/2 mu_gco f_k^2 over the knots outside their ball."""
        f = self._excess(X).clamp(min=0.0)
        return 0.5 * self.weight * f.square().sum(-1)

    def accumulate(self, X: Tensor, H: Tensor) -> None:
        """Add gradient and Gauss-Newton Hessian to H (B, N+1, s, s)."""
        n, position = X.shape[-1], self.position
        f = self._excess(X)
        rho = torch.where(f > 0, self.weight.unsqueeze(-1), 0.0).unsqueeze(-1)
        fx = 2.0 * (X[..., position] - self.center)
        gradient = rho * f.clamp(min=0.0).unsqueeze(-1) * fx
        H[..., position, n] += gradient
        H[..., n, position] += gradient
        H[..., position, position] += rho.unsqueeze(-1) * fx.unsqueeze(-1) * fx.unsqueeze(-2)

    def _excess(self, X: Tensor) -> Tensor:
        return (X[..., self.position] - self.center).square().sum(-1) - self.radius.square()


@dataclass(frozen=True)
class GuidePath:
    """A path that every knot is tied to by a spring, 1/2 weight |p_k - center_k|^2: exact in a quadratic model."""

    center: Tensor  # (B, N+1, d), m
    weight: Tensor  # (B,), cost per m^2
    position: slice

    @property
    def is_active(self) -> Tensor:
        """True for all, (B,) bool."""
        return torch.ones_like(self.weight, dtype=torch.bool)

    def value(self, X: Tensor) -> Tensor:
        """The springs' cost, (B,)."""
        return 0.5 * self.weight * (X[..., self.position] - self.center).square().sum(-1).sum(-1)

    def accumulate(self, X: Tensor, H: Tensor) -> None:
        """Add gradient and Hessian to H (B, N+1, s, s)."""
        n, position = X.shape[-1], self.position
        gradient = self.weight.view(-1, 1, 1) * (X[..., position] - self.center)
        H[..., position, n] += gradient
        H[..., n, position] += gradient
        H[..., position, position].diagonal(dim1=-2, dim2=-1).add_(self.weight.view(-1, 1, 1))


Penalty: TypeAlias = GuideRegion | GuidePath
