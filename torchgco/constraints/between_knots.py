"""Rows that hold within a stage, too."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.shapes import Dimensions
from torchgco.base.tree import is_users
from torchgco.constraints.base import Constraint, Distance
from torchgco.dynamics.integrators import INTEGRATORS

MOST_POINTS = 32  # of a stage: each has rows of its own


@dataclass(frozen=True)
class BetweenKnots(Constraint):
    """The rows of another constraint of the state at `points` instants within each stage, evenly spaced.

        speed = NormBounds(("x", [2, 3]), upper=2.0)
        problem = Problem(model, cost, [speed, BetweenKnots(speed)], x0, N=20)

    The states there are those that the problem's own integrator leads to from the knot before. Around a ring of few
    stages three points left 5 % of the violation that knots alone leave.

    Args:
        constraint: an inequality; it holds within the stages that end at its `knots`, by default all, with the numbers
            of that knot. Rows of states and controls: within the stages of its `knots`.
        points: of each stage, 1 to 32.

    Raises:
        InputError: on `Problem(...)`: obstacles, whose distances are kept between the knots anyway; equalities; rows
            of controls alone, or that join knots; a model that doesn't integrate a field.
    """

    constraint: Any  # a Constraint
    points: int = 3
    model: Any = field(default=None, repr=False, kw_only=True)  # the problem's, once bound, as what follows
    stages: Any = field(default=None, repr=False, kw_only=True)  # int64 (K,)
    counted: Any = field(default=None, repr=False, kw_only=True)  # int64 (K,): which of the constraint's knots end them
    factor: int | None = field(default=None, repr=False, kw_only=True)  # the state that is the factor of free time

    batched: ClassVar[tuple[str, ...]] = ("constraint", "model")
    calls_function = property(lambda self: is_users(self.constraint) or is_users(self.model))

    @property
    def knots(self) -> Any:
        return self.stages

    def bind(self, dims: Dimensions) -> Self:
        if not dims.model.is_integrated:
            raise InputError("between_knots", "a model that integrates a field", type(dims.model).__name__)
        if not isinstance(self.constraint, Constraint):
            raise InputError("between_knots.constraint", "a constraint", self.constraint)
        if getattr(self.constraint, "of", "x") == "u":
            raise InputError("between_knots.constraint", "one of the state: controls are held", self.constraint)
        if self.constraint.sense == "equality" or self.constraint.joins_knots:
            raise InputError("between_knots.constraint", "an inequality of one knot", self.constraint)
        if isinstance(self.points, bool) or not isinstance(self.points, int) or not 1 <= self.points <= MOST_POINTS:
            raise InputError("between_knots.points", f"1 to {MOST_POINTS}", self.points)
        if self.stages is not None:
            return self
        constraint: Any = self.constraint
        own = constraint.bind(dims)
        if isinstance(own, Distance):
            raise InputError(
                "between_knots.constraint", "one that isn't kept between the knots anyway", self.constraint
            )
        stages = torch.arange(dims.N + 1, device=dims.like.device)[own.knots] - (0 if _of_stages(own) else 1)
        counted = (stages >= 0).nonzero().flatten()
        return replace(self, constraint=own, model=dims.model, stages=stages[counted], counted=counted)

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        """c (B, K, points p) of the stages, a point after the other."""
        n, m = self.model.n, self.model.m
        model, u = self.model.at(torch.arange(U.shape[1], device=X.device)), U[..., :m]
        rates = lambda x: model.field(x, u)
        if self.factor is not None:
            tau = X[:, :-1, self.factor : self.factor + 1]
            rates = lambda x: tau * model.field(model.settled(x), u)
        rows = []
        for i in range(1, self.points + 1):
            x = INTEGRATORS[model.integrator](rates, X[:, :-1, :n], model.dt * i / (self.points + 1))
            within = (x, X[:, -1:, :n]) if _of_stages(self.constraint) else (X[:, :1, :n], x)
            rows.append(self.constraint.value(torch.cat(within, 1), u)[:, self.counted])
        return torch.cat(rows, dim=-1)

    def in_free_time(self, n: int, m: int, later: int) -> Constraint:
        return replace(self, factor=n)

    def told(self, row: int, knot: int, dynamics: Any) -> str:
        return f"row {row} within the stage"


def _of_stages(constraint: Any) -> bool:
    """Whether rows are of a stage's controls, too: their knots are those where stages begin."""
    return getattr(constraint, "of", "x") == "xu"
