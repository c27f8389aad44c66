"""Equalities of the quadrotor's planning problem."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.options import Above, Seconds, check_options
from torchgco.base.shapes import Dimensions, check_shape, check_tensor, tensor
from torchgco.constraints.base import Constraint, Sense
from torchgco.dynamics.quadrotor import Airframe


@dataclass(frozen=True)
class FirstStepRates(Constraint):
    """The body rates at knot 1 are those that the rotors' thrusts at x_0 produce (section 5.2.1):

        0 = w(t1) - w(t0) - J^-1 (T F(t0) - w x (J w) - D w) T_s,   at knot 1, with w = w(t0) of x_0.

    Args:
        thrusts: F(t0), (4,) or (B, 4), N.
        period: T_s, s.
        airframe: the quadrotor's parameters.
        reachable: lowest and highest w(t1) of the planning model, (B, 3) each, rad/s; where the rotors lead outside,
            the nearest reachable rates are asked for. None: as printed, which no plan may be able to meet.

    Raises:
        InputError: on `Problem(...)`: wrong shapes, dynamics without the planning model's 14 states.
    """

    thrusts: Any
    period: Seconds = 0.05
    airframe: Airframe = Airframe()
    reachable: tuple[Tensor, Tensor] | None = None
    target: Tensor | None = None  # (B, 3): w(t1), once bound

    knots: ClassVar[slice] = slice(1, 2)
    sense: ClassVar[Sense] = "equality"
    batched: ClassVar[tuple[str, ...]] = ("thrusts", "reachable", "target")
    rates: ClassVar[slice] = slice(10, 13)

    def bind(self, dims: Dimensions) -> Self:
        check_options(self, "first_step")
        if dims.n != 14:
            raise InputError("first_step.dynamics", "the planning model with 14 states", f"{dims.n} states")
        thrusts = tensor(self.thrusts, "first_step.thrusts", dims.like)
        thrusts = thrusts.expand(dims.B, 4) if thrusts.dim() == 1 else thrusts
        check_shape(thrusts, (dims.B, 4), "first_step.thrusts")
        w0 = dims.like[:, self.rates]
        target = w0 + self.period * self.airframe.angular_acceleration(w0, thrusts)
        if self.reachable is not None:
            lower, upper = self.reachable
            for bound in self.reachable:
                check_shape(bound, (dims.B, 3), "first_step.reachable")
                check_tensor(bound, "first_step.reachable", dims.like)
            target = torch.minimum(torch.maximum(target, lower), upper)
        return replace(self, thrusts=thrusts.contiguous(), target=target)

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        assert self.target is not None
        return (X[:, 1, self.rates] - self.target).unsqueeze(1)

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        n = X.shape[-1]
        H[:, 1, self.rates, n] += g[:, 0]
        H[:, 1, n, self.rates] += g[:, 0]
        H[:, 1, self.rates, self.rates] += torch.diag_embed(h[:, 0])


@dataclass(frozen=True)
class ThrustSum(Constraint):
    """The rotors' joint thrust follows the plan (section 5.2.1): 0 = sum_i F_i - m a_ref at knots 1..N.

    Args:
        acceleration: a_ref (B, N), m/s^2, at knots 1..N.
        mass: m, kg.

    Raises:
        InputError: on `Problem(...)`: wrong shape, dynamics without the tracking model's 7 states.
    """

    acceleration: Tensor
    mass: Annotated[float, Above(0, "kg")]
    thrust: Tensor | None = None  # (B, N): m a_ref, N, once bound

    knots: Any = None
    sense: ClassVar[Sense] = "equality"
    batched: ClassVar[tuple[str, ...]] = ("acceleration", "thrust")

    def bind(self, dims: Dimensions) -> Self:
        check_options(self, "thrust_sum")
        if dims.n != 7:
            raise InputError("thrust_sum.dynamics", "the tracking model with 7 states", f"{dims.n} states")
        check_shape(self.acceleration, (dims.B, dims.N), "thrust_sum.acceleration")
        check_tensor(self.acceleration, "thrust_sum.acceleration", dims.like)
        return replace(self, knots=slice(1, dims.N + 1), thrust=self.mass * self.acceleration)

    def toward(self, acceleration: Tensor) -> None:
        """Write another a_ref (B, N), m/s^2, into a bound part's own tensors, unchecked."""
        assert self.thrust is not None
        self.acceleration.copy_(acceleration)
        torch.mul(acceleration, self.mass, out=self.thrust)

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        assert self.thrust is not None
        return (X[:, self.knots, 3:].sum(-1) - self.thrust).unsqueeze(-1)

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        n = X.shape[-1]
        H[:, self.knots, 3:n, n] += g
        H[:, self.knots, n, 3:n] += g
        H[:, self.knots, 3:n, 3:n] += h.unsqueeze(-1)


@dataclass(frozen=True)
class RotorLimits(Constraint):
    """Commanded speeds are those that rotors can turn at: rows s (u - u_max), s (u_min - u) at knots 0..N-1.

    In newtons, as the other rows of the tracking problem: s = 2 b Omega_h is the change of thrust by speed at hover.
    Thrusts that start within their limits then stay there.

    Args:
        airframe: the quadrotor's parameters.

    Raises:
        InputError: on `Problem(...)`: dynamics without the tracking model's 4 rotors.
    """

    airframe: Airframe = Airframe()

    knots: Any = None
    batched: ClassVar[tuple[str, ...]] = ()

    def bind(self, dims: Dimensions) -> Self:
        if dims.n != 7:
            raise InputError("rotor_limits.dynamics", "the tracking model with 7 states", f"{dims.n} states")
        return replace(self, knots=slice(0, dims.N))

    @property
    def scale(self) -> float:
        """N per rpm."""
        return 2.0 * self.airframe.thrust_coefficient * self.airframe.hover_speed

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        slowest, fastest = self.airframe.rotor_speeds
        return self.scale * torch.cat((U - fastest, slowest - U), dim=-1)

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        n, inputs = X.shape[-1], slice(X.shape[-1] + 1, X.shape[-1] + 5)
        gradient = self.scale * (g[..., :4] - g[..., 4:])
        H[:, self.knots, inputs, n] += gradient
        H[:, self.knots, n, inputs] += gradient
        H[:, self.knots, inputs, inputs].diagonal(dim1=-2, dim2=-1).add_(self.scale**2 * (h[..., :4] + h[..., 4:]))
