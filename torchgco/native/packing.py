"""A problem in the structures that the library reads: cost, constraints, guide, and the numbers of its form."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchgco.lagrangian.penalties import GuideRegion, Penalty
from torchgco.native import structures as c
from torchgco.native.codegen.cost import CostSource
from torchgco.native.codegen.dynamics import DynamicsSource
from torchgco.native.codegen.knot import KnotSource
from torchgco.native.structures import NOWHERE, QUADRATIC, Guide, Kind, array
from torchgco.problem.problem import Problem
from torchgco.tracing import Traced, contents


@dataclass(frozen=True)
class Shared:
    """Such numbers as they were when they were read, (s,) float64 of each function."""

    model: Tensor
    cost: tuple[Tensor, Tensor]  # of stages, and of the last knot
    rows: Mapping[int, Tensor]  # of constraints, by their place

    def copy(self) -> Shared:
        stage, last = self.cost
        rows = {i: numbers.clone() for i, numbers in self.rows.items()}
        return Shared(self.model.clone(), (stage.clone(), last.clone()), rows)

    def take_over(self, other: Shared) -> None:
        """Write the numbers of another one of the same form into this one's memory."""
        for old, new in zip(self._all, other._all, strict=True):
            old.copy_(new)

    def is_same(self, other: Shared) -> bool:
        return all(torch.equal(*pair) for pair in zip(self._all, other._all, strict=True))

    @property
    def _all(self) -> tuple[Tensor, ...]:
        return self.model, *self.cost, *self.rows.values()


class Captured:
    """What the functions of a form read from outside: tensors that they capture, weights of modules."""

    def __init__(self, model: DynamicsSource, cost: CostSource | None, functions: Mapping[int, KnotSource]) -> None:
        self._places, self._has_cost = tuple(functions), cost is not None
        self.traces: list[Traced] = [model.traced]
        self.traces += () if cost is None else (source.span.traced for source in cost.parts)
        self.traces += (rows.span.traced for rows in functions.values())
        self._outside = list({id(tensor): tensor for traced in self.traces for tensor in traced.outside}.values())
        self._last: tuple[tuple[Hashable, ...] | None, Shared | None] = None, None

    @property
    def is_mixed(self) -> bool:
        """Whether numbers that differ between problems depend on it, too."""
        return any(traced.is_mixed for traced in self.traces)

    @property
    def reads_own(self) -> bool:
        """Whether a function's code has read the numbers of a problem that others may not have."""
        return any(traced.reads_own for traced in self.traces)

    @property
    def is_elsewhere(self) -> bool:
        """Whether some lie on another device."""
        return any(tensor.device.type != "cpu" for tensor in self._outside)

    @property
    def nbytes(self) -> int:
        """The size of all these tensors, of sparse ones as if they were dense."""
        return sum(tensor.numel() * tensor.element_size() for tensor in self._outside)

    def is_still(self, last: Shared | None) -> bool:
        """Whether `read` would give what it gave before, `last`; done without PyTorch's operations."""
        then, known = self._last
        return then is not None and last is known and contents(self._outside) == then

    def read(self) -> Shared | None:
        """The numbers as they are now, not to be written to; None where a function is to be traced again.

        The same object as at the last call where nothing has changed.
        """
        seen, (then, last) = contents(self._outside), self._last
        if seen is None or seen != then:
            last = self._read()
            self._last = seen, last  # seen before it was read: what changes meanwhile is read at the next call
        return last

    def _read(self) -> Shared | None:
        shared = list[Tensor]()
        for traced in self.traces:
            numbers = traced.shared_numbers()
            if numbers is None:
                return None
            shared.append(numbers)
        of_model, *others = shared
        of_cost = (others.pop(0), others.pop(0)) if self._has_cost else (of_model[:0], of_model[:0])
        return Shared(of_model, of_cost, dict(zip(self._places, others, strict=True)))


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
