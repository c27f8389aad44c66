"""The planar vehicle of Appendix A."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchgco.dynamics.base import Dynamics, check_model
from torchgco.shapes import lead


@dataclass(frozen=True)
class Planar(Dynamics):
    """Planar vehicle: x = [p (2, m), theta (rad), p' (2, m/s), theta' (rad/s)], u = [a_left, a_right] (m/s^2).

        p''     = -k1 p' + k2 [cos theta, sin theta] (a_left + a_right)
        theta'' = -k3 theta' + k4 (-a_left + a_right)                                   (Appendix A, Table A2)

    The coefficients may be tensors (B,), one value per problem.

    Raises:
        InputError: non-positive dt, unknown integrator.
    """

    dt: float = 0.05
    integrator: str = "euler"
    drag: float | Tensor = 10.0  # k1, 1/s
    thrust_gain: float | Tensor = 1.0  # k2
    turn_drag: float | Tensor = 0.001  # k3, 1/s
    turn_gain: float | Tensor = 0.10  # k4, rad/m

    n: ClassVar[int] = 6
    m: ClassVar[int] = 2
    position: ClassVar[slice] = slice(0, 2)
    per_element: ClassVar[tuple[str, ...]] = ("drag", "thrust_gain", "turn_drag", "turn_gain")

    def __post_init__(self) -> None:
        check_model(self, "planar")

    def rates(self, x: Sequence[Tensor], u: Sequence[Tensor]) -> tuple[Tensor, ...]:
        theta = x[2].contiguous()  # strided and contiguous cosines may differ in the last bit
        k1, k2, k3, k4 = self._coefficients(theta)
        push = k2 * (u[0] + u[1])
        return (
            x[3],
            x[4],
            x[5],
            push * torch.cos(theta) - k1 * x[3],
            push * torch.sin(theta) - k1 * x[4],
            k4 * (u[1] - u[0]) - k3 * x[5],
        )

    def field_jacobians(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        theta = x[..., 2].contiguous()
        k1, k2, k3, k4 = self._coefficients(theta)
        cos, sin = torch.cos(theta), torch.sin(theta)
        push = k2 * (u[..., 0] + u[..., 1])
        ax = x.new_zeros(*x.shape[:-1], 6, 6)
        ax[..., 0, 3] = ax[..., 1, 4] = ax[..., 2, 5] = 1.0
        ax[..., 3, 2] = -push * sin
        ax[..., 4, 2] = push * cos
        ax[..., 3, 3] = ax[..., 4, 4] = -k1
        ax[..., 5, 5] = -k3
        au = x.new_zeros(*x.shape[:-1], 6, 2)
        au[..., 3, 0] = au[..., 3, 1] = k2 * cos
        au[..., 4, 0] = au[..., 4, 1] = k2 * sin
        au[..., 5, 0] = -k4
        au[..., 5, 1] = k4
        return ax, au

    def _coefficients(self, component: Tensor) -> tuple[Tensor | float, ...]:
        return tuple(lead(k, component) for k in (self.drag, self.thrust_gain, self.turn_drag, self.turn_gain))
