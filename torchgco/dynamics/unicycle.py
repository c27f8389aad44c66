"""The unicycle: a vehicle that drives along its heading and turns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchgco.base.options import Seconds
from torchgco.base.shapes import components, vectors
from torchgco.dynamics.base import Dynamics
from torchgco.dynamics.integrators import Integrator


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
