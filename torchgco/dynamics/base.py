"""Dynamics: a discrete step and its derivatives, for any leading batch axes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal

from torch import Tensor

from torchgco.autodiff import jacobian
from torchgco.dynamics.integrators import INTEGRATORS
from torchgco.options import Count, Seconds, check_options
from torchgco.tree import PerElement


class Dynamics(PerElement):
    """x_{k+1} = step(x_k, u_k) on (..., n), (..., m).

    A model is a subclass with the numbers `n` and `m`, and one method: `field(x, u)`, the time derivative of x, with
    the attributes `dt` (s) and `integrator` ("euler", "midpoint" or "rk4"); or `step(x, u)` itself.

        class Car(Dynamics):
            n, m, dt, integrator, position = 4, 2, 0.05, "midpoint", slice(0, 2)

            def field(self, x, u):
                (_, _, angle, speed), (force, turn) = x.unbind(-1), u.unbind(-1)
                return torch.stack((speed * angle.cos(), speed * angle.sin(), turn, force), dim=-1)

    Derivatives and native kernels are made from this method. `position` says which states are the position in metres
    that obstacles are compared with, or is None. A parameter that may be a tensor (B,), one value per problem, is named
    in `per_element` and shaped by `shapes.lead`.
    """

    n: int
    m: int
    dt: float
    integrator: str = "euler"
    position: slice | None = None
    # Set in a class whose step depends on nothing but its dataclass fields: its traced step may then be cached.
    reads_fields_alone: ClassVar[bool]

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        """Time derivative of x, (..., n)."""
        raise NotImplementedError(f"{type(self).__name__} defines neither `step` nor `field`")

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        """The state one time step later, (..., n)."""
        return INTEGRATORS[self.integrator](lambda x: self.field(x, u), x, self.dt)

    def jacobians(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Derivatives of `step` by `torch.func`: fx (..., n, n) and fu (..., n, m)."""
        fx, fu = jacobian(self.step, x, u)
        return fx, fu


@dataclass(frozen=True)
class FunctionDynamics(Dynamics):
    """Dynamics from function(x, u) on (..., n), (..., m): the derivative x', or with integrator="none" the next state.

    Raises:
        InputError: a field out of its range or of another kind.
    """

    function: Callable[[Tensor, Tensor], Tensor]
    n: Count
    m: Count
    dt: Seconds
    integrator: Literal["euler", "midpoint", "rk4", "none"] = "euler"
    position: slice | None = None

    def __post_init__(self) -> None:
        check_options(self, "dynamics")

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        return self.function(x, u)

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        return self.function(x, u) if self.integrator == "none" else super().step(x, u)
