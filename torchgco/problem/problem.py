"""Problem: dynamics, cost and constraints of a batch, joined and validated once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.options import Count, check_value
from torchgco.base.shapes import Dimensions, as_states, check_tensor, computing_on, describe
from torchgco.base.tree import Rows, cast, field_names, is_users
from torchgco.constraints.base import Constraint
from torchgco.constraints.bounds import Bounds, bounds_of, joined_bounds
from torchgco.costs.base import Cost, ShiftedCost
from torchgco.costs.quadratic import BoundQuadratic
from torchgco.dynamics.base import Dynamics
from torchgco.obstacles.base import Obstacles, warn_of_small
from torchgco.problem.border import check_constraints, kind_of
from torchgco.problem.free_start import checked_horizon, chooses_position, clear_starts, moved_inside, start_mask
from torchgco.problem.free_time import FreeTime, check_served
from torchgco.problem.given import Given, as_given, bound, place, remember, replaced
from torchgco.problem.goal import Goal, bound_goal, released, with_goal, without_goal
from torchgco.problem.known import Known
from torchgco.problem.model import check_model
from torchgco.problem.scale import CostScale, changes_of, cost_scale, reach, savings
from torchgco.problem.subset import Subset
from torchgco.problem.summary import summary
from torchgco.problem.tried import check_code


@dataclass(frozen=True)
class Problem(Subset):
    """minimise J_var(X, U) subject to x_{k+1} = step(x_k, u_k), x_0 given, and the constraints: B problems at once.

    Args:
        dynamics, cost, constraints: the parts; values given per problem have the batch of x0.
        x0: (B, n), fixes batch, device and dtype: float64 or float32. Lists and arrays become a tensor, a single state
            (n,) is a batch of one.
        N: number of stages.
        goal: where the last knot should lie, or must: see `Goal`. None: what `Cost.goal` names, if anything, to seek
            paths to, with 0.09 of the distance from the start as radius, while the cost alone decides.
        horizon: int64 (B,), from 1 to N: the number of stages of each problem, after which time stops for it; its
            terminal cost and rows are those of its own last knot, with references and `knot_values` of that knot, and
            no obstacle counts later. None: all have N. CasADi and missions take none, nor do costs with a `total`.
        free_start: which components of the start the solver chooses, bool, (n,) or (B, n). There x0 is a guess, which
            is moved inside `StateBounds` that hold at knot 0. Other constraints hold at that knot where their `knots`
            say so, obstacles wherever a position is free. The interior point, and so `gco`, finds the start, which
            then is X[:, 0] of the solution; other solvers hold the guess. None: x0 is given.
        time: a FreeTime, where the duration is chosen, too; None: N stages of dt.

    Raises:
        InputError: names the part at fault, what was expected and what was given. A start that is bad in one problem
            (not finite, inside an obstacle) is no error: that problem ends with its own status.
    """

    dynamics: Dynamics
    cost: Cost
    constraints: Sequence[Constraint]
    x0: Tensor
    N: int
    goal: Goal | None = None
    horizon: Any = None
    free_start: Any = None
    time: FreeTime | None = None

    # No fields. `known`: what depends on the problems' form alone, shared by all subsets of a batch.
    known: ClassVar[Known]
    given: ClassVar[Given | None] = None  # its parts as they were given; None of what solvers make of a problem

    def __post_init__(self) -> None:
        fields_given = as_given({f.name: getattr(self, f.name) for f in fields(self)})
        given = Given.of(fields_given)
        self._set(**(fields_given | given.numbers), given=given, known=Known(), derived={})
        self._check_border()
        with computing_on(self.x0.device):
            self._bind(*(fields_given[name] for name in ("dynamics", "cost", "constraints")))

    def _bind(self, dynamics: Any, cost: Any, constraints: Any) -> None:
        """Bind the parts; the arguments are those that were given, by which checks of code know them again."""
        dims = self._dimensions(self.x0)
        self._set(dynamics=bound(self.dynamics, dims, "dynamics", Dynamics))
        check_model(self.dynamics, self.x0)
        dims = replace(dims, model=self.dynamics)
        self._set(cost=bound(self.cost, dims, "cost", Cost))
        goal, dims = bound_goal(self.goal, self.cost, dims)
        self._set(constraints=_all_bound(self.constraints, dims, self.goal))
        self._set(x0=moved_inside(self.x0, self.free_start, self.constraints))
        stated = without_goal(self.goal, dims, constraints)
        rows = list(zip(stated, self.constraints, strict=False))  # the goal's row is last
        check_code(dims, self.x0, (dynamics, self.dynamics), (cost, self.cost), rows)
        remember([(dynamics, self.dynamics), (cost, self.cost), *rows])
        for i, constraint in enumerate(self.constraints):
            if isinstance(constraint, Obstacles):
                warn_of_small(constraint, f"constraints[{i}]")
        self._set(goal=goal)
        if self.time is not None:
            self._set(time=self.time.bind(dims))
            check_served(self)

    def _set(self, **parts: Any) -> None:
        for name, part in parts.items():
            object.__setattr__(self, name, part)

    def _dimensions(self, x0: Tensor, dynamics: Dynamics | None = None) -> Dimensions:
        model = dynamics or self.dynamics
        first = 0 if chooses_position(self.free_start, model.position) else 1
        goal, dt = self.goal and self.goal.place, getattr(model, "dt", None)
        names = tuple(getattr(model, "state_names", ()))
        parts = len(x0), self.N, model.n, model.m, dt, model.position, x0, first, goal, self.horizon, names
        return Dimensions(*parts, free_time=self.time is not None, model=model)

    def __repr__(self) -> str:
        return summary(self)

    @cached_property
    def B(self) -> int:
        return self.x0.shape[0]

    @cached_property
    def n(self) -> int:
        return self.dynamics.n

    @cached_property
    def m(self) -> int:
        return self.dynamics.m

    @property
    def along(self) -> Dynamics:
        """The dynamics of all stages together, for states (B, N, n) and controls (B, N, m)."""
        return self.dynamics.at(torch.arange(self.N, device=self.x0.device))

    @property
    def stages(self) -> Tensor:
        """The number of stages of each problem, (B,) int64."""
        return self.x0.new_full((self.B,), self.N, dtype=torch.int64) if self.horizon is None else self.horizon

    @property
    def running(self) -> Tensor:
        """Which stages are a problem's own, (B, N) bool."""
        return torch.arange(self.N, device=self.x0.device) < self.stages.unsqueeze(-1)

    @cached_property
    def position(self) -> slice:
        """The position's place in the state.

        Raises:
            InputError: dynamics without a position.
        """
        where = self.dynamics.position
        if where is None:
            raise InputError("dynamics.position", "a model with a position", type(self.dynamics).__name__)
        return where

    @cached_property
    def geometric(self) -> tuple[Constraint, ...]:
        """The constraints on position that sampling and guidance consider."""
        return tuple(c for c in self.constraints if c.geometric)

    @cached_property
    def obstacles(self) -> tuple[Obstacles, ...]:
        """The constraints that are obstacles, of whatever kind."""
        return tuple(c for c in self.constraints if isinstance(c, Obstacles))

    @property
    def control_bounds(self) -> Bounds | None:
        """The bounds on controls, those of several parts as one; None where there are none."""
        return joined_bounds(bounds_of(self.constraints, "u"), self.N)

    @cached_property
    def start_is_clear(self) -> Tensor:
        """Whether each problem starts outside its obstacles, (B,) bool; see `free_start.clear_starts`."""
        find = lambda p: clear_starts(p.constraints, p.x0, p.free_start, p.dynamics.position)
        return self.derive_rows("start_is_clear", find)

    @property
    def cost_at_rest(self) -> Tensor:
        """J_var (B,) of staying at the start."""
        return self.derive_rows("cost at rest", lambda problem: problem.cost.total(*problem.at_rest))

    @property
    def cost_scale(self) -> CostScale:
        """The unit of each problem's cost, above 0, and its constant; see `scale.cost_scale`."""
        return self.derive_rows("cost_scale", Problem._cost_scale)

    def _cost_scale(self) -> CostScale:
        stages = None if self.horizon is None else self.stages
        if isinstance(self.cost, BoundQuadratic) and self.cost.kernel == "quadratic":
            curvatures = self.cost.control_curvatures.expand(self.B, self.N, self.m)
            return cost_scale(self.cost_at_rest, curvatures, None, stages, self.control_bounds)
        s = self.n + 1 + self.m
        H = self.x0.new_empty(self.B, self.N + 1, s, s)
        self.cost.expand(*self.at_rest, H)
        slopes, diagonal = H[..., self.n], H.diagonal(dim1=-2, dim2=-1)
        z = [i for i in range(s) if i != self.n]
        return self.scale_of(slopes[..., z], diagonal[..., z])

    def scale_of(self, slopes: Tensor, curvatures: Tensor) -> CostScale:
        """`cost_scale` of a cost that isn't quadratic, from its derivatives where the vehicle stays at the start.

        These are gradients and the Hessians' diagonals, (B, N+1, n+m) both.
        """
        X, U = self.at_rest
        total, goal = self.cost_at_rest, None if self.goal is None else self.goal.position
        steps = reach(self.dynamics, X, self.control_bounds)
        changes = changes_of(self.cost, X, U, total, goal, self.dynamics.position, steps)
        changes = torch.maximum(changes, savings(slopes, curvatures))
        return cost_scale(total, curvatures[:, :-1, self.n :], changes, self.horizon, self.control_bounds)

    @cached_property
    def row_shapes(self) -> tuple[tuple[int, int], ...]:
        """Knots and rows of every constraint; the same for all problems of a form."""
        shapes = self.known.row_shapes
        if shapes is None:
            stated = [None if is_users(constraint) else constraint.row_shape(self.N) for constraint in self.constraints]
            complete: list[Any] = stated
            if None in stated:
                # The first problem shows the shapes of all: evaluating a large batch only for its shapes takes long.
                first = self.take(slice(0, 1))
                X, U = first.x0.new_zeros(first.B, self.N + 1, self.n), first.x0.new_zeros(first.B, self.N, self.m)
                parts = zip(stated, first.constraints, strict=True)
                complete = [shape or constraint.value(X, U).shape[1:] for shape, constraint in parts]
            shapes = self.known.row_shapes = tuple((knots, rows) for knots, rows in complete)
        return shapes

    @property
    def cost_unit(self) -> Tensor:
        """The unit of each problem's cost, (B,)."""
        return self.cost_scale.unit

    @property
    def at_rest(self) -> tuple[Tensor, Tensor]:
        """States (B, N+1, n) that stay at the start, and controls (B, N, m) at rest."""
        like = self.x0.new_zeros(self.B, self.N, self.m)
        return self.dynamics.at_rest(self.x0, self.N), self.cost.rest_controls(like)

    def in_cost_units(self) -> Self:
        """The same problems with costs divided by `cost_unit`, without a constant that dwarfs the rest.

        No solver option then depends on the cost's scale or zero.
        """
        return self.derive_rows("in cost units", Problem._in_cost_units)

    def _in_cost_units(self) -> Self:
        unit, constant, _ = self.cost_scale
        cost = self.cost.scaled(1.0 / unit)
        if bool((constant != 0).any()):
            cost = ShiftedCost(cost, constant / (unit * self.N))
        return self._with({"cost": cost}, known=self.known)

    def __getstate__(self) -> dict[str, Any]:
        """The parts alone: native kernels stay in their process."""
        return {f.name: getattr(self.current(), f.name) for f in fields(self)} | {"known": Known(), "derived": {}}

    def take(self, index: Rows) -> Self:
        """The problems in `index` (int64, (B',), or a list or slice); a row may occur more than once.

        All of them in their order are this problem itself, with what is known of it.
        """
        if isinstance(index, list):
            index = torch.tensor(index, dtype=torch.int64, device=self.x0.device)
        B = self.B
        if isinstance(index, slice):
            whole = index.indices(B) == (0, B, 1)
        else:
            whole = index.numel() == B and (B == 1 or torch.equal(index, torch.arange(B, device=index.device)))
        if whole:
            return self
        subset = self.subset(index)
        if self.given is not None:
            subset._set(given=self.given.followed(self, lambda whole: whole.take(index)))
        return subset

    def renewed(self) -> Self:
        """The same problems, with nothing kept that was computed from their parts."""
        return self._with({})

    def current(self) -> Self:
        """The same problems with numbers as they are now, where these were changed in place since; else this one."""
        return self if self.given is None else self.given.current(self)

    def recorded(self) -> Self:
        """The same problems with gradients recorded, from the tensors that were given on; itself without such."""
        return self.given.recorded(self) if self.given is not None and self.given.asks else self

    def is_same(self, other: Problem) -> bool:
        """Whether both have the very same parts."""
        return all(getattr(self, f.name) is getattr(other, f.name) for f in fields(self))

    def start_in(self, x: Tensor) -> Tensor:
        """Starts (B, n): those of x (B, n) in the free components, and x0 in the others."""
        return self.x0 if self.free_start is None else torch.where(self.free_start, x, self.x0)

    def guessing(self, x: Tensor) -> Self:
        """The same problems with other guesses of their free starts, `start_in` x (B, n)."""
        return self._with({"x0": self.start_in(x)}, self.known)

    def held_at(self, x: Tensor) -> Self:
        """The same problems with starts that are given, `start_in` x (B, n); themselves where no start is free."""
        return self if self.free_start is None else self._with({"x0": self.start_in(x), "free_start": None}, self.known)

    def requiring_goal(self, radius: Tensor) -> Self:
        """The same problems with arriving within a radius (B,) of their goal, m, as a constraint, the last of them."""
        assert self.goal is not None
        goal = replace(self.goal, radius=radius, required=True, assumed=False)
        rows = with_goal(goal, self.constraints, self._dimensions(self.x0))
        return self._with({"goal": goal, "constraints": rows}, self.known.of_lifted("with its goal required"))

    def releasing_goal(self) -> Self:
        """The same problems, in the same form, with a required goal stated but not required, its ball without end."""
        assert self.goal is not None
        rows = tuple(map(released, self.constraints))
        return self._with({"goal": replace(self.goal, required=False), "constraints": rows}, self.known)

    def grown(self, by: Tensor) -> Self:
        """The same problems with their obstacles grown by `by` (B,), m."""
        return self._with({"constraints": tuple(c.grown(by) for c in self.constraints)}, known=self.known)

    def started_at(
        self,
        x0: Tensor,
        constraints: Sequence[Constraint],
        cost: Cost | None = None,
        dynamics: Dynamics | None = None,
    ) -> Self:
        """The same problems from other states x0 (B, n): for receding horizons.

        Constraints are of the same kinds in the same order; cost and dynamics as they are where None is given.

        Raises:
            InputError: x0 of another shape, dtype or device, constraints of other kinds, or parts that don't fit.
        """
        x0 = as_states(x0)
        check_tensor(x0, "x0")
        if x0.shape != self.x0.shape or x0.dtype != self.x0.dtype or x0.device != self.x0.device:
            raise InputError("x0", f"{self.x0.dtype} of shape {tuple(self.x0.shape)}", describe(x0))
        check_constraints(constraints)
        if (now := self.current()) is not self:
            return now.started_at(x0, replaced(constraints, self.constraints, now.constraints), cost, dynamics)
        for field, part, kind in (("cost", cost, Cost), ("dynamics", dynamics, Dynamics)):
            if part is not None and not isinstance(part, kind):
                raise InputError(field, f"a {kind.__name__}", kind_of(part))
        if dynamics is not None and (dynamics.n, dynamics.m) != (self.n, self.m):
            raise InputError("dynamics", f"{self.n} states and {self.m} controls", f"{dynamics.n} and {dynamics.m}")
        with computing_on(x0.device):
            model = self.dynamics
            if dynamics is not None:
                model = bound(dynamics, self._dimensions(x0, dynamics), "dynamics", Dynamics)
            dims = self._dimensions(x0, model)
            constraints = without_goal(self.goal, dims, constraints)
            rows = _all_bound(constraints, dims, self.goal)
            for i, part in enumerate(rows):
                other = (part.position, part.dt if part.moving else dims.dt) if isinstance(part, Obstacles) else None
                if other is not None and other != (dims.position, dims.dt):
                    expected = f"obstacles for steps of {dims.dt} s and the position in states {dims.position}"
                    raise InputError(f"constraints[{i}]", expected, f"bound ones for {other[1]} s and {other[0]}")
            if [type(row) for row in rows] != [type(row) for row in self.constraints]:
                kinds = ", ".join(type(row).__name__ for row in self.constraints)
                raise InputError("constraints", f"the kinds {kinds}", ", ".join(type(row).__name__ for row in rows))
            parts: dict[str, Any] = {"x0": moved_inside(x0, self.free_start, rows), "constraints": rows}
            parts["dynamics"] = model
            if cost is not None:
                parts["cost"] = bound(cost, dims, "cost", Cost)
                if self.goal is None or self.goal.assumed:
                    parts["goal"] = Goal.derived(parts["cost"].goal(x0), dims)
            started = self._with(parts)
            started._set(given=self.given and self.given.started(self, x0, constraints, cost, dynamics))
            new = [pair for pair in zip(constraints, rows, strict=False) if place(pair[0], self.constraints) is None]
            pair = lambda part, name: None if part is None else (part, parts[name])
            check_code(dims, started.x0, pair(dynamics, "dynamics"), pair(cost, "cost"), new)
        return started

    def moved_to(self, x0: Tensor, constraints: Sequence[Constraint] | None, dynamics: Dynamics | None) -> Self:
        """`started_at` by parts of the same kinds, code and shapes (None: those before), unchecked."""
        dims, parts = self._dimensions(x0, dynamics), dict[str, Any]()
        if dynamics is not None:
            parts["dynamics"] = dynamics.bind(dims)
        if constraints is not None:
            rows = [constraint.bind(dims) for constraint in without_goal(self.goal, dims, constraints)]
            parts["constraints"] = with_goal(self.goal, rows, dims)
        parts["x0"] = moved_inside(x0, self.free_start, parts.get("constraints", self.constraints))
        return self._with(parts, known=self.known)

    def cast(self, dtype: torch.dtype) -> Self:
        """The same problems in another precision."""
        names = "dynamics", "cost", "constraints", "x0", "goal", "time"
        return self._with({name: cast(getattr(self, name), dtype) for name in names})

    def _with(
        self, parts: dict[str, object], known: Known | None = None, derived: dict[str, Any] | None = None
    ) -> Self:
        # The parts are bound already: checking them again for every subset would cost more than a pass.
        copy, known = object.__new__(type(self)), Known() if known is None else known
        rest = {name: getattr(self, name) for name in field_names(type(self)) if name not in parts}
        vars(copy).update(rest, **parts, known=known, derived={} if derived is None else derived)
        return copy

    def check_controls(self, U: Tensor, field: str = "U0") -> None:
        """Raise InputError unless U is (B, N, m) of this problem's dtype and device."""
        if not isinstance(U, Tensor) or tuple(U.shape) != (self.B, self.N, self.m):
            got = tuple(U.shape) if isinstance(U, Tensor) else type(U).__name__
            raise InputError(field, f"a tensor ({self.B}, {self.N}, {self.m})", got)
        check_tensor(U, field, self.x0)

    def _check_border(self) -> None:
        # The bases themselves compute nothing.
        for name, part, kind in (("dynamics", self.dynamics, Dynamics), ("cost", self.cost, Cost)):
            if not isinstance(part, kind) or type(part) is kind:
                raise InputError(name, f"a {kind.__name__}", kind_of(part))
        for name in ("n", "m"):
            check_value(getattr(self.dynamics, name, None), Count, f"dynamics.{name}")
        self._set(x0=as_states(self.x0))
        if self.x0.dim() != 2 or not self.x0.is_floating_point():
            raise InputError("x0", f"a floating tensor (B, {self.dynamics.n})", describe(self.x0))
        if self.x0.shape[1] != self.dynamics.n or self.x0.shape[0] < 1:
            raise InputError("x0", f"shape (B, {self.dynamics.n})", tuple(self.x0.shape))
        check_tensor(self.x0, "x0")
        self._set(free_start=start_mask(self.free_start, self.x0))
        if isinstance(self.N, bool) or not isinstance(self.N, int) or self.N < 1:
            raise InputError("N", "at least one stage, an int", repr(self.N))
        if self.horizon is not None:
            self._set(horizon=checked_horizon(self.horizon, self.x0, self.N))
        if not callable(self.cost.goal):
            raise InputError("cost.goal", "a method, which no field may hide", type(self.cost.goal).__name__)
        if self.goal is not None and not isinstance(self.goal, Goal):
            raise InputError("goal", "a Goal, or None", type(self.goal).__name__)
        if self.time is not None and not isinstance(self.time, FreeTime):
            raise InputError("time", "a FreeTime, or None", shown(self.time))
        check_constraints(self.constraints)


def current_problem(problem: Any) -> Problem:
    """The problem with its numbers as they are now.

    Raises:
        InputError: the argument is no Problem.
    """
    if not isinstance(problem, Problem):
        raise InputError("problem", "a Problem", kind_of(problem))
    return problem.current()


def _all_bound(constraints: Sequence[Constraint], dims: Dimensions, goal: Goal | None) -> tuple[Constraint, ...]:
    stated = enumerate(without_goal(goal, dims, constraints))
    return with_goal(goal, [bound(row, dims, f"constraints[{i}]", Constraint) for i, row in stated], dims)
