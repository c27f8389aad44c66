"""Spheres, boxes and capsules along any known motion, given as places: other vehicles, tracks that were predicted.

Between two knots they move evenly, and after the last one they rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.numbers import Number, numbers, present
from torchgco.base.shapes import Dimensions, check_shape, tensor
from torchgco.constraints.base import Constraint, Lowered
from torchgco.obstacles.base import ABSENT, copied, marked, picked
from torchgco.obstacles.boxes import BoundBoxes, MovingBoxes
from torchgco.obstacles.inputs import check_sides, dimension, is_body, own_axes, own_radii, rows
from torchgco.obstacles.measured import Distances, box_distances, sphere_distances
from torchgco.obstacles.shapes import RoundedBoxes, array
from torchgco.obstacles.spheres import from_origin

NEAR_KNOT = 1e-9  # of a step: so near to a knot is at it


@dataclass(frozen=True)
class Moved(Constraint):
    """Obstacles whose centres are at given places at the knots: spheres, or boxes rounded by their radii.

    Rows are those of `Spheres` and of `Boxes`. From knot to knot they move along straight lines, as the judge measures
    them, and after the last knot they stay.

    Args:
        places: the centres at the knots 0..N, (N+1, M, d), or (B, N+1, M, d) one set per problem, m. One that is NaN at
            all knots is absent (padding).
        radii: one number, (M,) or (B, M), m; NaN where the centre is.
        vehicle_radius: number or (B,), m; or a `Body`.
        half_sizes: of boxes, half the lengths of the sides before rounding, (M, d) or (B, M, d), m, at least 0; one
            with a single side above 0 is a capsule. None: spheres.
        rotations: those that turn the axes of space into the sides of boxes, as of `Boxes`; they are kept.
        knots: at which rows hold, default 1..N.

    Raises:
        InputError: on `Problem(...)`: wrong shapes, places for another number of stages, numbers that aren't finite,
            negative sizes or boxes without any, dynamics without a time step or a position in 2-D or 3-D.
    """

    places: Any
    radii: Any = 0.0
    vehicle_radius: Any = 0.0
    half_sizes: Any = None
    rotations: Any = None
    knots: Any = None

    def bind(self, dims: Dimensions) -> Constraint:
        if is_body(self.vehicle_radius):
            return self.vehicle_radius.around(self, dims)
        if dims.dt is None:
            raise InputError("moved.places", "dynamics with a time step dt", "dynamics without one")
        path, absent = _places(self.places, dimension(dims, "moved.places"), dims)
        radii = own_radii(self.radii, "moved.radii", absent, dims)
        half = torch.zeros_like(path[:, 0])
        if self.half_sizes is not None:
            half = rows(self.half_sizes, "moved.half_sizes", path.shape[-1], dims)
            check_shape(half, (*absent.shape, path.shape[-1]), "moved.half_sizes")
            check_sides(half, radii, absent, "moved.half_sizes")
        elif self.rotations is not None:
            raise InputError("moved.rotations", "half_sizes of boxes, which they turn", "spheres")
        axes = own_axes(self.rotations, "moved.rotations", absent, path.shape[-1], dims)
        boxes = BoundBoxes.prepare(self, "moved", dims, torch.zeros_like(half), half, axes, absent, radii)
        if path.shape[2] == 0:
            return boxes  # none of them moves: what is asked of moving obstacles alone isn't asked of none
        kind = MovedSpheres if self.half_sizes is None else MovedBoxes
        return kind(boxes, path, dims.dt, boxes.knots, boxes.dt)


@dataclass(frozen=True)
class MovedBoxes(MovingBoxes):
    """Boxes along known motions, shaped for their problem."""

    boxes: BoundBoxes  # with centres at 0
    path: Tensor  # (B, T, M, d): the places, `step` seconds apart; 0 where absent
    step: float
    knots: Any
    dt: float
    stops: Tensor | None = None  # (B,)

    batched: ClassVar[tuple[str, ...]] = ("boxes", "path", "stops")

    def centers_at(self, t: Tensor) -> Tensor:
        last = self.path.shape[1] - 1
        sample = (t / self.step).clamp(0.0, last)
        near = sample.round()
        sample = torch.where((sample - near).abs() < NEAR_KNOT, near, sample)
        before = sample.floor().clamp(max=last - 1)
        share, i = (sample - before)[..., None, None], before.long()
        each = (slice(None), i) if t.dim() == 1 else (torch.arange(len(self.path), device=t.device).unsqueeze(-1), i)
        return self.path[each] * (1.0 - share) + self.path[each[0], i + 1] * share

    def measured(self, X: Tensor) -> Distances:
        return box_distances(self.boxes, self._measured_from(X))

    def _measured_from(self, X: Tensor) -> Tensor:
        """From the centres (B, K, M, d) to states X (B, K, n), k dt apart; the judge's own."""
        last, away = self.path.shape[1] - 1, []
        for k in range(X.shape[1]):
            whole = min(k * self.dt / self.step, float(last))
            i = min(int(whole + NEAR_KNOT), last - 1)
            start = torch.lerp(self.path[:, i], self.path[:, i + 1], whole - i)
            away.append(X[:, k, None, self.position] - start)
        return torch.stack(away, dim=1)

    def shapes(self, b: int) -> RoundedBoxes:
        return RoundedBoxes.of(self._solids, self.vehicle_radius, b, track=array(self.path[b]), step=self.step)

    def later(self, t: float) -> Self:
        k = torch.arange(self.path.shape[1], dtype=self.path.dtype, device=self.path.device)
        return replace(self, path=self.centers_at(k * self.step + t))

    def chosen(self, at: Tensor) -> Self:
        path = picked(self.path.transpose(1, 2), at).transpose(1, 2).contiguous()
        return replace(self, boxes=self.boxes.chosen(at), path=path)

    def numbers_of(self, where: str, index: int, others: Sequence[Any]) -> list[Number]:
        if bool(self.absent.any()):
            return []
        after = copied(self.path, [other.path for other in others])
        return numbers(where, {"places": (self.path, present)}, index, after=after)


@dataclass(frozen=True)
class MovedSpheres(MovedBoxes):
    """Boxes without sides, with the rows of spheres."""

    c_kernel: ClassVar[str] = "spheres"

    def rows(self, p: Tensor, t: Tensor) -> Tensor:
        c = self.boxes.inflated_radii.square().unsqueeze(1) - self._away(p, t).square().sum(-1)
        return torch.where(self.absent.unsqueeze(1), ABSENT, c)

    def slopes(self, p: Tensor, t: Tensor) -> Tensor:
        return -2.0 * self._away(p, t)

    def _chords(self, away: Tensor) -> Tensor:
        return from_origin(away[:, :-1], away.diff(dim=1))

    def measured(self, X: Tensor) -> Distances:
        return sphere_distances(self._measured_from(X), self.boxes.inflated_radii, self.absent)

    def lowered(self, n: int, others: Sequence[Any] = ()) -> Lowered:
        balls = (self, *others)
        k = torch.arange(self.path.shape[1], dtype=self.path.dtype, device=self.path.device)[self.knots]
        centers = torch.cat([ball.centers_at(k * ball.dt).flatten(2) for ball in balls], dim=-1)
        sizes = [marked(ball.boxes.inflated_radii.square(), ball.absent) for ball in balls]
        numbers = {"squares": torch.cat(sizes, dim=-1)} | self.lowered_stops()
        return Lowered({"bound": centers}, numbers, {"moved": True})


def _places(value: Any, d: int, dims: Dimensions) -> tuple[Tensor, Tensor]:
    """Places (B, N+1, M, d), 0 where absent, and which obstacles are, (B, M).

    Raises:
        InputError: another shape, NaN at some knots alone, infinity.
    """
    path = tensor(value, "moved.places", dims.like)
    path = path.unsqueeze(0).expand(dims.B, *path.shape) if path.dim() == 3 else path
    knots = dims.N + 1
    if path.dim() != 4 or tuple(path.shape[:2]) != (dims.B, knots) or path.shape[3] != d:
        got = tuple(tensor(value, "moved.places", dims.like).shape)
        raise InputError("moved.places", f"shape ({knots}, M, {d}) or ({dims.B}, {knots}, M, {d})", got)
    absent = torch.isnan(path).all(-1).all(1)
    wrong = ~torch.isfinite(path).all(-1).all(1) & ~absent
    if bool(wrong.any()):
        b, i = wrong.nonzero()[0].tolist()
        k = int((~torch.isfinite(path[b, :, i]).all(-1)).nonzero()[0])
        got = f"{path[b, k, i].tolist()} of obstacle {i} at knot {k} of problem {b}"
        raise InputError("moved.places", "finite places at all knots, or NaN at all of them", got)
    return torch.where(absent[:, None, :, None], 0.0, path).contiguous(), absent
