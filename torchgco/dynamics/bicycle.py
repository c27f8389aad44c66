"""The kinematic bicycle: a car that is steered by the rate of its front wheels' angle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from torchgco.base.options import Above, Seconds
from torchgco.base.shapes import components, vectors
from torchgco.dynamics.base import Dynamics
from torchgco.dynamics.integrators import Integrator


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
