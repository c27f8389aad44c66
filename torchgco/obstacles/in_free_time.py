"""Moving spheres where the time is free: when the vehicle is at a knot is a matter of a state.

All stages last the same multiple tau of dt, so knot k is at k dt tau, and with tau given a sphere moves in each stage
by tau times what it moves in dt: it is `BoundSpheres` of other velocities.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.shapes import Dimensions
from torchgco.base.tree import passed_on
from torchgco.constraints.norms import NO_ROW
from torchgco.obstacles.base import Obstacles
from torchgco.obstacles.measured import Distances
from torchgco.obstacles.spheres import BoundSpheres


@dataclass(frozen=True)
class SpheresInFreeTime(Obstacles):
    """Spheres whose velocities are per second of a time that is free.

    Rows are those of `NormBounds`, (r^2 - |p - o - v t|^2) / (2 r), near the surface as large as the depth.
    """

    spheres: BoundSpheres
    factor: int  # which state tau is

    batched: ClassVar[tuple[str, ...]] = ("spheres",)

    absent, vehicle_radius, position = passed_on("spheres", "absent", "vehicle_radius", "position")
    dt, knots, margins, moving = passed_on("spheres", "dt", "knots", "margins", "moving")
    row_shape, start_is_clear = passed_on("spheres", "row_shape", "start_is_clear")
    signed_distance, segment_clearance = passed_on("spheres", "signed_distance", "segment_clearance")

    def bind(self, dims: Dimensions) -> Self:
        return self

    def at_factor(self, factor: Tensor) -> BoundSpheres:
        """The same for stages of factor (B,) times dt."""
        return self.spheres.paced(factor)

    def along(self, X: Tensor) -> BoundSpheres:
        """The same for the factor of the first states of X (B, N+1, n), which all others have where X obeys the
        dynamics."""
        return self.at_factor(X[:, 0, self.factor])

    @property
    def row_radii(self) -> Tensor:
        return -self._sizes[0].unsqueeze(1)

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return self._rows(X[:, self.knots], self.times(X))

    def at(self, x: Tensor, k: int) -> Tensor:
        return self._rows(x, x.new_full((1,), k * self.dt))

    def violation(self, X: Tensor, U: Tensor) -> Tensor:
        """Depth beneath the full surface, (B, K, M), m."""
        radius, there = (part.unsqueeze(1) for part in self._sizes)
        away = self._away(X[:, self.knots], self.times(X))
        return there * (radius - away.norm(dim=-1)).clamp(min=0.0)

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        radius, there = (part.unsqueeze(1) for part in self._sizes)
        away = self._away(X[:, self.knots], self.times(X))
        by_place = (there / radius).unsqueeze(-1) * away
        velocities = self.spheres.velocities
        assert velocities is not None
        by_factor = (by_place * velocities.unsqueeze(1)).sum(-1) * self.times(X).view(1, -1, 1)
        J = torch.cat((-by_place, by_factor.unsqueeze(-1)), dim=-1)
        own = torch.tensor([*range(X.shape[-1])[self.position], self.factor], device=X.device)
        add, one = H.new_zeros(*g.shape[:2], *H.shape[2:]), X.shape[-1]
        gradient = (g.unsqueeze(-2) @ J).squeeze(-2)
        add[..., own, one] = gradient
        add[..., one, own] = gradient
        add[..., own.unsqueeze(-1), own] = J.mT @ (h.unsqueeze(-1) * J)
        H[:, self.knots] += add

    def distances(self, X: Tensor) -> Tensor:
        return self.along(X).distances(X)

    def measured(self, X: Tensor) -> Distances:
        return self.along(X).measured(X)

    def chord_clearance(self, X: Tensor, share: float | None = None) -> Tensor:
        return self.along(X).chord_clearance(X, share)

    def with_step(self, dt: float) -> Self:
        return replace(self, spheres=self.spheres.with_step(dt))

    def grown(self, by: Tensor) -> Self:
        return replace(self, spheres=self.spheres.grown(by))

    def chosen(self, at: Tensor) -> Self:
        return replace(self, spheres=self.spheres.chosen(at))

    def _rows(self, x: Tensor, t: Tensor) -> Tensor:
        radius, there = (part.unsqueeze(1) for part in self._sizes)
        depth = (radius.square() - self._away(x, t).square().sum(-1)) / (2.0 * radius)
        return there * depth + (1.0 - there) * NO_ROW

    def _away(self, x: Tensor, t: Tensor) -> Tensor:
        """From the centres (B, K, M, d) to states x (B, K, n) at t (K,) or (1,), s, where tau is 1."""
        velocities, late = self.spheres.velocities, (t * x[..., self.factor])[..., None, None]
        assert velocities is not None
        return x[:, :, None, self.position] - self.spheres.centers.unsqueeze(1) - late * velocities.unsqueeze(1)

    @property
    def _sizes(self) -> tuple[Tensor, Tensor]:
        """Radii (B, M), m, 1 where there is no row, and 1 where there is one, else 0."""
        there = ~self.absent & (self.spheres.inflated_radii > 0)
        return torch.where(there, self.spheres.inflated_radii, 1.0), there.to(self.spheres.centers.dtype)
