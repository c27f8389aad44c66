"""Gates that a trajectory passes in their order: balls, or squares that are crossed in one direction."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.numbers import Number, above_zero, directions, finite, numbers
from torchgco.base.shapes import Dimensions, per_row, space_of, tensor
from torchgco.constraints.base import ADMITTED, NO_ROW, Constraint, whole
from torchgco.constraints.norms import NormBounds, Vectors

# How far, m, a square's plane lies behind and ahead of the knots between which it is crossed: a trajectory that is
# feasible within the tolerance is still that tolerance away on each side, so that none can stand in the plane.
ROOM = 2.0 * ADMITTED


@dataclass(frozen=True)
class Gates(Constraint):
    """The position passes each gate, in their order, at a knot of its own.

        rings = Gates([[2.0, 0, 1], [4, 1, 1]], radius=0.3)
        frames = Gates([[2.0, 0, 1], [4, 1, 1]], normals=[[1.0, 0, 0], [0, 1, 0]], half_widths=0.2)

    A ball is a row |p - center| <= radius at its knot. A square is crossed from behind to ahead of its normal between
    its knot and the next: at both the position is inside the prism over the square, 2 mm behind the plane at the first
    and 2 mm ahead of it at the second, so that the straight line between them crosses the square itself. The knots
    before and after these, unless they are another gate's or beyond 1..N, are 6 mm behind and ahead: as far as at a
    constant speed. The search for paths leads through the gates leg by leg.

    Args:
        centers: (G, d), or (B, G, d) one row of gates per problem, m.
        radius: of balls, m: a number, (G,) or (B, G). None where there are squares.
        normals: of squares, (G, d) or (B, G, d), of any length above 0. In space two sides of a square are level, or
            parallel to the y axis where it lies flat.
        half_widths: of squares, m, as `radius`: half the length of a side.
        knots: (G,) or (B, G) whole numbers that rise, within 1..N; of squares they rise by 2, to N - 1. None: by arc
            length along the straight lines from the start through all gates to the goal, or to the last gate where none
            is known, slowly at both ends.

    Raises:
        InputError: on `Problem(...)`: no position, shapes that don't fit, numbers that aren't finite, sizes of 0 or
            less, neither balls nor squares or both, more gates than knots, two gates at one knot, knots in another
            order or beyond a horizon.
    """

    centers: Any
    radius: Any = None
    normals: Any = None
    half_widths: Any = None
    knots: Any = None

    def bind(self, dims: Dimensions) -> GateBalls | GateSquares:  # type: ignore[override]
        d = space_of(dims, "gates")
        centers = _each(self.centers, "gates.centers", dims, (d,))
        G = centers.shape[1]
        if (self.radius is None) == (self.normals is None):
            got = "none" if self.normals is None else "both"
            raise InputError("gates.radius", "a radius, or normals and half_widths", got)
        if (self.normals is None) != (self.half_widths is None):
            raise InputError("gates.half_widths", "half widths where there are normals", shown(self.half_widths))
        gap = 1 if self.normals is None else 2
        last = dims.N + 1 - gap
        ends = torch.full((dims.B,), last, device="cpu") if dims.horizon is None else dims.horizon.cpu() + 1 - gap
        if bool((1 + gap * (G - 1) > ends).any()):
            raise InputError("gates.centers", f"at most {(int(ends.min()) - 1) // gap + 1} gates in N = {dims.N}", G)
        knots = self.knots
        places = _by_length(centers, dims, gap, ends) if knots is None else _given(knots, dims, G, gap, ends)
        position = list(range(dims.n))[dims.position]  # type: ignore[index]
        if self.normals is None:
            radius = _sizes(self.radius, "gates.radius", dims, G)
            return _balls(position, centers, radius, places, dims)
        normals = _each(self.normals, "gates.normals", dims, (d,), G)
        if not bool((normals.norm(dim=-1) > 0).all()):
            raise InputError("gates.normals", "vectors other than 0", normals.tolist())
        half = _sizes(self.half_widths, "gates.half_widths", dims, G)
        components = torch.tensor(position, device=centers.device)
        return GateSquares(centers, _axes(normals), half, places, components=components).bind(dims)


@dataclass(frozen=True)
class GateBalls(NormBounds):
    """Gates that are balls, bound: at the other knots from 1 to N there is no bound."""

    places: Tensor = field(kw_only=True)  # (B, G) int64: their knots

    # Never shared by all problems: a batch of one that is repeated has as many rows of each as any other.
    batched: ClassVar[tuple[str, ...]] = ("upper", "center", "places")
    per_element: ClassVar[tuple[str, ...]] = ()
    name: ClassVar[str] = "gates"
    label: ClassVar[str] = "gates"
    on_its_way: ClassVar[bool] = True
    in_metres: ClassVar[bool] = True  # type: ignore[misc]
    says_where: ClassVar[bool] = True

    @property
    def centers(self) -> Tensor:
        """(B, G, d), m."""
        return self.center.gather(1, (self.places - 1).unsqueeze(-1).expand(-1, -1, self.center.shape[-1]))

    @property
    def sizes(self) -> Tensor:
        """Their radii (B, G), m."""
        return self.upper.gather(1, self.places - 1)

    def told(self, row: int, knot: int, dynamics: Any) -> str:
        return f"the radius of gate {int((self.places[0] == knot).nonzero()[0]) + 1}"

    def numbers(self, where: str, index: int) -> list[Number]:
        """Of gates, which keep their knots."""
        centers, radii = self.centers, self.sizes
        fields = {"centers": (centers, finite), "radius": (radii, above_zero)}
        return numbers("gates", fields, index, after=lambda: self.write(centers, radii))

    def on_the_way(self, X: Tensor) -> Tensor:
        return X[..., self.components].unsqueeze(-2)

    def write(self, centers: Tensor, sizes: Tensor) -> None:
        """Put other gates (B, G, d) of other radii (B, G) in the places of these, in this memory."""
        self.center.scatter_(1, (self.places - 1).unsqueeze(-1).expand_as(centers), centers)
        self.upper.scatter_(1, self.places - 1, sizes)


@dataclass(frozen=True)
class GateSquares(Vectors):
    """Gates that are squares, bound: rows A p - b <= 0, per knot those behind a plane, or ahead of one."""

    centers: Tensor  # (B, G, d), m
    axes: Tensor  # (B, G, d, d): normal, then the directions of the sides, as rows
    half_widths: Tensor  # (B, G), m
    places: Tensor  # (B, G) int64: the knots before the planes
    slopes: Tensor = field(default=None, repr=False)  # type: ignore[assignment]  # (B, N, p, d), once bound
    limits: Tensor = field(default=None, repr=False)  # type: ignore[assignment]  # (B, N, p)
    knots: Any = None

    batched: ClassVar[tuple[str, ...]] = ("centers", "axes", "half_widths", "places", "slopes", "limits")
    of: ClassVar[str] = "x"
    name: ClassVar[str] = "gates"
    on_its_way: ClassVar[bool] = True
    in_metres: ClassVar[bool] = True  # type: ignore[misc]
    says_where: ClassVar[bool] = True

    @property
    def sizes(self) -> Tensor:
        return self.half_widths

    def bind(self, dims: Dimensions) -> Self:
        B, _, d = self.centers.shape
        slopes = self.centers.new_zeros(B, dims.N, 2 * d - 1, d)
        limits = torch.full_like(slopes[..., 0], -NO_ROW)  # 0 - 1: no row
        bound = replace(self, slopes=slopes, limits=limits, knots=slice(1, dims.N + 1))
        bound.write()
        return bound

    def told(self, row: int, knot: int, dynamics: Any) -> str:
        off = knot - self.places[0]
        gate = (off == 0) | (off == 1)
        what = "side" if row > 0 and bool(gate.any()) else "plane"
        gate = gate if bool(gate.any()) else off == (2 if row > 0 else -1)
        return f"the {what} of gate {int(gate.nonzero()[0]) + 1}"

    def numbers(self, where: str, index: int) -> list[Number]:
        normals = self.axes[:, :, 0].clone()
        fields = {"centers": (self.centers, finite), "half_widths": (self.half_widths, above_zero)}
        fresh = numbers("gates", fields, index, after=self.write)
        return fresh + numbers("gates", {"normals": (normals, directions)}, index, after=lambda: self.write(normals))

    def write(self, normals: Tensor | None = None) -> None:
        """Make the rows of the centres and half widths as they are, and of other normals (B, G, d), in this memory."""
        if normals is not None:
            self.axes.copy_(_axes(normals))
        (B, G, _), p, half = self.centers.shape, self.slopes.shape[2], self.half_widths.unsqueeze(-1)
        normal, sides = self.axes[:, :, :1], self.axes[:, :, 1:]
        each = torch.arange(B, device=self.centers.device).unsqueeze(-1)
        for ahead, sign in ((0, 1.0), (1, -1.0)):
            rows = torch.cat((sign * normal, sides, -sides), dim=2)  # (B, G, p, d)
            room = torch.cat((torch.full_like(half, -ROOM), half.expand(B, G, p - 1)), dim=-1)
            limits = room + (rows @ self.centers.unsqueeze(-1))[..., 0]
            index = each, self.places - 1 + ahead
            self.slopes[index], self.limits[index] = rows, limits
            b, g, k = self._beside(ahead)
            # A knot may lie after one gate and before the next: its rows of the two are different ones.
            self.slopes[b, k - 1, ahead], self.limits[b, k - 1, ahead] = rows[b, g, 0], limits[b, g, 0] - 2.0 * ROOM

    def _beside(self, ahead: int) -> tuple[Tensor, Tensor, Tensor]:
        """The gates, each as b and g, with a knot k behind or ahead of theirs that is no gate's own."""
        N = self.slopes.shape[1]
        taken = torch.zeros(len(self.places), N + 2, dtype=torch.bool, device=self.places.device)
        taken[:, 0] = taken[:, N + 1] = True
        for shift in (0, 1):
            taken.scatter_(1, self.places + shift, True)
        knots = self.places + (2 if ahead else -1)
        b, g = (~taken.gather(1, knots)).nonzero(as_tuple=True)
        return b, g, knots[b, g]

    def on_the_way(self, X: Tensor) -> Tensor:
        return X[..., self.components].unsqueeze(-2)

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return (self.slopes * self._vectors(X, U).unsqueeze(-2)).sum(-1) - self.limits

    def _slopes(self, X: Tensor, U: Tensor) -> Tensor:
        return self.slopes


def _balls(position: list[int], centers: Tensor, radius: Tensor, places: Tensor, dims: Dimensions) -> GateBalls:
    """Balls as bounds on norms, with a centre and a radius at their own knots; an infinite one elsewhere."""
    each = torch.arange(dims.B, device=centers.device).unsqueeze(-1)
    middles = centers.new_zeros(dims.B, dims.N, centers.shape[-1])
    upper = centers.new_full((dims.B, dims.N), torch.inf)
    middles[each, places - 1], upper[each, places - 1] = centers, radius
    return GateBalls(("x", position), None, upper, slice(1, dims.N + 1), middles, places=places).bind(dims)


def _axes(normals: Tensor) -> Tensor:
    """Unit normals, then the directions of the sides, as rows (B, G, d, d), for normals (B, G, d)."""
    n = normals / normals.norm(dim=-1, keepdim=True)
    if n.shape[-1] == 2:
        return torch.stack((n, torch.stack((-n[..., 1], n[..., 0]), dim=-1)), dim=-2)
    flat = n[..., :2].norm(dim=-1, keepdim=True) < 1e-6
    z, y = torch.zeros_like(n), torch.zeros_like(n)
    z[..., 2], y[..., 1] = 1.0, 1.0
    level = torch.where(flat, y, torch.linalg.cross(z, n, dim=-1))
    level = level / level.norm(dim=-1, keepdim=True)
    return torch.stack((n, level, torch.linalg.cross(n, level, dim=-1)), dim=-2)


def _each(value: Any, name: str, dims: Dimensions, size: tuple[int, ...], G: int | None = None) -> Tensor:
    """Vectors (B, G, d): given so, or as (G, d) for all problems."""
    vectors = per_row(value, name, dims, "G" if G is None else G, *size)
    if vectors.shape[1] == 0 or not bool(torch.isfinite(vectors).all()):
        raise InputError(name, "one gate at least, of finite numbers", vectors.tolist())
    return vectors.contiguous()


def _sizes(value: Any, name: str, dims: Dimensions, G: int) -> Tensor:
    """Lengths (B, G), m: given as one, (G,) or (B, G)."""
    lengths = tensor(value, name, dims.like)
    if lengths.dim() > 2 or (lengths.dim() > 0 and tuple(lengths.shape) not in ((G,), (dims.B, G))):
        raise InputError(name, f"a number, shape ({G},) or ({dims.B}, {G})", tuple(lengths.shape))
    if not bool((torch.isfinite(lengths) & (lengths > 0)).all()):
        raise InputError(name, "finite numbers above 0 m", lengths.tolist())
    return lengths.expand(dims.B, G).contiguous()


def has_gates(problem: Any) -> bool:
    """Whether gates are among a problem's constraints, whose knots count from its start: a loop would put them off."""
    return gates_of(problem) is not None


def gates_of(problem: Any) -> GateBalls | GateSquares | None:
    """The first gates that a trajectory has to pass; None where there are none."""
    bare = (constraint.bare for constraint in problem.constraints)
    return next((gates for gates in bare if isinstance(gates, GateBalls | GateSquares)), None)


def _given(knots: Any, dims: Dimensions, G: int, gap: int, ends: Tensor) -> Tensor:
    """Knots (B, G), given so or as (G,)."""
    name, expected = "gates.knots", f"{G} whole numbers, or {dims.B} rows of them"
    try:
        rows = knots if len(knots) and hasattr(knots[0], "__len__") else [knots] * dims.B
        places = torch.tensor([[whole(k) for k in row] for row in rows], device="cpu")
    except (TypeError, ValueError):
        raise InputError(name, expected, shown(knots)) from None
    if tuple(places.shape) != (dims.B, G):
        raise InputError(name, expected, f"shape {tuple(places.shape)}")
    if bool((places.diff(dim=1) < gap).any()):
        rise = "knots that rise: no two gates at one" if gap == 1 else "knots that rise by 2 at least"
        raise InputError(name, rise, places.tolist())
    if bool((places < 1).any() | (places > ends.unsqueeze(-1)).any()):
        raise InputError(name, f"knots within 1..{int(ends.min())}", places.tolist())
    return places.to(dims.like.device)


def _by_length(centers: Tensor, dims: Dimensions, gap: int, ends: Tensor) -> Tensor:
    """Knots (B, G) along the straight lines from the start through the gates to the goal, with a smooth start and stop.

    At a constant speed a vehicle at rest would have to be at the first gate before it can be.
    """
    line = [dims.like[:, None, dims.position], centers] + ([] if dims.goal is None else [dims.goal.unsqueeze(1)])
    reached = torch.cat(line, dim=1).diff(dim=1).norm(dim=-1).cumsum(-1)
    G, last = centers.shape[1], ends.to(reached.device) + gap - 1
    share = (reached[:, :G] / reached[:, -1:].clamp(min=1e-12)).clamp(0.0, 1.0)
    when = 0.5 - ((1.0 - 2.0 * share).asin() / 3.0).sin()  # when^2 (3 - 2 when) = share
    places = (when * last.unsqueeze(-1)).round().long()
    for g in range(G):  # apart from each other, with room for those to come
        least = places[:, g - 1] + gap if g > 0 else torch.ones_like(last)
        places[:, g] = torch.minimum(torch.maximum(places[:, g], least), last + 1 - gap - gap * (G - 1 - g))
    return places
