"""The quadrotor: planning model (14 states), plant (17), rotor tracking (7), and one commanded by its rotors' thrusts.

Quaternions are scalar first; q' = 1/2 Qx(w) q, and R(q) e3 is the body's thrust axis in the world.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.options import Above, Meters, NonNegative, Positive, Seconds, check_options
from torchgco.base.shapes import components, lead, vectors
from torchgco.dynamics.base import Dynamics, Integrator

Components = tuple[Tensor, ...]
Triple = tuple[float, float, float]
Limits = tuple[float | None, ...]
Texts = tuple[str, ...]
POSE: Texts = ("x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz", "wx", "wy", "wz")
POSE_UNITS: Texts = (*["m"] * 3, *["m/s"] * 3, *[""] * 4, *["rad/s"] * 3)
THRUSTS: Texts = ("thrust 1", "thrust 2", "thrust 3", "thrust 4")
ROTORS: Texts = ("rotor 1", "rotor 2", "rotor 3", "rotor 4")
RADIANS = 2.0 * math.pi / 60.0  # per second, of one rpm
ROTOR_SPINS = (1.0, -1.0, 1.0, -1.0)  # signs of the rotors' torques about z


@dataclass(frozen=True)
class Airframe:
    """A quadrotor: Table 2 of the paper, or an own one. It is shared by the three models and all parts of a mission.

    Command lines and configurations call it `vehicle`: `vehicle.mass=1.2`, `vehicle=crazyflie`.

    Raises:
        InputError: a field out of its range or of another kind, thrust limits crossed or between which no rotor hovers,
            an inertia that can't be.
    """

    mass: Annotated[float, Above(0, "kg")] = 1.608
    inertia: tuple[Triple, Triple, Triple] = (
        (0.0366, 0.0, 0.0065),
        (0.0, 0.0327, 0.0046),
        (0.0065, 0.0046, 0.0187),
    )  # J, kg m^2
    arm: Meters = 0.216  # l
    rotor_torque: Positive = 1.6e-2  # k_r, m: yaw torque per newton of thrust
    rotational_drag: NonNegative = 1.0e-2  # k_a, N m s/rad, on the yaw rate
    rotor_inertia: NonNegative = 0.0  # J_r, kg m^2, of one rotor with its motor, about its axis
    rotor_time_constant: Seconds = 0.10  # T_r
    thrust_min: NonNegative = 0.1046  # N per rotor
    thrust_max: Positive = 6.0  # N per rotor
    hover_speed: Positive = 5000.0  # rpm at which the rotors carry the weight
    gravity: Annotated[float, Above(0, "m/s^2")] = 9.81  # g
    drag: NonNegative = 0.0  # force against the velocity, N s/m
    radius: NonNegative = 0.36  # of the ball around it that obstacles are kept out of, m

    def __post_init__(self) -> None:
        object.__setattr__(self, "inertia", _as_rows(self.inertia))
        check_options(self, "airframe")
        if not _is_inertia(*self.inertia):
            raise InputError("airframe.inertia", "a symmetric, positive definite matrix in kg m^2", self.inertia)
        if not self.thrust_min < self.thrust_max:
            raise InputError("airframe.thrust_min", f"less than thrust_max {self.thrust_max}", self.thrust_min)
        weight = f"than a quarter of the weight, {self.hover_thrust:.4g} N"
        if self.thrust_min >= self.hover_thrust:
            raise InputError("airframe.thrust_min", f"less {weight}", self.thrust_min)
        if self.thrust_max <= self.hover_thrust:
            raise InputError("airframe.thrust_max", f"more {weight}", self.thrust_max)

    def pose_rates(self, v: Components, q: Components, w: Components, a: Tensor) -> Components:
        """p' (3), v' (3) and q' (4) under a thrust acceleration a, m/s^2.

        p' = v,  v' = a R(q) e3 - g e3 - drag v / mass,  q' = 1/2 Qx(w) q
        """
        (q0, q1, q2, q3), (w1, w2, w3) = q, w
        axis = 2 * (q1 * q3 + q0 * q2), 2 * (q2 * q3 - q0 * q1), q0 * q0 - q1 * q1 - q2 * q2 + q3 * q3
        rates = a * axis[0], a * axis[1], a * axis[2] - self.gravity
        if self.drag != 0:
            loss = self.drag / self.mass
            rates = tuple(rate - loss * v_i for rate, v_i in zip(rates, v, strict=True))
        return (
            *v,
            *rates,
            -0.5 * (q1 * w1 + q2 * w2 + q3 * w3),
            0.5 * (q0 * w1 + q2 * w3 - q3 * w2),
            0.5 * (q0 * w2 - q1 * w3 + q3 * w1),
            0.5 * (q0 * w3 + q1 * w2 - q2 * w1),
        )

    @property
    def hover_thrust(self) -> float:
        """Of each rotor where the four carry the weight, m g / 4, N."""
        return self.mass * self.gravity / 4.0

    @property
    def accelerations(self) -> tuple[float, float]:
        """The least and the greatest joint acceleration of the four rotors, 4 f_min / m and 4 f_max / m, m/s^2."""
        return 4.0 * self.thrust_min / self.mass, 4.0 * self.thrust_max / self.mass

    @property
    def thrust_coefficient(self) -> float:
        """b in F = b Omega^2, N/rpm^2: four rotors at `hover_speed` carry the weight, b = m g / (4 hover_speed^2).

        A reading of a damaged text: Table 2 has m g / 5000^2 in the copy at hand, which would hover at 2500 rpm, but
        Table 5 starts from 5000 rpm "for hovering".
        """
        return self.mass * self.gravity / (4.0 * self.hover_speed**2)

    @property
    def rotor_speeds(self) -> tuple[float, float]:
        """The speeds, rpm, that hold a rotor's thrust at its limits: none turns slower or faster."""
        low, high = (math.sqrt(limit / self.thrust_coefficient) for limit in (self.thrust_min, self.thrust_max))
        return low, high

    def reachable(self, speed: Tensor) -> Tensor:
        """Commanded rotor speeds, rpm, cut off at those that a rotor can turn at."""
        return speed.clamp(*self.rotor_speeds)

    def allocation(self, like: Tensor) -> Tensor:
        """T (3, 4): body torques of the four thrusts, X configuration."""
        h, k = self.arm / math.sqrt(2.0), self.rotor_torque
        return like.new_tensor([[h, -h, -h, h], [-h, -h, h, h], [k, -k, k, -k]])

    def angular_acceleration(self, w: Tensor, F: Tensor, speed: Tensor | None = None) -> Tensor:
        """w' = J^-1 (T F - w x (J w) - D w + r e3), (..., 3), with D = diag(0, 0, k_a).

        r = J_r (Omega1' - Omega2' + Omega3' - Omega4') is what rotors that speed up react with, for commanded speeds in
        rpm; 0 where none are given.
        """
        J = w.new_tensor(self.inertia)
        torque = _apply(self.allocation(w), F) - torch.linalg.cross(w, _apply(J, w))
        drag = torch.stack((torch.zeros_like(w[..., 2]), torch.zeros_like(w[..., 2]), w[..., 2]), dim=-1)
        torque = torque - self.rotational_drag * drag
        if speed is not None and self.rotor_inertia > 0:
            turning = (F.clamp(min=torch.finfo(F.dtype).tiny) / self.thrust_coefficient).sqrt()
            spins = self.rotor_inertia * RADIANS / self.rotor_time_constant * w.new_tensor(ROTOR_SPINS)
            none = torch.zeros_like(spins)
            torque = torque + _apply(torch.stack((none, none, spins)), speed - turning)
        return _apply(torch.linalg.inv(J), torque)

    def thrust_rate(self, F: Tensor, speed: Tensor) -> Tensor:
        """F' = 2/T_r sqrt(F) (sqrt(b) u - sqrt(F)) for commanded rotor speeds u in rpm, (..., 4)."""
        root = F.clamp(min=torch.finfo(F.dtype).tiny).sqrt()  # the root of 0 has no derivative
        return 2.0 / self.rotor_time_constant * root * (math.sqrt(self.thrust_coefficient) * speed - root)


def _as_rows(inertia: Any) -> Any:
    """Lists, as files have them, in place of tuples; anything else as it is, for the check."""
    return (
        tuple(tuple(row) if isinstance(row, list) else row for row in inertia) if isinstance(inertia, list) else inertia
    )


def _is_inertia(a: Triple, b: Triple, c: Triple) -> bool:
    """Whether the matrix with these rows is symmetric and positive definite: its leading minors are above 0."""
    minor = a[0] * b[1] - a[1] * b[0]
    # By hand: a first use of PyTorch's linear algebra here would come before `import torchgco` has set it up.
    whole = c[0] * (a[1] * b[2] - a[2] * b[1]) - c[1] * (a[0] * b[2] - a[2] * b[0]) + c[2] * minor
    return (a[1], a[2], b[2]) == (b[0], c[0], c[1]) and min(a[0], minor, whole) > 0


def _apply(A: Tensor, x: Tensor) -> Tensor:
    """A x for a small constant matrix, as products and sums: bits then don't depend on the batch size."""
    return (A * x.unsqueeze(-2)).sum(-1)


@dataclass(frozen=True)
class QuadrotorPlanning(Dynamics, named="quadrotor"):
    """Planning model: x = [p (m), v (m/s), q, w (rad/s), a (m/s^2)], u = [w_c, a_c], n = 14, m = 4 (section 5.2).

        p' = v,  v' = a R(q) e3 - g e3,  q' = 1/2 Qx(w) q,  w' = (w_c - w)/T_w,  a' = (a_c - a)/T_a

    q isn't renormalised, as in the paper's planner, but where the time is free. The time constants may be tensors (B,).
    Of the airframe the model takes g and its drag, - drag v / m in v', and its mass and limits of thrust for
    `control_limits`; a mission takes all of it, for the vehicle that follows the plans.

    Raises:
        InputError: a field out of its range or of another kind.
    """

    dt: Seconds = 0.05
    integrator: Integrator = "euler"
    rate_time_constant: Seconds | Tensor = 1.5  # T_w, s
    thrust_time_constant: Seconds | Tensor = 1.5  # T_a, s
    airframe: Airframe = Airframe()

    n: ClassVar[int] = 14
    m: ClassVar[int] = 4
    position: ClassVar[slice] = slice(0, 3)
    state_names: ClassVar[Texts] = (*POSE, "a")
    state_units: ClassVar[Texts] = (*POSE_UNITS, "m/s^2")
    control_names: ClassVar[Texts] = ("wx command", "wy command", "wz command", "a command")
    control_units: ClassVar[Texts] = ("rad/s", "rad/s", "rad/s", "m/s^2")
    per_element: ClassVar[tuple[str, ...]] = ("rate_time_constant", "thrust_time_constant")

    @property
    def control_limits(self) -> tuple[Limits, Limits]:
        """The least and greatest controls that the vehicle can follow, None where there is no limit."""
        low, high = self.airframe.accelerations
        return (None, None, None, low), (None, None, None, high)

    def derived(self, x: Tensor, u: Tensor) -> dict[str, Tensor]:
        """The joint thrust of the rotors, m a."""
        return {"thrust [N]": self.airframe.mass * x[..., 13]}

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        states, controls = components(x), components(u)
        v, q, w, a = states[3:6], states[6:10], states[10:13], states[13]
        T_w, T_a = (lead(T, a) for T in (self.rate_time_constant, self.thrust_time_constant))
        turning = ((w_c - w_i) / T_w for w_c, w_i in zip(controls[:3], w, strict=True))
        return vectors(*self.airframe.pose_rates(v, q, w, a), *turning, (controls[3] - a) / T_a)

    def settled(self, x: Tensor) -> Tensor:
        return with_unit_quaternion(x)


@dataclass(frozen=True)
class QuadrotorPlant(Dynamics, named="plant"):
    """Full quadrotor: x = [p, v, q, w, F (N)], u = commanded rotor speeds (rpm), n = 17, m = 4 (section 2).

    A step ends by limiting the thrusts to [f_min, f_max] and renormalising the quaternion. Derivatives include both:
    beyond a limit, the derivative of that thrust is zero.

    Raises:
        InputError: a field out of its range or of another kind.
    """

    dt: Seconds = 0.01
    integrator: Integrator = "rk4"
    airframe: Airframe = Airframe()

    n: ClassVar[int] = 17
    m: ClassVar[int] = 4
    position: ClassVar[slice] = slice(0, 3)
    state_names: ClassVar[Texts] = (*POSE, *THRUSTS)
    state_units: ClassVar[Texts] = (*POSE_UNITS, *["N"] * 4)
    control_names: ClassVar[Texts] = ROTORS
    control_units: ClassVar[Texts] = ("rpm",) * 4

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        _, v, q, w, F = x.split((3, 3, 4, 3, 4), dim=-1)
        lift = F.sum(-1) / self.airframe.mass
        pose = self.airframe.pose_rates(components(v), components(q), components(w), lift)
        rates = self.airframe.angular_acceleration(w, F, u), self.airframe.thrust_rate(F, u)
        return torch.cat((vectors(*pose), *rates), dim=-1)

    stretches: ClassVar[bool] = True  # type: ignore[misc]

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        return within_limits(super().step(x, u), self.airframe)

    def settled(self, x: Tensor) -> Tensor:
        return within_limits(x, self.airframe)


def within_limits(x: Tensor, airframe: Airframe) -> Tensor:
    """States (..., 17) with thrusts limited to [f_min, f_max] and a renormalised quaternion."""
    F = x[..., 13:].clamp(airframe.thrust_min, airframe.thrust_max)
    return torch.cat((with_unit_quaternion(x[..., :13]), F), dim=-1)


def with_unit_quaternion(x: Tensor) -> Tensor:
    """States (..., n) whose components 6 to 9 are a quaternion, with that divided by its norm."""
    q = x[..., 6:10]
    return torch.cat((x[..., :6], q / q.square().sum(-1, keepdim=True).sqrt(), x[..., 10:]), dim=-1)


@dataclass(frozen=True)
class RotorTracking(Dynamics, named="rotors"):
    """Tracking model: x = [w (rad/s), F (N)], u = rotor speeds (rpm), n = 7, m = 4 (section 5.2, Table 5).

    Raises:
        InputError: a field out of its range or of another kind.
    """

    dt: Seconds = 0.01
    integrator: Integrator = "euler"
    airframe: Airframe = Airframe()

    n: ClassVar[int] = 7
    m: ClassVar[int] = 4
    state_names: ClassVar[Texts] = ("wx", "wy", "wz", *THRUSTS)
    state_units: ClassVar[Texts] = (*["rad/s"] * 3, *["N"] * 4)
    control_names: ClassVar[Texts] = ROTORS
    control_units: ClassVar[Texts] = ("rpm",) * 4

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        w, F = x[..., :3], x[..., 3:]
        return torch.cat((self.airframe.angular_acceleration(w, F, u), self.airframe.thrust_rate(F, u)), dim=-1)


@dataclass(frozen=True)
class QuadrotorThrusts(Dynamics, named="quadrotor"):
    """x = [p (m), v (m/s), q, w (rad/s)], u = [F_1, ..., F_4] (N), n = 13, m = 4: `QuadrotorPlant` with instant rotors.

        p' = v,  v' = sum(F) / m R(q) e3 / |q|^2 - g e3,  q' = 1/2 Qx(w) q,  w' = J^-1 (T F - w x (J w) - D w)

    q isn't renormalised; the thrust's axis is a unit vector whatever its norm.

    Raises:
        InputError: a field out of its range or of another kind.
    """

    dt: Seconds = 0.05
    integrator: Integrator = "rk4"
    airframe: Airframe = Airframe()

    n: ClassVar[int] = 13
    m: ClassVar[int] = 4
    position: ClassVar[slice] = slice(0, 3)
    state_names: ClassVar[Texts] = POSE
    state_units: ClassVar[Texts] = POSE_UNITS
    control_names: ClassVar[Texts] = THRUSTS
    control_units: ClassVar[Texts] = ("N",) * 4

    @property
    def control_limits(self) -> tuple[Limits, Limits]:
        """The least and the greatest thrust of each rotor, N."""
        return (self.airframe.thrust_min,) * 4, (self.airframe.thrust_max,) * 4

    def derived(self, x: Tensor, u: Tensor) -> dict[str, Tensor]:
        """The joint thrust of the rotors."""
        return {"thrust [N]": u.sum(-1)}

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        _, v, q, w = x.split((3, 3, 4, 3), dim=-1)
        lift = u.sum(-1) / self.airframe.mass / q.square().sum(-1)
        pose = self.airframe.pose_rates(components(v), components(q), components(w), lift)
        return torch.cat((vectors(*pose), self.airframe.angular_acceleration(w, u)), dim=-1)
