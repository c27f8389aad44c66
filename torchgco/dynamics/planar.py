"""The planar vehicle of Appendix A."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchgco.base.options import Seconds
from torchgco.base.shapes import components, lead, vectors
from torchgco.dynamics.base import Dynamics
from torchgco.dynamics.integrators import Integrator


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
        k1, k2, k3, k4 = (lead(k, theta) for k in (self.drag, self.thrust_gain, self.turn_drag, self.turn_gain))
        push = k2 * (left + right)
        return vectors(
            vx,
            vy,
            turning,
            push * torch.cos(theta) - k1 * vx,
            push * torch.sin(theta) - k1 * vy,
            k4 * (right - left) - k3 * turning,
        )
