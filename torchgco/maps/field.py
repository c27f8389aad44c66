"""Maps as obstacles: a constraint that keeps the vehicle's position away from what a distance field is of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, Self

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.options import check_value
from torchgco.base.shapes import Dimensions
from torchgco.constraints.base import Constraint, Lowered, resolve_knots
from torchgco.maps.distance import ALL_FREE, DistanceField
from torchgco.maps.grid import OccupancyGrid, PointCloud
from torchgco.maps.lookup import Lattice, lengths, squares, squares_and_slopes
from torchgco.maps.measured import segment_distances
from torchgco.obstacles.base import ABSENT, ADMITTED, BOUND_SLACK, CONTACT_FACTOR, TOUCH, OwnKind, least
from torchgco.obstacles.inputs import dimension, is_body, vehicle_radii
from torchgco.obstacles.measured import Distances

Interpolation = Literal["smooth", "linear"]
SEGMENT_STEPS = 0.5  # spacings of the lattice between points at which a segment's distance is looked up
POINTS_AT_ONCE = 2**16  # points looked up together
PIECE = 2**10  # of these along one segment


@dataclass(frozen=True)
class Field(Constraint):
    """a (R^2 - G(p_k)) <= 0: the vehicle stays R = r_veh away from everything that a map holds.

    G is a lower bound of the squared distance from the map, interpolated between the nodes of the field
    (`maps/lookup.py`): a position that meets the constraint is at least R from every occupied cell. In front of a flat
    wall it keeps up to h^2 (d - 1) / (8 R) more, with h the field's spacing, and around single points nothing. The
    factor a = (R + half a cell) / R gives c the slope of a box of one cell. One row per knot, whatever the map: its
    time doesn't grow with the map.

    Args:
        field: a `DistanceField`; or a grid or cloud, whose field is made with the defaults.
        vehicle_radius: number or (B,), m; or a `Body`.
        interpolation: "smooth", quadratic B-splines, or "linear", with kinks between the cells.
        knots: default 1..N.

    Raises:
        InputError: no field, another option; on `Problem(...)`: a map of another space than the position's, another
            number of maps than problems, a negative radius.
    """

    field: Any
    vehicle_radius: Any = 0.0
    interpolation: Interpolation = "smooth"
    knots: Any = None

    geometric: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if isinstance(self.field, OccupancyGrid | PointCloud):
            object.__setattr__(self, "field", DistanceField.of(self.field))
        if not isinstance(self.field, DistanceField):
            raise InputError("field.field", "a DistanceField, an OccupancyGrid or a PointCloud", shown(self.field))
        check_value(self.interpolation, Interpolation, "field.interpolation")

    def bind(self, dims: Dimensions) -> Constraint:
        if is_body(self.vehicle_radius):
            return self.vehicle_radius.around(self, dims)
        d, field, like = dimension(dims, "field.field"), self.field, dims.like
        if field.d != d:
            raise InputError("field.field", f"a {d}-D map, as the vehicle's position is {d}-D", f"{field.d}-D")
        if field.batch not in (None, dims.B):
            raise InputError("field.field", f"one map for all, or {dims.B} maps", field.batch)
        vehicle = vehicle_radii(self.vehicle_radius, "field.vehicle_radius", dims)
        knots = resolve_knots(self.knots, dims.N, "field.knots", like.device, dims.obstacles_from)
        every = torch.arange(dims.B, device=like.device)
        which = torch.zeros_like(every) if field.batch is None else every
        origins = torch.as_tensor(field.origin, dtype=like.dtype, device=like.device)[which]
        empty = torch.as_tensor(field.values.reshape(len(field.values), -1).min(-1) >= ALL_FREE, device=like.device)
        absent = empty[which].unsqueeze(-1)
        assert dims.position is not None
        smooth = self.interpolation == "smooth"
        return BoundField(field, which, origins, vehicle, absent, smooth, knots, dims.position, dims.dt or 0.0)


@dataclass(frozen=True)
class BoundField(OwnKind):
    """A field shaped for its problem: one obstacle, the map."""

    field: DistanceField  # of all maps; a batch's subsets share it
    which: Tensor  # (B,) int64: the problem's map
    origins: Tensor  # (B, d)
    vehicle_radius: Tensor  # (B,)
    absent: Tensor  # (B, 1) bool: nothing is occupied
    smooth: bool
    knots: Any
    position: slice
    dt: float
    stops: Tensor | None = None  # (B,)
    pieces: int = 1  # of a stage, which are what its knots are apart

    c_kernel: ClassVar[str] = "field"

    batched: ClassVar[tuple[str, ...]] = ("which", "origins", "vehicle_radius", "absent", "stops")

    @property
    def map(self) -> Self:
        return self

    @property
    def lattice(self) -> Lattice:
        """The field as it is looked up."""
        nodes = self.field.nodes(self.which.device)
        return Lattice(nodes, self.which, self.origins, self.field.spacing, self.smooth)

    @property
    def cores(self) -> Tensor:
        """The distance (B,), m, below which G is linear in it: R less a spacing, so that the surface is beyond it."""
        R, h = self.vehicle_radius, self.field.spacing
        return torch.maximum(R - h, 0.5 * R).clamp(min=0.5 * h)

    @property
    def factors(self) -> Tensor:
        """a (B,): it gives c the slope 2 (R + half a cell) by the distance, at the surface."""
        return (self.vehicle_radius + self.field.thickness) / torch.maximum(self.vehicle_radius, self.cores)

    @property
    def limits(self) -> Tensor:
        """The distance (B,), m, that counts as 0: R, or more where R is below the core."""
        return lengths(self.vehicle_radius.square(), self.cores)

    @property
    def margins(self) -> Tensor:
        return self.vehicle_radius.unsqueeze(-1)

    @property
    def sizes(self) -> Tensor:
        return (self.vehicle_radius + self.field.thickness).unsqueeze(-1)

    @property
    def contact_depths(self) -> Tensor:
        """A map is touched at the vehicle's full radius, but for what counts as feasible: cells have no radius."""
        return torch.full_like(self.margins, ADMITTED)

    def depths_along(self, start: Tensor, count: int) -> Tensor:
        """How deep beneath the full surface the map is touched at the first of `count` places and after it, (B, count).

        What a start, `start` (B,), m, away from the surface, has less than the full distance is no contact of the way
        that leads out of it, up to where other obstacles touch.
        """
        depths, first = self.contact_depths.repeat(1, count), slice(0, self.pieces)
        beneath = torch.minimum(ADMITTED - start, TOUCH * self.vehicle_radius).unsqueeze(-1)
        depths[:, first] = torch.maximum(depths[:, first], beneath)
        return depths

    def in_pieces(self, count: int) -> Self:
        return replace(super().in_pieces(count), pieces=count * self.pieces)

    def lowered(self, n: int, others: Sequence[Any] = ()) -> Lowered:
        """The numbers that field.h reads, and the map itself, which isn't copied."""
        nodes = self.field.nodes(self.origins.device)
        x, y, z = (*nodes.shape[1:], 1)[:3]
        bound = torch.cat([ball._lowered() for ball in (self, *others)], dim=-1)
        plain = {
            "map": nodes, "map_of": self.which.contiguous(), "map_x": x, "map_y": y, "map_z": z, "smooth": self.smooth,
        }  # fmt: skip
        return Lowered({}, {"bound": bound} | self.lowered_stops(), plain)

    def _lowered(self) -> Tensor:
        h, d, R, like = self.field.spacing, self.origins.shape[-1], self.vehicle_radius, self.origins
        factors = torch.where(self.absent[:, 0], ABSENT, self.factors)
        reach = BOUND_SLACK * (R + 1.5 * h * d**0.5)  # nodes read for a point lie within h sqrt(d) of the nearest one
        columns = [like.new_full((len(R),), 1.0 / h), like.new_full((len(R),), h * h), R.square(), factors, self.cores]
        return torch.cat((self.origins, torch.stack([*columns, self.limits, reach], dim=-1)), dim=-1)

    def measured(self, X: Tensor) -> Distances:
        p, radius = X[..., self.position], self.vehicle_radius.unsqueeze(-1)
        twice = torch.stack((p, p), dim=2).flatten(1, 2)
        at_knots = segment_distances(self.field, self.which, twice)[:, ::2] - radius
        return at_knots.unsqueeze(-1), (segment_distances(self.field, self.which, p) - radius).unsqueeze(-1)

    def clearances(self, X: Tensor) -> Distances:
        at_knots, ways = (gap.squeeze(-1) for gap in self.measured(X))
        nearest, between = (gap + self.depths_along(at_knots[:, 0], gap.shape[1]) for gap in (at_knots, ways))
        nearest = nearest.amin(-1)
        return nearest, torch.minimum(nearest, least(between.unsqueeze(-1)))

    def chord_clearance(self, X: Tensor, share: float | None = None) -> Tensor:
        if share is not None:
            return super().chord_clearance(X, share)
        p = X[..., self.position]
        start = self.signed_distance(p[:, :1], p.new_zeros(1))[:, 0, 0]
        gaps = self.segment_clearance(p[:, :-1], p[:, 1:])
        return least(gaps + self.depths_along(start, gaps.shape[1]).unsqueeze(-1))

    def rows(self, p: Tensor, t: Tensor) -> Tensor:
        square = self.vehicle_radius.square().unsqueeze(-1) - squares(self.lattice, p, self.cores)
        return torch.where(self.absent, ABSENT, self.factors.unsqueeze(-1) * square).unsqueeze(-1)

    def slopes(self, p: Tensor, t: Tensor) -> Tensor:
        _, slopes = squares_and_slopes(self.lattice, p, self.cores)
        return torch.where(self.absent.unsqueeze(-1), 0.0, -self.factors[:, None, None] * slopes).unsqueeze(-2)

    def signed_distance(self, p: Tensor, t: Tensor) -> Tensor:
        distance = lengths(squares(self.lattice, p, self.cores), self.cores.unsqueeze(-1))
        return torch.where(self.absent, torch.inf, distance - self.limits.unsqueeze(-1)).unsqueeze(-1)

    def segment_clearance(self, a: Tensor, b: Tensor) -> Tensor:
        at_ends = [self.signed_distance(p, p.new_zeros(p.shape[1]))[..., 0] for p in (a, b)]
        along = (b - a).square().sum(-1).sqrt()
        gap = torch.minimum(*at_ends)
        # The distance changes no faster than the point moves: of most segments this shows that others are nearer.
        bound = 0.5 * (at_ends[0] + at_ends[1] - along)
        near = ~self.absent & (bound < gap.amin(-1, keepdim=True) + self.field.spacing) if gap.numel() > 0 else gap > 0
        steps = (along / (SEGMENT_STEPS * self.field.spacing)).ceil()
        looked = near & (steps > 1) & torch.isfinite(steps)
        for group in (looked & (steps <= PIECE), looked & (steps > PIECE)):
            i, e = group.nonzero(as_tuple=True)
            if len(i) == 0:
                continue
            most = max(1, POINTS_AT_ONCE // (int(steps[i, e].amax().clamp(max=PIECE)) + 1))
            for rows, segments in zip(i.split(most), e.split(most), strict=True):
                ends = a[rows, segments], b[rows, segments]
                gap[rows, segments] = self._between(rows, *ends, steps[rows, segments], gap[rows, segments])
        gap = self._along(gap, 0.5 * along / steps.clamp(min=1.0))
        return torch.where(near | self.absent, gap, bound).unsqueeze(-1)

    def _along(self, gap: Tensor, half: Tensor) -> Tensor:
        """Lower bounds (B, E) along segments whose pieces, twice `half` (B, E) long, have ends with clearances `gap`.

        What is at least r away from both ends of a piece is at least sqrt(r^2 - half^2) away from all of it.
        """
        limits = self.limits.unsqueeze(-1)
        r = gap + limits
        between = (r.square() - half.square()).clamp(min=0.0).sqrt()
        return torch.where(r > half, between, r - half) - limits

    def _between(self, rows: Tensor, a: Tensor, b: Tensor, steps: Tensor, gap: Tensor) -> Tensor:
        """Smallest distances (E,) at points in equal steps along segments from a to b (E, d) of problems `rows`.

        In pieces of `PIECE` steps, each begun where the distance may come down to the smallest one so far, `gap` (E,)
        at the beginning: of a segment that leads far beyond the map, few are near it.
        """
        gap, length = gap.clone(), (b - a).square().sum(-1).sqrt() / steps
        count = torch.arange(int(steps.amax().clamp(max=PIECE)) + 1, dtype=a.dtype, device=a.device)
        first, left = torch.zeros_like(steps), torch.arange(len(rows), device=rows.device)
        while left.numel() > 0:
            share = (first[left].unsqueeze(-1) + count) / steps[left].unsqueeze(-1)
            p = a[left].unsqueeze(1) + share.clamp(max=1.0).unsqueeze(-1) * (b - a)[left].unsqueeze(1)
            distance = self.take(rows[left]).signed_distance(p, count)[..., 0]
            gap[left] = torch.minimum(gap[left], distance.amin(-1))
            skipped = ((distance[:, -1] - gap[left]) / length[left]).floor().clamp(min=0.0)
            first[left] += len(count) - 1 + skipped
            left = left[first[left] < steps[left]]
        return gap

    def start_is_clear(self, x0: Tensor) -> Tensor:
        """As for all obstacles; where the field's bound says no, each cell, or point, near the start is measured."""
        clear = self.signed_distance(x0[:, None, self.position], x0.new_zeros(1))[:, 0]
        clear = (clear >= -TOUCH * self.margins).all(-1)
        finite = torch.isfinite(x0[:, self.position]).all(-1)
        for b in (~clear & finite).nonzero().flatten().tolist():
            least = CONTACT_FACTOR * float(self.vehicle_radius[b])
            p = x0[b, self.position].double().cpu().numpy()
            field = self.field
            near = distance_within(field.source, field.unknown, int(self.which[b]), p, least + field.spacing)
            clear[b] = near >= least and near > 0
        return clear

    def grown(self, by: Tensor) -> Self:
        return replace(self, vehicle_radius=self.vehicle_radius + by)


def distance_within(
    source: OccupancyGrid | PointCloud, unknown: str, which: int, p: np.ndarray, within: float
) -> float:
    """Distance of a point (d,) from the nearest occupied cell, or point, of a map, m; infinite beyond `within`.

    Args:
        unknown: what the unknown cells of a grid count as, "occupied" or "free".
        which: the number of the map, 0 of one that all problems share.
    """
    if isinstance(source, PointCloud):
        points = source.clouds()[which]
        least = np.linalg.norm(points - p, axis=1).min(initial=np.inf) - source.radius
        return float(least) if least <= within else np.inf
    h = source.resolution
    origin = source.origin if source.origin.ndim == 1 else source.origin[which]
    first = np.maximum(np.floor((p - within - origin) / h), 0).astype(int)
    last = np.minimum(np.floor((p + within - origin) / h) + 1, source.shape).astype(int)
    if (last <= first).any():
        return np.inf
    near = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
    values = source.occupied[which][near] if source.batch is not None else source.occupied[near]
    (cells,) = OccupancyGrid(values, origin + h * first, h).held(unknown)
    low = origin + h * (first + np.argwhere(cells))
    least = np.linalg.norm(p - np.clip(p, low, low + h), axis=1).min(initial=np.inf)
    return float(least) if least <= within else np.inf
