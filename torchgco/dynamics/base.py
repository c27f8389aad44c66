"""Dynamics: a discrete step and its derivatives, for any leading batch axes, and integrators from rates to steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as hidden
from math import sqrt
from typing import Any, ClassVar, Literal, Self

import torch
from torch import Tensor

from torchgco.base.autodiff import jacobian
from torchgco.base.errors import InputError
from torchgco.base.options import Checked, Count, Natural, Seconds
from torchgco.base.roots import root
from torchgco.base.shapes import Dimensions, repeated
from torchgco.base.tree import PerElement, is_users, passed_on
from torchgco.base.values import NO_VALUES, Knot, Values, bound_values, taken_by

Rates = Callable[[Tensor], Tensor]
Integrator = Literal["euler", "midpoint", "rk4", "implicit_euler", "radau3", "radau5"]


def euler(rates: Rates, x: Tensor, dt: float) -> Tensor:
    return torch.add(x, rates(x), alpha=dt)


def midpoint(rates: Rates, x: Tensor, dt: float) -> Tensor:
    return torch.add(x, rates(torch.add(x, rates(x), alpha=0.5 * dt)), alpha=dt)


def rk4(rates: Rates, x: Tensor, dt: float) -> Tensor:
    k1 = rates(x)
    k2 = rates(torch.add(x, k1, alpha=0.5 * dt))
    k3 = rates(torch.add(x, k2, alpha=0.5 * dt))
    k4 = rates(torch.add(x, k3, alpha=dt))
    return torch.add(x, k1 + 2.0 * k2 + 2.0 * k3 + k4, alpha=dt / 6.0)


def implicit(weights: Sequence[Sequence[float]]) -> Callable[[Rates, Tensor, float], Tensor]:
    """A Radau IIA method of s stages with these weights (s, s), whose last stage is the next knot: Hairer and Wanner,
    Solving Ordinary Differential Equations II, section IV.5.

    The states at the stages are the root, from x itself, of x_i - x - dt sum_j a_ij rates(x_j); NaN where Newton's
    method finds none.
    """

    def step(rates: Rates, x: Tensor, dt: float) -> Tensor:
        def residual(stages: Tensor) -> Tensor:
            each = stages.chunk(len(weights), dim=-1)
            slopes = [rates(stage) for stage in each]
            ways = (sum(w * slope for w, slope in zip(row, slopes, strict=True)) for row in weights)
            return torch.cat([stage - torch.add(x, way, alpha=dt) for stage, way in zip(each, ways, strict=True)], -1)

        return root(residual, torch.cat([x] * len(weights), -1))[..., -x.shape[-1] :]

    return step


_R = sqrt(6.0)
IMPLICIT = {
    "implicit_euler": implicit([[1.0]]),
    "radau3": implicit([[5.0 / 12.0, -1.0 / 12.0], [3.0 / 4.0, 1.0 / 4.0]]),
    "radau5": implicit(
        [
            [(88.0 - 7.0 * _R) / 360.0, (296.0 - 169.0 * _R) / 1800.0, (-2.0 + 3.0 * _R) / 225.0],
            [(296.0 + 169.0 * _R) / 1800.0, (88.0 + 7.0 * _R) / 360.0, (-2.0 - 3.0 * _R) / 225.0],
            [(16.0 - _R) / 36.0, (16.0 + _R) / 36.0, 1.0 / 9.0],
        ]
    ),
}
INTEGRATORS = {"euler": euler, "midpoint": midpoint, "rk4": rk4} | IMPLICIT


class Dynamics(PerElement, Checked):
    """x_{k+1} = step(x_k, u_k) on (..., n), (..., m).

    A model is a subclass with the numbers `n` and `m`, and one method: `field(x, u)`, the time derivative of x, with
    the attributes `dt` (s) and `integrator` ("euler", "midpoint" or "rk4", and for stiff fields "implicit_euler",
    "radau3" or "radau5"); or `step(x, u)` itself.

        class Car(Dynamics):
            n, m, dt, integrator, position = 4, 2, 0.05, "midpoint", slice(0, 2)

            def field(self, x, u):
                (_, _, angle, speed), (force, turn) = x.unbind(-1), u.unbind(-1)
                return torch.stack((speed * angle.cos(), speed * angle.sin(), turn, force), dim=-1)

    Derivatives and native kernels are made from this method. `position` says which states are the position in metres
    that obstacles are compared with, or is None. A parameter that may be a tensor (B,), one value per problem, is named
    in `per_element` and shaped by `shapes.lead`. Dynamics that depend on the knot override `at`. `state_names`,
    `state_units`, `control_names` and `control_units`, a text for each state or control, are what figures, tables of
    trajectories and `explain` call them.
    """

    n: int
    m: int
    dt: float
    integrator: str = "euler"
    position: slice | None = None
    state_names: Sequence[str] = ()
    state_units: Sequence[str] = ()
    control_names: Sequence[str] = ()
    control_units: Sequence[str] = ()

    @property
    def is_integrated(self) -> bool:
        """Whether `step` integrates `field`."""
        return type(self).step is Dynamics.step

    @property
    def stretches(self) -> bool:
        """Whether a stage may be longer or shorter than dt, as in a problem with free time: `field` is all there is.

        A class with a `step` of its own that integrates `field` and then calls `settled` says so, too.
        """
        return self.is_integrated

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        """Time derivative of x, (..., n)."""
        raise NotImplementedError(f"{type(self).__name__} defines neither `step` nor `field`")

    def settled(self, x: Tensor) -> Tensor:
        """States (..., n) as they must be wherever `field` is asked in a problem with free time, by default x itself.

        A model with a quaternion divides it by its norm here: a longer stage lets the norm grow, and with it whatever
        is proportional to its square, such as thrust.
        """
        return x

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        """The state one time step later, (..., n)."""
        return INTEGRATORS[self.integrator](lambda x: self.field(x, u), x, self.dt)

    def at(self, k: int | Tensor) -> Self:
        """The model of stage k, or of stages k (K,), which are then the second axis of x (B, K, n).

        Solvers call `dynamics.at(k).step(x, u)`. Most models are the same at every stage: this one.
        """
        return self

    def at_rest(self, x0: Tensor, N: int) -> Tensor:
        """States (B, N+1, n) that stay at the start x0 (B, n), by which the scale of a cost is told."""
        return repeated(x0, N + 1)

    def bind(self, dims: Dimensions) -> Self:
        """The model checked and shaped for one problem; called once, by Problem."""
        return self

    def derived(self, x: Tensor, u: Tensor) -> dict[str, Tensor]:
        """Further quantities (...) that exported trajectories have beside states and controls, by label with unit."""
        return {}

    def jacobians(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Derivatives of `step` by `torch.func`: fx (..., n, n) and fu (..., n, m)."""
        fx, fu = jacobian(self.step, x, u)
        return fx, fu


@dataclass(frozen=True)
class WrappedDynamics(Dynamics):
    """A model with sizes, time step and position of another one, in a form of the problem with other steps.

    Its `field` is that of the other one's states between two knots, which come first, and 0 of the further ones.
    """

    model: Dynamics

    n, m, dt, position, integrator, stretches = passed_on(
        "model", "n", "m", "dt", "position", "integrator", "stretches"
    )
    calls_function = property(lambda self: is_users(self.model))

    def at_rest(self, x0: Tensor, N: int) -> Tensor:
        n = self.model.n
        return torch.cat((self.model.at_rest(x0[:, :n], N), repeated(x0[:, n:], N + 1)), dim=-1)

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        rates = self.model.field(x[..., : self.model.n], u)
        return torch.nn.functional.pad(rates, (0, self.n - self.model.n))


@dataclass(frozen=True)
class FunctionDynamics(Dynamics, named="dynamics"):
    """Dynamics from function(x, u) on (..., n), (..., m): the derivative x', or with integrator="none" the next state.

        drag = torch.tensor([0.2, 0.5]).double()  # of two problems
        boat = FunctionDynamics(field, n=4, m=2, dt=0.1, values={"drag": drag})  # calls field(x, u, drag=...)

    The function may take an argument k (without a default): the number of the stage, or the numbers (K,) of the stages
    of x (B, K, n).

    With algebraic equations 0 = g(x, z, u) of index 1, `algebraic` of them for as many algebraic states z, the function
    is function(x, z, u) -> (x', g):

        rod = FunctionDynamics(pulled, n=4, m=1, dt=0.05, integrator="radau5", algebraic=1)  # z: the force in the rod

    Args:
        dt: s, the same for all stages. Stages of different length: integrator="none", a function that makes a whole
            step, and its lengths in `knot_values`, named "dt" for `Solution.t`; obstacles that move then still count in
            steps of dt.
        values: numbers per problem by name, (B, ...), which the function takes as arguments of these names, shaped to
            fit x: (B, ...), or (B, 1, ...) where x has an axis of knots or samples. Numbers that change from solve to
            solve belong here, or in captured tensors: with another captured Python number the code is compiled again.
        knot_values: the same per stage, (B|1, N, ...); the function sees the rows of its stages, (B, ...), (B, K, ...)
            or (B, 1, ...).
        algebraic: number of algebraic states. Newton's method seeks them from 0; the step is NaN where it finds none.
        state_names, state_units, control_names, control_units: see `Dynamics`.

    Raises:
        InputError: a field out of its range or of another kind; on `Problem(...)`: values of another shape or that the
            function doesn't take; `step` or `field` of dynamics that depend on the stage without `at`.
    """

    function: Callable[..., Tensor]
    n: Count
    m: Count
    dt: Seconds
    integrator: Integrator | Literal["none"] = "euler"
    position: slice | None = None
    values: Any = None
    knot_values: Any = None
    k: Any = hidden(default=None, repr=False)  # the stage or the stages (K,), set by `at`
    algebraic: Natural = hidden(default=0, kw_only=True)
    state_names: Sequence[str] = hidden(default=(), kw_only=True)
    state_units: Sequence[str] = hidden(default=(), kw_only=True)
    control_names: Sequence[str] = hidden(default=(), kw_only=True)
    control_units: Sequence[str] = hidden(default=(), kw_only=True)

    batched: ClassVar[tuple[str, ...]] = ("values",)
    calls_function: ClassVar[bool] = True

    def bind(self, dims: Dimensions) -> Self:
        if self.algebraic and not self.is_integrated:
            raise InputError("dynamics.integrator", "an integrator, for algebraic states", "none")
        values = bound_values(self.values, self.knot_values, (self.function,), dims, "dynamics", knots=dims.N)
        return replace(self, values=values)

    def at(self, k: Knot) -> Self:
        return replace(self, k=k) if self._depends_on_stage else self

    @property
    def _depends_on_stage(self) -> bool:
        return taken_by(self.function).knot or (isinstance(self.values, Values) and bool(self.values.knot_names))

    @property
    def is_integrated(self) -> bool:
        return self.integrator != "none"

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        return self._equations(x, self.algebraic_states(x, u), u)[0] if self.algebraic else self._called(x, u)

    def algebraic_states(self, x: Tensor, u: Tensor) -> Tensor:
        """The algebraic states z (..., q) at states x (..., n) with controls u (..., m): where g(x, z, u) = 0."""
        if not self.algebraic:
            raise InputError("dynamics.algebraic", "at least 1, for algebraic states", 0)
        guess = x.new_zeros(*x.shape[:-1], self.algebraic)
        return root(lambda z: self._equations(x, z, u)[1], guess)

    def _equations(self, x: Tensor, z: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """x' and g."""
        values = self._called(x, z, u)
        shapes = [tuple(value.shape) for value in values] if isinstance(values, tuple) else type(values).__name__
        expected = [(*x.shape[:-1], size) for size in (self.n, self.algebraic)]
        if shapes != expected:
            raise InputError("dynamics.function", f"x' and g of shapes {expected[0]} and {expected[1]}", shapes)
        return values

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        return super().step(x, u) if self.is_integrated else self._called(x, u)

    def _called(self, x: Tensor, *more: Tensor) -> Any:
        if self.k is None and self._depends_on_stage:
            raise InputError("dynamics", "a stage, as in `dynamics.at(k).step(x, u)`", "none")
        return (self.values or NO_VALUES).call(self.function, x, *more, k=self.k)
