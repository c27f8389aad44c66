"""How a vehicle's frame is turned in its states: by a heading, a quaternion, or a function of a user."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown, theirs
from torchgco.base.mixing import why
from torchgco.base.shapes import MISTAKES, Dimensions

QUATERNION = "qw", "qx", "qy", "qz"
ROTATION_WITHIN = 1e-6  # how far a rotation's product with its transpose may be from the identity


@dataclass(frozen=True)
class Attitude:
    """Rotation matrices (..., d, d) of states (..., n).

    Args:
        of: the function, or the place of the heading, or of the quaternion's first component.
        d: dimension of space.
    """

    of: Callable[[Tensor], Tensor] | int
    d: int

    @property
    def calls_function(self) -> bool:
        """Whether it is a user's function."""
        return not isinstance(self.of, int)

    def __call__(self, x: Tensor) -> Tensor:
        if not isinstance(self.of, int):
            return self.of(x)
        return in_plane(x[..., self.of]) if self.d == 2 else in_space(x[..., self.of : self.of + 4])

    def turns(self, X: Tensor) -> Tensor:
        """Angles (B, N), rad, by which the vehicle turns from each state of X (B, N+1, n) to the next."""
        if isinstance(self.of, int) and self.d == 2:
            return X[..., self.of].diff(dim=1).abs()
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


def rotation(q: np.ndarray) -> np.ndarray:
    """The matrix (3, 3) of a unit quaternion [w, x, y, z], from the body's axes to the world's."""
    w, x, y, z = q
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def attitude_of(attitude: str | Callable[[Tensor], Tensor], d: int, dims: Dimensions) -> Attitude:
    """The attitude that a body names, in the states of a problem's model.

    Raises:
        InputError: the model has no such state, space has another dimension, or the function returns something else
            than rotation matrices of the problem's starts.
    """
    if isinstance(attitude, str):
        names, wanted = list(dims.state_names), ("heading",) if attitude == "heading" else QUATERNION
        if d != (2 if attitude == "heading" else 3):
            expected = "'quaternion', or a function, in space" if d == 3 else "'heading', or a function, in the plane"
            raise InputError("body.attitude", expected, f"{attitude!r}")
        first = names.index(wanted[0]) if wanted[0] in names else 0
        if tuple(names[first : first + len(wanted)]) != wanted:
            expected = f"a model with states named {', '.join(wanted)}, or a function of the state"
            got = f"{attitude!r} for states {', '.join(names) if names else 'without names'}"
            raise InputError("body.attitude", expected, got)
        return Attitude(first, d)
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
