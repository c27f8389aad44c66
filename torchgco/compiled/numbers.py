"""The numbers of a problem by name: where they lie, of which shape they are, and how new ones are written there.

Shapes begin with the axis of problems. References have an axis of all knots; what a problem's parts share between
stages stays shared.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.shapes import bound_of
from torchgco.base.tree import PerElement, own_mapped
from torchgco.base.values import Values
from torchgco.constraints.base import Constraint
from torchgco.constraints.bounds import ControlBounds, StateBounds
from torchgco.constraints.gates import GateBalls, GateSquares
from torchgco.constraints.norms import Cone, NormBounds
from torchgco.costs.in_free_time import QuadraticInFreeTime
from torchgco.costs.quadratic import BoundQuadratic, check_semidefinite, unfit
from torchgco.obstacles.base import Obstacles
from torchgco.obstacles.boxes import BoundBoxes
from torchgco.obstacles.spheres import BoundSpheres
from torchgco.problem.goal import Goal, GoalBall, GoalState
from torchgco.problem.problem import Problem

Floats = np.ndarray[Any, np.dtype[np.float64]]
Wrong: TypeAlias = tuple[str, Any] | None  # (expected, got); None: nothing is wrong
Check: TypeAlias = Callable[[Floats], Wrong]
Joint: TypeAlias = Callable[[Mapping[str, Floats]], Wrong]
WEIGHTS = "Q", "R", "Qf"


@dataclass(slots=True)
class Number:
    """One of them.

    Args:
        name: where it is in the problem, such as "constraints[1].centers".
        views: the memory that holds it, (B, ...); or of all stages, (B, N, ...), and of the last knot, (B, ...).
        part: whose number it is: "x0", "cost", "dynamics", or the place of a constraint.
        derived: whether kernels read what is computed from it, not the number itself.
        check: says what is wrong with new numbers, (expected, got), or None.
        after: is called when new numbers have been written.
        none: what None stands for in new numbers; only bounds have some.
        joint: says what is wrong with new numbers, by full names, that are written together; raises or returns as
            `check`.
    """

    name: str
    views: tuple[Floats, ...]
    part: str | int
    derived: bool
    check: Check
    after: Callable[[], object] | None = None
    joint: Joint | None = None
    shape: tuple[int, ...] = ()
    none: float | None = None

    def __post_init__(self) -> None:
        first, *last = self.views
        self.shape = first.shape if not last else (len(first), first.shape[1] + 1, *first.shape[2:])

    @property
    def value(self) -> Floats:
        """A copy, (B, ...)."""
        first, *last = self.views
        return first.copy() if not last else np.concatenate((first, last[0][:, None]), axis=1)

    def checked(self, value: Any) -> Floats:
        """New numbers of this shape, or without the axis of problems for all of them.

        Raises:
            InputError: another shape, no numbers, or numbers that the problem can't have.
        """
        value = value if self.none is None else bound_of(value, self.none)
        given, shape = as_floats(value, self.name), self.shape
        if given.shape != shape and given.shape != shape[1:]:
            expected = f"shape {shape}" if len(shape) == 1 else f"shape {shape}, or {shape[1:]} for all problems"
            raise InputError(self.name, expected, given.shape)
        if (wrong := self.check(given)) is not None:
            raise InputError(self.name, *wrong)
        return given

    def write(self, given: Floats) -> None:
        """Write numbers that are `checked`."""
        if len(self.views) == 1:
            self.views[0][...] = given
        else:
            first, last = self.views
            first[...], last[...] = given[..., :-1, :], given[..., -1, :]
        if self.after is not None:
            self.after()


class Numbers(Mapping[str, Floats]):
    """All numbers of a problem, by full names; a last part that only one of them has will do, too.

    `numbers[name]` is a copy, and `numbers[name] = value` writes.
    """

    def __init__(self, found: list[Number], changed: Callable[[Number], None]) -> None:
        self._all = {number.name: number for number in found}
        short = [_short(number.name) for number in found]
        self._by_name = dict(self._all)
        for name, number in zip(short, found, strict=True):
            if Counter(short)[name] == 1:
                self._by_name.setdefault(name, number)
        self._changed = changed

    def find(self, name: str) -> Number:
        """The number of this name.

        Raises:
            InputError: there is none, or there are several.
        """
        number = self._by_name.get(name)
        if number is None:
            alike = [full for full in self._all if _short(full) == name]
            raise InputError("numbers", f"one of {', '.join(alike or map(self._named, self._all))}", name)
        return number

    def __getitem__(self, name: str) -> Floats:
        return self.find(name).value

    def __setitem__(self, name: str, value: Any) -> None:
        self.write({name: value})

    def write(self, values: Mapping[str, Any]) -> None:
        """Write several; all are checked before the first is written."""
        new = [(number := self.find(name), number.checked(value)) for name, value in values.items()]
        joint = [(number, check) for number, _ in new if (check := number.joint) is not None]
        together = {number.name: np.broadcast_to(given, number.shape) for number, given in new} if joint else {}
        for number, check in joint:
            if (wrong := check(together)) is not None:
                raise InputError(number.name, *wrong)
        for number, given in new:
            number.write(given)
            self._changed(number)

    def __iter__(self) -> Iterator[str]:
        return iter(self._all)

    def __len__(self) -> int:
        return len(self._all)

    def __repr__(self) -> str:
        rows = [(self._named(name), "x".join(map(str, n.shape)), name) for name, n in self._all.items()]
        widths = [max(len(row[i]) for row in rows) for i in (0, 1)]
        return "\n".join(f"{a:{widths[0]}}  {b:{widths[1]}}  {c}" for a, b, c in [("name", "shape", "where"), *rows])

    def _named(self, name: str) -> str:
        short = _short(name)
        return short if self._by_name.get(short) is self._all[name] else name


def as_floats(value: Any, name: str) -> Floats:
    """Numbers as an array in double precision.

    Raises:
        InputError: no numbers.
    """
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value
    try:
        return np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(name, "numbers", type(value).__name__) from None


def measured(x: Any, B: int, n: int) -> Floats:
    """States (B, n), or (n,) of all vehicles.

    Raises:
        InputError: another shape, no numbers, NaN or infinity.
    """
    state = as_floats(x, "x")
    if state.shape not in ((B, n), (n,)):
        raise InputError("x", f"shape ({B}, {n}), or ({n},) for all vehicles", state.shape)
    if not math.isfinite(state.sum()) and not np.isfinite(state).all():  # a sum takes a third of the time
        raise InputError("x", "finite states", "NaN or infinity")
    return state


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
            found += numbers("goal", {"position": (place, _finite), "radius": (radius, above_zero)}, i)
        elif isinstance(part, GoalState):
            found += numbers("goal", {"state": (part.state, partial(_fixed, part))}, i)
        elif isinstance(part, GateBalls):
            found += _of_balls(part, i)
        elif isinstance(part, GateSquares):
            found += _of_squares(part, i)
        elif isinstance(part, NormBounds | Cone):
            found += _of_vectors(part, name, i)
        elif isinstance(part, BoundSpheres):
            found += _of_spheres(part, name, i)
        elif isinstance(part, BoundBoxes) and not bool(part.absent.any()):
            found += numbers(name, {"centers": (part.centers, _present)}, i)
        elif not isinstance(part, Obstacles):
            found += _of_part(part, name, i)
    return found


def numbers(
    where: str,
    fields: Mapping[str, tuple[Tensor, Check]],
    part: str | int,
    derived: bool = True,
    after: Callable[[], object] | None = None,
    joint: Joint | None = None,
) -> list[Number]:
    """A number for each of these fields, with its check; all else as of `Number`."""
    return [
        Number(f"{where}.{name}", (tensor.numpy(),), part, derived, check, after, joint)
        for name, (tensor, check) in fields.items()
    ]


def with_numbers_as_they_are(problem: Problem) -> Problem:
    """The same problems after numbers were written, with nothing that was computed from the previous ones."""
    constraints = tuple(c.remade() if isinstance(c, BoundSpheres) else c for c in problem.constraints)
    known = replace(problem.known, row_shapes=None, interior=None, packed={}, lifted={})
    now = problem._with({"constraints": constraints}, known)
    if now.goal is None or now.goal.assumed:
        dims = now._dimensions(now.x0)
        now = now._with({"goal": Goal.derived(now.cost.goal(now.x0), dims)}, known)
    return now


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
    found = [Number("cost.x_ref", (cost.x_ref.numpy(), cost.xf_ref.numpy()), "cost", False, _finite, after)]
    for name in ("u_ref", *WEIGHTS, "q", "r", "qf", "H"):
        tensor = getattr(cost, name)
        if tensor is not None:
            check = _finite if name not in WEIGHTS else at_least_zero if cost.diagonal else _matrices
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
        "lower": _lengths, "upper": _above_zero_or_infinite, "center": _finite, "apex": _finite, "angle": _angles,
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
    fields = {"centers": (centers, _finite), "radius": (radii, above_zero)}
    return numbers("gates", fields, i, after=lambda: part.write(centers, radii))


def _of_squares(part: GateSquares, i: int) -> list[Number]:
    normals = part.axes[:, :, 0].clone()
    fields = {"centers": (part.centers, _finite), "half_widths": (part.half_widths, above_zero)}
    found = numbers("gates", fields, i, after=part.write)
    return found + numbers("gates", {"normals": (normals, _axes)}, i, after=lambda: part.write(normals))


def _of_spheres(part: BoundSpheres, name: str, i: int) -> list[Number]:
    if bool(part.absent.any()):  # padding: which of them are there isn't a number
        return []
    vehicle = part.vehicle_radius.unsqueeze(-1)
    radii = part.inflated_radii - vehicle
    inflate = lambda: torch.add(radii, vehicle, out=part.inflated_radii)
    found = numbers(name, {"centers": (part.centers, _present)}, i, derived=False)
    sizes = {"radii": (radii, _lengths), "vehicle_radius": (part.vehicle_radius, _lengths)}
    found += numbers(name, sizes, i, after=inflate)
    if part.velocities is not None:
        found += numbers(name, {"velocities": (part.velocities, _present)}, i, derived=False)
    return found


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
                found += numbers(name, {own: (tensor, _finite)}, place)
    return found


def _short(name: str) -> str:
    return name.rpartition(".")[2]


def _finite(new: Floats) -> Wrong:
    return None if np.isfinite(new).all() else ("finite numbers", "NaN or infinity")


def _present(new: Floats) -> Wrong:
    return None if np.isfinite(new).all() else ("finite numbers (put an obstacle far away to be rid of it)", "others")


def _lengths(new: Floats) -> Wrong:
    return _finite(new) or (None if (new >= 0).all() else ("lengths of at least 0", float(new.min())))


def above_zero(new: Floats) -> Wrong:
    return _finite(new) or (None if (new > 0).all() else ("numbers above 0", float(new.min())))


def at_least_zero(new: Floats) -> Wrong:
    return _finite(new) or (None if (new >= 0).all() else ("numbers of at least 0", float(new.min())))


def _above_zero_or_infinite(new: Floats) -> Wrong:
    return None if (new > 0).all() else ("numbers above 0, or infinity", float(new.min()))


def _fixed(part: GoalState, new: Floats) -> Wrong:
    free = np.isnan(part.state.numpy()[0])
    fits = (np.isnan(new) == free).all() and np.isfinite(new[..., ~free]).all()
    return None if fits else ("finite numbers, and NaN in the components that are free at the end", new.tolist())


def _angles(new: Floats) -> Wrong:
    return None if ((new > 0) & (new < np.pi)).all() else ("angles in rad, above 0 and below pi", new.tolist())


def _axes(new: Floats) -> Wrong:
    return _finite(new) or (None if (np.abs(new).max(-1) > 0).all() else ("vectors other than 0", new.tolist()))


def _matrices(new: Floats) -> Wrong:
    return _finite(new) or unfit(torch.from_numpy(new))
