"""Dynamics: a discrete step and its derivatives, for any leading batch axes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchgco.autodiff import jacobian
from torchgco.dynamics.integrators import INTEGRATORS
from torchgco.shapes import InputError, PerElement


class Dynamics(PerElement):
    """x_{k+1} = step(x_k, u_k) on (..., n), (..., m).

    Subclass it with `n`, `m` and either `step`, or `field` with the attributes `dt` (s) and `integrator`
    ("euler", "midpoint" or "rk4"). Derivatives come from `torch.func` unless the model brings `field_jacobians`, or
    `field_entries` with `sparsity`: only what isn't zero, which is several times as fast for most vehicles.
    `position` says which states are the position in metres that obstacles are compared with, or is None.

    A model that brings `rates` in place of `field` is written on components, sequences of n and m tensors of one
    shape: thousands of samples then lie side by side, and sampling is several times as fast.
    """

    n: int
    m: int
    dt: float
    integrator: str = "euler"
    position: slice | None = None
    # A class that says so itself lets its traced step be kept: nothing but the dataclass's fields decides what it does.
    reads_fields_alone: ClassVar[bool]
    sparsity: tuple[tuple[int, int], ...] = ()  # (row, column) of [ax, au] (n, n+m) for each of `field_entries`

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        """Time derivative of x, (..., n)."""
        if self.rates is None:
            raise NotImplementedError(f"{type(self).__name__} defines neither `step` nor `field` nor `rates`")
        # Components stay apart in memory, which the next step reads as they are.
        return torch.stack(self.rates(x.unbind(-1), u.unbind(-1))).movedim(0, -1)

    field_jacobians: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]] | None = None
    field_entries: Callable[[Tensor, Tensor], Tensor] | None = None  # (..., e), by (..., n), (..., m)
    rates: Callable[[Sequence[Tensor], Sequence[Tensor]], tuple[Tensor, ...]] | None = None

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        """The state one time step later, (..., n)."""
        return INTEGRATORS[self.integrator][0](lambda parts: (self.field(parts[0], u),), (x,), self.dt)[0]

    def step_rows(self, x: Tensor, u: Tensor) -> Tensor:
        """The same, components first: (n, B, S) from x (n, B, S), u (m, B, S)."""
        rates = self.rates
        if rates is None:
            return self.step(x.movedim(0, -1), u.movedim(0, -1)).movedim(-1, 0)
        controls = u.unbind(0)
        return torch.stack(INTEGRATORS[self.integrator][0](lambda parts: rates(parts, controls), x.unbind(0), self.dt))

    def jacobians(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Derivatives of `step`: fx (..., n, n) and fu (..., n, m)."""
        jacobians = self.field_jacobians or (None if self.field_entries is None else self._dense)
        if jacobians is None:
            return self.autodiff_jacobians(x, u)
        return INTEGRATORS[self.integrator][1](self.field, jacobians, x, u, self.dt)

    def step_entries(self, x: Tensor, u: Tensor) -> Tensor | None:
        """[fx, fu] at the places of `sparsity`, (..., e), else the identity; None where all of it must be written."""
        # A subclass of a model may have derivatives of its own.
        own = self.field_jacobians is not None or type(self).jacobians is not Dynamics.jacobians
        if own or self.field_entries is None or self.integrator != "euler":
            return None
        stays = [float(row == column) for row, column in self.sparsity]
        return x.new_tensor(stays).add(self.field_entries(x, u), alpha=self.dt)

    def _dense(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """`field_entries` in their places, and zeros."""
        assert self.field_entries is not None
        whole = x.new_zeros(*x.shape[:-1], self.n, self.n + self.m)
        rows, columns = zip(*self.sparsity, strict=True)
        whole[..., rows, columns] = self.field_entries(x, u)
        return whole[..., : self.n], whole[..., self.n :]

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
