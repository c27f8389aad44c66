"""Boxes as obstacles, aligned with the axes or turned, sharp or rounded, at rest or moving along sums of sines.

They are evaluated in PyTorch. No path is sought among them, as among spheres that move.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError, undefined
from torchgco.base.numbers import Number, numbers, present
from torchgco.base.shapes import Dimensions, check_finite, check_shape, per_row
from torchgco.base.tree import passed_on, take
from torchgco.constraints.base import Constraint, Lowered, resolve_knots
from torchgco.obstacles.base import ABSENT, BOUND_SLACK, OwnKind, copied, least, marked, picked
from torchgco.obstacles.box_geometry import Cuboids, segment_distance
from torchgco.obstacles.inputs import (
    check_absent,
    check_sides,
    dimension,
    is_body,
    own_axes,
    own_radii,
    points,
    rows,
    vehicle_radii,
)
from torchgco.obstacles.measured import Distances, box_distances
from torchgco.obstacles.shapes import RoundedBoxes, array

BOX_GAPS_AT_ONCE = 2**17  # distances computed together: the intermediate results of more leave the processor's cache


@dataclass(frozen=True)
class Boxes(Constraint):
    """2 s (r + r_veh - distance of p_k from box i) <= 0 for every box i, rounded by a radius r.

    Distances count from the surface of the box before it is rounded, negative inside. The factor 2 s, with s = r +
    r_veh + the smallest half side, makes c a squared length with the slope of a sphere of radius s: penalties then mean
    the same for both kinds. Rows hold at the knots; between two knots a trajectory may cut a corner, which is rounded
    by r + r_veh, by up to the square of its step over 8 (r + r_veh). `gco` solves such trajectories again with grown
    boxes.

    Args:
        centers: (M, d), or (B, M, d) one set per problem, m. Rows of NaN are absent boxes (padding); M may be 0, and an
            empty list stands for (0, d).
        half_sizes: as centers: half the lengths of the sides before rounding, m; NaN where the centre is. Above 0, or
            at least 0 where the box has a radius above 0: a box with a single side above 0 is then a capsule.
        vehicle_radius: number or (B,), m; or a `Body`.
        rotations: those that turn the axes of space into the box's sides. In the plane angles (M,) or (B, M), rad; in
            space unit quaternions [w, x, y, z], (M, 4) or (B, M, 4). None: sides along the axes.
        radii: one number, (M,) or (B, M), m, at least 0; NaN where the centre is. The surface of a rounded box lies so
            far outside its sides. Bodies touch at CONTACT_FACTOR (r + r_veh) from the sides. None: sharp boxes.
        knots: default 1..N.

    Raises:
        InputError: on `Problem(...)`: wrong shapes, NaN centre with finite sides or radius, sides that aren't above 0
            in a sharp box or are negative in a rounded one, negative radii, quaternions of another length than 1,
            dynamics without a position in 2-D or 3-D.
    """

    centers: Any
    half_sizes: Any
    vehicle_radius: Any = 0.0
    rotations: Any = None
    radii: Any = None
    knots: Any = None

    def bind(self, dims: Dimensions) -> Constraint:
        if is_body(self.vehicle_radius):
            return self.vehicle_radius.around(self, dims)
        d = dimension(dims, "boxes.centers")
        centers, absent = points(self.centers, "boxes.centers", d, dims)
        half = rows(self.half_sizes, "boxes.half_sizes", d, dims)
        check_shape(half, tuple(centers.shape), "boxes.half_sizes")
        check_absent(torch.isnan(half), absent.unsqueeze(-1), "boxes.half_sizes", "the centre is NaN")
        radii = torch.zeros_like(half[..., 0])
        if self.radii is not None:
            radii = own_radii(self.radii, "boxes.radii", absent, dims)
        check_sides(half, radii, absent, "boxes.half_sizes")
        axes = own_axes(self.rotations, "boxes.rotations", absent, d, dims)
        return BoundBoxes.prepare(self, "boxes", dims, centers, half, axes, absent, radii)


@dataclass(frozen=True)
class BoundBoxes(OwnKind):
    """Boxes, sharp or rounded, shaped for their problem."""

    centers: Tensor  # (B, M, d)
    half_sizes: Tensor  # (B, M, d), before rounding; 0 where absent
    axes: Tensor  # (B, M, d, d): row i is the direction of side i
    absent: Tensor  # (B, M) bool
    vehicle_radius: Tensor  # (B,)
    inflated_radii: Tensor  # (B, M): r + r_veh; 0 where absent
    depths: Tensor  # (B, M): r + r_veh + the smallest half side; 0 where absent
    knots: Any
    position: slice
    dt: float
    stops: Tensor | None = None  # (B,)

    batched: ClassVar[tuple[str, ...]] = (
        "centers", "half_sizes", "axes", "absent", "vehicle_radius", "inflated_radii", "depths", "stops",
    )  # fmt: skip

    c_kernel: ClassVar[str] = "boxes"

    @classmethod
    def prepare(
        cls,
        options: Any,
        name: str,
        dims: Dimensions,
        centers: Tensor,
        half_sizes: Tensor,
        axes: Tensor,
        absent: Tensor,
        radii: Tensor,
    ) -> BoundBoxes:
        """Boxes of checked numbers (B, ...), whatever those of absent boxes are, with radius and knots of `options`."""
        assert dims.position is not None
        vehicle = vehicle_radii(options.vehicle_radius, f"{name}.vehicle_radius", dims)
        knots = resolve_knots(options.knots, dims.N, f"{name}.knots", centers.device, dims.obstacles_from)
        centers, half = (torch.where(absent.unsqueeze(-1), 0.0, values) for values in (centers, half_sizes))
        inflated = torch.where(absent, 0.0, radii + vehicle.unsqueeze(-1))
        depths = inflated + half.amin(-1)
        return cls(centers, half, axes, absent, vehicle, inflated, depths, knots, dims.position, dims.dt or 0.0)

    @property
    def margins(self) -> Tensor:
        return self.inflated_radii

    @property
    def sizes(self) -> Tensor:
        return self.depths

    def rows(self, p: Tensor, t: Tensor) -> Tensor:
        return torch.where(self.absent.unsqueeze(1), ABSENT, -2.0 * self.depths.unsqueeze(1) * self._outside(p))

    def slopes(self, p: Tensor, t: Tensor) -> Tensor:
        return -2.0 * self.depths[:, None, :, None] * self.inflated().normals(p)

    def worst(self, X: Tensor, U: Tensor) -> Tensor:
        parts = self._parts(X.shape[1])
        return torch.cat([super(BoundBoxes, self.take(rows)).worst(X[rows], U[rows]) for rows in parts])

    def signed_distance(self, p: Tensor, t: Tensor) -> Tensor:
        return torch.where(self.absent.unsqueeze(1), torch.inf, self._outside(p))

    def segment_clearance(self, a: Tensor, b: Tensor) -> Tensor:
        boxes, here = self.inflated(), ~self.absent.unsqueeze(1)
        apart = torch.cat([take(boxes, rows).apart(a[rows], b[rows]) for rows in self._parts(a.shape[1])])
        apart = apart.masked_fill(~here, torch.inf)
        if apart.numel() == 0:
            return apart
        # The pair that looks nearest bounds the smallest distance: no pair farther apart than that has to be measured.
        i, first = torch.arange(len(apart), device=a.device), apart.flatten(1).argmin(-1)
        e, j = first // apart.shape[2], first % apart.shape[2]
        most = boxes.segment_distance((i, e, j), a, b) + self.inflated_radii.amax(-1)
        k, e, j = ((apart <= most.view(-1, 1, 1)) & here).nonzero(as_tuple=True)
        apart[k, e, j] = boxes.segment_distance((k, e, j), a, b)
        return apart

    def measured(self, X: Tensor) -> Distances:
        return box_distances(self, X[:, :, None, self.position] - self.centers.unsqueeze(1))

    def grown(self, by: Tensor) -> Self:
        more = torch.where(self.absent, 0.0, by.unsqueeze(-1))
        inflated, depths = self.inflated_radii + more, self.depths + more
        return replace(self, vehicle_radius=self.vehicle_radius + by, inflated_radii=inflated, depths=depths)

    def chosen(self, at: Tensor) -> BoundBoxes:
        absent = (at < 0) | picked(self.absent, at)
        names = ("centers", "half_sizes", "axes", "inflated_radii", "depths")
        parts = {name: picked(getattr(self, name), at) for name in names}
        for name in ("centers", "half_sizes", "inflated_radii", "depths"):
            parts[name] = parts[name].masked_fill(absent.view(*absent.shape, *([1] * (parts[name].dim() - 2))), 0.0)
        return replace(self, absent=absent, **parts)

    def numbers_of(self, where: str, index: int, others: Sequence[Any]) -> list[Number]:
        if bool(self.absent.any()):
            return []
        after = copied(self.centers, [other.centers for other in others])
        return numbers(where, {"centers": (self.centers, present)}, index, after=after)

    def lowered(self, n: int, others: Sequence[Any] = ()) -> Lowered:
        bound = torch.cat([ball._lowered() for ball in (self, *others)], dim=-1)
        return Lowered({}, {"bound": bound} | self.lowered_stops())

    def _lowered(self) -> Tensor:
        """The numbers (B, ...) that boxes.h reads: bounds of all boxes, axis by axis, factors, all numbers of each."""
        absent, radius = self.absent.unsqueeze(-1), self.inflated_radii.unsqueeze(-1)
        reach = marked(BOUND_SLACK * (self.inflated().extent + radius), absent)
        bounds = torch.stack((self.centers, reach), dim=-1).transpose(1, 2)
        numbers = torch.cat((self.centers, self.axes.flatten(2), self.half_sizes, marked(radius, absent)), dim=-1)
        return torch.cat((bounds.flatten(1), 2.0 * self.depths, numbers.flatten(1)), dim=1)

    def solids_at(self, t: Tensor) -> Cuboids:
        return self.inflated()

    def inflated(self) -> Cuboids:
        return Cuboids(self.centers, self.inflated_radii, self.absent, self.axes, self.half_sizes)

    def _outside(self, p: Tensor) -> Tensor:
        """Distances (B, K, M) of points p (B, K, d) from the full surfaces, as if none were absent."""
        boxes = self.inflated()
        return torch.cat([take(boxes, rows).signed_distance(p[rows]) for rows in self._parts(p.shape[1])])

    def _parts(self, points: int) -> list[slice]:
        """The problems of a batch, as many at a time as the processor's cache holds distances of `points` points."""
        B, M = self.absent.shape
        size = max(B, 1) if self.absent.is_cuda else max(1, BOX_GAPS_AT_ONCE // max(1, points * M))
        return [slice(first, first + size) for first in range(0, max(B, 1), size)]


class MovingBoxes(OwnKind):
    """A kind says where the centres are, `centers_at`, and by how much they leave their chords, `bulge`."""

    boxes: BoundBoxes  # with centres that may count from elsewhere
    knots: Any
    dt: float

    absent, vehicle_radius, position = passed_on("boxes", "absent", "vehicle_radius", "position")
    margins, sizes = passed_on("boxes", "margins", "sizes")

    @property
    def moving(self) -> bool:
        return True

    @property
    def bulge(self) -> Tensor | None:
        """By how much centres leave the straight lines between their places at two knots, (B, M), m; None: never."""
        return None

    def centers_at(self, t: Tensor) -> Tensor:
        """Centres (B, K, M, d), m, at times t (K,) or (B, K), s."""
        raise undefined(self, "centers_at")

    def rows(self, p: Tensor, t: Tensor) -> Tensor:
        c = -2.0 * self.boxes.depths.unsqueeze(1) * self._outside(p, t)
        return torch.where(self.absent.unsqueeze(1), ABSENT, c)

    def slopes(self, p: Tensor, t: Tensor) -> Tensor:
        return -2.0 * self.boxes.depths[:, None, :, None] * self._solids.normals_at(self._local(p, t))

    def signed_distance(self, p: Tensor, t: Tensor) -> Tensor:
        return torch.where(self.absent.unsqueeze(1), torch.inf, self._outside(p, t))

    def segment_clearance(self, a: Tensor, b: Tensor) -> Tensor:
        now = self.centers_at(a.new_zeros(1))[:, 0]
        return replace(self.boxes, centers=now).segment_clearance(a, b)

    def chord_clearance(self, X: Tensor, share: float | None = None) -> Tensor:
        k = torch.arange(X.shape[1], dtype=X.dtype, device=X.device)
        k = k if self.stops is None else torch.minimum(k, self.stops.unsqueeze(-1))
        gap = self._chords(self._away(X[..., self.position], k * self.dt))
        gap = gap if self.bulge is None else gap - self.bulge.unsqueeze(1)
        gap = gap + (self.beneath(share) - self.boxes.inflated_radii).unsqueeze(1)
        return least(torch.where(self.absent.unsqueeze(1), torch.inf, gap))

    def _chords(self, away: Tensor) -> Tensor:
        """Distances (B, K-1, M) of the segments between relative places (B, K, M, d) from boxes that aren't rounded."""
        local = torch.stack(self._solids.local(away.unbind(-1)), dim=-1)
        return segment_distance(local[:, :-1].unbind(-1), local.diff(dim=1).unbind(-1), self._solids.halves())

    def solids_at(self, t: Tensor) -> Cuboids:
        return replace(self._solids, centers=self.centers_at(t)[0])

    def grown(self, by: Tensor) -> Self:
        return replace(self, boxes=self.boxes.grown(by))  # type: ignore[type-var]

    @property
    def _solids(self) -> Cuboids:
        return self.boxes.inflated()

    def _away(self, p: Tensor, t: Tensor) -> Tensor:
        """From where the centres are, (B, K, M, d), to points p (B, K, d)."""
        return p.unsqueeze(2) - self.centers_at(t)

    def _local(self, p: Tensor, t: Tensor) -> list[Tensor]:
        """The same along the sides, d tensors (B, K, M)."""
        return self._solids.local(self._away(p, t).unbind(-1))

    def _outside(self, p: Tensor, t: Tensor) -> Tensor:
        """Distances (B, K, M) from the full surfaces, as if none were absent."""
        return self._solids.distance_at(self._local(p, t))


@dataclass(frozen=True)
class OscillatingBoxes(Constraint):
    """Boxes as `Boxes`, whose centres at time t are centers + sum_s amplitudes sin(rates t + phases).

    Args:
        boxes: at the middle of their motion.
        amplitudes, rates, phases: (M, S, d), or (B, M, S, d) one set per problem: S sines along each axis, m, rad/s and
            rad. Those of absent boxes don't count; a box with amplitudes of 0 rests.

    Raises:
        InputError: on `Problem(...)`: as `Boxes`; other shapes, NaN or infinity, dynamics without a time step.
    """

    boxes: Boxes
    amplitudes: Any
    rates: Any
    phases: Any

    def bind(self, dims: Dimensions) -> Constraint:
        if is_body(self.boxes.vehicle_radius):
            return self.boxes.vehicle_radius.around(self, dims)
        boxes = self.boxes.bind(dims)
        assert isinstance(boxes, BoundBoxes)
        if dims.dt is None:
            raise InputError("boxes.amplitudes", "dynamics with a time step dt", "dynamics without one")
        _, M, d = boxes.centers.shape
        sines: list[Tensor] = []
        for name in ("amplitudes", "rates", "phases"):
            sine = per_row(getattr(self, name), f"boxes.{name}", dims, M, sines[0].shape[2] if sines else "S", d)
            sine = torch.where(boxes.absent[..., None, None], 0.0, sine)
            check_finite(sine, f"boxes.{name}", "finite numbers for every box that is there")
            sines.append(sine)
        if M == 0:
            return boxes  # none of them moves: what is asked of moving obstacles alone isn't asked of none
        amplitudes, rates, phases = sines
        return BoundOscillatingBoxes(boxes, amplitudes, rates, phases, boxes.knots, boxes.dt)


@dataclass(frozen=True)
class BoundOscillatingBoxes(MovingBoxes):
    """Oscillating boxes shaped for their problem."""

    boxes: BoundBoxes  # in the middle of their motion
    amplitudes: Tensor  # (B, M, S, d)
    rates: Tensor  # (B, M, S, d)
    phases: Tensor  # (B, M, S, d), at t = 0
    knots: Any
    dt: float

    batched: ClassVar[tuple[str, ...]] = ("boxes", "amplitudes", "rates", "phases")

    moving = property(lambda self: bool((self.amplitudes != 0).any()))  # type: ignore[assignment]

    def centers_at(self, t: Tensor) -> Tensor:
        angle = t.view(1, -1, 1, 1, 1) * self.rates.unsqueeze(1) + self.phases.unsqueeze(1)
        return self.boxes.centers.unsqueeze(1) + (self.amplitudes.unsqueeze(1) * angle.sin()).sum(-2)

    def measured(self, X: Tensor) -> Distances:
        t = self.dt * torch.arange(X.shape[1], dtype=X.dtype, device=X.device).view(1, -1, 1)
        away, strongest = [], []
        for i, p in enumerate(X[..., self.position].unbind(-1)):
            sines = (values[..., i].unbind(-1) for values in (self.amplitudes, self.rates, self.phases))
            middle, most = self.boxes.centers[..., i].unsqueeze(1), torch.zeros_like(self.boxes.centers[..., i])
            for amplitude, rate, phase in zip(*sines, strict=True):
                angle = rate.unsqueeze(1) * t + phase.unsqueeze(1)
                middle, most = middle + amplitude.unsqueeze(1) * angle.sin(), most + amplitude.abs() * rate**2
            away.append(p.unsqueeze(2) - middle)
            strongest.append(most)
        # Seen from a box, the way between two knots leaves its chord by dt^2 / 8 of the box's acceleration at most.
        bulge = self.dt**2 / 8.0 * torch.stack(strongest, dim=-1).norm(dim=-1)
        return box_distances(self.boxes, torch.stack(away, dim=-1), bulge)

    @property
    def bulge(self) -> Tensor:
        """How far a centre's path may leave its chord between two knots, (B, M), m: dt^2 / 8 of its acceleration."""
        most = (self.amplitudes.abs() * self.rates.square()).sum(-2).square().sum(-1).sqrt()
        return self.dt**2 / 8.0 * most

    def shapes(self, b: int) -> RoundedBoxes:
        sines = np.stack([array(values[b]) for values in (self.amplitudes, self.rates, self.phases)])
        return RoundedBoxes.of(self._solids, self.vehicle_radius, b, sines=sines)

    def later(self, t: float) -> Self:
        return replace(self, phases=self.phases + t * self.rates)

    def chosen(self, at: Tensor) -> Self:
        parts = {name: picked(getattr(self, name), at) for name in ("amplitudes", "rates", "phases")}
        return replace(self, boxes=self.boxes.chosen(at), **parts)
