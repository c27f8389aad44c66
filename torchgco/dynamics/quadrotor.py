"""The quadrotor at three depths: planning model (14 states), plant (17), rotor tracking (7).

Quaternions are scalar first; q' = 1/2 Qx(w) q, and R(q) e3 is the body's thrust axis in the world.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchgco.dynamics.base import Dynamics, check_model
from torchgco.shapes import InputError, lead

GRAVITY = 9.81  # m/s^2


@dataclass(frozen=True)
class Airframe:
    """What the quadrotor is made of (Table 2), shared by plant, tracking model and first-step consistency.

    Raises:
        InputError: non-positive mass, or thrust limits crossed.
    """

    mass: float = 1.608  # kg
    inertia: tuple[tuple[float, float, float], ...] = (
        (0.0366, 0.0, 0.0065),
        (0.0, 0.0327, 0.0046),
        (0.0065, 0.0046, 0.0187),
    )  # J, kg m^2
    arm: float = 0.216  # l, m
    rotor_torque: float = 1.6e-2  # k_r, m: yaw torque per newton of thrust
    rotational_drag: float = 1.0e-2  # k_a, N m s/rad, on the yaw rate
    rotor_time_constant: float = 0.10  # T_r, s
    thrust_min: float = 0.1046  # N per rotor
    thrust_max: float = 6.0  # N per rotor
    hover_speed: float = 5000.0  # rpm that carries the weight

    def __post_init__(self) -> None:
        if not self.mass > 0:
            raise InputError("airframe.mass", "a positive mass in kg", self.mass)
        if not self.thrust_min < self.thrust_max:
            raise InputError("airframe.thrust_min", f"less than thrust_max {self.thrust_max}", self.thrust_min)

    @property
    def thrust_coefficient(self) -> float:
        """b in F = b Omega^2, N/rpm^2: four rotors at `hover_speed` carry the weight."""
        return self.mass * GRAVITY / (4.0 * self.hover_speed**2)

    def allocation(self, like: Tensor) -> Tensor:
        """T (3, 4): body torques of the four thrusts, X configuration."""
        h, k = self.arm / math.sqrt(2.0), self.rotor_torque
        return like.new_tensor([[h, -h, -h, h], [-h, -h, h, h], [k, -k, k, -k]])

    def angular_acceleration(self, w: Tensor, F: Tensor) -> Tensor:
        """w' = J^-1 (T F - w x (J w) - D w), (..., 3), with D = diag(0, 0, k_a)."""
        J = w.new_tensor(self.inertia)
        torque = _apply(self.allocation(w), F) - torch.linalg.cross(w, _apply(J, w))
        drag = torch.stack((torch.zeros_like(w[..., 2]), torch.zeros_like(w[..., 2]), w[..., 2]), dim=-1)
        return _apply(torch.linalg.inv(J), torque - self.rotational_drag * drag)

    def angular_jacobians(self, w: Tensor, F: Tensor) -> tuple[Tensor, Tensor]:
        """Derivatives of `angular_acceleration` by w (..., 3, 3) and by F (..., 3, 4)."""
        J = w.new_tensor(self.inertia)
        J_inv = torch.linalg.inv(J)
        gyro = _skew(_apply(J, w)) - _skew(w) @ J  # d(-w x Jw)/dw
        gyro[..., 2, 2] -= self.rotational_drag
        by_F = (J_inv @ self.allocation(w)).expand(*F.shape[:-1], 3, 4)
        return J_inv @ gyro, by_F

    def thrust_rate(self, F: Tensor, speed: Tensor) -> Tensor:
        """F' = 2/T_r sqrt(F) (sqrt(b) u - sqrt(F)) for commanded rotor speeds u in rpm, (..., 4)."""
        root = F.clamp(min=0.0).sqrt()
        return 2.0 / self.rotor_time_constant * root * (math.sqrt(self.thrust_coefficient) * speed - root)

    def thrust_jacobians(self, F: Tensor, speed: Tensor) -> tuple[Tensor, Tensor]:
        """Diagonals (..., 4) of the derivatives of `thrust_rate` by F and by the speeds."""
        gain, b_root = 2.0 / self.rotor_time_constant, math.sqrt(self.thrust_coefficient)
        root = F.clamp(min=torch.finfo(F.dtype).tiny).sqrt()
        return gain * (0.5 * b_root * speed / root - 1.0), gain * b_root * root


def _apply(A: Tensor, x: Tensor) -> Tensor:
    """A x for a small constant matrix, as products and sums: bits then don't depend on the batch size."""
    return (A * x.unsqueeze(-2)).sum(-1)


def _skew(w: Tensor) -> Tensor:
    """The matrix of w x (...), (..., 3, 3)."""
    zero = torch.zeros_like(w[..., 0])
    rows = (zero, -w[..., 2], w[..., 1], w[..., 2], zero, -w[..., 0], -w[..., 1], w[..., 0], zero)
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def _thrust_axis(q0: Tensor, q1: Tensor, q2: Tensor, q3: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """R(q) e3, of length |q|^2."""
    return 2 * (q1 * q3 + q0 * q2), 2 * (q2 * q3 - q0 * q1), q0 * q0 - q1 * q1 - q2 * q2 + q3 * q3


def _attitude_rate(q: tuple[Tensor, ...], w: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
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
    states, factors = (
        [abs(state) for state, _ in flat],
        [math.copysign(factor * (state != 0), state) for state, factor in flat],
    )
    return torch.tensor(states, device=device), torch.tensor(factors, dtype=dtype, device=device).unsqueeze(-1)


def _pose_rates(x: Tensor) -> tuple[Tensor, Tensor]:
    """R(q) e3 (3, ...) and q' (4, ...) of states (n, ...)."""
    states, factors = _sums(x.dtype, x.device)
    flat = x.reshape(x.shape[0], -1)
    terms = flat.index_select(0, states).mul_(factors).view(4, 7, -1) * flat[6:10].unsqueeze(1)
    first, second = terms.view(2, 14, -1).unbind(0)
    first, second = (first + second).view(2, 7, *x.shape[1:]).unbind(0)
    return (first + second).split((3, 4))  # type: ignore[return-value]


def _pose_entries(x: Tensor, lift: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives (..., 39) of p', v', q' at POSE_SPARSITY, and R(q) e3 (..., 3), of states (..., n).

    `lift` is the thrust acceleration (..., 1), m/s^2. Its own column of v' is left to the caller.
    """
    states, factors = _derivatives(x.dtype, x.device)
    entries = x.index_select(-1, states) * factors[:, 0]
    by_q = entries[..., :12]
    axis = 0.5 * (by_q.unflatten(-1, (3, 4)) * x[..., None, 6:10]).sum(-1)
    return torch.cat((torch.ones_like(x[..., :3]), lift * by_q, entries[..., 12:]), dim=-1), axis


@dataclass(frozen=True)
class QuadrotorPlanning(Dynamics):
    """Planning model: x = [p (m), v (m/s), q, w (rad/s), a (m/s^2)], u = [w_c, a_c], n = 14, m = 4 (section 5.2).

        p' = v,  v' = a R(q) e3 - g e3,  q' = 1/2 Qx(w) q,  w' = (w_c - w)/T_w,  a' = (a_c - a)/T_a

    q isn't renormalised, as in the paper's planner. The time constants may be tensors (B,).

    Raises:
        InputError: non-positive dt, unknown integrator.
    """

    dt: float = 0.05
    integrator: str = "euler"
    rate_time_constant: float | Tensor = 1.5  # T_w, s
    thrust_time_constant: float | Tensor = 1.5  # T_a, s
    gravity: float = GRAVITY

    n: ClassVar[int] = 14
    m: ClassVar[int] = 4
    position: ClassVar[slice] = slice(0, 3)
    per_element: ClassVar[tuple[str, ...]] = ("rate_time_constant", "thrust_time_constant")
    sparsity: ClassVar[tuple[tuple[int, int], ...]] = (
        *POSE_SPARSITY, (3, 13), (4, 13), (5, 13), (10, 10), (11, 11), (12, 12), (13, 13),
        (10, 14), (11, 15), (12, 16), (13, 17),
    )  # fmt: skip

    def __post_init__(self) -> None:
        check_model(self, "quadrotor")

    def rates(self, x: Sequence[Tensor], u: Sequence[Tensor]) -> tuple[Tensor, ...]:
        vx, vy, vz, q0, q1, q2, q3, w1, w2, w3, a = x[3:]
        T_w, T_a = lead(self.rate_time_constant, a), lead(self.thrust_time_constant, a)
        bx, by, bz = _thrust_axis(q0, q1, q2, q3)
        dq = _attitude_rate((q0, q1, q2, q3), (w1, w2, w3))
        dw = ((u[0] - w1) / T_w, (u[1] - w2) / T_w, (u[2] - w3) / T_w)
        return (vx, vy, vz, a * bx, a * by, a * bz - self.gravity, *dq, *dw, (u[3] - a) / T_a)

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        # The same as `rates` for a few trajectories, where the number of operations counts, not what each has to do.
        x, u = (x.mT, u.mT) if x.dim() == 2 else (x.movedim(-1, 0), u.movedim(-1, 0))
        _, v, _, w, a = x.split((3, 3, 4, 3, 1))
        w_c, a_c = u.split((3, 1))
        axis, dq = _pose_rates(x)
        dv = axis * a
        dv[2] -= self.gravity
        T_w, T_a = (lead(T, x[0]) for T in (self.rate_time_constant, self.thrust_time_constant))
        rates = torch.cat((v, dv, dq, (w_c - w) / T_w, (a_c - a) / T_a))
        return rates.mT if rates.dim() == 2 else rates.movedim(0, -1)

    def field_entries(self, x: Tensor, u: Tensor) -> Tensor:
        pose, axis = _pose_entries(x, x[..., 13:])
        one = torch.ones_like(x[..., :1])
        w, a = (one / lead(T, one) for T in (self.rate_time_constant, self.thrust_time_constant))
        w = w.expand_as(axis)
        return torch.cat((pose, axis, -w, -a, w, a), dim=-1)


@dataclass(frozen=True)
class QuadrotorPlant(Dynamics):
    """Full quadrotor: x = [p, v, q, w, F (N)], u = commanded rotor speeds (rpm), n = 17, m = 4 (section 2).

    A step ends with the thrusts limited to [f_min, f_max] and the quaternion renormalised, which the
    derivatives account for (at a limit, the derivative of that thrust is zero).
    """

    dt: float = 0.01
    integrator: str = "rk4"
    airframe: Airframe = Airframe()
    gravity: float = GRAVITY

    n: ClassVar[int] = 17
    m: ClassVar[int] = 4
    position: ClassVar[slice] = slice(0, 3)

    def __post_init__(self) -> None:
        check_model(self, "plant")

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        w, F = x[..., 10:13], x[..., 13:]
        axis, dq = (rows.movedim(0, -1) for rows in _pose_rates(x.movedim(-1, 0)))
        dv = axis * (F.sum(-1, keepdim=True) / self.airframe.mass)
        dw = self.airframe.angular_acceleration(w, F)
        parts = (x[..., 3:6], dv[..., :2], dv[..., 2:] - self.gravity, dq, dw, self.airframe.thrust_rate(F, u))
        return torch.cat(parts, dim=-1)

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        x = super().step(x, u)
        q = x[..., 6:10]
        q = q / q.square().sum(-1, keepdim=True).sqrt()
        F = x[..., 13:].clamp(self.airframe.thrust_min, self.airframe.thrust_max)
        return torch.cat((x[..., :6], q, x[..., 10:13], F), dim=-1)

    def field_jacobians(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        w, F = x[..., 10:13], x[..., 13:]
        ax = x.new_zeros(*x.shape[:-1], 17, 17)
        rows, columns = zip(*POSE_SPARSITY, strict=True)
        ax[..., rows, columns], axis = _pose_entries(x, F.sum(-1, keepdim=True) / self.airframe.mass)
        ax[..., 3:6, 13:] = axis.unsqueeze(-1) / self.airframe.mass
        ax[..., 10:13, 10:13], ax[..., 10:13, 13:] = self.airframe.angular_jacobians(w, F)
        by_F, by_speed = self.airframe.thrust_jacobians(F, u)
        ax[..., 13:, 13:] = torch.diag_embed(by_F)
        au = x.new_zeros(*x.shape[:-1], 17, 4)
        au[..., 13:, :] = torch.diag_embed(by_speed)
        return ax, au

    def jacobians(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Derivatives of `step`, limits and renormalisation included."""
        fx, fu = super().jacobians(x, u)
        free = super().step(x, u)
        q, F = free[..., 6:10], free[..., 13:]
        length = q.square().sum(-1, keepdim=True).sqrt()
        unit = q / length
        eye = torch.eye(4, dtype=x.dtype, device=x.device)
        project = (eye - unit.unsqueeze(-1) * unit.unsqueeze(-2)) / length.unsqueeze(-1)
        inside = ((self.airframe.thrust_min <= F) & (self.airframe.thrust_max >= F)).to(x.dtype).unsqueeze(-1)
        for f in (fx, fu):
            f[..., 6:10, :] = project @ f[..., 6:10, :]
            f[..., 13:, :] = inside * f[..., 13:, :]
        return fx, fu


@dataclass(frozen=True)
class RotorTracking(Dynamics):
    """Tracking model: x = [w (rad/s), F (N)], u = rotor speeds (rpm), n = 7, m = 4 (section 5.2, Table 5)."""

    dt: float = 0.01
    integrator: str = "euler"
    airframe: Airframe = Airframe()

    n: ClassVar[int] = 7
    m: ClassVar[int] = 4

    def __post_init__(self) -> None:
        check_model(self, "rotors")

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        w, F = x[..., :3], x[..., 3:]
        return torch.cat((self.airframe.angular_acceleration(w, F), self.airframe.thrust_rate(F, u)), dim=-1)

    def field_jacobians(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        w, F = x[..., :3], x[..., 3:]
        ax, au = x.new_zeros(*x.shape[:-1], 7, 7), x.new_zeros(*x.shape[:-1], 7, 4)
        ax[..., :3, :3], ax[..., :3, 3:] = self.airframe.angular_jacobians(w, F)
        by_F, by_speed = self.airframe.thrust_jacobians(F, u)
        ax[..., 3:, 3:] = torch.diag_embed(by_F)
        au[..., 3:, :] = torch.diag_embed(by_speed)
        return ax, au
