"""The quadrotor at three depths: planning model (14 states), plant (17), rotor tracking (7).

Quaternions are scalar first; q' = 1/2 Qx(w) q, and R(q) e3 is the body's thrust axis in the world.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchgco.dynamics.base import Dynamics, check_model
from torchgco.dynamics.pose import POSE_SPARSITY, attitude_rate, pose_entries, pose_rates, thrust_axis
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
    reads_fields_alone: ClassVar[bool] = True
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
        bx, by, bz = thrust_axis(q0, q1, q2, q3)
        dq = attitude_rate((q0, q1, q2, q3), (w1, w2, w3))
        dw = ((u[0] - w1) / T_w, (u[1] - w2) / T_w, (u[2] - w3) / T_w)
        return (vx, vy, vz, a * bx, a * by, a * bz - self.gravity, *dq, *dw, (u[3] - a) / T_a)

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        # `rates` with fewer operations.
        x, u = (x.mT, u.mT) if x.dim() == 2 else (x.movedim(-1, 0), u.movedim(-1, 0))
        _, v, _, w, a = x.split_with_sizes((3, 3, 4, 3, 1))
        w_c, a_c = u.split_with_sizes((3, 1))
        axis, dq = pose_rates(x)
        dv = axis * a
        T_w, T_a = (lead(T, x[0]) for T in (self.rate_time_constant, self.thrust_time_constant))
        rates = torch.cat((v, dv[:2], dv[2:] - self.gravity, dq, (w_c - w) / T_w, (a_c - a) / T_a))
        return rates.mT if rates.dim() == 2 else rates.movedim(0, -1)

    def field_entries(self, x: Tensor, u: Tensor) -> Tensor:
        pose, axis = pose_entries(x, x[..., 13:])
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
    reads_fields_alone: ClassVar[bool] = True
    position: ClassVar[slice] = slice(0, 3)

    def __post_init__(self) -> None:
        check_model(self, "plant")

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        w, F = x[..., 10:13], x[..., 13:]
        axis, dq = (rows.movedim(0, -1) for rows in pose_rates(x.movedim(-1, 0)))
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
        ax[..., rows, columns], axis = pose_entries(x, F.sum(-1, keepdim=True) / self.airframe.mass)
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
    reads_fields_alone: ClassVar[bool] = True

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
