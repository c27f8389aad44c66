"""The numbers of a problem by name: where they lie, of which shape they are, and how new ones are written there.

Shapes begin with the axis of problems. References have an axis of all knots; what a problem's parts share between
stages stays shared.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.tree import PerElement
from torchgco.base.values import Values
from torchgco.constraints.base import Constraint
from torchgco.constraints.bounds import ControlBounds, StateBounds
from torchgco.constraints.gates import GateBalls, GateSquares
from torchgco.constraints.norms import Cone, NormBounds
from torchgco.costs.in_free_time import QuadraticInFreeTime
from torchgco.costs.quadratic import BoundQuadratic, check_semidefinite
from torchgco.obstacles.base import Obstacles
from torchgco.obstacles.boxes import BoundBoxes
from torchgco.obstacles.spheres import BoundSpheres
from torchgco.problem.goal import Goal, GoalBall, GoalState
from torchgco.problem.problem import Problem

Floats = np.ndarray[Any, np.dtype[np.float64]]
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
        joint: says what is wrong with new numbers, by full names, that are written together; raises or returns as
            `check`.
    """

    name: str
    views: tuple[Floats, ...]
    part: str | int
    derived: bool
    check: Callable[[Floats], tuple[str, Any] | None]
    after: Callable[[], object] | None = None
    joint: Callable[[Mapping[str, Floats]], tuple[str, Any] | None] | None = None
    shape: tuple[int, ...] = ()

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
    found = [Number("x0", (_view(problem.x0),), "x0", False, lambda new: None)]
    found += _of_cost(problem)
    found += _of_part(problem.dynamics, "dynamics", "dynamics")
    for i, part in enumerate(problem.constraints):
        name = f"constraints[{i}]"
        if isinstance(part, ControlBounds | StateBounds):
            found += _of_bounds(part, name, i)
        elif isinstance(part, GoalBall):
            found.append(Number("goal.position", (_view(part.center[:, 0]),), i, True, _finite))
            found.append(Number("goal.radius", (_view(part.upper[:, 0]),), i, True, _radii))
        elif isinstance(part, GoalState):
            found.append(Number("goal.state", (_view(part.state),), i, True, partial(_fixed, part)))
        elif isinstance(part, GateBalls):
            found += _of_balls(part, i)
        elif isinstance(part, GateSquares):
            found += _of_squares(part, i)
        elif isinstance(part, NormBounds | Cone):
            found += _of_vectors(part, name, i)
        elif isinstance(part, BoundSpheres):
            found += _of_spheres(part, name, i)
        elif isinstance(part, BoundBoxes) and not bool(part.absent.any()):
            found.append(Number(f"{name}.centers", (_view(part.centers),), i, True, _present))
        elif not isinstance(part, Obstacles):
            found += _of_part(part, name, i)
    return found


def with_numbers_as_they_are(problem: Problem) -> Problem:
    """The same problems after numbers were written, with nothing that was computed from the previous ones."""
    constraints = tuple(_renewed(part) for part in problem.constraints)
    known = replace(problem.known, row_shapes=None, interior=None, packed={}, cost=(None, 0, None), lifted={})
    now = problem._with({"constraints": constraints}, known)
    if now.goal is None or now.goal.assumed:
        dims = now._dimensions(now.x0)
        now = now._with({"goal": Goal.derived(now.cost.goal(now.x0), dims)}, known)
    return now


def _renewed(part: Any) -> Any:
    """A part of a problem with what was derived from its numbers made again."""
    if not isinstance(part, BoundSpheres):
        return part
    made = BoundSpheres.prepare(
        part.centers, part.inflated_radii, part.velocities, part.absent, part.vehicle_radius, part.knots,
        part.position, part.dt,
    )  # fmt: skip
    return replace(made, stops=part.stops)


def _own(part: Any, B: int) -> Any:
    """A part of a problem with copies of all its numbers, one for every problem."""
    if isinstance(part, Tensor):
        return part.expand(B, *part.shape[1:]).clone(memory_format=torch.contiguous_format) if part.dim() else part
    if isinstance(part, tuple):
        return tuple(_own(leaf, B) for leaf in part)
    if not isinstance(part, PerElement):
        return part
    twin = copy(part)
    for name in (*part.batched, *part.per_element):
        object.__setattr__(twin, name, _own(getattr(part, name), B))
    return twin


def _of_cost(problem: Problem) -> list[Number]:
    cost, after = problem.cost, None
    if isinstance(cost, QuadraticInFreeTime):
        cost, after = cost.cost, cost.write
    if type(cost) is not BoundQuadratic:
        return _of_part(cost, "cost", "cost")
    found = [Number("cost.x_ref", (_view(cost.x_ref), _view(cost.xf_ref)), "cost", False, _finite, after)]
    for name in ("u_ref", *WEIGHTS, "q", "r", "qf", "H"):
        tensor = getattr(cost, name)
        if tensor is not None:
            check = _finite if name not in WEIGHTS else _weights if cost.diagonal else _matrices
            joint = _semidefinite(cost) if name in ("Q", "R", "H") and cost.H is not None else None
            found.append(Number(f"cost.{name}", (_view(tensor),), "cost", False, check, joint=joint))
    return found


def _semidefinite(cost: BoundQuadratic) -> Callable[[Mapping[str, Floats]], None]:
    """A check of Q, R and H together: each alone may be fine, and the stage cost still fall without end."""

    def check(new: Mapping[str, Floats]) -> None:
        own = {name: new.get(f"cost.{name}", _view(getattr(cost, name))) for name in (*WEIGHTS, "H")}
        check_semidefinite(**{name: torch.tensor(weights) for name, weights in own.items()})

    return check


def _of_bounds(part: ControlBounds | StateBounds, name: str, i: int) -> list[Number]:
    def check(new: Floats, side: str) -> tuple[str, Any] | None:
        sign = 1.0 if side == "lower" else -1.0
        bounded = np.zeros(part.lower.shape[-1], dtype=bool)
        bounded[part.below if side == "lower" else part.above] = True
        free = new[..., ~bounded]
        if np.isnan(new).any() or (new == sign * np.inf).any():
            return f"numbers or {-sign * np.inf}", new.tolist()
        if np.isfinite(free).any():
            return "infinity in components that were infinite when the problem was compiled; give them 1e9 then", (
                float(free[np.isfinite(free)][0])
            )
        return None

    def joint(new: Mapping[str, Floats]) -> tuple[str, Any] | None:
        lower, upper = (new.get(f"{name}.{side}", _view(getattr(part, side))) for side in ("lower", "upper"))
        over = np.nonzero(lower > upper)
        if not len(over[0]):
            return None
        return "lower bounds of at most the upper ones", f"{lower[over][0]:g} and {upper[over][0]:g}"

    return [
        Number(f"{name}.{side}", (_view(getattr(part, side)),), i, True, partial(check, side=side), joint=joint)
        for side in ("lower", "upper")
    ]


def _of_vectors(part: NormBounds | Cone, name: str, i: int) -> list[Number]:
    """Of bounds on norms and of cones; an axis may have any length above 0."""

    def joint(new: Mapping[str, Floats]) -> tuple[str, Any] | None:
        lower, upper = (new.get(f"{name}.{side}", _view(getattr(part, side))) for side in ("lower", "upper"))
        over = np.nonzero(~(lower < upper))
        if not len(over[0]):
            return None
        return "lower bounds below the upper ones", f"{(lower + 0 * upper)[over][0]:g}"

    checks: dict[str, Callable[[Floats], tuple[str, Any] | None]] = {
        "lower": _lengths, "upper": _above_zero, "center": _finite, "apex": _finite, "angle": _angles, "axis": _axes,
    }  # fmt: skip
    both = all(getattr(part, side, None) is not None for side in ("lower", "upper"))
    return [
        Number(f"{name}.{field}", (_view(getattr(part, field)),), i, True, checks[field], joint=joint if both else None)
        for field in part.per_element
        if field in checks and getattr(part, field) is not None
    ]


def _of_balls(part: GateBalls, i: int) -> list[Number]:
    """Of gates, which keep their knots."""
    centers, radii = part.centers, part.sizes
    write = lambda: part.write(centers, radii)
    return [
        Number("gates.centers", (_view(centers),), i, True, _finite, write),
        Number("gates.radius", (_view(radii),), i, True, _radii, write),
    ]


def _of_squares(part: GateSquares, i: int) -> list[Number]:
    normals = part.axes[:, :, 0].clone()
    return [
        Number("gates.centers", (_view(part.centers),), i, True, _finite, part.write),
        Number("gates.half_widths", (_view(part.half_widths),), i, True, _radii, part.write),
        Number("gates.normals", (_view(normals),), i, True, _axes, lambda: part.write(normals)),
    ]


def _of_spheres(part: BoundSpheres, name: str, i: int) -> list[Number]:
    if bool(part.absent.any()):  # padding: which of them are there isn't a number
        return []
    vehicle = part.vehicle_radius.unsqueeze(-1)
    radii = part.inflated_radii - vehicle
    inflate = lambda: torch.add(radii, vehicle, out=part.inflated_radii)
    found = [
        Number(f"{name}.centers", (_view(part.centers),), i, False, _present),
        Number(f"{name}.radii", (_view(radii),), i, True, _lengths, inflate),
        Number(f"{name}.vehicle_radius", (_view(part.vehicle_radius),), i, True, _lengths, inflate),
    ]
    if part.velocities is not None:
        found.append(Number(f"{name}.velocities", (_view(part.velocities),), i, False, _present))
    return found


def _of_part(part: Any, name: str, place: str | int) -> list[Number]:
    """The floating numbers of any part, its `values` by their own names."""
    found = []
    for field in (*part.batched, *part.per_element) if isinstance(part, PerElement) else ():
        value = getattr(part, field)
        if isinstance(value, Values):
            names = (*value.names, *value.knot_names)
            for own, tensor in zip(names, (*value.rows, *value.knot_rows), strict=True):
                if tensor.is_floating_point():
                    found.append(Number(f"{name}.{own}", (_view(tensor),), place, True, _finite))
        elif isinstance(value, Tensor) and value.is_floating_point() and value.dim() > 0:
            found.append(Number(f"{name}.{field}", (_view(value),), place, True, _finite))
        elif isinstance(value, PerElement):
            found += _of_part(value, f"{name}.{field}", place)
    return found


def _view(tensor: Tensor) -> Floats:
    return tensor.numpy()


def _short(name: str) -> str:
    return name.rpartition(".")[2]


def _finite(new: Floats) -> tuple[str, Any] | None:
    return None if np.isfinite(new).all() else ("finite numbers", "NaN or infinity")


def _present(new: Floats) -> tuple[str, Any] | None:
    return None if np.isfinite(new).all() else ("finite numbers (put an obstacle far away to be rid of it)", "others")


def _lengths(new: Floats) -> tuple[str, Any] | None:
    return _finite(new) or (None if (new >= 0).all() else ("lengths of at least 0", float(new.min())))


def _radii(new: Floats) -> tuple[str, Any] | None:
    return _finite(new) or _above_zero(new)


def _fixed(part: GoalState, new: Floats) -> tuple[str, Any] | None:
    free = np.isnan(_view(part.state)[0])
    fits = (np.isnan(new) == free).all() and np.isfinite(new[..., ~free]).all()
    return None if fits else ("finite numbers, and NaN in the components that are free at the end", new.tolist())


def _above_zero(new: Floats) -> tuple[str, Any] | None:
    return None if (new > 0).all() else ("numbers above 0, or infinity", float(new.min()))


def _angles(new: Floats) -> tuple[str, Any] | None:
    return None if ((new > 0) & (new < np.pi)).all() else ("angles in rad, above 0 and below pi", new.tolist())


def _axes(new: Floats) -> tuple[str, Any] | None:
    return _finite(new) or (None if (np.abs(new).max(-1) > 0).all() else ("vectors other than 0", new.tolist()))


def _weights(new: Floats) -> tuple[str, Any] | None:
    return _finite(new) or (None if (new >= 0).all() else ("weights of at least 0", float(new.min())))


def _matrices(new: Floats) -> tuple[str, Any] | None:
    if (wrong := _finite(new)) is not None:
        return wrong
    lowest = float(np.linalg.eigvalsh(0.5 * (new + np.swapaxes(new, -1, -2))).min())
    size = float(np.abs(new).max())
    if float(np.abs(new - np.swapaxes(new, -1, -2)).max()) > 1e-9 * max(size, 1.0):
        return "symmetric matrices", "unsymmetric ones"
    semidefinite = lowest >= -1e-9 * max(size, 1.0)
    return None if semidefinite else ("positive semidefinite weights", f"an eigenvalue of {lowest:.3g}")
