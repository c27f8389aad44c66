"""A point mass in the plane: a vehicle that accelerates in every direction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from torchgco.base.options import Seconds
from torchgco.base.shapes import components, vectors
from torchgco.dynamics.base import Dynamics
from torchgco.dynamics.integrators import Integrator


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
