"""Integrals over time as constraints (isoperimetric constraints, budgets): a quadrature by the model's own steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.options import check_options
from torchgco.base.shapes import Dimensions, check_finite, per_row
from torchgco.base.values import Values, asks_for_knot, bound_values
from torchgco.constraints.base import Constraint
from torchgco.constraints.carried import Carried, Carrying
from torchgco.constraints.link import CarriedRows
from torchgco.dynamics.integrators import INTEGRATORS

# Rows (..., p) of integrals (..., 1), by the limits that there are.
ROWS: dict[tuple[str, ...], Callable[..., Tensor]] = {
    ("most",): lambda integral, most: integral - most,
    ("least",): lambda integral, least: least - integral,
    ("most", "least"): lambda integral, most, least: torch.cat((integral - most, least - integral), dim=-1),
    ("equals",): lambda integral, equals: integral - equals,
}
LIMITS = "most", "least", "equals"


@dataclass(frozen=True)
class Integral(Constraint):
    """least <= the integral of function(x, u) over time <= most, or = equals; derivatives by `torch.func`.

        effort = Integral(lambda x, u: u.square().sum(-1), most=3.0)  # a budget
        length = Integral(lambda x, u: (1 + u[..., 0] ** 2).sqrt(), equals=2.5)  # isoperimetric

    From knot 0 to the last one, of each problem its own. A stage is integrated with the states by the model's own
    integrator, or where the model makes whole steps counts dt times the value at its knot. Solvers see the integral up
    to each knot as a further state after all others, as do callbacks and solvers of your own; problem and solution have
    the problem's own states. Judge and certificate integrate along the states themselves. Compiled problems and
    exported C don't take it.

    Args:
        function: of x (..., n), u (..., m), a number for each, (...), per second. It may take k, the stage.
        most, least, equals: the limits, a number or one per problem (B,): most, least or both, or equals.
        values: numbers per problem by name, (B, ...), which the function takes as arguments of these names.
        name: in errors and explanations.

    Raises:
        InputError: on `Problem(...)`: no limit, limits that cross or aren't finite, a function that gives no number for
            each state and control, a model without a time step or with stages of several lengths.
    """

    function: Callable[..., Tensor]
    most: Any = None
    least: Any = None
    equals: Any = None
    values: Any = None
    name: str = "integral"
    model: Any = field(default=None, repr=False)  # once bound, as what follows
    running: Tensor | None = field(default=None, repr=False)  # (B, N): 1 in a problem's stages; None: everywhere
    knots: Any = field(default=None, repr=False)

    batched: ClassVar[tuple[str, ...]] = (*LIMITS, "values", "model", "running")
    calls_function: ClassVar[bool] = True
    joins_knots: ClassVar[bool] = True
    of: ClassVar[str] = "x"

    sense = property(lambda self: "inequality" if self.equals is None else "equality")  # type: ignore[assignment]

    def bind(self, dims: Dimensions) -> Self:
        check_options(self, self.name if isinstance(self.name, str) else "integral")
        if not callable(self.function):
            raise InputError(f"{self.name}.function", "a function of a state and a control", shown(self.function))
        if self._given not in ROWS:
            raise InputError(self.name, "most, least or both; or equals", " and ".join(self._given) or "none of them")
        limits = {name: per_row(getattr(self, name), f"{self.name}.{name}", dims) for name in self._given}
        for name, limit in limits.items():
            check_finite(limit, f"{self.name}.{name}")
        if len(limits) == 2 and not bool((limits["least"] < limits["most"]).all()):
            raise InputError(f"{self.name}.least", "below most; equals= for one value", "limits that meet or cross")
        names = getattr(getattr(dims.model, "values", None), "knot_names", ())
        if dims.dt is None or (not dims.model.stretches and "dt" in names):
            got = "none" if dims.dt is None else "stages of several lengths"
            raise InputError("dynamics.dt", f"a time step, over which {self.name} is integrated", got)
        values = bound_values(self.values, None, (self.function,), dims, self.name)
        running = None
        if dims.horizon is not None:
            running = (torch.arange(dims.N, device=dims.like.device) < dims.horizon.unsqueeze(-1)).to(dims.like)
        last = slice(dims.N, dims.N + 1)
        return replace(self, **limits, values=values, model=dims.model, running=running, knots=last)

    @property
    def _given(self) -> tuple[str, ...]:
        return tuple(name for name in LIMITS if getattr(self, name) is not None)

    @property
    def _summed(self) -> _Summed:
        return _Summed(self.function, self.values, self.running, self.name)

    def _limits(self) -> Values:
        return Values(self._given, tuple(getattr(self, name).unsqueeze(-1) for name in self._given))

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        model = self.model.at(torch.arange(U.shape[1], device=U.device))
        integral = self._summed.along(torch.zeros_like(X[:, 0, :1]), X, U, model)[:, -1:]
        return self._limits().call(ROWS[self._given], integral)

    def told(self, row: int, knot: int, dynamics: Any) -> str:
        return f"the integral, {self._given[row]}"

    def ending(self, horizon: Tensor, N: int, counts: Tensor, where: str) -> Constraint:
        return self

    def carries(self, x0: Tensor, N: int) -> Carried:
        """The integral up to each knot."""
        return Carried(torch.zeros_like(x0[:, :1]), self._summed)

    def with_carried(self, first: int) -> Constraint:
        limits = self._limits()
        rows, state = ROWS[self._given], torch.tensor([first], device=limits.rows[0].device)
        return CarriedRows(rows, self.sense, self.knots, name=self.name, values=limits, places=(state,))


@dataclass(frozen=True)
class _Summed(Carrying):
    """A further state: the integral of a function over time up to a knot."""

    function: Callable[..., Tensor]
    values: Values
    running: Tensor | None
    name: str

    batched: ClassVar[tuple[str, ...]] = ("values", "running")

    by_stage = property(  # type: ignore[assignment]
        lambda self: self.running is not None or asks_for_knot(self.function)
    )

    def __len__(self) -> int:
        return 1

    def after(
        self, x: Tensor, u: Tensor, carried: Tensor, k: int | Tensor | None, model: Any, pace: Tensor | None = None
    ) -> Tensor:
        more = self._over(x, u, k, model, pace)
        if self.running is None:
            return carried + more
        runs = self.running[:, k]
        runs = runs.unsqueeze(-1) if x.dim() == 3 and isinstance(k, int) else runs  # samples of one stage
        return carried + runs.unsqueeze(-1) * more

    def along(self, start: Tensor, X: Tensor, U: Tensor, model: Any, pace: Tensor | None = None) -> Tensor:
        k = torch.arange(U.shape[1], device=U.device)
        more = self.after(X[:, :-1], U, torch.zeros_like(X[:, :-1, :1]), k, model, pace)
        return start.unsqueeze(1) + torch.nn.functional.pad(more.cumsum(1), (0, 0, 1, 0))

    def _over(self, x: Tensor, u: Tensor, k: int | Tensor | None, model: Any, pace: Tensor | None) -> Tensor:
        """The integral over the stage, (..., 1)."""
        if not model.stretches:
            return model.dt * self._rate(x, u, k)
        n = x.shape[-1]

        def rates(z: Tensor) -> Tensor:
            state = z[..., :n] if pace is None else model.settled(z[..., :n])
            both = torch.cat((model.field(state, u), self._rate(state, u, k)), dim=-1)
            return both if pace is None else pace * both

        return INTEGRATORS[model.integrator](rates, torch.cat((x, torch.zeros_like(x[..., :1])), -1), model.dt)[..., n:]

    def _rate(self, x: Tensor, u: Tensor, k: int | Tensor | None) -> Tensor:
        rate = self.values.call(self.function, x, u, k=k)
        if not isinstance(rate, Tensor) or rate.shape != x.shape[:-1]:
            got = tuple(rate.shape) if isinstance(rate, Tensor) else shown(rate)
            raise InputError(f"{self.name}.function", f"a number for each, {tuple(x.shape[:-1])}", got)
        return rate.unsqueeze(-1)
