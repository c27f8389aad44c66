"""The goal of a problem, for solver, search and judge alike; and the rows of one that binds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchgco.base.errors import InputError, shown
from torchgco.base.numbers import Floats, Number, Wrong, above_zero, finite, numbers
from torchgco.base.shapes import Dimensions, check_finite, check_shape, per_row, space_of
from torchgco.base.tree import PerElement
from torchgco.constraints.base import Constraint, whole
from torchgco.constraints.norms import NormBounds
from torchgco.costs.base import Cost
from torchgco.obstacles.base import ADMITTED
from torchgco.problem.border import called

AXES = "xyz"
RADIUS_SHARE = 0.09  # radius of a goal that is derived from a cost, as a share of the distance from start to goal


@dataclass(frozen=True)
class Goal(PerElement):
    """A ball in which the last knot should lie; or, required, a ball in which or a state at which it must.

        Goal([4.0, 0.0], 0.3)                     # where the trajectory should end: judged, and sought by the search
        Goal([4.0, 0.0], 0.3, required=True)      # |p_N - position| <= radius is a constraint
        Goal(state=[4.0, 0, 0, 0], required=True)  # x_N = state is one: a boundary constraint
        Goal(state=hover, required=True, quaternion=range(6, 10))  # the same attitude, as q or as -q

    A required goal adds its rows to the problem's constraints, as the last of them; where horizons differ they hold at
    each problem's own last knot. Feasible is then what arrives.

    Args:
        position: its centre (d,), or (B, d) one per problem, m.
        radius: number or (B,), m, above 0. With a state, by how much its position may be missed to count as reached;
            None: 1e-3, as constraints are admitted to be violated.
        required: whether arriving is a constraint.
        state: (n,), or (B, n) one per problem, in the place of a position; NaN in components that are free at the end,
            the same ones in all problems. Models without a position take one, too: the problem has no `goal` then.
        quaternion: which four states (w, x, y, z) of `state` are a quaternion: q and -q, one attitude, serve alike. In
            their place are three rows, about the rotation vector that is left, rad. None: there is none.

    Raises:
        InputError: on `Problem(...)`: wrong shapes, values that aren't finite, a radius that isn't above 0, dynamics
            without a position; a position and a state, or neither; a state that isn't required, or free as a whole;
            a quaternion without a state, of other than four states, or free or 0 in a problem.
    """

    position: Any = None
    radius: Any = None
    required: bool = False
    state: Any = None
    quaternion: Any = None
    assumed: bool = False  # derived from the cost: the radius is a rule of thumb

    batched: ClassVar[tuple[str, ...]] = ("position", "radius", "state")

    def bind(self, dims: Dimensions) -> Goal | None:
        """The goal with one row per problem; None where the model has no position; called once, by Problem."""
        if not isinstance(self.required, bool):
            raise InputError("goal.required", "True or False", shown(self.required))
        if self.state is not None:
            return self._bound_state(dims)
        if self.quaternion is not None:
            raise InputError("goal.quaternion", "None without a state, which says the attitude", shown(self.quaternion))
        position = per_row(self.position, "goal.position", dims, space_of(dims, "goal"))
        check_finite(position, "goal.position")
        return Goal(position.contiguous(), self._bound_radius(dims), self.required)

    def _bound_radius(self, dims: Dimensions) -> Tensor:
        radius = per_row(self.radius, "goal.radius", dims)
        if not bool((radius > 0).all() & torch.isfinite(radius).all()):
            raise InputError("goal.radius", "finite numbers above 0 m", float(radius.min()))
        return radius.contiguous()

    def _bound_state(self, dims: Dimensions) -> Goal | None:
        if not self.required:
            raise InputError("goal.state", "a state with required=True; or a position and a radius", "required=False")
        if self.position is not None and not self._is_bound:
            raise InputError("goal.position", "none beside a state", shown(self.position))
        state = per_row(self.state, "goal.state", dims, dims.n)
        free = torch.isnan(state)
        if bool(torch.isinf(state).any() | (free != free[:1]).any() | free.all()):
            raise InputError("goal.state", "finite numbers, NaN in the same components of all problems", state.tolist())
        quaternion = self._attitude(state, dims.n)
        if dims.position is None:
            return None
        if bool(free[:, dims.position].any()):
            raise InputError("goal.state", "a position that isn't free", "NaN in it")
        radius = dims.like.new_full((dims.B,), ADMITTED) if self.radius is None else self._bound_radius(dims)
        return Goal(state[:, dims.position].contiguous(), radius, True, state.contiguous(), quaternion)

    def _attitude(self, state: Tensor, n: int) -> tuple[int, ...] | None:
        """Which of the n states are the quaternion, which no problem's state (B, n) leaves free."""
        if self.quaternion is None:
            return None
        try:
            places = tuple(whole(i) for i in self.quaternion)
        except TypeError:
            places = ()
        if len(set(places)) != 4 or len(places) != 4 or not all(0 <= i < n for i in places):
            expected = f"four of the states 0..{n - 1}, (w, x, y, z), none twice"
            raise InputError("goal.quaternion", expected, shown(self.quaternion))
        if not bool((state[:, places].norm(dim=-1) > 0).all()):
            raise InputError("goal.state", "a quaternion other than 0 and without NaN", state[:, places].tolist())
        return places

    @property
    def _is_bound(self) -> bool:
        """Whether a position stands beside the state because this goal is bound already."""
        return isinstance(self.position, Tensor) and isinstance(self.state, Tensor) and self.state.dim() == 2

    @property
    def place(self) -> Tensor | None:
        """The position (B, d) of a goal that is bound; None before that."""
        return self.position if isinstance(self.position, Tensor) and self.position.dim() == 2 else None

    def rows(self, dims: Dimensions) -> Constraint:
        """The constraint of a required goal that `bind` accepts."""
        if self.state is None:
            bound = self.bind(dims)
            assert bound is not None and dims.position is not None
            components = list(range(dims.n))[dims.position]
            return GoalBall(("x", components), upper=bound.radius, knots=[dims.N], center=bound.position).bind(dims)
        state = per_row(self.state, "goal.state", dims, dims.n)
        return GoalState(state, quaternion=self._attitude(state, dims.n)).bind(dims)

    @classmethod
    def derived(cls, state: Tensor | None, dims: Dimensions) -> Goal | None:
        """The goal at the state (B, n) that a cost asks for; None without such a state or without a position."""
        if state is None or dims.position is None:
            return None
        check_shape(state, (dims.B, dims.n), "cost.goal")
        apart = (dims.like - state)[:, dims.position].square().sum(-1).sqrt()
        return cls(state[:, dims.position], RADIUS_SHARE * apart, assumed=True)

    def distance(self, p: Tensor) -> Tensor:
        """Distances (B, ...) of points p (B, ..., d) from the centre, m."""
        center = self.position if p.dim() == 2 else self.position.view(-1, *([1] * (p.dim() - 2)), p.shape[-1])
        return (p - center).square().sum(-1).sqrt()


@dataclass(frozen=True)
class GoalBall(NormBounds):
    """The row of a required goal: the last knot lies in its ball; `violation` in metres."""

    name: ClassVar[str] = "goal"
    label: ClassVar[str] = "goal"
    in_metres: ClassVar[bool] = True  # type: ignore[misc]
    is_goal: ClassVar[bool] = True
    says_where: ClassVar[bool] = True

    def told(self, row: int, knot: int, dynamics: Any) -> str:
        return "its radius"

    def numbers(self, where: str, index: int) -> list[Number]:
        centre, radius = self.center[:, 0], self.upper[:, 0]
        return numbers("goal", {"position": (centre, finite), "radius": (radius, above_zero)}, index)

    def goal(self, before: Goal, position: slice) -> Goal:
        """The goal whose numbers lie in the memory of this row's."""
        return Goal(self.center[:, 0], self.upper[:, 0], True)


@dataclass(frozen=True)
class GoalState(Constraint):
    """The rows x_N - state = 0 of a required goal, of the components that aren't NaN.

    Of a quaternion q they are 2 g* q / |g| with the goal's conjugate g*, without the scalar part: q = g and q = -g meet
    them. Nearby they are the rotation from one to the other, rad.
    """

    state: Tensor  # (B, n)
    quaternion: tuple[int, ...] | None = None
    components: Tensor | None = None  # (c,) int64, once bound
    knots: Any = None

    batched: ClassVar[tuple[str, ...]] = ("state",)
    of: ClassVar[str] = "x"
    sense: ClassVar[Any] = "equality"
    name: ClassVar[str] = "goal"
    is_goal: ClassVar[bool] = True

    def bind(self, dims: Dimensions) -> Self:
        stated = ~torch.isnan(self.state[0])
        if self.quaternion is not None:
            stated[list(self.quaternion)] = False
        components = stated.nonzero().flatten()
        return replace(self, components=components, knots=slice(dims.N, dims.N + 1))

    def told(self, row: int, knot: int, dynamics: Any) -> str:
        components: list[int] = self.components.tolist()  # type: ignore[union-attr]
        if row < len(components):
            return f"state {components[row]}"
        return f"rotation about the body's {AXES[row - len(components)]} axis"

    def numbers(self, where: str, index: int) -> list[Number]:
        return numbers("goal", {"state": (self.state, self._check_new)}, index)

    def _check_new(self, new: Floats) -> Wrong:
        free = np.isnan(self.state.numpy()[0])
        fits = (np.isnan(new) == free).all() and np.isfinite(new[..., ~free]).all()
        return None if fits else ("finite numbers, and NaN in the components that are free at the end", new.tolist())

    def goal(self, before: Goal, position: slice) -> Goal:
        """As of `GoalBall`."""
        return Goal(self.state[:, position], before.radius.clone(), True, self.state, self.quaternion)

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        x = X[:, self.knots]
        rows = x[..., self.components] - self.state[:, self.components].unsqueeze(1)
        if self.quaternion is None:
            return rows
        q = x[..., list(self.quaternion)].unsqueeze(-2)
        return torch.cat((rows, (self._turns().unsqueeze(1) * q).sum(-1)), dim=-1)

    def _turns(self) -> Tensor:
        """The matrices (B, 3, 4) of the rows of the quaternion."""
        assert self.quaternion is not None
        w, x, y, z = (2.0 * normalize(self.state[:, list(self.quaternion)], dim=-1)).unbind(-1)
        rows = (-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w)
        return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        components, n = self.components, X.shape[-1]
        assert components is not None
        if self.quaternion is not None:
            places, turns = torch.tensor(self.quaternion, device=X.device), self._turns()
            (g, by_turn), (h, weight) = (rows[:, 0].split([len(components), 3], -1) for rows in (g, h))
            slope = (by_turn.unsqueeze(-2) @ turns).squeeze(-2)
            H[:, -1, places, n] += slope
            H[:, -1, n, places] += slope
            H[:, -1, places.unsqueeze(-1), places] += turns.mT @ (weight.unsqueeze(-1) * turns)
            g, h = g.unsqueeze(1), h.unsqueeze(1)
        H[:, -1, components, n] += g[:, 0]
        H[:, -1, n, components] += g[:, 0]
        H[:, -1, components, components] += h[:, 0]


def bound_goal(goal: Goal | None, cost: Cost, dims: Dimensions) -> tuple[Goal | None, Dimensions]:
    """The goal that was stated, else the one that the cost names, bound; and the dimensions with its position.

    Raises:
        InputError: see `Goal`.
    """
    stated = goal is not None and not goal.assumed
    if stated:
        bound = goal.bind(dims)  # type: ignore[union-attr]
    else:
        place = called("cost.goal", f"{dims.like.dtype} states {tuple(dims.like.shape)}, or None", cost.goal, dims.like)
        bound = Goal.derived(place, dims)
    return bound, dims if bound is None else replace(dims, goal=bound.position)


def released(row: Constraint) -> Constraint:
    """A row of a required ball, whatever form it has, without an end to the ball; any other row itself."""
    if isinstance(row, GoalBall):
        return replace(row, upper=torch.full_like(row.upper, torch.inf))
    if not isinstance(row.bare, GoalBall):
        return row
    return replace(row, constraint=released(row.constraint))  # type: ignore


def without_goal(goal: Goal | None, dims: Dimensions, constraints: Sequence[Constraint]) -> Sequence[Constraint]:
    """Constraints without the rows of a required goal, as they may be those of a problem that is bound.

    A model without a position keeps them where no goal takes their place: its problems have no other memory of it.
    """
    if dims.position is None and goal is None:
        return constraints
    return [constraint for constraint in constraints if not constraint.is_goal]


def with_goal(goal: Goal | None, rows: Sequence[Constraint], dims: Dimensions) -> tuple[Constraint, ...]:
    """Bound constraints followed by those of a required goal.

    Raises:
        InputError: see `Goal`.
    """
    if goal is None or not goal.required:
        return tuple(rows)
    goal.bind(dims)  # which says what is wrong with it
    return (*rows, goal.rows(dims))
