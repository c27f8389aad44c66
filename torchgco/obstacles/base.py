"""The interface of all kinds of obstacles: distances of the vehicle from them, for solver and search."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.brief import brief
from torchgco.base.errors import InputError, ScaleWarning, undefined
from torchgco.base.numbers import Number, numbers_of_fields
from torchgco.base.shapes import MISTAKES, Dimensions
from torchgco.base.tree import field_names, is_users
from torchgco.constraints.base import ADMITTED as ADMITTED
from torchgco.constraints.base import CONTACT_FACTOR as CONTACT_FACTOR
from torchgco.constraints.base import TOUCH as TOUCH
from torchgco.constraints.base import Distance, count_of
from torchgco.constraints.base import least as least
from torchgco.costs.base import add_at
from torchgco.obstacles.shapes import RoundedBoxes

ABSENT = -1.0  # in C: stands for a length of an absent obstacle, or the square of one, which are never negative
BOUND_SLACK = 1.0 + 1e-4  # so that rounding, in single precision too, can't make a row active beyond its box's bounds
TINY = 1e-12  # what is divided by is at least this: lengths and their squares in the search for paths


@dataclass(frozen=True)
class Solids:
    """M spheres at rest of each of B problems, grown by the vehicle's radius; `box_geometry.Cuboids` are boxes.

    What the search for paths knows of obstacles. The methods measure as if none were absent.
    """

    centers: Tensor  # (B, M, d), m
    radii: Tensor  # (B, M): r_obs + r_veh, m; 0 where absent
    absent: Tensor  # (B, M) bool

    @property
    def sizes(self) -> Tensor:
        """How deep the deepest point lies beneath the grown surface, (B, M), m; 0 where absent."""
        return self.radii

    @property
    def extent(self) -> Tensor:
        """Half the side lengths (B, M, d) of boxes along the axes that hold the solids before they are grown, m."""
        return torch.zeros_like(self.centers)

    def grown(self, by: Tensor) -> Self:
        """Those present with radii that are larger by lengths (B,), m."""
        return replace(self, radii=torch.where(self.absent, self.radii, self.radii + by.unsqueeze(-1)))

    def signed_distance(self, points: Tensor) -> Tensor:
        """Distances (B, V, M) of points (B, V, d) from the grown surfaces, m; negative inside."""
        apart = (points.unsqueeze(2) - self.centers.unsqueeze(1)).square_().sum(-1)
        return apart.sqrt_() - self.radii.unsqueeze(1)

    def deeper(self, points: Tensor, than: Tensor) -> Tensor:
        """Whether points (B, V, d) lie deeper than lengths (B,) >= 0, m, beneath the surface of one present, (B, V)."""
        limit = self.radii - than.unsqueeze(-1)
        limit = torch.where(self.absent | (limit <= 0), 0.0, limit.square()).unsqueeze(1)
        axes = ((points[..., i, None] - self.centers[:, None, :, i]).square_() for i in range(points.shape[-1]))
        return (reduce(torch.add, axes) < limit).any(-1)


class Obstacles(Distance):
    """Obstacles that the vehicle's position keeps clear of, M per problem, once bound.

    Distances count from the full surface, the obstacle's own grown by the vehicle's radius: positive outside, negative
    inside, infinite where an obstacle is absent. An absent one is marked in `absent`, and its numbers are 0; NaN stands
    for it only in what users and files give.

    A kind of obstacles is a subclass with the fields below. It must define

        bind                                  as any constraint
        absent, margins                       which obstacles there are, and their lengths
        signed_distance, segment_clearance    distances of points and of segments
        grown                                 the same obstacles, larger: contact between knots is repaired with it
        measured                              distances by separate code, for the judge and the certificate

    and it may define

        rows, accumulate                      c, where it isn't minus the distance, and its own derivatives
        numbers_of                            what a compiled problem writes, where some of `batched` are derived
        inflated                              its form as spheres or boxes: without it no path is sought
        shapes                                how it looks, where `inflated` doesn't say
        moving, chord_clearance, later        where its obstacles move
        stops                                 the last knot at which they count, where horizons differ
        chosen                                some of its obstacles: without it none is left out of a search
        sizes, start_is_clear                 where the margins don't say enough

    Kernels in C are optional.
    """

    geometric: ClassVar[bool] = True
    says_where: ClassVar[bool] = True

    absent: Tensor  # (B, M) bool
    vehicle_radius: Tensor  # (B,), m
    position: slice
    dt: float
    stops: Tensor | None = None  # (B,): the last knot at which they count, and move; None: all of `knots`

    def __repr__(self) -> str:
        try:
            present = (~self.absent).sum(-1)
            B, (least, most) = len(present), (int(f(present)) if len(present) else 0 for f in (torch.min, torch.max))
        except MISTAKES:  # of a user's kind that isn't bound yet
            return brief(self)
        count = f"{most}" if least == most else f"{least} to {most}"
        moving = ", moving" if self.moving else ""
        return f"{type(self).__name__.removeprefix('Bound')}({count} each of {B} problems{moving})"

    @property
    def moving(self) -> bool:
        """Whether any of them may move."""
        return False

    @property
    def has_chords(self) -> bool:
        """Whether its distances from segments are known, which a user's kind need not define."""
        kind = type(self)
        return not (
            kind.segment_clearance is Obstacles.segment_clearance and kind.chord_clearance is Obstacles.chord_clearance
        )

    @property
    def inscribed(self) -> Obstacles:
        """The obstacles of a vehicle that is a ball: themselves, or of a body those of the ball that it holds."""
        return self

    @property
    def body(self) -> Any:
        """The `BoundBody` that they are of; None of a vehicle that is a ball."""
        return None

    @property
    def map(self) -> Any:
        """The `BoundField` that the inscribed ball meets; None of other kinds."""
        return None

    @property
    def margins(self) -> Tensor:
        """Lengths (B, M), m: bodies touch at (1 - CONTACT_FACTOR) times these beneath the full surface."""
        raise undefined(self, "margins")

    @property
    def contact_depths(self) -> Tensor:
        """How deep beneath the full surface bodies touch, (B, M), m."""
        return TOUCH * self.margins

    @property
    def sizes(self) -> Tensor:
        """The smallest distance from an obstacle's centre to its full surface, (B, M), m."""
        return self.margins

    def signed_distance(self, p: Tensor, t: Tensor) -> Tensor:
        """Distances (B, K, M), m, of points p (B, K, d), m, at times t (K,), s."""
        raise undefined(self, "signed_distance")

    def distances_of(self, X: Tensor, t: Tensor) -> Tensor:
        """The same of vehicles in states X (B, K, n)."""
        return self.signed_distance(X[..., self.position], t)

    def distances(self, X: Tensor) -> Tensor:
        """Distances (B, K, M), m, of states X (B, N+1, n) at the constraint's knots."""
        return self.signed_distance(X[:, self.knots, self.position], self.times(X))

    def segment_clearance(self, a: Tensor, b: Tensor) -> Tensor:
        """Smallest distances (B, E, M), m, of the straight segments from a to b (B, E, d), from obstacles at t = 0.

        A lower bound will do where it exceeds the smallest of the problem by more than its largest margin.
        """
        raise undefined(self, "segment_clearance")

    def places(self, X: Tensor) -> Tensor:
        return X[..., self.position].unsqueeze(-2)

    def numbers(self, where: str, index: int) -> list[Number]:
        return self.numbers_of(where, index, ())

    def numbers_of(self, where: str, index: int, others: Sequence[Any]) -> list[Number]:
        """The same where `others`, the same obstacles of other balls of a body, have the numbers, too; by default none.

        Without others by default all of `batched`. Absent obstacles are padding: where there are any, which are there
        isn't a number, and none can be written.
        """
        return [] if others or bool(self.absent.any()) else numbers_of_fields(self, where, index)

    def rows(self, p: Tensor, t: Tensor) -> Tensor:
        """c (B, K, M) at points p (B, K, d), m, at times t (K,) or (1,), s; `ABSENT` of what isn't there."""
        return torch.where(self.absent.unsqueeze(1), ABSENT, -self.signed_distance(p, t))

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return self.counted(self.rows(X[:, self.knots, self.position], self.times(X)), ABSENT, X.shape[1])

    def at(self, x: Tensor, k: int) -> Tensor:
        rows = self.rows(x[..., self.position], x.new_full((1,), k * self.dt))
        return rows if self.stops is None else rows.masked_fill((k > self.stops)[:, None, None], ABSENT)

    def told(self, row: int, knot: int, dynamics: Any) -> str:
        return f"obstacle {row}"

    def grown(self, by: Tensor) -> Self:
        raise undefined(self, "grown")

    def inflated(self) -> Solids | None:
        """The obstacles as spheres or boxes at rest; None where they are neither, and no path is sought."""
        return None

    def solids_at(self, t: Tensor) -> Solids | None:
        """Those of a batch of one at times t (K,), s, as of K problems, or of one where they rest; None where they are
        neither spheres nor boxes."""
        return None

    def shapes(self, b: int) -> RoundedBoxes | None:
        """How those of problem b look; None where nobody says: no page or sensor shows them then."""
        solids = self.inflated()
        return None if solids is None else RoundedBoxes.of(solids, self.vehicle_radius, b)

    def chosen(self, at: Tensor) -> Obstacles:
        """The same kind with the obstacles at places (B, M') alone; -1 stands for an absent one."""
        raise undefined(self, "chosen")

    def beneath(self, share: float | None) -> Tensor:
        """Depths (B, M), m, from which clearances count: a share of the margins; None: where bodies touch."""
        return self.contact_depths if share is None else share * self.margins

    def chord_clearance(self, X: Tensor, share: float | None = None) -> Tensor:
        """As of `Distance`; obstacles that move override this."""
        p = X[..., self.position]
        return least(self.segment_clearance(p[:, :-1], p[:, 1:]) + self.beneath(share).unsqueeze(1))

    def start_is_clear(self, x0: Tensor) -> Tensor:
        """False where the vehicle touches an obstacle at the start, (B,)."""
        distance = self.signed_distance(x0[:, None, self.position], x0.new_zeros(1))[:, 0]
        return (distance >= -self.contact_depths).all(-1)

    def counted(self, rows: Tensor, other: float, count: int) -> Tensor:
        """Rows (B, K, M) of `count` knots in all, with `other` where a problem's time has stopped."""
        if self.stops is None:
            return rows
        knots = torch.arange(count, device=rows.device)[self.knots]
        return rows.masked_fill((knots > self.stops.unsqueeze(-1)).unsqueeze(-1), other)

    def with_more(self, n: int, m: int) -> Self:
        return self

    def in_free_time(self, n: int, m: int, later: int) -> Obstacles:
        return self

    def ending(self, horizon: Tensor, N: int, counts: Tensor, where: str) -> Self:
        """Obstacles that don't count after the last knots; those of knot N alone meet the state of the last knot."""
        late = torch.arange(N + 1, device=horizon.device)[self.knots].tolist()
        if late == [N] and not self.moving:
            return self
        if N in late and not all(self.holds_at(int(h)) for h in horizon.unique()):
            raise InputError("horizon", f"last knots at which {where} holds", horizon.unique().tolist())
        if "stops" not in field_names(type(self.inscribed)):
            got = type(self.inscribed).__name__
            raise InputError("horizon", "obstacles that can stop to count, such as Spheres, Boxes or a Field", got)
        return self.stopping_at(horizon)

    def stopping_at(self, knots: Tensor) -> Self:
        """The same obstacles, which don't count, and don't move, after each problem's knot (B,)."""
        return replace(self, stops=knots.to(self.vehicle_radius.dtype))  # type: ignore[type-var]

    def with_step(self, dt: float) -> Self:
        """The same obstacles, which move from knot to knot by what they do in dt, s."""
        return replace(self, dt=dt)  # type: ignore[type-var]

    def in_pieces(self, count: int) -> Self:
        moving = self if self.stops is None else self.stopping_at(count * self.stops)
        return moving.with_step(moving.dt / count) if moving.moving else moving

    def with_knots(self, knots: slice) -> Self:
        """The same obstacles, which count at other knots."""
        return replace(self, knots=knots)  # type: ignore[type-var]

    def times(self, X: Tensor) -> Tensor:
        """t = k dt (K,) at the constraint's knots, s."""
        return torch.arange(X.shape[1], dtype=X.dtype, device=X.device)[self.knots] * self.dt


class OwnKind(Obstacles):
    """A kind of torchgco's own, once bound: a row per obstacle and knot, of the position and the time alone."""

    c_kernel: ClassVar[str] = "function"

    @property
    def kernel(self) -> str:
        return "function" if is_users(self) else self.c_kernel

    def lowered_stops(self) -> dict[str, Tensor]:
        """The last knots at which obstacles count, for `lowered`."""
        return {} if self.stops is None else {"stops": self.stops.unsqueeze(-1)}

    def bind(self, dims: Dimensions) -> Self:
        return self

    def numbers_of(self, where: str, index: int, others: Sequence[Any]) -> list[Number]:
        return []

    def slopes(self, p: Tensor, t: Tensor) -> Tensor:
        """The derivatives (B, K, M, d) of the rows by p."""
        raise undefined(self, "slopes")

    def row_shape(self, N: int) -> tuple[int, int]:
        return count_of(self.knots, N + 1), self.absent.shape[1]

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        g, h = (self.counted(rows, 0.0, X.shape[1]) for rows in (g, h))
        J = self.slopes(X[:, self.knots, self.position], self.times(X))
        gradient, hessian = (g.unsqueeze(-2) @ J).squeeze(-2), (h.unsqueeze(-1) * J).mT @ J
        add_at(H, self.knots, self.position, X.shape[-1], gradient, hessian)

    def violation(self, X: Tensor, U: Tensor) -> Tensor:
        """Depth beneath the full surface, (B, K, M), m."""
        return self.counted((-self.distances(X)).clamp(min=0.0), 0.0, X.shape[1])


def warn_of_small(obstacles: Obstacles, field: str) -> None:
    """A ScaleWarning where an admitted violation is over 5 % of an obstacle's size: lengths may not be in metres."""
    sizes = obstacles.sizes[~obstacles.absent]
    sizes = sizes[sizes > 0]  # a point that is marked, not an obstacle
    if sizes.numel() > 0 and (1.0 - CONTACT_FACTOR) * float(sizes.min()) < ADMITTED:
        text = f"an obstacle of {float(sizes.min()):.3g} m is too small for violations of up to {ADMITTED:g} m"
        text += ", which count as feasible: scale the problem, or are its lengths not in metres?"
        warnings.warn(f"{field}: {text}", ScaleWarning, stacklevel=6)


def copied(whole: Tensor, others: Sequence[Tensor]) -> Callable[[], None] | None:
    """What copies a number into the memory of others; None where there are none."""

    def copy() -> None:
        for other in others:
            other.copy_(whole)

    return copy if others else None


def picked(values: Tensor, columns: Tensor) -> Tensor:
    """Values (B, M, ...) at places (B, M'); where a place is -1 those of the first, or zeros where M = 0."""
    if values.shape[1] == 0:
        return values.new_zeros(*columns.shape, *values.shape[2:])
    index = columns.clamp(min=0).view(*columns.shape, *([1] * (values.dim() - 2)))
    return values.gather(1, index.expand(*columns.shape, *values.shape[2:]))


def places_of(kept: Tensor) -> Tensor:
    """Places (B, M') of the true ones of (B, M), in their order, -1 after them; at least one column."""
    count = max(1, int(kept.sum(-1).max()))
    order = (~kept).to(torch.int8).argsort(dim=-1, stable=True)[:, :count]
    return order.masked_fill(~kept.gather(1, order), -1)


def marked(lengths: Tensor, absent: Tensor) -> Tensor:
    """Lengths or squares (B, M) as C reads them: `ABSENT` stands for those of absent obstacles."""
    return torch.where(absent, ABSENT, lengths)
