"""A problem's cost, constraints and guide in the structures that the library reads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchgco.constraints.base import Constraint
from torchgco.constraints.bounds import ControlBounds, StateBounds
from torchgco.lagrangian.penalties import GuideRegion, Penalty
from torchgco.maps.field import BoundField
from torchgco.native import structures as c
from torchgco.native.shared import Shared
from torchgco.native.structures import NOWHERE, QUADRATIC, Guide, Kind, array
from torchgco.obstacles.base import ABSENT, marked
from torchgco.obstacles.body import BoundBody
from torchgco.obstacles.boxes import BoundBoxes
from torchgco.obstacles.spheres import BoundSpheres
from torchgco.problem.problem import Problem

# All other constraints, subclasses of these too, are traced.
KIND_OF = {
    ControlBounds: Kind.BOUNDS, StateBounds: Kind.BOUNDS, BoundSpheres: Kind.SPHERES, BoundBoxes: Kind.BOXES,
    BoundField: Kind.FIELD,
}  # fmt: skip
SOLIDS = BoundSpheres, BoundBoxes, BoundField
BOUND_SLACK = 1.0 + 1e-4  # so that rounding, in single precision too, can't make a row active beyond its box's bounds


def quadratic_arrays(cost: Any) -> list[c.Array]:
    """The arrays of a quadratic cost; those of the last knot have no axis of knots."""
    return [array(getattr(cost, field), knots=not name.endswith("_LAST")) for name, field in QUADRATIC.items()]


def is_bounded(cost: Any) -> bool:
    """Whether no stage of a quadratic cost can be below 0, rounding included; unknown of weights that are matrices."""
    if not cost.diagonal or any(part is not None for part in (cost.q, cost.r, cost.qf, cost.H)):
        return False
    return all(bool((weights.numpy() >= 0).all()) for weights in (cost.Q, cost.R, cost.Qf))


def shared_fields(shared: Shared) -> dict[str, Any]:
    """The fields of a problem that hold the numbers of model and cost that all problems share."""
    stage, last = shared.cost
    return {"shared": shared.model, "stage_shared": stage, "last_shared": last}


def constraint_of(problem: Problem, i: int, own: dict[str, Any]) -> c.Constraint:
    """Constraint i without multipliers, with the fields that `numbers_of` gives."""
    constraint, (knots, rows) = problem.constraints[i], problem.row_shapes[i]
    place = torch.full((problem.N + 1,), NOWHERE, dtype=torch.int32)
    if rows > 0:
        place[constraint.knots] = torch.arange(knots, dtype=torch.int32)
    kind = kind_of(constraint)
    equality, geometric = constraint.sense == "equality", constraint.geometric
    return c.Constraint(kind=kind, equality=equality, geometric=geometric, knots=knots, rows=rows, place=place, **own)


def numbers_of(constraint: Constraint, numbers: Tensor | None, problem: Problem) -> dict[str, Any]:
    """The fields of a `Constraint` in C that hold the numbers of this one; `numbers` (B|1, K|1, count) if traced."""
    if kind_of(constraint) is Kind.FUNCTION:
        return {"bound": array(numbers, knots=True)}
    if isinstance(constraint, ControlBounds | StateBounds):
        return _bounds(constraint, problem)
    parts: tuple[Any, ...] = constraint.balls if isinstance(constraint, BoundBody) else (constraint,)
    own: dict[str, Any] = {}
    if isinstance(parts[0], BoundSpheres):
        own = _spheres(parts)
    elif isinstance(parts[0], BoundBoxes):
        own = {"bound": array(torch.cat([_box_numbers(part) for part in parts], dim=-1), knots=False)}
    elif isinstance(parts[0], BoundField):
        own = _field(parts)
    if isinstance(parts[0], SOLIDS) and parts[0].stops is not None:
        own["stops"] = array(parts[0].stops.unsqueeze(-1), knots=False)
    if isinstance(constraint, BoundBody):
        own |= {"lift": array(numbers, knots=True), "balls": len(parts), "kind_of_balls": KIND_OF[type(parts[0])]}
    return own


def kind_of(constraint: Constraint) -> Kind:
    """How C computes a constraint's rows; a body is a FUNCTION where its balls are of no other kind."""
    if isinstance(constraint, BoundBody):
        return Kind.BODY if type(constraint.balls[0]) in KIND_OF else Kind.FUNCTION
    return KIND_OF.get(type(constraint), Kind.FUNCTION)


def is_lifted(constraint: Constraint) -> bool:
    """Whether C traces where the balls of a body are, and computes their rows itself."""
    return kind_of(constraint) is Kind.BODY


def guide_of(guide: Penalty | None) -> dict[str, Any]:
    """The fields of a problem that hold the penalty of guidance."""
    if guide is None:
        return {}
    own = {"center": array(guide.center, knots=True), "weight": array(guide.weight.unsqueeze(-1), knots=False)}
    if isinstance(guide, GuideRegion):
        return {**own, "guide": Guide.REGION, "radius": array(guide.radius.unsqueeze(-1), knots=True)}
    return {**own, "guide": Guide.PATH}


def _bounds(constraint: ControlBounds | StateBounds, problem: Problem) -> dict[str, Any]:
    size, first = (problem.m, problem.n) if constraint.of == "u" else (problem.n, 0)
    variables = torch.arange(first, first + size, dtype=torch.int32)
    above, below = variables[constraint.above], variables[constraint.below]
    sign = torch.cat((torch.ones(above.numel()), -torch.ones(below.numel()))).double()
    upper, lower = constraint.limits()
    B, K = (max(upper.shape[i], lower.shape[i]) for i in (0, 1))  # one may be shared by all problems or knots
    bound = torch.cat((upper.expand(B, K, -1), lower.expand(B, K, -1)), dim=-1)
    return {"variable": torch.cat((above, below)), "sign": sign, "bound": array(bound, knots=True)}


def _spheres(parts: Sequence[BoundSpheres]) -> dict[str, Any]:
    def joined(rows: list[Tensor]) -> c.Array:
        """Of one part its own memory, which a compiled problem writes into."""
        return array(
            rows[0].flatten(1) if len(rows) == 1 else torch.cat([row.flatten(1) for row in rows], -1), knots=False
        )

    squares = [marked(part.inflated_radii.square(), part.absent) for part in parts]
    own = {"bound": joined([part.centers for part in parts]), "squares": joined(squares)}
    velocities = [part.velocities for part in parts if part.velocities is not None]
    if velocities:
        own["velocities"] = joined(velocities)
    return {**own, "dt": parts[0].dt}


def _box_numbers(boxes: BoundBoxes) -> Tensor:
    """The numbers (B, ...) that boxes.h reads: bounds of all boxes, axis by axis, factors, all numbers of each."""
    absent, radius = boxes.absent.unsqueeze(-1), boxes.inflated_radii.unsqueeze(-1)
    reach = marked(BOUND_SLACK * (boxes.inflated().extent + radius), absent)
    bounds = torch.stack((boxes.centers, reach), dim=-1).transpose(1, 2)
    numbers = torch.cat((boxes.centers, boxes.axes.flatten(2), boxes.half_sizes, marked(radius, absent)), dim=-1)
    return torch.cat((bounds.flatten(1), 2.0 * boxes.depths, numbers.flatten(1)), dim=1)


def _field(parts: Sequence[BoundField]) -> dict[str, Any]:
    """The numbers (B, ...) that field.h reads, and the map itself, which isn't copied."""
    field = parts[0]
    nodes = field.field.nodes(field.origins.device)
    x, y, z = (*nodes.shape[1:], 1)[:3]
    numbers = torch.cat([_field_numbers(part) for part in parts], dim=-1)
    return {
        "bound": array(numbers, knots=False), "map": nodes, "map_of": field.which.contiguous(),
        "map_x": x, "map_y": y, "map_z": z, "smooth": field.smooth,
    }  # fmt: skip


def _field_numbers(field: BoundField) -> Tensor:
    h, d, R, like = field.field.spacing, field.origins.shape[-1], field.vehicle_radius, field.origins
    factors = torch.where(field.absent[:, 0], ABSENT, field.factors)
    reach = BOUND_SLACK * (R + 1.5 * h * d**0.5)  # nodes read for a point lie within h sqrt(d) of the nearest one
    columns = [like.new_full((len(R),), 1.0 / h), like.new_full((len(R),), h * h), R.square(), factors, field.cores]
    return torch.cat((field.origins, torch.stack([*columns, field.limits, reach], dim=-1)), dim=-1)
