"""Spherical obstacles, static or moving.

All obstacles of a trajectory are evaluated by one small matrix product per problem: with t = k dt and
features q = [p, |p|^2, 1 | t p, t, t^2], the constraint c = R^2 - |p - o - t v|^2 is linear in q. Gradient and
Gauss-Newton Hessian are products of the weights with moments of o and v in the same way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.numbers import Number, lengths, numbers, present
from torchgco.base.shapes import Dimensions, space_of
from torchgco.base.tree import passed_on
from torchgco.constraints.base import Constraint, Lowered, resolve_knots
from torchgco.constraints.norms import NO_ROW
from torchgco.costs.base import add_at
from torchgco.obstacles.base import TOUCH, Obstacles, OwnKind, Solids, copied, least, marked, picked
from torchgco.obstacles.inputs import is_body, own_radii, own_velocities, points, vehicle_radii
from torchgco.obstacles.measured import Distances, sphere_distances
from torchgco.obstacles.shapes import RoundedBoxes, array


@dataclass(frozen=True)
class Spheres(Constraint):
    """(r_obs,i + r_veh)^2 - |p_obs,i(k) - p_k|^2 <= 0 for every obstacle i (Equation 52).

    Args:
        centers: (M, d), or (B, M, d) one set per problem, m. Rows of NaN are absent obstacles (padding); M may be 0,
            and an empty list stands for (0, d).
        radii: one number, (M,) or (B, M), m; NaN where the centre is.
        vehicle_radius: number or (B,), m; or a `Body`.
        velocities: as centers, m/s; the obstacle is at centers + velocities * k dt. None: static.
        knots: default 1..N.

    Raises:
        InputError: on `Problem(...)`: wrong shapes, NaN centre with a finite radius, negative radius, dynamics
            without a position of the obstacles' dimension.
    """

    centers: Any
    radii: Any
    vehicle_radius: Any = 0.0
    velocities: Any = None
    knots: Any = None

    def bind(self, dims: Dimensions) -> Constraint:
        if is_body(self.vehicle_radius):
            return self.vehicle_radius.around(self, dims)
        d = space_of(dims, "obstacles.centers")
        assert dims.position is not None
        centers, absent = points(self.centers, "obstacles.centers", d, dims)
        radii = own_radii(self.radii, "obstacles.radii", absent, dims)
        vehicle = vehicle_radii(self.vehicle_radius, "obstacles.vehicle_radius", dims)
        velocities = own_velocities(self.velocities, "obstacles.velocities", absent, dims)
        centers = torch.where(absent.unsqueeze(-1), 0.0, centers)
        inflated = torch.where(absent, 0.0, radii + vehicle.unsqueeze(-1))
        knots = resolve_knots(self.knots, dims.N, "obstacles.knots", radii.device, dims.obstacles_from)
        made = product_matrices(centers, inflated, velocities, absent)
        at, dt = dims.position, dims.dt or 0.0
        return BoundSpheres(centers, inflated, velocities, absent, vehicle, knots, at, dt, **made)


@dataclass(frozen=True)
class BoundSpheres(OwnKind):
    """Spheres shaped for their problem, with the matrices of the one-product evaluation prepared."""

    centers: Tensor  # (B, M, d), at t = 0
    inflated_radii: Tensor  # (B, M): r_obs + r_veh
    velocities: Tensor | None  # (B, M, d)
    absent: Tensor  # (B, M) bool
    vehicle_radius: Tensor  # (B,)
    knots: Any
    position: slice
    dt: float
    weights: Tensor  # (B, r, M): c = q @ weights
    first: Tensor  # (B, M, 1 + d [+ d]): 1, o, and v where they move
    second: Tensor  # (B, M, d d [* 3]): o o', and o v' + v o', v v' where they move
    stops: Tensor | None = None  # (B,)

    batched: ClassVar[tuple[str, ...]] = (
        "centers", "inflated_radii", "velocities", "absent", "vehicle_radius", "weights", "first", "second", "stops",
    )  # fmt: skip

    c_kernel: ClassVar[str] = "spheres"

    def rows(self, p: Tensor, t: Tensor) -> Tensor:
        return torch.bmm(self._features(p, t.unsqueeze(-1)), self.weights)

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        # With c_p = -2 (p - o):  sum g c_p = 2 (sum g o - p sum g),  sum h c_p c_p' = 4 sum h (o - p)(o - p)'.
        p = X[:, self.knots, self.position]
        d, t = p.shape[-1], self.times(X).unsqueeze(-1)
        g, h = self.counted(g, 0.0, X.shape[1]), self.counted(h, 0.0, X.shape[1])
        g_sum, g_o = self._first_moments(g, t, d)
        h_sum, h_o = self._first_moments(h, t, d)
        h_oo = self._second_moment(h, t, d)
        gradient = 2.0 * (g_o - p * g_sum)
        cross = p.unsqueeze(-1) * h_o.unsqueeze(-2)
        hessian = 4.0 * (h_oo - cross - cross.mT + h_sum.unsqueeze(-1) * _outer(p, p).unflatten(-1, (d, d)))
        add_at(H, self.knots, self.position, X.shape[-1], gradient, hessian)

    def violation(self, X: Tensor, U: Tensor) -> Tensor:
        """Penetration depth r_obs + r_veh - |p_obs - p|, m, by plain differences."""
        depth = (self.inflated_radii.unsqueeze(1) - self.gaps(X)).clamp(min=0.0)
        return self.counted(depth, 0.0, X.shape[1])

    def gaps(self, X: Tensor) -> Tensor:
        """Distance |p_obs,i(k) - p_k| (B, K, M), m; infinite where absent."""
        return self._gaps(X[:, self.knots, self.position], self.times(X))

    @property
    def moving(self) -> bool:
        return self.velocities is not None

    @property
    def margins(self) -> Tensor:
        return self.inflated_radii

    def signed_distance(self, p: Tensor, t: Tensor) -> Tensor:
        return self._gaps(p, t) - self.inflated_radii.unsqueeze(1)

    def segment_clearance(self, a: Tensor, b: Tensor) -> Tensor:
        o = self.centers.unsqueeze(1)
        gap = from_origin(a.unsqueeze(2) - o, (b - a).unsqueeze(2)) - self.inflated_radii.unsqueeze(1)
        return torch.where(self.absent.unsqueeze(1), torch.inf, gap)

    def measured(self, X: Tensor) -> Distances:
        away = X[:, :, None, self.position] - self.centers.unsqueeze(1)
        if self.velocities is not None:
            t = self.dt * torch.arange(X.shape[1], dtype=X.dtype, device=X.device).view(1, -1, 1, 1)
            away = away - t * self.velocities.unsqueeze(1)
        return sphere_distances(away, self.inflated_radii, self.absent)

    def grown(self, by: Tensor) -> Self:
        radii = torch.where(self.absent, self.inflated_radii, self.inflated_radii + by.unsqueeze(-1))
        weights = self.weights.clone()
        weights[:, self.centers.shape[-1] + 1] += radii.square() - self.inflated_radii.square()
        return replace(self, inflated_radii=radii, vehicle_radius=self.vehicle_radius + by, weights=weights)

    def later(self, t: float) -> BoundSpheres:
        return self if self.velocities is None else self.remade(centers=self.centers + t * self.velocities)

    def in_free_time(self, n: int, m: int, later: int) -> Obstacles:
        return SpheresInFreeTime(self, n) if self.moving else self

    def chosen(self, at: Tensor) -> BoundSpheres:
        absent = (at < 0) | picked(self.absent, at)
        centers, velocities = (
            None if values is None else torch.where(absent.unsqueeze(-1), 0.0, picked(values, at))
            for values in (self.centers, self.velocities)
        )
        radii = torch.where(absent, 0.0, picked(self.inflated_radii, at))
        return self.remade(centers=centers, inflated_radii=radii, velocities=velocities, absent=absent)

    def remade(self, **changes: Tensor | None) -> BoundSpheres:
        """The same with other numbers, and matrices of the numbers as they are."""
        made = replace(self, **changes)  # type: ignore[arg-type]
        return replace(made, **product_matrices(made.centers, made.inflated_radii, made.velocities, made.absent))

    def numbers_of(self, where: str, index: int, others: Sequence[Any]) -> list[Number]:
        if bool(self.absent.any()):
            return []
        written = []
        for name in ("centers",) if self.velocities is None else ("centers", "velocities"):
            whole = getattr(self, name)
            after = copied(whole, [getattr(other, name) for other in others])
            written += numbers(where, {name: (whole, present)}, index, bool(others), after)
        radii = self.inflated_radii - self.vehicle_radius.unsqueeze(-1)

        def inflate() -> None:
            for group in (self, *others):
                torch.add(radii, group.vehicle_radius.unsqueeze(-1), out=group.inflated_radii)

        sizes = {"radii": (radii, lengths)} | ({} if others else {"vehicle_radius": (self.vehicle_radius, lengths)})
        return written + numbers(where, sizes, index, after=inflate)

    def lowered(self, n: int, others: Sequence[Any] = ()) -> Lowered:
        balls = (self, *others)

        def joined(rows: list[Any]) -> Tensor:
            """Of one part its own memory, which a compiled problem writes into."""
            return rows[0].flatten(1) if len(rows) == 1 else torch.cat([row.flatten(1) for row in rows], -1)

        numbers = {
            "bound": joined([ball.centers for ball in balls]),
            "squares": joined([marked(ball.inflated_radii.square(), ball.absent) for ball in balls]),
        }
        if self.velocities is not None:
            numbers["velocities"] = joined([ball.velocities for ball in balls])
        return Lowered({}, numbers | self.lowered_stops(), {"dt": self.dt})

    def inflated(self) -> Solids | None:
        return None if self.moving else Solids(self.centers, self.inflated_radii, self.absent)

    def solids_at(self, t: Tensor) -> Solids:
        moved = 0.0 if self.velocities is None else t.view(-1, 1, 1) * self.velocities
        return Solids(self.centers + moved, self.inflated_radii, self.absent)

    def shapes(self, b: int) -> RoundedBoxes:
        velocity = None if self.velocities is None or not bool(self.velocities[b].any()) else array(self.velocities[b])
        solids = Solids(self.centers, self.inflated_radii, self.absent)
        return RoundedBoxes.of(solids, self.vehicle_radius, b, velocity=velocity)

    def chord_clearance(self, X: Tensor, share: float | None = None) -> Tensor:
        o = self.centers.unsqueeze(1)
        if self.velocities is not None:
            t = torch.arange(X.shape[1], dtype=X.dtype, device=X.device)
            t = t.unsqueeze(0) if self.stops is None else torch.minimum(t, self.stops.unsqueeze(-1))
            o = o + (t * self.dt)[..., None, None] * self.velocities.unsqueeze(1)
        away = X[:, :, None, self.position] - o
        contact = 1.0 - (TOUCH if share is None else share)
        gap = from_origin(away[:, :-1], away.diff(dim=1)) - contact * self.inflated_radii.unsqueeze(1)
        return least(torch.where(self.absent.unsqueeze(1), torch.inf, gap))

    def _gaps(self, p: Tensor, t: Tensor) -> Tensor:
        """Distances (B, K, M) of points p (B, K, d) from the centres at times t (K,); infinite where absent."""
        o = self.centers.unsqueeze(1)
        if self.velocities is not None:
            o = o + t.view(1, -1, 1, 1) * self.velocities.unsqueeze(1)
        gap = (p.unsqueeze(2) - o).square().sum(-1).sqrt()
        return torch.where(self.absent.unsqueeze(1), torch.inf, gap)

    def _features(self, p: Tensor, t: Tensor) -> Tensor:
        q = [p, p.square().sum(-1, keepdim=True), torch.ones_like(p[..., :1])]
        if self.velocities is not None:
            t = t.expand(*p.shape[:-1], 1)
            q += [t * p, t, t.square()]
        return torch.cat(q, dim=-1)

    def _first_moments(self, w: Tensor, t: Tensor, d: int) -> tuple[Tensor, Tensor]:
        """sum w (B, K, 1) and sum w o(t) (B, K, d) over the obstacles, for weights w (B, K, M)."""
        s = torch.bmm(w, self.first)
        moving = 0.0 if self.velocities is None else t * s[..., 1 + d :]
        return s[..., :1], s[..., 1 : 1 + d] + moving

    def _second_moment(self, w: Tensor, t: Tensor, d: int) -> Tensor:
        """sum w o(t) o(t)' (B, K, d, d)."""
        s = torch.bmm(w, self.second)
        if self.velocities is not None:
            fixed, linear, square = s.split(d * d, dim=-1)
            s = fixed + t * linear + t.square() * square
        return s.unflatten(-1, (d, d))


@dataclass(frozen=True)
class SpheresInFreeTime(Obstacles):
    """Spheres whose velocities are per second of a time that is free: when the vehicle is at a knot is a matter of a
    state, tau.

    All stages last tau times dt, so knot k is at k dt tau, and with tau given a sphere moves in each stage by tau times
    what it moves in dt: it is `BoundSpheres` of other velocities.

    Rows are those of `NormBounds`, (r^2 - |p - o - v t|^2) / (2 r), near the surface as large as the depth.
    """

    spheres: BoundSpheres
    factor: int  # which state tau is

    batched: ClassVar[tuple[str, ...]] = ("spheres",)

    absent, vehicle_radius, position = passed_on("spheres", "absent", "vehicle_radius", "position")
    dt, knots, margins, moving = passed_on("spheres", "dt", "knots", "margins", "moving")
    row_shape, start_is_clear = passed_on("spheres", "row_shape", "start_is_clear")
    signed_distance, segment_clearance = passed_on("spheres", "signed_distance", "segment_clearance")

    def bind(self, dims: Dimensions) -> Self:
        return self

    def at_factor(self, factor: Tensor) -> BoundSpheres:
        """The same for stages of factor (B,) times dt."""
        assert self.spheres.velocities is not None
        return self.spheres.remade(velocities=factor.view(-1, 1, 1) * self.spheres.velocities)

    def along(self, X: Tensor) -> BoundSpheres:
        """The same for the factor of the first states of X (B, N+1, n), which all others have where X obeys the
        dynamics."""
        return self.at_factor(X[:, 0, self.factor])

    @property
    def row_radii(self) -> Tensor:
        return -self._sizes[0].unsqueeze(1)

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return self._rows(X[:, self.knots], self.times(X))

    def at(self, x: Tensor, k: int) -> Tensor:
        return self._rows(x, x.new_full((1,), k * self.dt))

    def violation(self, X: Tensor, U: Tensor) -> Tensor:
        """Depth beneath the full surface, (B, K, M), m."""
        radius, there = (size.unsqueeze(1) for size in self._sizes)
        away = self._away(X[:, self.knots], self.times(X))
        return there * (radius - away.norm(dim=-1)).clamp(min=0.0)

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        radius, there = (size.unsqueeze(1) for size in self._sizes)
        away = self._away(X[:, self.knots], self.times(X))
        by_place = (there / radius).unsqueeze(-1) * away
        velocities = self.spheres.velocities
        assert velocities is not None
        by_factor = (by_place * velocities.unsqueeze(1)).sum(-1) * self.times(X).view(1, -1, 1)
        J = torch.cat((-by_place, by_factor.unsqueeze(-1)), dim=-1)
        columns = torch.tensor([*range(X.shape[-1])[self.position], self.factor], device=X.device)
        add, constant = H.new_zeros(*g.shape[:2], *H.shape[2:]), X.shape[-1]
        gradient = (g.unsqueeze(-2) @ J).squeeze(-2)
        add[..., columns, constant] = gradient
        add[..., constant, columns] = gradient
        add[..., columns.unsqueeze(-1), columns] = J.mT @ (h.unsqueeze(-1) * J)
        H[:, self.knots] += add

    def distances(self, X: Tensor) -> Tensor:
        return self.along(X).distances(X)

    def measured(self, X: Tensor) -> Distances:
        return self.along(X).measured(X)

    def chord_clearance(self, X: Tensor, share: float | None = None) -> Tensor:
        return self.along(X).chord_clearance(X, share)

    def with_step(self, dt: float) -> Self:
        return replace(self, spheres=self.spheres.with_step(dt))

    def grown(self, by: Tensor) -> Self:
        return replace(self, spheres=self.spheres.grown(by))

    def chosen(self, at: Tensor) -> Self:
        return replace(self, spheres=self.spheres.chosen(at))

    def _rows(self, x: Tensor, t: Tensor) -> Tensor:
        radius, there = (size.unsqueeze(1) for size in self._sizes)
        depth = (radius.square() - self._away(x, t).square().sum(-1)) / (2.0 * radius)
        return there * depth + (1.0 - there) * NO_ROW

    def _away(self, x: Tensor, t: Tensor) -> Tensor:
        """From the centres (B, K, M, d) to states x (B, K, n) at t (K,) or (1,), s, where tau is 1."""
        velocities, late = self.spheres.velocities, (t * x[..., self.factor])[..., None, None]
        assert velocities is not None
        return x[:, :, None, self.position] - self.spheres.centers.unsqueeze(1) - late * velocities.unsqueeze(1)

    @property
    def _sizes(self) -> tuple[Tensor, Tensor]:
        """Radii (B, M), m, 1 where there is no row, and 1 where there is one, else 0."""
        there = ~self.absent & (self.spheres.inflated_radii > 0)
        return torch.where(there, self.spheres.inflated_radii, 1.0), there.to(self.spheres.centers.dtype)


def from_origin(a: Tensor, along: Tensor) -> Tensor:
    """Distances (...) of the origin from segments that begin at a and go along, (..., d)."""
    length = along.square().sum(-1, keepdim=True).clamp(min=torch.finfo(a.dtype).tiny)
    nearest = a - ((a * along).sum(-1, keepdim=True) / length).clamp(-1.0, 0.0) * along
    return nearest.square().sum(-1).sqrt()


def product_matrices(o: Tensor, radii: Tensor, v: Tensor | None, absent: Tensor) -> dict[str, Tensor]:
    """The matrices of a BoundSpheres, from its centres, inflated radii, velocities, and which are absent."""
    present = (~absent).to(o.dtype).unsqueeze(-1)  # absent: left out of sums
    rows = [2 * o, -present, (radii.square() - o.square().sum(-1)).unsqueeze(-1)]
    first, second = [present, o], [_outer(o, o)]
    if v is not None:
        rows += [2 * v, -2 * (o * v).sum(-1, keepdim=True), -v.square().sum(-1, keepdim=True)]
        first += [v]
        second += [_outer(o, v) + _outer(v, o), _outer(v, v)]
    weights = torch.cat(rows, dim=-1)
    # An absent sphere is c = -1 everywhere: satisfied, with a multiplier that stays zero.
    constant = torch.zeros_like(weights)
    constant[..., o.shape[-1] + 1] = -1.0
    weights = torch.where(absent.unsqueeze(-1), constant, weights).mT.contiguous()
    return {"weights": weights, "first": torch.cat(first, dim=-1), "second": torch.cat(second, dim=-1)}


def _outer(a: Tensor, b: Tensor) -> Tensor:
    """a b' of the last axis, flattened: (..., d * d)."""
    return (a.unsqueeze(-1) * b.unsqueeze(-2)).flatten(-2)
