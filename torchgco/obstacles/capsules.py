"""Capsules as static obstacles: segments with a radius, such as trunks, posts and cables, in the plane and in space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.shapes import Dimensions, check_shape
from torchgco.constraints.base import Constraint
from torchgco.obstacles.box_geometry import from_quaternions
from torchgco.obstacles.boxes import BoundBoxes
from torchgco.obstacles.inputs import check_absent, dimension, is_body, own_radii, points


@dataclass(frozen=True)
class Capsules(Constraint):
    """2 s (s - distance of p_k from segment i) <= 0 for every capsule i, with s = r + r_veh.

    The vehicle keeps s away from the segments, and bodies touch at CONTACT_FACTOR s, as for spheres. Bound, a capsule
    is a rounded box (`Boxes`) with a single side.

    Args:
        starts, ends: of the segments, (M, d), or (B, M, d) one set per problem, m. Rows of NaN are absent capsules
            (padding); M may be 0, and empty lists stand for (0, d). Equal points make a sphere.
        radii: one number, (M,) or (B, M), m, above 0; NaN where the start is.
        vehicle_radius: number or (B,), m; or a `Body`.
        knots: default 1..N.

    Raises:
        InputError: on `Problem(...)`: wrong shapes, points that are neither finite nor NaN throughout, radii that
            aren't above 0, negative vehicle radius, dynamics without a position in 2-D or 3-D.
    """

    starts: Any
    ends: Any
    radii: Any
    vehicle_radius: Any = 0.0
    knots: Any = None

    def bind(self, dims: Dimensions) -> Constraint:
        if is_body(self.vehicle_radius):
            return self.vehicle_radius.around(self, dims)
        d = dimension(dims, "capsules.starts")
        starts, absent = points(self.starts, "capsules.starts", d, dims)
        ends, gone = points(self.ends, "capsules.ends", d, dims)
        check_shape(ends, tuple(starts.shape), "capsules.ends")
        check_absent(gone, absent, "capsules.ends", "the start is NaN")
        radii = own_radii(self.radii, "capsules.radii", absent, dims)
        if bool((radii[~absent] == 0).any()):
            raise InputError("capsules.radii", "radii above 0 m", 0.0)
        half, axes = _single_side(ends - starts, absent)
        return BoundBoxes.prepare(self, "capsules", dims, 0.5 * (starts + ends), half, axes, absent, radii)


def _single_side(along: Tensor, absent: Tensor) -> tuple[Tensor, Tensor]:
    """Half sides (B, M, d) and their directions (B, M, d, d), as rows, of boxes that are the segments `along`.

    The first side runs along the segment in the plane, the last in space: there a vertical one isn't turned at all.
    """
    d, side = along.shape[-1], 0 if along.shape[-1] == 2 else 2
    length = torch.where(absent.unsqueeze(-1), 0.0, along).square().sum(-1, keepdim=True).sqrt()
    axis = torch.eye(d, dtype=along.dtype, device=along.device)[side]
    u = torch.where(length > 0, along / length, axis)
    if d == 2:
        x, y = u.unbind(-1)
        axes = torch.stack((u, torch.stack((-y, x), dim=-1)), dim=-2)
    else:
        # A segment has no sense: pointed upwards, it lies at most a right angle from the axis.
        x, y, z = torch.where(u[..., 2:] < 0, -u, u).unbind(-1)
        turn = torch.stack((1.0 + z, -y, x, torch.zeros_like(z)), dim=-1)
        axes = from_quaternions(turn / turn.square().sum(-1, keepdim=True).sqrt())
    return 0.5 * length * axis, axes.contiguous()
