"""Ellipsoids as obstacles, aligned with the axes or turned, at rest or moving, in the plane and in space.

An ellipsoid grown by a ball of radius r is no ellipsoid. Those with squared semi-axes (1 + r / h) a^2 + (1 + h / r) r^2
hold it and touch it, one for each h > 0 (A. B. Kurzhanski and I. Valyi, Ellipsoidal Calculus for Estimation and
Control, 1997), and it is what all of them have in common: a point is clear of it exactly where it is outside of one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.numbers import Number, above_zero, lengths, numbers, present
from torchgco.base.shapes import Dimensions, check_shape
from torchgco.constraints.base import Constraint, resolve_knots
from torchgco.obstacles.base import ABSENT, OwnKind, copied, least, picked
from torchgco.obstacles.box_geometry import Cuboids
from torchgco.obstacles.inputs import (
    check_absent,
    dimension,
    is_body,
    own_axes,
    own_velocities,
    points,
    rows,
    vehicle_radii,
)
from torchgco.obstacles.measured import Distances, along_ways

REACH_STEPS = 3  # towards h; what they leave is told in `Ellipsoids`
NORMAL_STEPS = 8  # towards the nearest point's normal: outside of semi-axes up to 1 to 30 no more than rounding is left
CROSSINGS = 12  # of tangents, each of which leaves about a quarter of what is unknown of a smallest distance
NEAR_CENTER = 1e-12  # share of a squared semi-axis that tells where a point lies that has no direction
HALVINGS_OF_WAYS, HALVINGS_TO_NORMALS = 30, 60  # of a way, and of a range of up to 16 powers of ten, by its logarithm


@dataclass(frozen=True)
class Ellipsoids(Constraint):
    """s^2 (1 - sum_i q_i^2 / b_i^2) <= 0 for every ellipsoid, with q the vehicle's position along its axes.

    With b_i^2 = (h + r_veh) (a_i^2 / h + r_veh), b are the semi-axes of the ellipsoid that holds the one grown by the
    vehicle, and touches it where the ray from the centre through q leaves it. With s the smallest semi-axis + r_veh, c
    is a squared length with at most the slope of a sphere of radius s, less at the ends of long axes; of equal
    semi-axes it is a sphere's. h is found in a fixed number of steps. Any h keeps clear: those left out cost at most
    1e-8 of the smallest semi-axis where the longest is up to 10 times as long, and 2e-4 where it is 30 times.

    A quadrotor's downwash is an ellipsoid with a long axis along z that moves with it.

    Args:
        centers: (M, d), or (B, M, d) one set per problem, m. Rows of NaN are absent ellipsoids (padding); M may be 0,
            and an empty list stands for (0, d).
        semi_axes: as centers: half the lengths of the axes, above 0 m; NaN where the centre is.
        vehicle_radius: number or (B,), m; or a `Body`.
        rotations: those that turn the axes of space into the ellipsoid's. In the plane angles (M,) or (B, M), rad; in
            space unit quaternions [w, x, y, z], (M, 4) or (B, M, 4). None: along the axes.
        velocities: as centers, m/s; the ellipsoid is at centers + velocities * k dt. None: static.
        knots: default 1..N.

    Raises:
        InputError: on `Problem(...)`: wrong shapes, NaN centre with finite semi-axes, semi-axes that aren't above 0,
            negative vehicle radius, quaternions of another length than 1, dynamics without a position in 2-D or 3-D.
    """

    centers: Any
    semi_axes: Any
    vehicle_radius: Any = 0.0
    rotations: Any = None
    velocities: Any = None
    knots: Any = None

    def bind(self, dims: Dimensions) -> Constraint:
        if is_body(self.vehicle_radius):
            return self.vehicle_radius.around(self, dims)
        d = dimension(dims, "ellipsoids.centers")
        assert dims.position is not None
        centers, absent = points(self.centers, "ellipsoids.centers", d, dims)
        semi = rows(self.semi_axes, "ellipsoids.semi_axes", d, dims)
        check_shape(semi, tuple(centers.shape), "ellipsoids.semi_axes")
        gone = absent.unsqueeze(-1)
        check_absent(torch.isnan(semi), gone, "ellipsoids.semi_axes", "the centre is NaN")
        wrong = ~((semi > 0) & torch.isfinite(semi)).all(-1) & ~absent
        if bool(wrong.any()):
            raise InputError("ellipsoids.semi_axes", "finite semi-axes above 0 m", semi[wrong][0].tolist())
        axes = own_axes(self.rotations, "ellipsoids.rotations", absent, d, dims)
        vehicle = vehicle_radii(self.vehicle_radius, "ellipsoids.vehicle_radius", dims)
        velocities = own_velocities(self.velocities, "ellipsoids.velocities", absent, dims)
        knots = resolve_knots(self.knots, dims.N, "ellipsoids.knots", centers.device, dims.obstacles_from)
        centers, semi = torch.where(gone, 0.0, centers), torch.where(gone, 1.0, semi)
        return BoundEllipsoids(centers, semi, axes, velocities, absent, vehicle, knots, dims.position, dims.dt or 0.0)


@dataclass(frozen=True)
class BoundEllipsoids(OwnKind):
    """Ellipsoids shaped for their problem."""

    centers: Tensor  # (B, M, d), at t = 0
    semi_axes: Tensor  # (B, M, d); 1 where absent
    axes: Tensor  # (B, M, d, d): row i is the direction of axis i
    velocities: Tensor | None  # (B, M, d)
    absent: Tensor  # (B, M) bool
    vehicle_radius: Tensor  # (B,)
    knots: Any
    position: slice
    dt: float
    stops: Tensor | None = None  # (B,)

    batched: ClassVar[tuple[str, ...]] = (
        "centers", "semi_axes", "axes", "velocities", "absent", "vehicle_radius", "stops",
    )  # fmt: skip

    @property
    def moving(self) -> bool:
        return self.velocities is not None

    @property
    def margins(self) -> Tensor:
        return torch.where(self.absent, 0.0, self.semi_axes.amin(-1) + self.vehicle_radius.unsqueeze(-1))

    def rows(self, p: Tensor, t: Tensor) -> Tensor:
        q = self._local(p, t)
        c = self.margins.square().unsqueeze(1) * (1.0 - (q.square() * self._inverse(q)).sum(-1))
        return torch.where(self.absent.unsqueeze(1), ABSENT, c)

    def slopes(self, p: Tensor, t: Tensor) -> Tensor:
        # Of the semi-axes that a point may choose from, its own give the largest sum: they count as fixed.
        q = self._local(p, t)
        slopes = -2.0 * self.margins.square()[:, None, :, None] * q * self._inverse(q)
        return (self.axes.unsqueeze(1) * slopes.unsqueeze(-1)).sum(-2)

    def signed_distance(self, p: Tensor, t: Tensor) -> Tensor:
        apart = nearest(self._local(p, t), self.semi_axes.unsqueeze(1))[0] - self.vehicle_radius.view(-1, 1, 1)
        return apart.masked_fill(self.absent.unsqueeze(1), torch.inf)

    def segment_clearance(self, a: Tensor, b: Tensor) -> Tensor:
        now = a.new_zeros(1)
        return self._along(self._local(a, now), self._local(b, now))

    def chord_clearance(self, X: Tensor, share: float | None = None) -> Tensor:
        t = torch.arange(X.shape[1], dtype=X.dtype, device=X.device)
        t = t if self.stops is None else torch.minimum(t, self.stops.unsqueeze(-1))
        q = self._local(X[..., self.position], t * self.dt)
        return least(self._along(q[:, :-1], q[:, 1:]) + self.beneath(share).unsqueeze(1))

    def measured(self, X: Tensor) -> Distances:
        away = X[:, :, None, self.position] - self.centers.unsqueeze(1)
        if self.velocities is not None:
            t = self.dt * torch.arange(X.shape[1], dtype=X.dtype, device=X.device).view(1, -1, 1, 1)
            away = away - t * self.velocities.unsqueeze(1)
        q = (self.axes.unsqueeze(1) @ away.unsqueeze(-1)).squeeze(-1)
        ends = _bisected(q, self.semi_axes.unsqueeze(1))[0] - self.vehicle_radius.view(-1, 1, 1)

        def way(i: Tensor, k: Tensor, j: Tensor) -> Tensor:
            return _bisected_way(q[i, k, j], q[i, k + 1, j], self.semi_axes[i, j]) - self.vehicle_radius[i]

        return along_ways(ends, away, self.contact_depths, self.absent, way)

    def grown(self, by: Tensor) -> Self:
        return replace(self, vehicle_radius=self.vehicle_radius + by)

    def later(self, t: float) -> Self:
        return self if self.velocities is None else replace(self, centers=self.centers + t * self.velocities)

    def chosen(self, at: Tensor) -> Self:
        absent = (at < 0) | picked(self.absent, at)
        parts = {name: picked(getattr(self, name), at) for name in ("centers", "semi_axes", "axes")}
        parts["semi_axes"] = torch.where(absent.unsqueeze(-1), 1.0, parts["semi_axes"])
        velocities = None if self.velocities is None else picked(self.velocities, at)
        return replace(self, absent=absent, velocities=velocities, **parts)

    def numbers_of(self, where: str, index: int, others: Sequence[Any]) -> list[Number]:
        if bool(self.absent.any()):
            return []
        written = []
        for name, check in {"centers": present, "semi_axes": above_zero, "velocities": present}.items():
            if (whole := getattr(self, name)) is not None:
                after = copied(whole, [getattr(other, name) for other in others])
                written += numbers(where, {name: (whole, check)}, index, after=after)
        radius = {} if others else {"vehicle_radius": (self.vehicle_radius, lengths)}
        return written + numbers(where, radius, index)

    def inflated(self) -> Cuboids | None:
        """Boxes that hold them: with the smallest semi-axis m, |a n| <= sum_i (a_i - m) |n_i| + m along any normal n.

        So a box of half sides a_i - m, rounded by m, holds the ellipsoid; of equal semi-axes it is the sphere.
        """
        if self.moving:
            return None
        half = self.semi_axes - self.semi_axes.amin(-1, keepdim=True)
        return Cuboids(self.centers, self.margins, self.absent, self.axes, half)

    def shapes(self, b: int) -> None:
        """Pictures draw where their distance is 0: nothing here is a rounded box."""

    def _local(self, p: Tensor, t: Tensor) -> Tensor:
        """Places (B, K, M, d) along the axes, from the centres at times t (K,) or (B, K), of points p (B, K, d)."""
        away = p.unsqueeze(2) - self.centers.unsqueeze(1)
        if self.velocities is not None:
            away = away - t[..., None, None] * self.velocities.unsqueeze(1)
        return (self.axes.unsqueeze(1) * away.unsqueeze(-2)).sum(-1)

    def _inverse(self, q: Tensor) -> Tensor:
        """1 / b^2 (B, K, M, d) for points q along the axes.

        h is how far the ellipsoid reaches along the normal n with n_i proportional to q_i / (a_i^2 + r h), the same for
        both: h^2 = |a n|^2. Each step is Newton's in the logarithm of h, which can't leave the range of the semi-axes.
        """
        a, r = self.semi_axes.unsqueeze(1), self.vehicle_radius.view(-1, 1, 1, 1)
        square, low, high = a.square(), a.amin(-1, keepdim=True), a.amax(-1, keepdim=True)
        weights, h = q.square() + NEAR_CENTER * square, (low * high).sqrt()
        for _ in range(REACH_STEPS):
            inverse = 1.0 / (square + r * h)
            length = weights * inverse.square()
            reach, share = square * length, r * h * inverse
            lengths, reaches = length.sum(-1, keepdim=True), reach.sum(-1, keepdim=True)
            change = (length * share).sum(-1, keepdim=True) / lengths - (reach * share).sum(-1, keepdim=True) / reaches
            scaled = h.square() * lengths
            # Half of log(reaches / scaled) is near (reaches - scaled) / (reaches + scaled); x is half a step.
            x = 0.5 * (reaches - scaled) / (reaches + scaled) / (1.0 - change)
            h = torch.minimum(torch.maximum(h * (1.0 + x) / (1.0 - x).clamp(min=0.1), low), high)
        return h / ((h + r) * (square + r * h))

    def _along(self, a: Tensor, b: Tensor) -> Tensor:
        """Smallest distances (B, E, M) along segments from a to b (B, E, M, d), as `segment_clearance` has them."""
        r, semi, absent = self.vehicle_radius.view(-1, 1, 1), self.semi_axes.unsqueeze(1), self.absent.unsqueeze(1)
        begin, end = ((nearest(q, semi)[0] - r).masked_fill(absent, torch.inf) for q in (a, b))
        apart = 0.5 * (begin + end - (b - a).square().sum(-1).sqrt())  # it changes no faster than a point moves
        if apart.numel() == 0:
            return apart
        limit = torch.minimum(begin, end).flatten(1).amin(-1) + self.margins.amax(-1)
        i, e, j = (apart <= limit.view(-1, 1, 1)).nonzero(as_tuple=True)
        apart[i, e, j] = lowest_along(a[i, e, j], b[i, e, j], self.semi_axes[i, j]) - self.vehicle_radius[i]
        return apart


def nearest(q: Tensor, semi: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distances (...), m, of points q (..., d) from ellipsoids along the axes, and normals (..., d) there.

    A point lies q n - |a n| beyond the plane that touches the ellipsoid with the unit normal n, and the distance is the
    largest of these: none exceeds it. The nearest point's normal is proportional to q_i / (a_i^2 + v), where v is the
    root of |a_i q_i / (a_i^2 + v)| = 1. Newton's steps on one over this norm, which is concave and almost linear,
    approach it from below (J. J. More and D. C. Sorensen, Computing a trust region step, 1983).
    """
    square, away = semi.square(), torch.maximum(q.abs(), torch.finfo(q.dtype).eps * semi)
    smallest = square.amin(-1, keepdim=True)
    more, reach = square - smallest, semi * away
    least = torch.maximum((reach - more).amax(-1), reach.square().sum(-1).sqrt() - more.amax(-1)).unsqueeze(-1)
    v = torch.maximum(least, smallest)
    for _ in range(NORMAL_STEPS):
        terms = (reach / (more + v)).square()
        whole = terms.sum(-1, keepdim=True)
        v = torch.maximum(v + whole * (whole.sqrt() - 1.0) / (terms / (more + v)).sum(-1, keepdim=True), least)
    normal = torch.where(q < 0, -away, away) / (more + v)
    normal = normal / normal.square().sum(-1, keepdim=True).sqrt()
    return (q * normal).sum(-1) - (semi * normal).square().sum(-1).sqrt(), normal


def lowest_along(a: Tensor, b: Tensor, semi: Tensor) -> Tensor:
    """Close lower bounds (P,) of the signed distances along segments from a to b (P, d) from ellipsoids (P, d).

    The distance is convex along a segment: it is smallest between two points where it falls and where it rises, and not
    below the crossing of its tangents there.
    """

    def at(share: Tensor) -> Sequence[Tensor]:
        value, normal = nearest(torch.lerp(a, b, share.unsqueeze(-1)), semi)
        return share, value, (normal * (b - a)).sum(-1)

    left, right = at(torch.zeros_like(a[:, 0])), at(torch.ones_like(a[:, 0]))
    for _ in range(CROSSINGS):
        new = at(_crossing(left, right)[0])
        falls = new[2] < 0
        left = tuple(torch.where(falls, x, y) for x, y in zip(new, left, strict=True))
        right = tuple(torch.where(falls, y, x) for x, y in zip(new, right, strict=True))
    return _crossing(left, right)[1]


def _crossing(left: Sequence[Tensor], right: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Where two lines cross, one that falls and one that rises, and how high; each as a place, its height and slope."""
    (low, begin, falls), (high, end, rises) = left, right
    falls, rises = falls.clamp(max=0.0), rises.clamp(min=0.0)
    step = (begin - end + rises * (high - low)) / (rises - falls).clamp(min=torch.finfo(low.dtype).tiny)
    crossing = torch.minimum(torch.maximum(low + step, low), high)
    return crossing, begin + falls * (crossing - low)


def _bisected(q: Tensor, semi: Tensor) -> tuple[Tensor, Tensor]:
    """As `nearest`, by bisection."""
    away = torch.maximum(q.abs(), 1e-15 * semi)
    more = semi**2 - (semi**2).amin(-1, keepdim=True)
    # At the lower end the part along the smallest semi-axis alone is 1, at the upper one all together are at most 1.
    low, high = (semi * away + torch.where(more > 0, torch.inf, 0.0)).amin(-1), (semi * away).norm(dim=-1)
    for _ in range(HALVINGS_TO_NORMALS):
        middle = (low * high).sqrt()
        beyond = (semi * away / (more + middle.unsqueeze(-1))).norm(dim=-1) > 1.0
        low, high = torch.where(beyond, middle, low), torch.where(beyond, high, middle)
    normal = torch.copysign(away, q) / (more + (low * high).sqrt().unsqueeze(-1))
    normal = normal / normal.norm(dim=-1, keepdim=True)
    return (q * normal).sum(-1) - (semi * normal).norm(dim=-1), normal


def _bisected_way(a: Tensor, b: Tensor, semi: Tensor) -> Tensor:
    """As `lowest_along`, by bisection: below the tangent at the place found, which the distance is never."""
    low, high = torch.zeros_like(a[:, 0]), torch.ones_like(a[:, 0])
    for _ in range(HALVINGS_OF_WAYS if len(a) > 0 else 0):
        middle = 0.5 * (low + high)
        falls = (_bisected(a + middle.unsqueeze(-1) * (b - a), semi)[1] * (b - a)).sum(-1) < 0
        low, high = torch.where(falls, middle, low), torch.where(falls, high, middle)
    value, normal = _bisected(a + (0.5 * (low + high)).unsqueeze(-1) * (b - a), semi)
    return value - 0.5 * (high - low) * (normal * (b - a)).sum(-1).abs()
