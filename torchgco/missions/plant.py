"""The plant: the vehicle that flies the rotor commands, with what its planner doesn't know."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, Self, runtime_checkable

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.options import Seconds, check_options
from torchgco.base.tree import PerElement, Rows
from torchgco.dynamics.base import rk4
from torchgco.dynamics.quadrotor import Airframe, QuadrotorPlant, within_limits


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
    """The paper's full quadrotor (`QuadrotorPlant`), with wind, and with errors of the planner's model.

    Rotors turn no slower and no faster than the airframe's limits of thrust ask for: commands beyond are cut off.

    Args:
        airframe: None, as a mission takes it from its planning model, which has no such errors; alone the paper's.
        mass_error, thrust_error: share by which mass and thrust coefficient differ from the airframe's, number or (B,).
        drag: force against the velocity beyond the airframe's own, N s/m, a number or (B,).

    Raises:
        InputError: non-positive dt, a mass or thrust coefficient that isn't above 0, a negative drag, a parameter that
            is neither a finite number nor (B,).
    """

    airframe: Airframe | None = None
    dt: Seconds = 0.01
    mass_error: float | Tensor = 0.0
    thrust_error: float | Tensor = 0.0
    drag: float | Tensor = 0.0

    per_element: ClassVar[tuple[str, ...]] = ("mass_error", "thrust_error", "drag")

    def __post_init__(self) -> None:
        check_options(self, "plant")
        check_vehicle(self.mass_error, self.thrust_error, self.drag)

    @property
    def frame(self) -> Airframe:
        """The airframe that flies."""
        return Airframe() if self.airframe is None else self.airframe

    def advance(self, x: Tensor, u: Tensor, force: Tensor) -> Tensor:
        """See `Plant`."""
        frame = self.frame
        model = QuadrotorPlant(self.dt, airframe=frame)
        mass_error, thrust_error, drag = (column(z, x) for z in (self.mass_error, self.thrust_error, self.drag))
        speed = (1.0 + thrust_error).sqrt() * frame.reachable(u)

        def rates(x: Tensor) -> Tensor:
            planned = model.field(x, speed)  # the drag of the airframe in it, too
            lift = planned[:, 3:6] + planned.new_tensor([0.0, 0.0, frame.gravity])
            push = (force - drag * x[:, 3:6]) / frame.mass
            error = (push - mass_error * lift) / (1.0 + mass_error)
            return torch.cat((planned[:, :3], planned[:, 3:6] + error, planned[:, 6:]), dim=-1)

        return within_limits(rk4(rates, x, self.dt), frame)


def flown(plant: Plant, airframe: Airframe) -> Plant:
    """The plant of a mission with this airframe, where it hasn't been given one."""
    return replace(plant, airframe=airframe) if isinstance(plant, RotorPlant) and plant.airframe is None else plant


def check_vehicle(mass_error: float | Tensor, thrust_error: float | Tensor, drag: float | Tensor) -> None:
    """Check the ranges of the fields that plants have in common; see `RotorPlant`.

    Raises:
        InputError: a mass or thrust coefficient that isn't above 0, a negative drag, a parameter that is neither a
            finite number nor (B,).
    """
    shares = {"mass_error": mass_error, "thrust_error": thrust_error}
    for name, value in {**shares, "drag": drag}.items():
        values = torch.as_tensor(value, device="cpu")
        if values.is_complex() or values.dim() > 1 or not bool(torch.isfinite(values).all()):
            raise InputError(f"plant.{name}", "a finite number or a tensor (B,) of such", value)
        if name in shares and not bool((values > -1.0).all()):
            raise InputError(f"plant.{name}", "a share above -1", value)
    if not bool((torch.as_tensor(drag, device="cpu") >= 0).all()):
        raise InputError("plant.drag", "at least 0 N s/m", drag)


def column(value: float | Tensor, like: Tensor) -> Tensor:
    """A number or (B,) as (1 or B, 1)."""
    return torch.as_tensor(value, device=like.device).to(like).reshape(-1, 1)


def hovering(airframe: Airframe, position: Tensor) -> Tensor:
    """States (B, 17) at rest, upright, with the thrusts that carry the weight, from positions (B, 3), m."""
    x = position.new_zeros(position.shape[0], 17)
    x[:, :3] = position
    x[:, 6] = 1.0
    x[:, 13:] = airframe.hover_thrust
    return x
