"""The plant: the vehicle that flies the rotor commands, with what its planner doesn't know."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol, Self, runtime_checkable

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.options import Seconds, check_options
from torchgco.base.tree import PerElement, Rows
from torchgco.dynamics.integrators import rk4
from torchgco.dynamics.quadrotor import GRAVITY, Airframe, pose_rates, within_limits


@runtime_checkable
class Plant(Protocol):
    """A simulated vehicle, B of them side by side: states x (B, 17) = [p (m), v (m/s), q, w (rad/s), F (N)]."""

    @property
    def dt(self) -> float:
        """Time step, s."""
        ...

    def take(self, index: Rows) -> Self:
        """The vehicles in `index`."""
        ...

    def advance(self, x: Tensor, u: Tensor, force: Tensor) -> Tensor:
        """The states one step of dt later, for rotor speeds u (B, 4), rpm, and a force of the wind (B, 3), N."""
        ...


@dataclass(frozen=True)
class RotorPlant(PerElement):
    """The paper's full quadrotor (section 2), Runge-Kutta steps with limited thrusts and a renormalised quaternion.

    Args:
        airframe: as the planner knows it.
        mass_error, thrust_error: share by which mass and thrust coefficient differ from the airframe's, number or (B,).
        drag: force against the velocity, N s/m, a number or (B,).

    Raises:
        InputError: non-positive dt, a mass or thrust coefficient that isn't above 0, a negative drag, a parameter that
            is neither a finite number nor (B,).
    """

    airframe: Airframe = Airframe()
    dt: Seconds = 0.01
    mass_error: float | Tensor = 0.0
    thrust_error: float | Tensor = 0.0
    drag: float | Tensor = 0.0

    per_element: ClassVar[tuple[str, ...]] = ("mass_error", "thrust_error", "drag")

    def __post_init__(self) -> None:
        check_options(self, "plant")
        check_vehicle(self.mass_error, self.thrust_error, self.drag)

    def advance(self, x: Tensor, u: Tensor, force: Tensor) -> Tensor:
        """See `Plant`."""
        return within_limits(rk4(lambda at: self._rates(at, u, force), x, self.dt), self.airframe)

    def _rates(self, x: Tensor, u: Tensor, force: Tensor) -> Tensor:
        _, v, q, w, F = x.split((3, 3, 4, 3, 4), dim=-1)
        mass = self.airframe.mass * (1.0 + self.mass_error)
        motion = pose_rates(v.unbind(-1), q.unbind(-1), w.unbind(-1), F.sum(-1) / mass, GRAVITY)
        pose = torch.stack(motion, dim=-1)
        pushed = (force - _column(self.drag) * v) / _column(mass)
        pose = torch.cat((pose[..., :3], pose[..., 3:6] + pushed, pose[..., 6:]), dim=-1)
        speed = (1.0 + _column(self.thrust_error)) ** 0.5 * u
        return torch.cat((pose, self.airframe.angular_acceleration(w, F), self.airframe.thrust_rate(F, speed)), dim=-1)


def check_vehicle(mass_error: float | Tensor, thrust_error: float | Tensor, drag: float | Tensor) -> None:
    """Check the ranges of the fields that plants have in common; see `RotorPlant`.

    Raises:
        InputError: a mass or thrust coefficient that isn't above 0, a negative drag, a parameter that is neither a
            finite number nor (B,).
    """
    shares = {"mass_error": mass_error, "thrust_error": thrust_error}
    for name, value in {**shares, "drag": drag}.items():
        values = torch.as_tensor(value)
        if values.is_complex() or values.dim() > 1 or not bool(torch.isfinite(values).all()):
            raise InputError(f"plant.{name}", "a finite number or a tensor (B,) of such", value)
        if name in shares and not bool((values > -1.0).all()):
            raise InputError(f"plant.{name}", "a share above -1", value)
    if not bool((torch.as_tensor(drag) >= 0).all()):
        raise InputError("plant.drag", "at least 0 N s/m", drag)


def _column(value: float | Tensor) -> float | Tensor:
    return value.unsqueeze(-1) if isinstance(value, Tensor) and value.dim() == 1 else value


def hovering(airframe: Airframe, position: Tensor) -> Tensor:
    """States (B, 17) at rest, upright, with the thrusts that carry the weight, from positions (B, 3), m."""
    x = position.new_zeros(position.shape[0], 17)
    x[:, :3] = position
    x[:, 6] = 1.0
    x[:, 13:] = airframe.mass * GRAVITY / 4.0
    return x
