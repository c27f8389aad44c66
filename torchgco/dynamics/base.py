"""Dynamics: a discrete step and its derivatives, for any leading batch axes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from torchgco.autodiff import jacobian
from torchgco.dynamics.integrators import INTEGRATORS
from torchgco.shapes import InputError, PerElement


class Dynamics(PerElement):
    """x_{k+1} = step(x_k, u_k) on (..., n), (..., m).

    Subclass it with `n`, `m` and either `step`, or `field` with the attributes `dt` (s) and `integrator`
    ("euler", "midpoint" or "rk4"). Derivatives come from `torch.func` unless the model brings `field_jacobians`.
    `position` says which states are the position in metres that obstacles are compared with, or is None.
    """

    n: int
    m: int
    dt: float
    integrator: str = "euler"
    position: slice | None = None

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        """Time derivative of x, (..., n)."""
        raise NotImplementedError(f"{type(self).__name__} defines neither `step` nor `field`")

    field_jacobians: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]] | None = None

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        """The state one time step later, (..., n)."""
        return INTEGRATORS[self.integrator][0](self.field, x, u, self.dt)

    def jacobians(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Derivatives of `step`: fx (..., n, n) and fu (..., n, m)."""
        if self.field_jacobians is None:
            return self.autodiff_jacobians(x, u)
        return INTEGRATORS[self.integrator][1](self.field, self.field_jacobians, x, u, self.dt)

    def autodiff_jacobians(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """The same by `torch.func`; the analytic ones are tested against it."""
        fx, fu = jacobian(self.step, x, u)
        return fx, fu


def check_model(dynamics: Any, name: str) -> None:
    """Raise InputError unless time step and integrator of a model can be used."""
    if not dynamics.dt > 0:
        raise InputError(f"{name}.dt", "a positive time step in seconds", dynamics.dt)
    if dynamics.integrator not in INTEGRATORS:
        raise InputError(f"{name}.integrator", f"one of {sorted(INTEGRATORS)}", dynamics.integrator)


@dataclass(frozen=True)
class FunctionDynamics(Dynamics):
    """Dynamics from a function: x' = function(x, u), integrated; or the step itself with integrator="none".

    Raises:
        InputError: non-positive dt, unknown integrator.
    """

    function: Callable[[Tensor, Tensor], Tensor]
    n: int
    m: int
    dt: float
    integrator: str = "euler"
    position: slice | None = None

    def __post_init__(self) -> None:
        if self.integrator != "none":
            check_model(self, "dynamics")

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        return self.function(x, u)

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        return self.function(x, u) if self.integrator == "none" else super().step(x, u)
