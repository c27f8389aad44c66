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
    reads_fields_alone: ClassVar[bool] = True
    position: ClassVar[slice] = slice(0, 2)
    per_element: ClassVar[tuple[str, ...]] = ("drag", "thrust_gain", "turn_drag", "turn_gain")
    sparsity: ClassVar[tuple[tuple[int, int], ...]] = (
        (0, 3), (1, 4), (2, 5), (3, 2), (4, 2), (3, 3), (4, 4), (5, 5), (3, 6), (3, 7), (4, 6), (4, 7), (5, 6), (5, 7),
    )  # fmt: skip

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

    def field_entries(self, x: Tensor, u: Tensor) -> Tensor:
        theta = x[..., 2].contiguous()
        one = torch.ones_like(theta)
        k1, k2, k3, k4 = (one * k for k in self._coefficients(theta))
        along, across = k2 * torch.cos(theta), k2 * torch.sin(theta)
        thrust = u[..., 0] + u[..., 1]
        entries = (
            one, one, one, -thrust * across, thrust * along, -k1, -k1, -k3,
            along, along, across, across, -k4, k4,
        )  # fmt: skip
        return torch.stack(entries, dim=-1)

    def _coefficients(self, component: Tensor) -> tuple[Tensor | float, ...]:
        return tuple(lead(k, component) for k in (self.drag, self.thrust_gain, self.turn_drag, self.turn_gain))
