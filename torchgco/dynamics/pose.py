"""Position, velocity and attitude of a quadrotor: the part of its dynamics that plant and planning model share.

    p' = v,  v' = a R(q) e3 - g e3,  q' = 1/2 Qx(w) q,  in states [p, v, q, w, ...] with a scalar-first quaternion

It stands here twice: on components, for samples, and with few operations, for a few trajectories at a time, where their
number counts and not what each has to do.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor


def thrust_axis(q0: Tensor, q1: Tensor, q2: Tensor, q3: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """R(q) e3, of length |q|^2."""
    return 2 * (q1 * q3 + q0 * q2), 2 * (q2 * q3 - q0 * q1), q0 * q0 - q1 * q1 - q2 * q2 + q3 * q3


def attitude_rate(q: tuple[Tensor, ...], w: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """q' = 1/2 Qx(w) q."""
    q0, q1, q2, q3 = q
    w1, w2, w3 = w
    return (
        -0.5 * (q1 * w1 + q2 * w2 + q3 * w3),
        0.5 * (q0 * w1 + q2 * w3 - q3 * w2),
        0.5 * (q0 * w2 - q1 * w3 + q3 * w1),
        0.5 * (q0 * w3 + q1 * w2 - q2 * w1),
    )


# R(q) e3 and q' are sums of products of two states. As tables: the state, and its sign, that stands with q0, q1, q2, q3
# (with w1, w2, w3 for _TURN) in each row; 0 where nothing does. A few operations then do for all rows together.
Table = tuple[tuple[int, ...], ...]
_AXIS: Table = ((8, 9, 6, 7), (-7, -6, 9, 8), (6, -7, -8, 9))  # R(q) e3, and half its derivative by q
_SPIN: Table = ((0, -10, -11, -12), (10, 0, 12, -11), (11, -12, 0, 10), (12, 11, -10, 0))  # 2 q', 2 dq'/dq
_TURN: Table = ((-7, -8, -9), (6, -9, 8), (9, 6, -7), (-8, 7, 6))  # 2 dq'/dw
_BY_AXIS, _BY_SPIN, _BY_TURN = (
    tuple((first + i, column + j) for i, row in enumerate(table) for j, state in enumerate(row) if state)
    for table, first, column in ((_AXIS, 3, 6), (_SPIN, 6, 6), (_TURN, 6, 10))
)
POSE_SPARSITY = (*((i, 3 + i) for i in range(3)), *_BY_AXIS, *_BY_SPIN, *_BY_TURN)


@functools.cache
def _sums(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """The states and factors (28,), (28, 1) of R(q) e3 and q' that q0 stands with, then q1, q2, q3."""
    flat = [(i, state) for column in zip(*_AXIS, *_SPIN, strict=True) for i, state in enumerate(column)]
    return _states_and_factors([(state, 1.0 if i < 3 else 0.5) for i, state in flat], dtype, device)


@functools.cache
def _derivatives(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """The states and factors (36,), (36, 1) of their derivatives, table by table."""
    tables = ((_AXIS, 2.0), (_SPIN, 0.5), (_TURN, 0.5))
    flat = [(state, factor) for table, factor in tables for row in table for state in row if state]
    return _states_and_factors(flat, dtype, device)


def _states_and_factors(
    flat: list[tuple[int, float]], dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Where nothing stands, state 0 with the factor 0."""
    states = torch.tensor([abs(state) for state, _ in flat], device=device)
    factors = [math.copysign(factor * (state != 0), state) for state, factor in flat]
    return states, torch.tensor(factors, dtype=dtype, device=device).unsqueeze(-1)


# Made here: a first call from within a transform of torch.func would keep what belongs to that transform.
for _made in (_sums, _derivatives):
    for _dtype in (torch.float64, torch.float32):
        _made(_dtype, torch.device("cpu"))


def pose_rates(x: Tensor) -> tuple[Tensor, Tensor]:
    """R(q) e3 (3, ...) and q' (4, ...) of states (n, ...)."""
    states, factors = _sums(x.dtype, x.device)
    flat = x.reshape(x.shape[0], -1)
    terms = (flat.index_select(0, states) * factors).view(4, 7, -1) * flat[6:10].unsqueeze(1)
    first, second = terms.view(2, 14, -1).unbind(0)
    first, second = (first + second).view(2, 7, *x.shape[1:]).unbind(0)
    axis, dq = (first + second).split_with_sizes((3, 4))
    return axis, dq


def pose_entries(x: Tensor, lift: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives (..., 39) of p', v', q' at POSE_SPARSITY, and R(q) e3 (..., 3), of states (..., n).

    `lift` is the thrust acceleration (..., 1), m/s^2. Its own column of v' is left to the caller.
    """
    states, factors = _derivatives(x.dtype, x.device)
    entries = x.index_select(-1, states) * factors[:, 0]
    by_q = entries[..., :12]
    axis = 0.5 * (by_q.unflatten(-1, (3, 4)) * x[..., None, 6:10]).sum(-1)
    return torch.cat((torch.ones_like(x[..., :3]), lift * by_q, entries[..., 12:]), dim=-1), axis
