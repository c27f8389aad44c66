"""Boxes that move along sums of sines: their centres swing along the axes of space, their sides keep their directions.

They are evaluated in PyTorch. No path is sought among them, as among spheres that move.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.shapes import Dimensions, check_finite, per_row
from torchgco.constraints.base import Constraint
from torchgco.obstacles.base import picked
from torchgco.obstacles.boxes import BoundBoxes, Boxes, MovingBoxes
from torchgco.obstacles.inputs import is_body
from torchgco.obstacles.measured import Distances, box_distances
from torchgco.obstacles.shapes import RoundedBoxes, array


@dataclass(frozen=True)
class OscillatingBoxes(Constraint):
    """Boxes as `Boxes`, whose centres at time t are centers + sum_s amplitudes sin(rates t + phases).

    Args:
        boxes: at the middle of their motion.
        amplitudes, rates, phases: (M, S, d), or (B, M, S, d) one set per problem: S sines along each axis, m, rad/s and
            rad. Those of absent boxes don't count; a box with amplitudes of 0 rests.

    Raises:
        InputError: on `Problem(...)`: as `Boxes`; other shapes, NaN or infinity, dynamics without a time step.
    """

    boxes: Boxes
    amplitudes: Any
    rates: Any
    phases: Any

    def bind(self, dims: Dimensions) -> Constraint:
        if is_body(self.boxes.vehicle_radius):
            return self.boxes.vehicle_radius.around(self, dims)
        boxes = self.boxes.bind(dims)
        assert isinstance(boxes, BoundBoxes)
        if dims.dt is None:
            raise InputError("boxes.amplitudes", "dynamics with a time step dt", "dynamics without one")
        _, M, d = boxes.centers.shape
        sines: list[Tensor] = []
        for name in ("amplitudes", "rates", "phases"):
            sine = per_row(getattr(self, name), f"boxes.{name}", dims, M, sines[0].shape[2] if sines else "S", d)
            sine = torch.where(boxes.absent[..., None, None], 0.0, sine)
            check_finite(sine, f"boxes.{name}", "finite numbers for every box that is there")
            sines.append(sine)
        if M == 0:
            return boxes  # none of them moves: what is asked of moving obstacles alone isn't asked of none
        amplitudes, rates, phases = sines
        return BoundOscillatingBoxes(boxes, amplitudes, rates, phases, boxes.knots, boxes.dt)


@dataclass(frozen=True)
class BoundOscillatingBoxes(MovingBoxes):
    """Oscillating boxes shaped for their problem."""

    boxes: BoundBoxes  # in the middle of their motion
    amplitudes: Tensor  # (B, M, S, d)
    rates: Tensor  # (B, M, S, d)
    phases: Tensor  # (B, M, S, d), at t = 0
    knots: Any
    dt: float

    batched: ClassVar[tuple[str, ...]] = ("boxes", "amplitudes", "rates", "phases")

    moving = property(lambda self: bool((self.amplitudes != 0).any()))  # type: ignore[assignment]

    def centers_at(self, t: Tensor) -> Tensor:
        angle = t.view(1, -1, 1, 1, 1) * self.rates.unsqueeze(1) + self.phases.unsqueeze(1)
        return self.boxes.centers.unsqueeze(1) + (self.amplitudes.unsqueeze(1) * angle.sin()).sum(-2)

    def measured(self, X: Tensor) -> Distances:
        t = self.dt * torch.arange(X.shape[1], dtype=X.dtype, device=X.device).view(1, -1, 1)
        away, strongest = [], []
        for i, p in enumerate(X[..., self.position].unbind(-1)):
            sines = (values[..., i].unbind(-1) for values in (self.amplitudes, self.rates, self.phases))
            middle, most = self.boxes.centers[..., i].unsqueeze(1), torch.zeros_like(self.boxes.centers[..., i])
            for amplitude, rate, phase in zip(*sines, strict=True):
                angle = rate.unsqueeze(1) * t + phase.unsqueeze(1)
                middle, most = middle + amplitude.unsqueeze(1) * angle.sin(), most + amplitude.abs() * rate**2
            away.append(p.unsqueeze(2) - middle)
            strongest.append(most)
        # Seen from a box, the way between two knots leaves its chord by dt^2 / 8 of the box's acceleration at most.
        bulge = self.dt**2 / 8.0 * torch.stack(strongest, dim=-1).norm(dim=-1)
        return box_distances(self.boxes, torch.stack(away, dim=-1), bulge)

    @property
    def bulge(self) -> Tensor:
        """How far a centre's path may leave its chord between two knots, (B, M), m: dt^2 / 8 of its acceleration."""
        most = (self.amplitudes.abs() * self.rates.square()).sum(-2).square().sum(-1).sqrt()
        return self.dt**2 / 8.0 * most

    def shapes(self, b: int) -> RoundedBoxes:
        sines = np.stack([array(values[b]) for values in (self.amplitudes, self.rates, self.phases)])
        return RoundedBoxes.of(self._solids, self.vehicle_radius, b, sines=sines)

    def later(self, t: float) -> Self:
        return replace(self, phases=self.phases + t * self.rates)

    def chosen(self, at: Tensor) -> Self:
        parts = {name: picked(getattr(self, name), at) for name in ("amplitudes", "rates", "phases")}
        return replace(self, boxes=self.boxes.chosen(at), **parts)
