"""A quadrotor whose controls are the thrusts of its four rotors, for plans at the limits of what it can do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchgco.base.options import Seconds
from torchgco.base.shapes import components, vectors
from torchgco.dynamics.base import Dynamics
from torchgco.dynamics.integrators import Integrator
from torchgco.dynamics.quadrotor import POSE, POSE_UNITS, THRUSTS, Airframe, Limits, Texts


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
