"""Starts of which some components are variables, and horizons per problem: the checks of both."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.shapes import MISTAKES, describe
from torchgco.constraints.base import Constraint
from torchgco.constraints.bounds import bounds_of


def start_mask(value: Any, x0: Tensor) -> Tensor | None:
    """Which components of the starts x0 (B, n) are free, (B, n) bool; None where no mask is given.

    Raises:
        InputError: no mask (n,) or (B, n) of bool.
    """
    if value is None:
        return None
    (B, n), expected = x0.shape, f"a mask ({x0.shape[1]},) or {tuple(x0.shape)} of bool"
    try:
        mask = torch.as_tensor(value, device=x0.device)
    except (TypeError, ValueError, RuntimeError):
        raise InputError("free_start", expected, shown(value)) from None
    if mask.dtype != torch.bool or tuple(mask.shape) not in ((n,), (B, n)):
        raise InputError("free_start", expected, f"{mask.dtype} of shape {tuple(mask.shape)}")
    return mask.expand(B, n).clone()


def chooses_position(free: Tensor | None, position: slice | None) -> bool:
    """Whether the position at the start is free in any problem of a batch."""
    return free is not None and position is not None and bool(free[:, position].any())


def moved_inside(x0: Tensor, free: Tensor | None, constraints: Sequence[Constraint]) -> Tensor:
    """x0 (B, n) with its free components inside the state bounds of knot 0."""
    if free is None:
        return x0
    for bounds in bounds_of(constraints, "x"):
        if bounds.holds_at(0):
            first = 0 if isinstance(bounds.knots, slice) else int((bounds.knots == 0).nonzero())
            lower, upper = (bound[:, first if bound.shape[1] > 1 else 0] for bound in bounds.by_knot)
            x0 = torch.where(free, torch.minimum(torch.maximum(x0, lower), upper), x0)
    return x0


def checked_horizon(horizon: Any, x0: Tensor, N: int) -> Tensor:
    """Numbers of stages as an int64 tensor (B,) on the device of x0 (B, n).

    Raises:
        InputError: another shape, numbers that aren't whole or outside 1..N.
    """
    expected = f"whole numbers ({x0.shape[0]},) from 1 to N = {N}"
    try:
        given = torch.as_tensor(horizon, device=x0.device)
    except MISTAKES:
        raise InputError("horizon", expected, shown(horizon)) from None
    if given.dtype == torch.bool or given.is_floating_point() or given.is_complex() or given.shape != x0.shape[:1]:
        raise InputError("horizon", expected, describe(given))
    if not bool(((given >= 1) & (given <= N)).all()):
        raise InputError("horizon", expected, given.tolist())
    return given.to(torch.int64)


def clear_starts(constraints: Sequence[Constraint], x0: Tensor, free: Tensor | None, position: slice | None) -> Tensor:
    """Which starts x0 (B, n) lie outside the obstacles, (B,) bool.

    Those that hold at later knots than 1 don't count: a vehicle may leave them. Nor does a guess of a free start.
    """
    clear = torch.ones_like(x0[:, 0], dtype=torch.bool)
    for constraint in constraints:
        if constraint.holds_at(0) or constraint.holds_at(1):
            clear &= constraint.start_is_clear(x0)
    return clear if free is None or position is None else clear | free[:, position].any(dim=-1)
