"""Box bounds on controls and on states."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, Self

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.shapes import Dimensions, check_shape, tensor
from torchgco.constraints.base import Constraint, resolve_knots

LOOSE = 1e20  # stands for infinity in rows: a component may be bounded in one problem of a batch and free in another


@dataclass(frozen=True)
class _Bounds(Constraint):
    """lower <= z <= upper, as rows [z - upper, lower - z] of the bounded components.

    Bounds are one number for all components, (size,), per problem (B, size), or per knot (B|1, K, size) with a row for
    each of the K `knots` in their order; infinity means unbounded.

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
    of: ClassVar[Literal["x", "u"]]

    def bind(self, dims: Dimensions) -> Self:
        if self.above is not None and self.lower.dim() == 2:  # bound already; other knots may not fit another problem
            return self
        name, size = ("control_bounds", dims.m) if self.of == "u" else ("state_bounds", dims.n)
        last = dims.N - 1 if self.of == "u" else dims.N
        default = slice(0, dims.N) if self.of == "u" else slice(1, dims.N + 1)
        knots = resolve_knots(default if self.knots is None else self.knots, last, f"{name}.knots", dims.like.device)
        shape = dims.B, len(range(last + 1)[knots]) if isinstance(knots, slice) else len(knots), size
        lower = self._checked(self.lower, f"{name}.lower", shape, dims, torch.inf)
        upper = self._checked(self.upper, f"{name}.upper", shape, dims, -torch.inf)
        if lower.dim() != upper.dim():
            lower, upper = (bound if bound.dim() == 3 else bound.unsqueeze(1) for bound in (lower, upper))
        if bool((lower > upper).any()):
            raise InputError(f"{name}.lower", "at most the upper bound", f"{lower.tolist()} over {upper.tolist()}")
        above, below = (torch.isfinite(bound).flatten(0, -2).any(dim=0).nonzero().flatten() for bound in (upper, lower))
        if above.numel() + below.numel() == 0:
            raise InputError(name, "at least one finite bound", "none")
        return replace(self, lower=lower, upper=upper, knots=knots, above=_range(above), below=_range(below))

    @property
    def by_knot(self) -> tuple[Tensor, Tensor]:
        """The lower and the upper bounds with an axis of knots, (B|1, K|1, size)."""
        lower, upper = (bound if bound.dim() == 3 else bound.unsqueeze(1) for bound in (self.lower, self.upper))
        return lower, upper

    def over(self, count: int) -> tuple[Tensor, Tensor]:
        """The same of the knots 0..count-1, (B|1, count|1, size); infinite where the bounds don't hold."""
        if self.knots == slice(0, count):
            return self.by_knot
        found = []
        for bound, free in zip(self.by_knot, (-torch.inf, torch.inf), strict=True):
            found.append(bound.new_full((bound.shape[0], count, bound.shape[2]), free))
            found[-1][:, self.knots] = bound
        return found[0], found[1]

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
        bound = tensor(value, name, dims.like)
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

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        z = (U if self.of == "u" else X)[:, self.knots]
        upper, lower = self.limits()
        return torch.cat((z[..., self.above] - upper, lower - z[..., self.below]), dim=-1)

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        n, size = X.shape[-1], self.upper.shape[-1]
        at = slice(n + 1, n + 1 + size) if self.of == "u" else slice(0, n)
        gradient, diagonal = H.new_zeros(2, *g.shape[:2], size)
        split = gradient[..., self.above].shape[-1]
        gradient[..., self.above] += g[..., :split]
        gradient[..., self.below] -= g[..., split:]
        diagonal[..., self.above] += h[..., :split]
        diagonal[..., self.below] += h[..., split:]
        H[:, self.knots, at, n] += gradient
        H[:, self.knots, n, at] += gradient
        if isinstance(self.knots, slice):
            H[:, self.knots, at, at].diagonal(dim1=-2, dim2=-1).add_(diagonal)
        else:
            H[:, self.knots, at, at] += torch.diag_embed(diagonal)


def _range(components: Tensor) -> slice | Tensor:
    """Components as a slice where they are adjacent: indexing then makes a view, not a copy."""
    first, count = int(components[0]) if components.numel() else 0, components.numel()
    adjacent = components.tolist() == list(range(first, first + count))
    return slice(first, first + count) if adjacent else components


@dataclass(frozen=True)
class ControlBounds(_Bounds):
    """lower <= u_k <= upper at knots 0..N-1, in the units of u."""

    of: ClassVar[Literal["x", "u"]] = "u"


@dataclass(frozen=True)
class StateBounds(_Bounds):
    """lower <= x_k <= upper at knots 1..N (x_0 is given), in the units of x."""

    of: ClassVar[Literal["x", "u"]] = "x"
