"""Half-spaces at every knot, which keep a trajectory in convex parts of free space."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.shapes import Dimensions, check_shape, check_tensor
from torchgco.constraints.base import Constraint
from torchgco.costs.base import add_at


@dataclass(frozen=True)
class HalfSpaces(Constraint):
    """b_i - n_i p_k <= 0 for R half-spaces of each knot k = 1..N.

    Args:
        normals: unit vectors (B, N, R, 3); zeros where a knot has fewer half-spaces.
        offsets: b, (B, N, R), m; any negative number where there is none.

    Raises:
        InputError: on `Problem(...)`: wrong shapes, dynamics without a position in space.
    """

    normals: Tensor
    offsets: Tensor
    knots: Any = None
    position: Any = None

    batched: ClassVar[tuple[str, ...]] = ("normals", "offsets")

    def bind(self, dims: Dimensions) -> Self:
        if dims.position is None or dims.position.stop - dims.position.start != 3:
            raise InputError("half_spaces.dynamics", "a position in space", "dynamics without one")
        check_shape(self.normals, (dims.B, dims.N, "R", 3), "half_spaces.normals")
        check_shape(self.offsets, tuple(self.normals.shape[:3]), "half_spaces.offsets")
        for values in (self.normals, self.offsets):
            check_tensor(values, "half_spaces", dims.like)
        return replace(self, knots=slice(1, dims.N + 1), position=dims.position)

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        p = X[:, self.knots, self.position]
        n = self.normals
        return self.offsets - sum(n[..., i] * p[..., i : i + 1] for i in range(3))  # type: ignore[operator]

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        n, gradient = self.normals, -(g.unsqueeze(-1) * self.normals).sum(-2)
        add_at(H, self.knots, self.position, X.shape[-1], gradient, (h.unsqueeze(-1) * n).mT @ n)


def stacked(planes: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """Normals and offsets of planes (B, N, R, 4), moved by `radius` (B, N, 1), m, into the free side."""
    normals, offsets = planes[..., :3].contiguous(), planes[..., 3]
    there = (normals != 0).any(-1)
    return normals, torch.where(there, offsets + radius, -1.0)
