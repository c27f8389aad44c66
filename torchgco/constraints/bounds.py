"""Box bounds on controls and on states."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from typing import Any, ClassVar, Literal, Self

import numpy as np
import torch
from torch import Tensor, inf
from torch.nn.functional import pad

from torchgco.base.errors import InputError
from torchgco.base.numbers import Floats, Number, Wrong, crossed, finite, numbers
from torchgco.base.shapes import Dimensions, bound_of, check_finite, check_shape, tensor
from torchgco.base.tree import is_users
from torchgco.constraints.base import Constraint, FirstRowsInTime, Lowered, count_of, resolve_knots
from torchgco.constraints.carried import Carried, Taken
from torchgco.dynamics.names import controls_of, states_of

LOOSE = 1e20  # stands for infinity in rows: a component may be bounded in one problem of a batch and free in another


@dataclass(frozen=True)
class _Bounds(Constraint):
    """lower <= z <= upper, as rows [z - upper, lower - z] of the bounded components.

    Bounds are one number for all components, (size,), per problem (B, size), or per knot (B|1, K, size) with a row for
    each of the K `knots` in their order; infinity or None means unbounded.

    Raises:
        InputError: on `Problem(...)`: wrong shape, NaN, bounds crossed, nothing bounded, a lower bound of infinity or
            an upper bound of minus infinity.
    """

    lower: Any
    upper: Any
    knots: Any = None
    above: slice | Tensor | None = field(default=None, repr=False)  # components with an upper bound, once bound
    below: slice | Tensor | None = field(default=None, repr=False)

    per_element: ClassVar[tuple[str, ...]] = ("lower", "upper")
    in_place: ClassVar[bool] = True
    of: ClassVar[Literal["x", "u"]]
    label: ClassVar[str]  # in errors

    def bind(self, dims: Dimensions) -> Self:
        if self.above is not None and self.lower.dim() == 2:  # bound already; other knots may not fit another problem
            return self
        name, size, last = self.label, dims.m if self.of == "u" else dims.n, dims.N - 1 if self.of == "u" else dims.N
        knots = resolve_knots(self.knots, last, f"{name}.knots", dims.like.device, self._first_knot)
        shape = dims.B, count_of(knots, last + 1), size
        lower = self._checked(self.lower, f"{name}.lower", shape, dims, torch.inf)
        upper = self._checked(self.upper, f"{name}.upper", shape, dims, -torch.inf)
        if lower.dim() != upper.dim():
            lower, upper = (bound if bound.dim() == 3 else bound.unsqueeze(1) for bound in (lower, upper))
        if bool((lower > upper).any()):
            raise InputError(f"{name}.lower", "at most the upper bound", f"{lower.tolist()} over {upper.tolist()}")
        above, below = map(_bounded, (upper, lower))
        if count_of(above, size) + count_of(below, size) == 0:
            raise InputError(name, "at least one finite bound", "none")
        return replace(self, lower=lower, upper=upper, knots=knots, above=above, below=below)

    def numbers(self, where: str, index: int) -> list[Number]:
        fields = {side: (getattr(self, side), partial(self._check_new, side=side)) for side in ("lower", "upper")}
        joint = crossed(self, where, np.greater, "lower bounds of at most the upper ones")
        pair = numbers(where, fields, index, joint=joint)
        for number, none in zip(pair, (-np.inf, np.inf), strict=True):
            number.none = none
        return pair

    def _check_new(self, new: Floats, side: str) -> Wrong:
        sign = 1.0 if side == "lower" else -1.0
        bounded = np.zeros(self.lower.shape[-1], dtype=bool)
        bounded[self.below if side == "lower" else self.above] = True
        free = new[..., ~bounded]
        if np.isnan(new).any() or (new == sign * np.inf).any():
            return f"numbers or {-sign * np.inf}", new.tolist()
        if np.isfinite(free).any():
            expected = "infinity in components that were infinite when the problem was compiled; give them 1e9 then"
            return expected, float(free[np.isfinite(free)][0])
        return None

    def row_sizes(self, at_rest: Tensor, along: Tensor) -> Tensor:
        """Of both sides the larger one at rest, and along a trajectory their distance: none where they are equal."""
        every = torch.arange(self.upper.shape[-1], device=along.device)
        place = torch.cat((every[self.above], every[self.below])).expand_as(along)
        none = along.new_zeros(*along.shape[:2], len(every))
        rest = none.scatter_reduce(2, place, at_rest.abs().expand_as(along), "amax")
        return (
            torch.maximum(rest, none.scatter_add(2, place, along).abs()).amax(1, keepdim=True).gather(2, place[:, :1])
        )

    def told(self, row: int, knot: int, dynamics: Any) -> str:
        places = torch.arange(self.lower.shape[-1])
        above, below = (places[which].tolist() for which in (self.above, self.below))
        side, component = ("upper", above[row]) if row < len(above) else ("lower", below[row - len(above)])
        kind, of = ("control", controls_of) if self.of == "u" else ("state", states_of)
        named = getattr(dynamics, f"{kind}_names")
        return f"{side} bound of {kind} {component}{f' ({of(dynamics)[component].label})' if len(named) else ''}"

    def in_free_time(self, n: int, m: int, later: int) -> Constraint:
        if is_users(self) or self.of == "x" or later == 0:
            return super().in_free_time(n, m, later)
        sides = {side: pad(getattr(self, side), (0, 1), value=free) for side, free in (("lower", -inf), ("upper", inf))}
        return replace(self, **sides)

    def ending(self, horizon: Tensor, N: int, counts: Tensor, where: str) -> Constraint:
        lower, upper = self.by_knot
        each = counts.unsqueeze(-1) > 0
        return replace(self, lower=torch.where(each, lower, -inf), upper=torch.where(each, upper, inf))

    @property
    def _first_knot(self) -> int:
        return 0 if self.of == "u" else 1

    @property
    def by_knot(self) -> tuple[Tensor, Tensor]:
        """The lower and the upper bounds with an axis of knots, (B|1, K|1, size)."""
        lower, upper = (bound if bound.dim() == 3 else bound.unsqueeze(1) for bound in (self.lower, self.upper))
        return lower, upper

    def over(self, count: int) -> tuple[Tensor, Tensor]:
        """The same of the knots 0..count-1, (B|1, count|1, size); infinite where the bounds don't hold."""
        if self.knots == slice(0, count):
            return self.by_knot
        wide = []
        for bound, free in zip(self.by_knot, (-torch.inf, torch.inf), strict=True):
            wide.append(bound.new_full((bound.shape[0], count, bound.shape[2]), free))
            wide[-1][:, self.knots] = bound
        return wide[0], wide[1]

    @property
    def range(self) -> Tensor:
        """The distance between the bounds, (B|1, size), the largest of all knots; infinite where one is missing."""
        lower, upper = self.by_knot
        return (upper - lower).amax(1)

    def range_from(self, z: Tensor, signs: Tensor) -> Tensor:
        """Distances (B, P, size) from z (B, 1, size) to the bounds that signs (P, size) point to, at least 0.

        Of the bounds of several knots, the widest count.
        """
        lower, upper = self.by_knot
        lower, upper = lower.amin(1, keepdim=True), upper.amax(1, keepdim=True)
        return torch.where(signs > 0, upper - z, z - lower).clamp(min=0.0)

    def middle(self, z: Tensor) -> Tensor:
        """The middle of the bounds in the shape of z (B, K, size); z within them where one is missing."""
        lower, upper = self.by_knot
        return torch.where(torch.isfinite(upper - lower), 0.5 * (lower + upper), torch.clamp(z, lower, upper))

    def limits(self) -> tuple[Tensor, Tensor]:
        """The upper and the lower bounds of the rows, (B|1, K|1, rows above) and (.., rows below), as finite numbers.

        A row of minus infinity, times a multiplier of 0, would be NaN.
        """
        lower, upper = self.by_knot
        return upper[..., self.above].clamp(max=LOOSE), lower[..., self.below].clamp(min=-LOOSE)

    def _checked(self, value: Any, name: str, shape: tuple[int, int, int], dims: Dimensions, refused: float) -> Tensor:
        """A bound as (B|1, size) or (B|1, K|1, size), for the shape (B, K, size)."""
        B, K, size = shape
        bound = tensor(bound_of(value, -refused), name, dims.like)
        bound = bound.repeat(size) if bound.dim() == 0 else bound
        bound = bound.unsqueeze(0) if bound.dim() == 1 else bound
        if bound.dim() == 3:
            check_shape(bound, (*(1 if bound.shape[i] == 1 else shape[i] for i in (0, 1)), size), name)
        elif bound.shape not in ((1, size), (B, size)):
            raise InputError(name, f"shape ({B}, {size}), or per knot ({B} or 1, {K}, {size})", tuple(bound.shape))
        bad = torch.isnan(bound) | (bound == refused)
        if bool(bad.any()):
            raise InputError(name, f"numbers or {-refused}", float(bound[bad][0]))
        return bound

    def row_shape(self, N: int) -> tuple[int, int]:
        assert self.above is not None and self.below is not None
        size = self.upper.shape[-1]
        return count_of(self.knots, N + 1), count_of(self.above, size) + count_of(self.below, size)

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        z = self._bounded(X, U)
        upper, lower = self.limits()
        return torch.cat((z[..., self.above] - upper, lower - z[..., self.below]), dim=-1)

    def _bounded(self, X: Tensor, U: Tensor) -> Tensor:
        """What is bounded, (B, K, size)."""
        return (U if self.of == "u" else X)[:, self.knots]

    def _by_component(self, g: Tensor, h: Tensor) -> Tensor:
        """Sums (2, B, K, size) over the rows of each component: of g, as the rows point, and of h."""
        sums = g.new_zeros(2, *g.shape[:2], self.upper.shape[-1])
        split = sums[..., self.above].shape[-1]
        for total, rows, sign in zip(sums, (g, h), (-1.0, 1.0), strict=True):
            total[..., self.above] += rows[..., :split]
            total[..., self.below] += sign * rows[..., split:]
        return sums

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        n, size = X.shape[-1], self.upper.shape[-1]
        span = slice(n + 1, n + 1 + size) if self.of == "u" else slice(0, size)
        gradient, diagonal = self._by_component(g, h)
        H[:, self.knots, span, n] += gradient
        H[:, self.knots, n, span] += gradient
        if isinstance(self.knots, slice):
            H[:, self.knots, span, span].diagonal(dim1=-2, dim2=-1).add_(diagonal)
        else:
            H[:, self.knots, span, span] += torch.diag_embed(diagonal)


def _bounded(bound: Tensor) -> slice | Tensor:
    """The bounded components, as a slice where they are adjacent: indexing then makes a view, not a copy."""
    components = torch.isfinite(bound).flatten(0, -2).any(dim=0).nonzero().flatten()
    first, count = int(components[0]) if components.numel() else 0, components.numel()
    adjacent = components.tolist() == list(range(first, first + count))
    return slice(first, first + count) if adjacent else components


class Bounds(_Bounds):
    """Bounds on single controls or states of a knot, as `of` says."""

    @property
    def kernel(self) -> str:
        return "function" if is_users(self) else "bounds"

    def lowered(self, n: int, others: Sequence[Any] = ()) -> Lowered:
        variables = torch.arange(self.lower.shape[-1], dtype=torch.int32) + (n if self.of == "u" else 0)
        above, below = variables[self.above], variables[self.below]
        sign = torch.cat((torch.ones(above.numel()), -torch.ones(below.numel()))).double()
        upper, lower = self.limits()
        B, K = (max(upper.shape[i], lower.shape[i]) for i in (0, 1))  # one may be shared by all problems or knots
        bound = torch.cat((upper.expand(B, K, -1), lower.expand(B, K, -1)), dim=-1)
        return Lowered({"bound": bound}, plain={"variable": torch.cat((above, below)), "sign": sign})


def bounds_of(parts: Iterable[Constraint], of: Literal["x", "u"] | None = None) -> list[Bounds]:
    """The bounds among constraints, of states or controls alone where `of` says so."""
    return [bounds for bounds in parts if isinstance(bounds, Bounds) and of in (None, bounds.of)]


@dataclass(frozen=True)
class ControlBounds(Bounds):
    """lower <= u_k <= upper at knots 0..N-1, in the units of u."""

    of: ClassVar[Literal["x", "u"]] = "u"
    says_where: ClassVar[bool] = True
    label: ClassVar[str] = "control_bounds"

    def ending(self, horizon: Tensor, N: int, counts: Tensor, where: str) -> Constraint:
        return self  # controls at rest are within them


def rates_of(parts: Iterable[Constraint]) -> RateBounds | None:
    """The bounds on rates, of which a problem has one at most; None where there are none."""
    return next((rates for rates in parts if isinstance(rates, RateBounds)), None)


def joined_bounds(parts: Sequence[Bounds], N: int) -> Bounds | None:
    """The bounds of several parts, once bound, as one; the only part as it is, and None of none.

    Where they leave a control no value, its upper bound counts alone: the problem is infeasible.
    """
    if len(parts) < 2:
        return parts[0] if parts else None
    lower, upper = zip(*(bounds.over(N) for bounds in parts), strict=True)
    upper = reduce(torch.minimum, upper)
    lower = torch.minimum(reduce(torch.maximum, lower), upper)
    ends = {"above": _bounded(upper), "below": _bounded(lower)}
    return replace(parts[0], lower=lower.contiguous(), upper=upper.contiguous(), knots=slice(0, N), **ends)


@dataclass(frozen=True)
class StateBounds(Bounds):
    """lower <= x_k <= upper at knots 1..N (x_0 is given), in the units of x."""

    of: ClassVar[Literal["x", "u"]] = "x"
    label: ClassVar[str] = "state_bounds"


@dataclass(frozen=True)
class RateBounds(_Bounds):
    """lower <= u_k - u_{k-1} <= upper at knots 1..N-1, and at knot 0 where `previous` says what came before.

        gentle = RateBounds(-0.1, 0.1, previous=[0.0, 9.81])  # of two controls, by at most 0.1 a step

    Bounds are of the change from one stage to the next, in the units of u: an actuator's limit per second times dt.
    Solvers see the bounded controls of the stage before as further states, last in x: so does a callback, and a solver
    of your own. Solutions have the problem's own states. A problem has one RateBounds at most.

    Args:
        lower, upper: as for other bounds; without a lower one, say, controls may fall at any rate.
        knots: of u_k, within 1..N-1, or 0..N-1 with `previous`.
        previous: u_{-1}, one number for all controls, (m,) or (B, m); None: u_0 is free.

    Raises:
        InputError: on `Problem(...)`: as other bounds; a `previous` of another shape or not finite, knot 0 without it.
    """

    joins_knots: ClassVar[bool] = True
    previous: Any = None
    states: Tensor | None = field(default=None, repr=False)  # (m,) int64: where x has each u_{k-1}, in a solver
    share: float = field(default=1.0, repr=False)  # of what it allows at knot 0, in a loop of periods below a stage

    per_element: ClassVar[tuple[str, ...]] = ("lower", "upper", "previous")
    of: ClassVar[Literal["x", "u"]] = "u"
    label: ClassVar[str] = "rate_bounds"

    def bind(self, dims: Dimensions) -> Self:
        if self.previous is None:
            if dims.N < 2:
                raise InputError("rate_bounds", "two stages at least, or the controls `previous`", f"N = {dims.N}")
            bound = super().bind(dims)
            if bound.holds_at(0):
                raise InputError("rate_bounds.knots", "knots from 1 on, or the controls `previous`", "knot 0")
            return bound
        previous = tensor(self.previous, "rate_bounds.previous", dims.like)
        previous = previous.expand(1, dims.m) if previous.dim() == 0 else previous
        previous = previous.unsqueeze(0) if previous.dim() == 1 else previous
        check_shape(previous, (1 if previous.shape[0] == 1 else dims.B, dims.m), "rate_bounds.previous")
        check_finite(previous, "rate_bounds.previous")
        return super(RateBounds, replace(self, previous=previous)).bind(dims)

    @property
    def _first_knot(self) -> int:
        return 1 if self.previous is None else 0

    @property
    def controls(self) -> Tensor:
        """Which controls are bounded, (r,) int64."""
        every = torch.arange(self.upper.shape[-1], device=self.upper.device)
        return torch.cat((every[self.above], every[self.below])).unique()

    @property
    def before(self) -> Tensor:
        """The bounded controls of the stage before the first, (B|1, r), in a solver: 0 where they are free."""
        every = self.upper.new_zeros(1, self.upper.shape[-1]) if self.previous is None else self.previous
        return every[:, self.controls]

    def with_more(self, n: int, m: int) -> Constraint:
        return self

    def in_free_time(self, n: int, m: int, later: int) -> Constraint:
        return RatesInTime(self, n, m)

    def carries(self, x0: Tensor, N: int) -> Carried:
        """The bounded controls of the stage before."""
        return Carried(self.before, Taken(x0.shape[-1] + self.controls))

    def with_carried(self, first: int) -> Self:
        states = torch.zeros(self.upper.shape[-1], dtype=torch.int64, device=self.upper.device)
        states[self.controls] = first + torch.arange(len(self.controls), device=states.device)
        return replace(self, states=states)

    def _bounded(self, X: Tensor, U: Tensor) -> Tensor:
        if self.states is not None:
            return (U - X[:, :-1, self.states])[:, self.knots]
        first = U[:, :1] if self.previous is None else self.previous.unsqueeze(1).expand(U.shape[0], 1, -1)
        return (U - torch.cat((first, U[:, :-1]), dim=1))[:, self.knots]

    def numbers(self, where: str, index: int) -> list[Number]:
        before = [] if self.previous is None else numbers(where, {"previous": (self.previous, finite)}, index)
        return super().numbers(where, index) + before

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        if self.states is None:
            raise NotImplementedError("rows of two knots have no block; solvers take `with_carried`")
        n, controls = X.shape[-1], self.controls
        x, u = self.states[controls], n + 1 + controls
        gradient, diagonal = self._by_component(g, h)[..., controls]
        add = H.new_zeros(*g.shape[:2], *H.shape[2:])
        for i, sign in ((u, 1.0), (x, -1.0)):
            add[..., i, n] = add[..., n, i] = sign * gradient
            add[..., i, i] = diagonal
        add[..., u, x] = add[..., x, u] = -diagonal
        H[:, self.knots] += add


@dataclass(frozen=True)
class RatesInTime(FirstRowsInTime):
    """Bounds on changes of controls from stage to stage, which grow with the length of the stage: tau times these."""

    constraint: RateBounds

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        rates, tau = self.constraint, X[:, self.constraint.knots, self.n : self.n + 1]
        z = (U[..., : self.m] - X[:, : U.shape[1], rates.states])[:, rates.knots]
        upper, lower = rates.limits()
        return torch.cat((z[..., rates.above] - tau * upper, tau * lower - z[..., rates.below]), dim=-1)

    def violation(self, X: Tensor, U: Tensor) -> Tensor:
        return self.value(X, U).clamp(min=0.0)

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        rates, n = self.constraint, X.shape[-1]
        upper, lower = rates.limits()
        every, before = torch.arange(self.m, device=H.device), rates.states
        assert before is not None
        J = H.new_zeros(*torch.broadcast_shapes(upper.shape[:2], g.shape[:2]), g.shape[-1], H.shape[-1])
        first = 0
        for which, limit, sign in ((rates.above, upper, 1.0), (rates.below, lower, -1.0)):
            controls = every[which]
            rows = first + torch.arange(len(controls), device=H.device)
            J[..., rows, n + 1 + controls], J[..., rows, before[controls]] = sign, -sign
            J[..., rows, self.n] = -sign * limit
            first += len(controls)
        slope = (g.unsqueeze(-2) @ J).squeeze(-2)
        add = (h.unsqueeze(-1) * J).mT @ J
        add[..., n, :] += slope
        add[..., :, n] += slope
        H[:, rates.knots] += add
