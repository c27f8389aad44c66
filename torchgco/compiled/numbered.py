"""Which numbers a problem has: those of its start, its cost, its model and of each of its constraints."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base.tree import PerElement, own_mapped
from torchgco.base.values import Values
from torchgco.compiled.numbers import (
    Check,
    Floats,
    Joint,
    Number,
    Wrong,
    above_zero,
    above_zero_or_infinite,
    at_least_zero,
    finite,
    lengths,
    numbers,
    present,
)
from torchgco.constraints.base import Constraint
from torchgco.constraints.bounds import ControlBounds, StateBounds
from torchgco.constraints.gates import GateBalls, GateSquares
from torchgco.constraints.norms import Cone, NormBounds
from torchgco.costs.in_free_time import QuadraticInFreeTime
from torchgco.costs.quadratic import BoundQuadratic, check_semidefinite, unfit
from torchgco.obstacles.base import Obstacles
from torchgco.obstacles.body import BoundBody
from torchgco.obstacles.boxes import BoundBoxes
from torchgco.obstacles.spheres import BoundSpheres
from torchgco.problem.goal import Goal, GoalBall, GoalState
from torchgco.problem.problem import Problem

WEIGHTS = "Q", "R", "Qf"


def with_own_numbers(problem: Problem) -> Problem:
    """The same problems, with memory of its own for every number of every problem."""
    B = problem.B
    cost = _own(problem.cost, B)
    if type(cost) is BoundQuadratic:
        for name, length in (("x_ref", problem.N), ("u_ref", problem.N)):
            part = getattr(cost, name)
            object.__setattr__(cost, name, part.expand(B, length, part.shape[-1]).clone())
    rows = tuple(_own(part, B) for part in problem.constraints)
    parts = {"x0": problem.x0.clone(), "dynamics": _own(problem.dynamics, B), "cost": cost, "constraints": rows}
    parts["time"] = _own(problem.time, B)
    if problem.goal is not None and problem.goal.required:
        parts["goal"] = _goal_of(rows[-1], problem)
    return problem._with(parts)


def _goal_of(row: Constraint, problem: Problem) -> Goal:
    """The goal whose numbers lie in the memory of its row's."""
    goal = problem.goal
    assert goal is not None
    if isinstance(row, GoalState):
        return Goal(row.state[:, problem.position], goal.radius.clone(), True, row.state)
    assert isinstance(row, GoalBall)
    return Goal(row.center[:, 0], row.upper[:, 0], True)


def numbers_of(problem: Problem) -> list[Number]:
    """The numbers of a problem that has memory of its own for each, `with_own_numbers`."""
    found = [Number("x0", (problem.x0.numpy(),), "x0", False, lambda new: None)]
    found += _of_cost(problem)
    found += _of_part(problem.dynamics, "dynamics", "dynamics")
    for i, part in enumerate(problem.constraints):
        name = f"constraints[{i}]"
        if isinstance(part, ControlBounds | StateBounds):
            found += _of_bounds(part, name, i)
        elif isinstance(part, GoalBall):
            place, radius = part.center[:, 0], part.upper[:, 0]
            found += numbers("goal", {"position": (place, finite), "radius": (radius, above_zero)}, i)
        elif isinstance(part, GoalState):
            found += numbers("goal", {"state": (part.state, partial(_fixed, part))}, i)
        elif isinstance(part, GateBalls):
            found += _of_balls(part, i)
        elif isinstance(part, GateSquares):
            found += _of_squares(part, i)
        elif isinstance(part, NormBounds | Cone):
            found += _of_vectors(part, name, i)
        elif isinstance(part, Obstacles):
            found += _of_obstacles(part, name, i)
        else:
            found += _of_part(part, name, i)
    return found


def with_numbers_as_they_are(problem: Problem) -> Problem:
    """The same problems after numbers were written, with nothing that was computed from the previous ones."""
    constraints = tuple(map(_remade, problem.constraints))
    known = replace(problem.known, row_shapes=None, interior=None, packed={}, lifted={})
    now = problem._with({"constraints": constraints}, known)
    if now.goal is None or now.goal.assumed:
        dims = now._dimensions(now.x0)
        now = now._with({"goal": Goal.derived(now.cost.goal(now.x0), dims)}, known)
    return now


def _remade(part: Constraint) -> Constraint:
    """A constraint whose matrices are those of its numbers as they are."""
    if isinstance(part, BoundBody):
        balls = tuple(ball.remade() if isinstance(ball, BoundSpheres) else ball for ball in part.balls)
        inner = part.inner.remade() if isinstance(part.inner, BoundSpheres) else part.inner
        return replace(part, balls=balls, inner=inner)
    return part.remade() if isinstance(part, BoundSpheres) else part


def _own(part: Any, B: int) -> Any:
    """A part of a problem with copies of all its numbers, one for every problem."""

    def each(value: Tensor) -> Tensor:
        if value.dim() == 0:
            return value
        return value.expand(B, *value.shape[1:]).clone(memory_format=torch.contiguous_format)

    return own_mapped(part, each)


def _of_cost(problem: Problem) -> list[Number]:
    cost, after = problem.cost, None
    if isinstance(cost, QuadraticInFreeTime):
        cost, after = cost.cost, cost.write
    if type(cost) is not BoundQuadratic:
        return _of_part(cost, "cost", "cost")
    found = [Number("cost.x_ref", (cost.x_ref.numpy(), cost.xf_ref.numpy()), "cost", False, finite, after)]
    for name in ("u_ref", *WEIGHTS, "q", "r", "qf", "H"):
        tensor = getattr(cost, name)
        if tensor is not None:
            check = finite if name not in WEIGHTS else at_least_zero if cost.diagonal else _matrices
            joint = _semidefinite(cost) if name in ("Q", "R", "H") and cost.H is not None else None
            found += numbers("cost", {name: (tensor, check)}, "cost", False, joint=joint)
    return found


def _semidefinite(cost: BoundQuadratic) -> Joint:
    """A check of Q, R and H together: each alone may be fine, and the stage cost still fall without end."""

    def check(new: Mapping[str, Floats]) -> None:
        own = {name: new.get(f"cost.{name}", getattr(cost, name).numpy()) for name in (*WEIGHTS, "H")}
        check_semidefinite(**{name: torch.tensor(weights) for name, weights in own.items()})

    return check


def _of_bounds(part: ControlBounds | StateBounds, name: str, i: int) -> list[Number]:
    def check(new: Floats, side: str) -> Wrong:
        sign = 1.0 if side == "lower" else -1.0
        bounded = np.zeros(part.lower.shape[-1], dtype=bool)
        bounded[part.below if side == "lower" else part.above] = True
        free = new[..., ~bounded]
        if np.isnan(new).any() or (new == sign * np.inf).any():
            return f"numbers or {-sign * np.inf}", new.tolist()
        if np.isfinite(free).any():
            expected = "infinity in components that were infinite when the problem was compiled; give them 1e9 then"
            return expected, float(free[np.isfinite(free)][0])
        return None

    fields = {side: (getattr(part, side), partial(check, side=side)) for side in ("lower", "upper")}
    crossed = _crossed(part, name, np.greater, "lower bounds of at most the upper ones")
    found = numbers(name, fields, i, joint=crossed)
    for number, none in zip(found, (-np.inf, np.inf), strict=True):
        number.none = none
    return found


def _crossed(part: Any, name: str, is_over: Callable[..., Any], expected: str) -> Joint:
    """A check of lower and upper bounds together."""

    def check(new: Mapping[str, Floats]) -> Wrong:
        bounds = (new.get(f"{name}.{side}", getattr(part, side).numpy()) for side in ("lower", "upper"))
        lower, upper = np.broadcast_arrays(*bounds)
        over = is_over(lower, upper)
        return (expected, f"{lower[over][0]:g} and {upper[over][0]:g}") if over.any() else None

    return check


def _of_vectors(part: NormBounds | Cone, name: str, i: int) -> list[Number]:
    """Of bounds on norms and of cones; an axis may have any length above 0."""
    checks: dict[str, Check] = {
        "lower": lengths, "upper": above_zero_or_infinite, "center": finite, "apex": finite, "angle": _angles,
        "axis": _axes,
    }  # fmt: skip
    both = all(getattr(part, side, None) is not None for side in ("lower", "upper"))
    crossed = _crossed(part, name, np.greater_equal, "lower bounds below the upper ones") if both else None
    given = {field: getattr(part, field) for field in part.per_element if field in checks}
    fields = {field: (tensor, checks[field]) for field, tensor in given.items() if tensor is not None}
    return numbers(name, fields, i, joint=crossed)


def _of_balls(part: GateBalls, i: int) -> list[Number]:
    """Of gates, which keep their knots."""
    centers, radii = part.centers, part.sizes
    fields = {"centers": (centers, finite), "radius": (radii, above_zero)}
    return numbers("gates", fields, i, after=lambda: part.write(centers, radii))


def _of_squares(part: GateSquares, i: int) -> list[Number]:
    normals = part.axes[:, :, 0].clone()
    fields = {"centers": (part.centers, finite), "half_widths": (part.half_widths, above_zero)}
    found = numbers("gates", fields, i, after=part.write)
    return found + numbers("gates", {"normals": (normals, _axes)}, i, after=lambda: part.write(normals))


def _of_obstacles(part: Obstacles, name: str, i: int) -> list[Number]:
    """Of spheres and boxes, also as each ball of a body meets them; of none where some are absent."""
    alone = not isinstance(part, BoundBody)
    kinds: tuple[Any, ...] = (part,) if alone else (part.inner, *part.balls)
    first = kinds[0]
    if not isinstance(first, BoundSpheres | BoundBoxes) or bool(first.absent.any()):
        return []  # padding: which of them are there isn't a number
    moves = isinstance(first, BoundSpheres) and first.velocities is not None
    derived, fields = not alone or isinstance(first, BoundBoxes), ("centers", *(["velocities"] if moves else []))
    found = []
    for field in fields:
        whole, *others = (getattr(kind, field) for kind in kinds)
        after = partial(_copied, whole, others) if others else None
        found += numbers(name, {field: (whole, present)}, i, derived, after)
    return found + (_of_sizes(kinds, alone, name, i) if isinstance(first, BoundSpheres) else [])


def _of_sizes(kinds: Sequence[BoundSpheres], alone: bool, name: str, i: int) -> list[Number]:
    """The radii of spheres and, where it is a ball, of the vehicle."""
    radii = kinds[0].inflated_radii - kinds[0].vehicle_radius.unsqueeze(-1)

    def inflate() -> None:
        for kind in kinds:
            torch.add(radii, kind.vehicle_radius.unsqueeze(-1), out=kind.inflated_radii)

    sizes = {"radii": (radii, lengths), "vehicle_radius": (kinds[0].vehicle_radius, lengths)}
    return numbers(name, sizes if alone else {"radii": sizes["radii"]}, i, after=inflate)


def _copied(whole: Tensor, others: Sequence[Tensor]) -> None:
    for other in others:
        other.copy_(whole)


def _of_part(part: Any, name: str, place: str | int) -> list[Number]:
    """The floating numbers of any part, its `values` by their own names."""
    found = []
    for field in (*part.batched, *part.per_element) if isinstance(part, PerElement) else ():
        value = getattr(part, field)
        tensors: dict[str, Any] = {field: value}
        if isinstance(value, Values):
            names = (*value.names, *value.knot_names)
            tensors = dict(zip(names, (*value.rows, *value.knot_rows), strict=True))
        elif isinstance(value, PerElement):
            found += _of_part(value, f"{name}.{field}", place)
        for own, tensor in tensors.items():
            if isinstance(tensor, Tensor) and tensor.is_floating_point() and tensor.dim() > 0:
                found += numbers(name, {own: (tensor, finite)}, place)
    return found


def _fixed(part: GoalState, new: Floats) -> Wrong:
    free = np.isnan(part.state.numpy()[0])
    fits = (np.isnan(new) == free).all() and np.isfinite(new[..., ~free]).all()
    return None if fits else ("finite numbers, and NaN in the components that are free at the end", new.tolist())


def _angles(new: Floats) -> Wrong:
    return None if ((new > 0) & (new < np.pi)).all() else ("angles in rad, above 0 and below pi", new.tolist())


def _axes(new: Floats) -> Wrong:
    return finite(new) or (None if (np.abs(new).max(-1) > 0).all() else ("vectors other than 0", new.tolist()))


def _matrices(new: Floats) -> Wrong:
    return finite(new) or unfit(torch.from_numpy(new))
