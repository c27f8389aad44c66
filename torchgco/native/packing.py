"""A problem's cost, constraints and guide in the structures that the library reads."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchgco.lagrangian.penalties import GuideRegion, Penalty
from torchgco.native import structures as c
from torchgco.native.shared import Shared
from torchgco.native.structures import NOWHERE, QUADRATIC, Guide, Kind, array
from torchgco.problem.problem import Problem


def quadratic_arrays(cost: Any) -> list[c.Array]:
    """The arrays of a quadratic cost; those of the last knot have no axis of knots."""
    return [array(getattr(cost, field), knots=not name.endswith("_LAST")) for name, field in QUADRATIC.items()]


def is_bounded(cost: Any) -> bool:
    """Whether no stage of a quadratic cost can be below 0, rounding included; unknown of weights that are matrices."""
    if not cost.diagonal or any(term is not None for term in (cost.q, cost.r, cost.qf, cost.H)):
        return False
    return all(bool((weights.numpy() >= 0).all()) for weights in (cost.Q, cost.R, cost.Qf))


def shared_fields(shared: Shared) -> dict[str, Any]:
    """The fields of a problem that hold the numbers of model and cost that all problems share."""
    stage, last = shared.cost
    return {"shared": shared.model, "stage_shared": stage, "last_shared": last}


def constraint_of(constraint: Any, shape: tuple[int, int], N: int, kind: Kind, own: dict[str, Any]) -> c.Constraint:
    """A constraint with rows of a shape (K, p) without multipliers, with the fields that `numbers_of` gives."""
    knots, rows = shape
    slots = torch.full((N + 1,), NOWHERE, dtype=torch.int32)
    if rows > 0:
        slots[constraint.knots] = torch.arange(knots, dtype=torch.int32)
    equality, geometric = constraint.sense == "equality", constraint.geometric
    return c.Constraint(kind=kind, equality=equality, geometric=geometric, knots=knots, rows=rows, place=slots, **own)


def numbers_of(constraint: Any, numbers: Tensor | None, problem: Problem) -> dict[str, Any]:
    """The fields of a `Constraint` in C that hold the numbers of this one; `numbers` (B|1, K|1, count) if traced."""
    kind = kind_of(constraint)
    if kind is Kind.FUNCTION:
        return {"bound": array(numbers, knots=True)}
    of = constraint.lowered(problem.n)
    fields = {name: array(value, knots=True) for name, value in of.by_knot.items()}
    fields |= {name: array(value, knots=False) for name, value in of.by_problem.items()} | of.plain
    if kind is Kind.BODY:
        fields |= {"lift": array(numbers, knots=True), "kind_of_balls": kind_of(constraint.balls[0])}
    return fields


def kind_of(constraint: Any) -> Kind:
    """How C computes a constraint's rows."""
    return Kind[constraint.kernel.upper()]


def is_lifted(constraint: Any) -> bool:
    """Whether C traces where the balls of a body are, and computes their rows itself."""
    return constraint.kernel == "body"


def guide_of(guide: Penalty | None) -> dict[str, Any]:
    """The fields of a problem that hold the penalty of guidance."""
    if guide is None:
        return {}
    fields = {"center": array(guide.center, knots=True), "weight": array(guide.weight.unsqueeze(-1), knots=False)}
    if isinstance(guide, GuideRegion):
        return {**fields, "guide": Guide.REGION, "radius": array(guide.radius.unsqueeze(-1), knots=True)}
    return {**fields, "guide": Guide.PATH}
