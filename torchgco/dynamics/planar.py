"""Vehicles in the plane: the paper's planar vehicle, a point mass, a unicycle and a car."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from torchgco.base.options import Above, Seconds
from torchgco.base.shapes import components, lead, vectors
from torchgco.dynamics.base import Dynamics, Integrator


@dataclass(frozen=True)
class Planar(Dynamics, named="planar"):
    """Planar vehicle: x = [p (2, m), theta (rad), p' (2, m/s), theta' (rad/s)], u = [a_left, a_right] (m/s^2).

        p''     = -k1 p' + k2 [cos theta, sin theta] (a_left + a_right)
        theta'' = -k3 theta' + k4 (-a_left + a_right)                                   (Appendix A, Table A2)

    The coefficients may be tensors (B,), one value per problem.

    Raises:
        InputError: a field out of its range or of another kind.
    """

    dt: Seconds = 0.05
    integrator: Integrator = "euler"
    drag: float | Tensor = 10.0  # k1, 1/s
    thrust_gain: float | Tensor = 1.0  # k2
    turn_drag: float | Tensor = 0.001  # k3, 1/s
    turn_gain: float | Tensor = 0.10  # k4, rad/m

    n: ClassVar[int] = 6
    m: ClassVar[int] = 2
    position: ClassVar[slice] = slice(0, 2)
    state_names: ClassVar[tuple[str, ...]] = ("x", "y", "heading", "vx", "vy", "turn rate")
    state_units: ClassVar[tuple[str, ...]] = ("m", "m", "rad", "m/s", "m/s", "rad/s")
    control_names: ClassVar[tuple[str, ...]] = ("left", "right")
    control_units: ClassVar[tuple[str, ...]] = ("m/s^2", "m/s^2")
    per_element: ClassVar[tuple[str, ...]] = ("drag", "thrust_gain", "turn_drag", "turn_gain")

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        _, _, theta, vx, vy, turning = components(x)
        left, right = components(u)
        given = self.drag, self.thrust_gain, self.turn_drag, self.turn_gain
        k1, k2, k3, k4 = (lead(k, theta) if isinstance(k, Tensor) else k for k in given)
        push = k2 * (left + right)
        return vectors(
            vx,
            vy,
            turning,
            push * torch.cos(theta) - k1 * vx,
            push * torch.sin(theta) - k1 * vy,
            k4 * (right - left) - k3 * turning,
        )


@dataclass(frozen=True)
class PointMass(Dynamics, named="point_mass"):
    """Point mass: x = [p (2, m), v (2, m/s)], u = acceleration (2, m/s^2).

        p' = v,  v' = u

    Raises:
        InputError: a field out of its range or of another kind.
    """

    dt: Seconds = 0.1
    integrator: Integrator = "rk4"

    n: ClassVar[int] = 4
    m: ClassVar[int] = 2
    position: ClassVar[slice] = slice(0, 2)
    state_names: ClassVar[tuple[str, ...]] = ("x", "y", "vx", "vy")
    state_units: ClassVar[tuple[str, ...]] = ("m", "m", "m/s", "m/s")
    control_names: ClassVar[tuple[str, ...]] = ("ax", "ay")
    control_units: ClassVar[tuple[str, ...]] = ("m/s^2", "m/s^2")

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        _, _, vx, vy = components(x)
        return vectors(vx, vy, *components(u))


@dataclass(frozen=True)
class Unicycle(Dynamics, named="unicycle"):
    """Unicycle: x = [p (2, m), heading (rad), speed (m/s)], u = [acceleration (m/s^2), turn rate (rad/s)].

        p' = speed [cos heading, sin heading],  heading' = turn rate,  speed' = acceleration

    A negative speed drives backwards. Bounds on acceleration and turn rate are `ControlBounds`, on speed `StateBounds`.
    The model is that of textbooks, such as LaValle, Planning Algorithms (2006), section 13.1.2, with an integrator
    before the speed.

    Raises:
        InputError: a field out of its range or of another kind.
    """

    dt: Seconds = 0.05
    integrator: Integrator = "rk4"

    n: ClassVar[int] = 4
    m: ClassVar[int] = 2
    position: ClassVar[slice] = slice(0, 2)
    state_names: ClassVar[tuple[str, ...]] = ("x", "y", "heading", "speed")
    state_units: ClassVar[tuple[str, ...]] = ("m", "m", "rad", "m/s")
    control_names: ClassVar[tuple[str, ...]] = ("acceleration", "turn rate")
    control_units: ClassVar[tuple[str, ...]] = ("m/s^2", "rad/s")

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        _, _, heading, speed = components(x)
        acceleration, turning = components(u)
        return vectors(speed * torch.cos(heading), speed * torch.sin(heading), turning, acceleration)


@dataclass(frozen=True)
class Bicycle(Dynamics, named="bicycle"):
    """Kinematic bicycle: x = [p (2, m), heading (rad), speed (m/s), steering (rad)], u = [acceleration (m/s^2),
    steering rate (rad/s)].

        p' = speed [cos heading, sin heading],  heading' = speed tan(steering) / wheelbase
        speed' = acceleration,  steering' = steering rate

    The position is that of the middle of the rear axle. A negative speed drives backwards. Bounds on steering and speed
    are `StateBounds`. The model is that of textbooks, such as LaValle, Planning Algorithms (2006), section 13.1.2.1,
    with integrators before speed and steering.

    Args:
        wheelbase: from the rear axle to the front axle, m.

    Raises:
        InputError: a field out of its range or of another kind.
    """

    dt: Seconds = 0.1
    wheelbase: Annotated[float, Above(0, "m")] = 2.6
    integrator: Integrator = "rk4"

    n: ClassVar[int] = 5
    m: ClassVar[int] = 2
    position: ClassVar[slice] = slice(0, 2)
    state_names: ClassVar[tuple[str, ...]] = ("x", "y", "heading", "speed", "steering")
    state_units: ClassVar[tuple[str, ...]] = ("m", "m", "rad", "m/s", "rad")
    control_names: ClassVar[tuple[str, ...]] = ("acceleration", "steering rate")
    control_units: ClassVar[tuple[str, ...]] = ("m/s^2", "rad/s")

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        _, _, heading, speed, steering = components(x)
        acceleration, rate = components(u)
        turning = speed * torch.tan(steering) / self.wheelbase
        return vectors(speed * torch.cos(heading), speed * torch.sin(heading), turning, acceleration, rate)
