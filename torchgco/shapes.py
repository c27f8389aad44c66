"""The glossary of dimensions, and the checks of input.

Dimensions, always these letters in this order:

    B  problems in the batch      S  samples of a problem      N  stages (controls); knots are 0..N
    n  states                     m  controls                  p  rows of a constraint      d  space (2 or 3)
    k  index of a stage or knot   s  = n + 1 + m, the size of the homogeneous vector [x, 1, u]

    X  (B, N+1, n) states         U  (B, N, m) controls        c <= 0 is feasible
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchgco.errors import InputError


def tensor(value: Any, field: str, like: Tensor | None = None) -> Tensor:
    """`value` (tensor, array, nested sequence or number) as a floating tensor of the dtype and device of `like`.

    Raises InputError where it isn't numeric, and where a tensor comes with another dtype or device than `like`:
    converting it silently would hide a mistake.
    """
    if isinstance(value, Tensor):
        if like is not None and value.dtype != like.dtype:
            raise InputError(field, f"dtype {like.dtype} as in x0", value.dtype)
        if like is not None and value.device != like.device:
            raise InputError(field, f"device {like.device} as in x0", value.device)
        return value
    dtype = like.dtype if like is not None else torch.float64
    device = like.device if like is not None else None
    try:
        plain = list(value) if isinstance(value, Sequence) else value
        return torch.as_tensor(plain, dtype=dtype, device=device)
    except (TypeError, ValueError, RuntimeError):
        raise InputError(field, "numbers", repr(value)) from None


@dataclass(frozen=True)
class Dimensions:
    """The facts about a problem that a part needs to check and shape its tensors."""

    B: int
    N: int
    n: int
    m: int
    dt: float | None  # s, None for dynamics without a time step
    position: slice | None
    like: Tensor  # x0: dtype and device of everything


def check_shape(value: Tensor, shape: tuple[int | str, ...], field: str) -> None:
    """Raise InputError unless `value` has `shape`; a letter stands for any length and names the dimension."""
    fits = value.dim() == len(shape) and all(
        isinstance(want, str) or want == got for want, got in zip(shape, value.shape, strict=True)
    )
    if not fits:
        raise InputError(field, f"shape ({', '.join(map(str, shape))})", tuple(value.shape))


def lead(parameter: Tensor | float, component: Tensor) -> Tensor | float:
    """A model parameter shaped to multiply a component (B, ...) of states with leading batch axis.

    A number or a tensor without axes is returned as it is; one of shape (B,) gets the axes that the component has.
    """
    if isinstance(parameter, Tensor) and parameter.dim() == 1:
        return parameter.view(-1, *([1] * (component.dim() - 1)))
    return parameter


def components(z: Tensor) -> tuple[Tensor, ...]:
    """The components (...) of vectors (..., n), each of them contiguous: arithmetic on strided ones takes longer."""
    return z.movedim(-1, 0).contiguous().unbind(0)


def vectors(*parts: Tensor) -> Tensor:
    """Vectors (..., n) of n components (...), each of which stays contiguous in memory."""
    return torch.stack(parts).movedim(0, -1)
