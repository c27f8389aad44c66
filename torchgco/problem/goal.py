"""The goal of a problem, its position and radius, for solver, search and judge alike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.shapes import Dimensions, check_shape, space_of, tensor
from torchgco.base.tree import PerElement

RADIUS_SHARE = 0.09  # radius of a goal that is derived from a cost, as a share of the distance from start to goal


@dataclass(frozen=True)
class Goal(PerElement):
    """A ball in which the last knot should lie.

    Args:
        position: its centre (d,), or (B, d) one per problem, m.
        radius: number or (B,), m, above 0.

    Raises:
        InputError: on `Problem(...)`: wrong shapes, values that aren't finite, a radius that isn't above 0, dynamics
            without a position.
    """

    position: Any
    radius: Any
    assumed: bool = False  # derived from the cost: the radius is a rule of thumb

    batched: ClassVar[tuple[str, ...]] = ("position", "radius")

    def bind(self, dims: Dimensions) -> Goal:
        """The goal with one row per problem; called once, by Problem."""
        d = space_of(dims, "goal")
        position = tensor(self.position, "goal.position", dims.like)
        position = position.expand(dims.B, -1) if position.dim() == 1 else position
        check_shape(position, (dims.B, d), "goal.position")
        radius = tensor(self.radius, "goal.radius", dims.like)
        radius = radius.expand(dims.B) if radius.dim() == 0 else radius
        check_shape(radius, (dims.B,), "goal.radius")
        if not bool(torch.isfinite(position).all()):
            raise InputError("goal.position", "finite numbers", "NaN or infinity")
        if not bool((radius > 0).all() & torch.isfinite(radius).all()):
            raise InputError("goal.radius", "finite numbers above 0 m", float(radius.min()))
        return Goal(position.contiguous(), radius.contiguous())

    @classmethod
    def derived(cls, state: Tensor | None, dims: Dimensions) -> Goal | None:
        """The goal at the state (B, n) that a cost asks for; None without such a state or without a position."""
        if state is None or dims.position is None:
            return None
        check_shape(state, (dims.B, dims.n), "cost.goal")
        apart = (dims.like - state)[:, dims.position].square().sum(-1).sqrt()
        return cls(state[:, dims.position], RADIUS_SHARE * apart, assumed=True)

    def distance(self, p: Tensor) -> Tensor:
        """Distances (B, ...) of points p (B, ..., d) from the centre, m."""
        center = self.position.view(-1, *([1] * (p.dim() - 2)), p.shape[-1])
        return (p - center).square().sum(-1).sqrt()
