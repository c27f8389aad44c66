"""Rows that hold within a stage, too."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.shapes import Dimensions
from torchgco.base.tree import is_users
from torchgco.constraints.base import Constraint
from torchgco.dynamics.integrators import INTEGRATORS

MOST_POINTS = 32  # of a stage: each has rows of its own
# Where rows are measured between two neighbours among a stage's points, as shares of the gap: a peak anywhere from
# 1/256 of it on is seen to at least 83 %, as its distance from a knot is known to a factor of sqrt(2).
_HALVES = [2.0**-i for i in range(8, 0, -1)]
IN_A_GAP = (*_HALVES, *(1.0 - share for share in reversed(_HALVES[:-1])))
MORE = 1.05  # of an excess: the next trajectory bends a little more


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
    margins: Any = field(default=None, repr=False, kw_only=True)  # (B, K, points, p), once tightened
    counted: Any = field(default=None, repr=False, kw_only=True)  # int64 (K,): which of the constraint's knots end them
    factor: int | None = field(default=None, repr=False, kw_only=True)  # the state that is the factor of free time

    batched: ClassVar[tuple[str, ...]] = ("constraint", "model", "margins")
    on_its_way: ClassVar[bool] = True
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
        own: Any = self.constraint.bind(dims)
        if own.on_its_way:
            raise InputError(
                "between_knots.constraint", "one that isn't kept between the knots anyway", self.constraint
            )
        stages = torch.arange(dims.N + 1, device=dims.like.device)[own.knots] - (0 if _of_stages(own) else 1)
        counted = (stages >= 0).nonzero().flatten()
        if len(counted) == 0:
            raise InputError("between_knots.constraint", "a constraint of a knot at which a stage ends", "knot 0 alone")
        return replace(self, constraint=own, model=dims.model, stages=stages[counted], counted=counted)

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        """c (B, K, points p) of the stages, a point after the other."""
        shares = [i / (self.points + 1) for i in range(1, self.points + 1)]
        rows = torch.stack([self._rows(X, U, share) for share in shares], -2)
        return (rows if self.margins is None else rows + self.margins).flatten(-2)

    def _rows(self, X: Tensor, U: Tensor, share: float) -> Tensor:
        """c (B, K, p) after this share of each stage."""
        n, m = self.model.n, self.model.m
        model, u = self.model.at(torch.arange(U.shape[1], device=X.device)), U[..., :m]
        rates = lambda x: model.field(x, u)
        if self.factor is not None:
            tau = X[:, :-1, self.factor : self.factor + 1]
            rates = lambda x: tau * model.field(model.settled(x), u)
        x = INTEGRATORS[model.integrator](rates, X[:, :-1, :n], model.dt * share)
        within = (x, X[:, -1:, :n]) if _of_stages(self.constraint) else (X[:, :1, :n], x)
        return self.constraint.value(torch.cat(within, 1), u)[:, self.counted]

    def tightened(self, lowered: Self, X: Tensor, U: Tensor) -> Self:
        """The same rows, kept further at points beside a gap in which one is violated, by as much as in that gap.

        A gap that begins or ends at a knot has one such point, and the row is held at the knot: nearer to it, the row
        has to fall further at the point.

        Args:
            lowered: this in the form of X (B, N+1, n) and U (B, N, m).
        """
        gaps, levers = self.points + 1, torch.tensor(IN_A_GAP, dtype=X.dtype, device=X.device)
        at = lambda gap, share=0.0: lowered._rows(X, U, (gap + share) / gaps)
        now = torch.stack([at(gap) for gap in range(1, gaps)], 2)  # (B, K, points, p)
        inner = torch.stack([torch.stack([at(gap, share) for share in IN_A_GAP], -1) for gap in range(gaps)], 2)
        excess, place = inner.max(-1)  # (B, K, gaps, p)
        lever = torch.ones_like(excess)  # how far a row falls there where it falls by 1 at the points of its gap
        lever[:, :, 0], lever[:, :, -1] = levers[place[:, :, 0]], 1.0 - levers[place[:, :, -1]]
        excess = excess.clamp(min=0.0) / lever
        falls = torch.maximum(excess[:, :, :-1], excess[:, :, 1:])
        before = torch.zeros_like(now) if self.margins is None else self.margins
        return replace(self, margins=torch.where(falls > 0, MORE * falls - now, before).clamp(min=0.0))

    def in_free_time(self, n: int, m: int, later: int) -> Constraint:
        return replace(self, factor=n)

    def told(self, row: int, knot: int, dynamics: Any) -> str:
        return f"row {row} within the stage"


def _of_stages(constraint: Any) -> bool:
    """Whether rows are of a stage's controls, too: their knots are those where stages begin."""
    return getattr(constraint, "of", "x") == "xu"
