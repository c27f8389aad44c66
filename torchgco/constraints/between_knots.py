"""Rows that hold within a stage, too."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from torchgco.base.errors import InputError
from torchgco.base.shapes import Dimensions
from torchgco.base.tree import is_users
from torchgco.constraints.base import Constraint
from torchgco.dynamics.base import INTEGRATORS

MOST_POINTS = 32  # of a stage: each has rows of its own
# Instants at which rows of a stage are measured, its ends included, closer to these. A parabola through three of them
# finds a peak so well that a row there, whose slope is 0, is off by 1e-4 of what the row bends within a stage.
INSTANTS = 65
NUMBERS_AT_ONCE = 2**20  # of states at several instants: 8 MB
PUSHES = 0.1  # share of a row's largest multiplier in a stage from which a point holds the trajectory: others are idle
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
    shares: Any = field(default=None, repr=False, kw_only=True)  # (B, N, points), once tightened: of each stage
    margins: Any = field(default=None, repr=False, kw_only=True)  # (B, K, points, p), once tightened
    counted: Any = field(default=None, repr=False, kw_only=True)  # int64 (K,): which of the constraint's knots end them
    factor: int | None = field(default=None, repr=False, kw_only=True)  # the state that is the factor of free time

    batched: ClassVar[tuple[str, ...]] = ("constraint", "model", "shares", "margins")
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
        places = self._even if self.shares is None else self.shares.unbind(-1)
        rows = torch.stack([self._rows(X, U, share) for share in places], -2)
        return (rows if self.margins is None else rows + self.margins).flatten(-2)

    @property
    def _even(self) -> list[float]:
        """Shares of a stage that are apart by the same."""
        return [i / (self.points + 1) for i in range(1, self.points + 1)]

    def _rows(self, X: Tensor, U: Tensor, share: float | Tensor) -> Tensor:
        """c (B, K, p) after this share of each stage, one of all or (B, N)."""
        n, m = self.model.n, self.model.m
        model, u = self.model.at(torch.arange(U.shape[1], device=X.device)), U[..., :m]
        rates = lambda x: model.field(x, u)
        if self.factor is not None:
            tau = X[:, :-1, self.factor : self.factor + 1]
            rates = lambda x: tau * model.field(model.settled(x), u)
        length, own = model.dt * share, rates
        if isinstance(share, Tensor):  # integrators take one time step for all states
            length, own = model.dt, lambda x: share.unsqueeze(-1) * rates(x)
        x = INTEGRATORS[model.integrator](own, X[:, :-1, :n], length)
        within = (x, X[:, -1:, :n]) if _of_stages(self.constraint) else (X[:, :1, :n], x)
        return self.constraint.value(torch.cat(within, 1), u)[:, self.counted]

    def tightened(self, lowered: Self, X: Tensor, U: Tensor, lam: Tensor) -> Self:
        """The same rows, kept further, or at other instants, where one is violated between its points.

        Between two points that both push, the row is kept further at both, by the excess: the trajectory lies on them.
        Beside one alone a peak would flee to its other side: there the least of the stage's points moves to the peak,
        and the next one is between two (an exchange method of semi-infinite programming).

        Args:
            lowered: this in the form of X (B, N+1, n) and U (B, N, m).
            lam: multipliers (B, K, points p).
        """
        shape = *U.shape[:2], self.points
        shares = X.new_tensor(self._even).expand(shape) if self.shares is None else self.shares
        now = torch.stack([lowered._rows(X, U, share) for share in shares.unbind(-1)], 2)  # (B, K, points, p)
        margins = torch.zeros_like(now) if self.margins is None else self.margins
        rows = now, lam.unflatten(-1, (self.points, -1))
        points, margins = _answered(shares[:, self.stages], margins, *rows, *lowered._peaks(X, U))
        shares = shares.clone()
        shares[:, self.stages] = points
        return replace(self, shares=shares, margins=margins)

    def _peaks(self, X: Tensor, U: Tensor) -> tuple[Tensor, Tensor]:
        """The heights of each row's peaks within stages, minus infinity where there is none, and their shares,
        (B, K, p instants) both."""
        angles = torch.linspace(0.0, torch.pi, INSTANTS, dtype=X.dtype, device=X.device)
        shares = lambda angle: 0.5 - 0.5 * angle.cos()
        at_once = max(1, NUMBERS_AT_ONCE // max(1, X.numel()))
        c = torch.cat([self._at_all(X, U, shares(some)) for some in angles.split(at_once)], 1).movedim(1, -1)
        low, mid, high = c[..., :-2], c[..., 1:-1], c[..., 2:]  # (B, K, p, instants)
        bend = low - 2.0 * mid + high
        off = torch.where(bend < 0, 0.5 * (low - high) / bend, 0.0).clamp(-1.0, 1.0)
        peak = (mid >= low) & (mid > high)
        height = torch.where(peak, mid - 0.25 * (low - high) * off, -torch.inf)
        return height, shares(angles[1:-1] + off * (angles[1] - angles[0]))

    def _at_all(self, X: Tensor, U: Tensor, shares: Tensor) -> Tensor:
        """c (B, S, K, p) after each of these shares (S,) of all stages."""
        B, S = len(X), len(shares)
        each = torch.arange(B, device=X.device).repeat_interleave(S)
        lengths = shares.repeat(B).unsqueeze(-1).expand(-1, U.shape[1])
        return self.take(each)._rows(X[each], U[each], lengths).unflatten(0, (B, S))

    def in_free_time(self, n: int, m: int, later: int) -> Constraint:
        return replace(self, factor=n)

    def told(self, row: int, knot: int, dynamics: Any) -> str:
        return f"row {row} within the stage"


def _of_stages(constraint: Any) -> bool:
    """Whether rows are of a stage's controls, too: their knots are those where stages begin."""
    return getattr(constraint, "of", "x") == "xu"


def _answered(
    shares: Tensor, margins: Tensor, now: Tensor, lam: Tensor, heights: Tensor, places: Tensor
) -> tuple[Tensor, Tensor]:
    """Shares (B, K, P) and margins (B, K, P, p) of points that answer peaks above 0, as many as there are points.

    Args:
        now: the rows at the points, (B, K, P, p).
        lam: their multipliers.
        heights, places: of each row's peaks, (B, K, p, q).
    """
    before, (*_, P, p) = shares, now.shape
    pushes, idle = lam > PUSHES * lam.amax(2, keepdim=True), lam.sum(-1)
    highest, index = heights.flatten(2).topk(P, dim=-1)
    for height, chosen in zip(highest.split(1, -1), index.split(1, -1), strict=True):
        place, row = places.flatten(2).gather(-1, chosen), one_hot(chosen // heights.shape[-1], p).bool()
        beside = _beside(before, place)
        held = beside.any(-1, keepdim=True) & ~(beside & ~(pushes & row).any(-1)).any(-1, keepdim=True)
        further = torch.maximum(margins, MORE * height.unsqueeze(-1) - now)
        margins = torch.where((beside & held & (height > 0)).unsqueeze(-1) & row, further, margins)
        moves = one_hot(idle.argmin(-1), P).bool() & (height > 0) & ~held
        shares, margins = torch.where(moves, place, shares), torch.where(moves.unsqueeze(-1), 0.0, margins)
        idle = idle.masked_fill(moves, torch.inf)
    return shares, margins


def _beside(points: Tensor, place: Tensor) -> Tensor:
    """The last of the points (B, K, P) up to a place (B, K, 1) and the first after it, bool; none without both."""
    up_to = points <= place
    sides = points.masked_fill(~up_to, -torch.inf).argmax(-1), points.masked_fill(up_to, torch.inf).argmin(-1)
    both = up_to.any(-1, keepdim=True) & ~up_to.all(-1, keepdim=True)
    return one_hot(torch.stack(sides, -1), points.shape[-1]).bool().any(-2) & both
