"""What all kinds of obstacles check and shape of a user's numbers: points, velocities, turns, and radii."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.shapes import Dimensions, check_finite, per_row, space_of, tensor
from torchgco.obstacles.attitude import in_plane
from torchgco.obstacles.box_geometry import from_quaternions

UNIT_WITHIN = 1e-3  # by which the length of a quaternion may differ from 1


def is_body(radius: Any) -> bool:
    """Whether a vehicle's radius is a `Body`, which binds obstacles to each of its balls."""
    return hasattr(radius, "around")


def dimension(dims: Dimensions, name: str) -> int:
    """d of the space that the vehicle moves in.

    Raises:
        InputError: dynamics without a position in 2-D or 3-D.
    """
    d = space_of(dims, name)
    if d not in (2, 3):
        raise InputError(name, "dynamics with a position in 2-D or 3-D", f"{d}-D")
    return d


def points(value: Any, name: str, d: int, dims: Dimensions) -> tuple[Tensor, Tensor]:
    """Points (B, M, d) and which of them are absent (B, M): rows of NaN, which stay so.

    Raises:
        InputError: not numbers, points of another space, another batch, infinity, NaN among numbers.
    """
    values = rows(value, name, d, dims)
    if values.shape[-1] != d:
        raise InputError(name, f"{d}-D points, as the vehicle's position is {d}-D", f"{values.shape[-1]}-D points")
    absent = torch.isnan(values).all(-1)
    wrong = ~torch.isfinite(values).all(-1) & ~absent
    if bool(wrong.any()):
        raise InputError(name, "finite points, or rows of NaN", values[wrong][0].tolist())
    return values, absent


def rows(value: Any, name: str, d: int, dims: Dimensions) -> Tensor:
    """Numbers per obstacle and coordinate, (B, M, ...); an empty list stands for none of d coordinates.

    Raises:
        InputError: as `per_row`.
    """
    values = tensor(value, name, dims.like)
    return per_row(values.reshape(0, d) if tuple(values.shape) == (0,) else values, name, dims, "M", "d").contiguous()


def own_radii(value: Any, name: str, absent: Tensor, dims: Dimensions) -> Tensor:
    """The obstacles' own radii (B, M), 0 where absent; one number stands for all of them.

    Raises:
        InputError: another shape, NaN elsewhere or not there, infinite or negative radii.
    """
    values = tensor(value, name, dims.like)
    values = torch.where(absent, torch.nan, values) if values.dim() == 0 else values
    radii = per_row(values, name, dims, absent.shape[1])
    check_absent(torch.isnan(radii), absent, name, "the obstacle is absent")
    wrong = ~absent & ~((radii >= 0) & torch.isfinite(radii))
    if bool(wrong.any()):
        raise InputError(name, "finite radii of at least 0 m", float(radii[wrong][0]))
    return torch.where(absent, 0.0, radii)


def check_absent(missing: Tensor, absent: Tensor, name: str, where: str) -> None:
    """Raise InputError unless numbers are NaN exactly where obstacles are absent."""
    if bool((missing != absent).any()):
        raise InputError(name, f"NaN exactly where {where}", "NaN and numbers mixed")


def check_sides(half: Tensor, radii: Tensor, absent: Tensor, name: str) -> None:
    """Raise InputError where half sides (B, M, d) of boxes with radii (B, M) aren't finite, or 0 without a radius."""
    sized = torch.where(radii.unsqueeze(-1) > 0, half >= 0, half > 0) & torch.isfinite(half)
    wrong = ~sized.all(-1) & ~absent
    if bool(wrong.any()):
        expected = "finite half sides above 0 m; 0 m too where the box is rounded"
        raise InputError(name, expected, half[wrong][0].tolist())


def vehicle_radii(value: Any, name: str, dims: Dimensions) -> Tensor:
    """The vehicle's radius in every problem, (B,).

    Raises:
        InputError: neither a finite number nor one per problem, or negative.
    """
    radius = tensor(value, name, dims.like)
    finite = bool(torch.isfinite(radius).all())
    if radius.dim() > 1 or radius.numel() not in (1, dims.B) or not finite:
        raise InputError(
            name, f"a number, or {dims.B} of them", f"shape {tuple(radius.shape)}" if finite else "NaN or infinity"
        )
    if not bool((radius >= 0).all()):
        raise InputError(name, "a number of at least 0 m", float(radius.min()))
    return radius.reshape(-1).expand(dims.B).contiguous()


def own_velocities(value: Any, name: str, absent: Tensor, dims: Dimensions) -> Tensor | None:
    """The obstacles' velocities (B, M, d), 0 where absent; None where none is given, or there is no obstacle.

    Raises:
        InputError: another shape, NaN or infinity of an obstacle that is there, dynamics without a time step.
    """
    if value is None:
        return None
    velocities = per_row(value, name, dims, absent.shape[1], space_of(dims, name))
    velocities = torch.where(absent.unsqueeze(-1), 0.0, velocities)
    check_finite(velocities, name, "finite velocities of every obstacle that is there")
    if dims.dt is None:
        raise InputError(name, "dynamics with a time step dt", "dynamics without one")
    # None of none moves: what is asked of moving obstacles alone isn't asked of them.
    return velocities if absent.shape[1] > 0 else None


def own_axes(rotations: Any, name: str, absent: Tensor, d: int, dims: Dimensions) -> Tensor:
    """The directions (B, M, d, d) of the obstacles' axes, as rows; those of absent ones are the axes of space.

    Raises:
        InputError: another shape, quaternions of another length than 1, NaN or infinity of one that is there.
    """
    straight = torch.eye(d, dtype=dims.like.dtype, device=dims.like.device).expand(*absent.shape, d, d)
    if rotations is None:
        return straight.contiguous()
    if d == 2:
        axes = in_plane(per_row(rotations, name, dims, absent.shape[1])).mT
    else:
        turns = per_row(rotations, name, dims, absent.shape[1], 4)
        length = turns.square().sum(-1, keepdim=True).sqrt()
        wrong = ((length - 1.0).abs() > UNIT_WITHIN).squeeze(-1) & ~absent
        if bool(wrong.any()):
            raise InputError(name, "unit quaternions [w, x, y, z]", turns[wrong][0].tolist())
        axes = from_quaternions(turns / length)
    axes = torch.where(absent[..., None, None], straight, axes)
    check_finite(axes, name, "finite numbers for every obstacle that is there")
    return axes.contiguous()
