"""Boxes whose centres move, while their sides keep their directions: what is the same along any motion."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Self

import torch
from torch import Tensor

from torchgco.base.errors import undefined
from torchgco.base.tree import passed_on
from torchgco.obstacles.base import ABSENT, OwnKind, least
from torchgco.obstacles.box_geometry import Cuboids, segment_distance
from torchgco.obstacles.boxes import BoundBoxes


class MovingBoxes(OwnKind):
    """A kind says where the centres are, `centers_at`, and by how much they leave their chords, `bulge`."""

    boxes: BoundBoxes  # with centres that may count from elsewhere
    knots: Any
    dt: float

    absent, vehicle_radius, position = passed_on("boxes", "absent", "vehicle_radius", "position")
    margins, sizes = passed_on("boxes", "margins", "sizes")

    @property
    def moving(self) -> bool:
        return True

    @property
    def bulge(self) -> Tensor | None:
        """By how much centres leave the straight lines between their places at two knots, (B, M), m; None: never."""
        return None

    def centers_at(self, t: Tensor) -> Tensor:
        """Centres (B, K, M, d), m, at times t (K,) or (B, K), s."""
        raise undefined(self, "centers_at")

    def rows(self, p: Tensor, t: Tensor) -> Tensor:
        c = -2.0 * self.boxes.depths.unsqueeze(1) * self._outside(p, t)
        return torch.where(self.absent.unsqueeze(1), ABSENT, c)

    def slopes(self, p: Tensor, t: Tensor) -> Tensor:
        return -2.0 * self.boxes.depths[:, None, :, None] * self._solids.normals_at(self._local(p, t))

    def signed_distance(self, p: Tensor, t: Tensor) -> Tensor:
        return torch.where(self.absent.unsqueeze(1), torch.inf, self._outside(p, t))

    def segment_clearance(self, a: Tensor, b: Tensor) -> Tensor:
        now = self.centers_at(a.new_zeros(1))[:, 0]
        return replace(self.boxes, centers=now).segment_clearance(a, b)

    def chord_clearance(self, X: Tensor, share: float | None = None) -> Tensor:
        k = torch.arange(X.shape[1], dtype=X.dtype, device=X.device)
        k = k if self.stops is None else torch.minimum(k, self.stops.unsqueeze(-1))
        local = torch.stack(self._local(X[..., self.position], k * self.dt), dim=-1)
        begin, along = local[:, :-1].unbind(-1), local.diff(dim=1).unbind(-1)
        gap = segment_distance(begin, along, self._solids.halves())
        gap = gap if self.bulge is None else gap - self.bulge.unsqueeze(1)
        gap = gap + (self.beneath(share) - self.boxes.inflated_radii).unsqueeze(1)
        return least(torch.where(self.absent.unsqueeze(1), torch.inf, gap))

    def solids_at(self, t: Tensor) -> Cuboids:
        return replace(self._solids, centers=self.centers_at(t)[0])

    def grown(self, by: Tensor) -> Self:
        return replace(self, boxes=self.boxes.grown(by))  # type: ignore[type-var]

    @property
    def _solids(self) -> Cuboids:
        return self.boxes.inflated()

    def _away(self, p: Tensor, t: Tensor) -> Tensor:
        """From where the centres are, (B, K, M, d), to points p (B, K, d)."""
        return p.unsqueeze(2) - self.centers_at(t)

    def _local(self, p: Tensor, t: Tensor) -> list[Tensor]:
        """The same along the sides, d tensors (B, K, M)."""
        return self._solids.local(self._away(p, t).unbind(-1))

    def _outside(self, p: Tensor, t: Tensor) -> Tensor:
        """Distances (B, K, M) from the full surfaces, as if none were absent."""
        return self._solids.distance_at(self._local(p, t))
