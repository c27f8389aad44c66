"""How a vehicle's frame is turned in its states: by angles, a quaternion, or a function of a user."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown, theirs
from torchgco.base.mixing import why
from torchgco.base.shapes import MISTAKES, Dimensions

QUATERNION = "qw", "qx", "qy", "qz"
BALL_RAYS = 720  # along which the largest ball that a body holds is measured
ROTATION_WITHIN = 1e-6  # how far a rotation's product with its transpose may be from the identity


@dataclass(frozen=True)
class Attitude:
    """Rotation matrices (..., d, d) of states (..., n).

    Args:
        of: the function; or in the plane the place of the angle, or of those whose sum it is; or the place of the
            quaternion's first component.
        d: dimension of space.
    """

    of: Callable[[Tensor], Tensor] | int | tuple[int, ...]
    d: int

    @property
    def calls_function(self) -> bool:
        """Whether it is a user's function."""
        return not isinstance(self.of, int | tuple)

    def __call__(self, x: Tensor) -> Tensor:
        if callable(self.of):
            return self.of(x)
        if isinstance(self.of, int) and self.d == 3:
            return in_space(x[..., self.of : self.of + 4])
        return in_plane(self._angle(x))

    def _angle(self, x: Tensor) -> Tensor:
        """The angle (...), rad, in the plane."""
        places = (self.of,) if isinstance(self.of, int) else self.of
        assert isinstance(places, tuple)
        return sum((x[..., i] for i in places[1:]), x[..., places[0]])

    def turns(self, X: Tensor) -> Tensor:
        """Angles (B, N), rad, by which the vehicle turns from each state of X (B, N+1, n) to the next."""
        if not callable(self.of) and self.d == 2:
            return self._angle(X).diff(dim=1).abs()
        R = self(X)
        trace = (R[:, 1:] * R[:, :-1]).sum((-1, -2))  # 2 cos of the turn in the plane, 1 + 2 cos in space
        return (0.5 * (trace - (self.d - 2))).clamp(-1.0, 1.0).acos()


def in_plane(heading: Tensor) -> Tensor:
    """Rotation matrices (..., 2, 2) of angles (...), rad."""
    cos, sin = heading.cos(), heading.sin()
    return torch.stack((torch.stack((cos, -sin), dim=-1), torch.stack((sin, cos), dim=-1)), dim=-2)


def in_space(quaternion: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4) of any length above 0, scalar first."""
    w, x, y, z = quaternion.unbind(-1)
    square = w * w + x * x + y * y + z * z
    rows = (
        (w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
    )
    return torch.stack([torch.stack([entry / square for entry in row], dim=-1) for row in rows], dim=-2)


def directions(d: int) -> Tensor:
    """Unit vectors (R, d) all around, in space a Fibonacci lattice."""
    i = torch.arange(BALL_RAYS, dtype=torch.float64, device="cpu")
    if d == 2:
        angle = 2.0 * math.pi / BALL_RAYS * i
        return torch.stack((angle.cos(), angle.sin()), dim=-1)
    z, angle = 1.0 - (2.0 * i + 1.0) / BALL_RAYS, math.pi * (3.0 - math.sqrt(5.0)) * i
    flat = (1.0 - z.square()).sqrt()
    return torch.stack((flat * angle.cos(), flat * angle.sin(), z), dim=-1)


def rotation(q: np.ndarray) -> np.ndarray:
    """The matrix (3, 3) of a unit quaternion [w, x, y, z], from the body's axes to the world's."""
    w, x, y, z = q
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def attitude_of(attitude: Any, d: int, dims: Dimensions) -> Attitude:
    """The attitude that a body names, in the states of a problem's model.

    Raises:
        InputError: the model has no such state, space has another dimension, or the function returns something else
            than rotation matrices of the problem's starts.
    """
    if isinstance(attitude, str | Sequence):
        return _named(attitude, d, list(dims.state_names))
    try:
        R = attitude(dims.like)
    except MISTAKES as error:
        expected = f"a function of states (..., n) that returns rotation matrices (..., {d}, {d})"
        raise InputError("body.attitude", expected, why(error, attitude, dims.like)) from theirs(error)
    if not isinstance(R, Tensor) or R.dtype != dims.like.dtype or tuple(R.shape) != (dims.B, d, d):
        got = f"{R.dtype} {tuple(R.shape)}" if isinstance(R, Tensor) else shown(R)
        expected = f"rotation matrices ({dims.B}, {d}, {d}) in {dims.like.dtype} of the starts"
        raise InputError("body.attitude", expected, got)
    away = (R @ R.mT - torch.eye(d, dtype=R.dtype, device=R.device)).abs().amax((-1, -2))
    finite = torch.isfinite(dims.like).all(-1)
    if bool((away[finite] > ROTATION_WITHIN).any()):
        got = f"matrices that differ from them by {float(away[finite].max()):.3g}"
        raise InputError("body.attitude", "rotation matrices R, with R R' = 1", got)
    return Attitude(attitude, d)


def _named(attitude: str | Sequence[str], d: int, names: list[str]) -> Attitude:
    """The attitude of states with these names, among those of a model."""
    spatial = attitude == "quaternion"
    wanted = QUATERNION if spatial else (attitude,) if isinstance(attitude, str) else tuple(attitude)
    if d != (3 if spatial else 2):
        expected = "'quaternion', or a function, in space" if d == 3 else "'heading', or a function, in the plane"
        raise InputError("body.attitude", expected, f"{attitude!r}")
    places = tuple(names.index(name) for name in wanted if name in names)
    if len(places) < len(wanted) or (spatial and places != tuple(range(places[0], places[0] + 4))):
        expected = f"a model with states named {', '.join(wanted)}, or a function of the state"
        got = f"{attitude!r} for states {', '.join(names) if names else 'without names'}"
        raise InputError("body.attitude", expected, got)
    return Attitude(places[0] if spatial or len(places) == 1 else places, d)
