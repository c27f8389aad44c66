"""Rows of several knots: states of two knots joined, for periodic and linked boundaries, and integrals over time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.options import check_options
from torchgco.base.shapes import Dimensions, check_finite, per_row
from torchgco.base.values import Values, bound_values, taken_by
from torchgco.constraints.base import Constraint, FunctionConstraint, Sense, whole
from torchgco.constraints.carried import Carried, Carrying, Taken
from torchgco.dynamics.base import INTEGRATORS
from torchgco.dynamics.names import states_of


def _difference(x_i: Tensor, x_j: Tensor) -> Tensor:
    return x_i - x_j


@dataclass(frozen=True)
class Link(Constraint):
    """function(x_i, x_j) = 0, or <= 0, of the states at two knots i < j; derivatives by `torch.func`.

        lap = Link()  # x_0 = x_N: periodic, with `free_start` for what the solver chooses of x_0
        gait = Link(lambda a, b: b + a, components=[0, 2])  # the mirror image after half a period, in states 0 and 2
        later = Link(lambda a, b, gap: a + gap - b, (10, 20), "inequality", [0], {"gap": gaps})  # gaps (B, 1)

    Solvers see the components of x_i as further states after all others, as do callbacks and solvers of your own;
    solutions have the problem's own states. Judge and certificate read the two knots themselves.

    Args:
        function: maps both states (..., r) to rows (..., p), with any leading axes; None: x_i - x_j.
        knots: (i, j), the earlier one first; negative ones count from the end. With horizons per problem, N stands for
            each problem's own last knot.
        sense: "equality", or "inequality": rows <= 0.
        components: which r states both arguments consist of; None: all. Few are faster.
        values: numbers per problem by name, (B, ...), which the function takes as arguments of these names.
        name: in errors and explanations.

    Raises:
        InputError: on `Problem(...)`: knots that aren't two within 0..N in their order, components that aren't states,
            or what is wrong in a `FunctionConstraint`.
    """

    function: Callable[..., Tensor] | None = None
    knots: Any = (0, -1)
    sense: Sense = "equality"
    components: Any = None
    values: Any = None
    name: str = "link"
    earlier: int | None = None  # knot i, once bound; `knots` then are j

    batched: ClassVar[tuple[str, ...]] = ("values",)
    calls_function: ClassVar[bool] = True
    joins_knots: ClassVar[bool] = True
    of: ClassVar[str] = "x"

    def bind(self, dims: Dimensions) -> Self:
        check_options(self, self.name if isinstance(self.name, str) else "link")
        i, j = self._pair(dims.N)
        if self.function is not None and not callable(self.function):
            raise InputError(f"{self.name}.function", "a function of two states, or None", shown(self.function))
        every = torch.arange(dims.n, device=dims.like.device)
        try:
            chosen = every if self.components is None else every[self.components]
        except (IndexError, TypeError, ValueError):
            chosen = every[:0]
        if chosen.dim() != 1 or not 0 < len(chosen) == len(chosen.unique()):
            expected = f"some of the states 0..{dims.n - 1}, none twice, or None"
            raise InputError(f"{self.name}.components", expected, shown(self.components))
        function = self.function or _difference
        values = bound_values(self.values, None, (function,), dims, self.name)
        return replace(self, function=function, knots=slice(j, j + 1), components=chosen, values=values, earlier=i)

    def _pair(self, N: int) -> tuple[int, int]:
        knots = self.knots if self.earlier is None else (self.earlier, self.knots.start)
        try:
            pair = [whole(k) + (N + 1 if k < 0 else 0) for k in knots]
        except TypeError:
            pair = []
        if len(pair) != 2 or not 0 <= pair[0] < pair[1] <= N:
            raise InputError(f"{self.name}.knots", f"two of 0..{N}, the earlier one first", shown(knots))
        return pair[0], pair[1]

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        i = self.earlier
        assert i is not None and self.function is not None
        ends = (X[:, k, self.components].unsqueeze(1) for k in (i, self.knots.start))
        return self.values.call(self.function, *ends)

    def told(self, row: int, knot: int, dynamics: Any) -> str:
        if self.function is not _difference:
            return f"row {row} of the states at knots {self.earlier} and {knot}"
        component = int(self.components[row])
        named = f" ({states_of(dynamics)[component].label})" if len(dynamics.state_names) else ""
        return f"state {component}{named} at knot {self.earlier} less that at knot {knot}"

    def ending(self, horizon: Tensor, N: int, counts: Tensor, where: str) -> Constraint:
        assert self.earlier is not None
        if bool((horizon <= self.earlier).any()):
            expected = f"more than {self.earlier} stages, after which {where} begins"
            raise InputError("horizon", expected, int(horizon.min()))
        return self

    def carries(self, x0: Tensor, N: int) -> Carried:
        """The components of x_i, after stage i."""
        stages = x0.new_zeros(N, len(self.components))
        stages[self.earlier] = 1.0
        return Carried(x0[:, self.components], Taken(self.components, stages))

    def with_carried(self, first: int) -> Constraint:
        assert self.function is not None
        places = first + torch.arange(len(self.components), device=self.components.device), self.components
        return CarriedRows(self.function, self.sense, self.knots, name=self.name, values=self.values, places=places)

    def at_once(self, later: Link) -> Constraint:
        """The same rows of a state and a control that is the later state, whose components `later` has."""
        assert self.function is not None
        places = self.components, later.components
        return RowsAtOnce(self.function, self.sense, of="xu", name=self.name, values=self.values, places=places)


@dataclass(frozen=True)
class CarriedRows(FunctionConstraint):
    """Rows of one knot, some of whose states are carried ones: function of some components after others."""

    places: tuple[Tensor, ...] = ()  # of each argument which states it is, (r,) int64

    def rows_at(self, k: Tensor | int, *arguments: Tensor) -> Tensor:
        (x,) = arguments
        return self.values.call(self.function, *(x[..., components] for components in self.places))

    def with_more(self, n: int, m: int) -> Constraint:
        return self

    def in_free_time(self, n: int, m: int, later: int) -> Constraint:
        return self


@dataclass(frozen=True)
class RowsAtOnce(FunctionConstraint):
    """Rows of some components of a state, and of a control that is a state, too."""

    places: tuple[Tensor, ...] = ()  # of both which components, (r,) int64

    def rows_at(self, k: Tensor | int, *arguments: Tensor) -> Tensor:
        pairs = zip(arguments, self.places, strict=True)
        return self.values.call(self.function, *(z[..., components] for z, components in pairs))


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
    def _summed(self) -> Summed:
        return Summed(self.function, self.values, self.running, self.name)

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
class Summed(Carrying):
    """A further state: the integral of a function over time up to a knot."""

    function: Callable[..., Tensor]
    values: Values
    running: Tensor | None
    name: str

    batched: ClassVar[tuple[str, ...]] = ("values", "running")

    by_stage = property(  # type: ignore[assignment]
        lambda self: self.running is not None or taken_by(self.function).knot
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
