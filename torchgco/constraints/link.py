"""Rows that join the states of two knots: periodic and linked boundaries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.options import check_options
from torchgco.base.shapes import Dimensions
from torchgco.base.values import bound_values
from torchgco.constraints.base import Constraint, FunctionConstraint, Sense, whole
from torchgco.constraints.carried import Carried, Taken
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
