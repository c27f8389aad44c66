"""All vehicles of a fleet as one problem, in whose state their states follow each other.

Pairs keep their distance at the knots and halfway between them: two discs that meet at 5 m/s come half a metre nearer
in a stage of 0.1 s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchgco.base.autodiff import jacobian
from torchgco.base.shapes import Dimensions
from torchgco.base.tree import is_users
from torchgco.constraints.base import Constraint, WrappedConstraint
from torchgco.constraints.bounds import Bounds, ControlBounds, StateBounds, bounds_of
from torchgco.constraints.separation import Separation
from torchgco.costs.base import Cost, add_blocks
from torchgco.dynamics.base import Dynamics
from torchgco.dynamics.integrators import INTEGRATORS
from torchgco.fleets.fleet import Fleet
from torchgco.problem.problem import Problem


@dataclass(frozen=True)
class JointDynamics(Dynamics):
    """The models of all vehicles side by side."""

    parts: tuple[Dynamics, ...]

    batched: ClassVar[tuple[str, ...]] = ("parts",)
    calls_function = property(lambda self: any(map(is_users, self.parts)))
    n = property(lambda self: sum(part.n for part in self.parts))  # type: ignore[assignment]
    m = property(lambda self: sum(part.m for part in self.parts))  # type: ignore[assignment]
    dt = property(lambda self: self.parts[0].dt)  # type: ignore[assignment]
    integrator = property(lambda self: self.parts[0].integrator)  # type: ignore[assignment]

    @property
    def stretches(self) -> bool:
        alike = all(part.integrator == self.integrator for part in self.parts)
        return alike and all(part.stretches for part in self.parts)

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.cat([part.field(*z) for part, z in self.split(x, u)], dim=-1)

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.cat([part.step(*z) for part, z in self.split(x, u)], dim=-1)

    def at(self, k: int | Tensor) -> JointDynamics:
        return JointDynamics(tuple(part.at(k) for part in self.parts))

    def split(self, x: Tensor, u: Tensor) -> list[tuple[Dynamics, tuple[Tensor, Tensor]]]:
        """Each model with its states and controls."""
        states, controls = x.split([p.n for p in self.parts], -1), u.split([p.m for p in self.parts], -1)
        return list(zip(self.parts, zip(states, controls, strict=True), strict=True))


@dataclass(frozen=True)
class JointCost(Cost):
    """The sum of the vehicles' costs."""

    parts: tuple[Cost, ...]
    sizes: tuple[tuple[int, int], ...]  # of states and controls

    batched: ClassVar[tuple[str, ...]] = ("parts",)
    calls_function = property(lambda self: any(map(is_users, self.parts)))

    @property
    def reads_knots(self) -> bool:
        return any(part.reads_knots for part in self.parts)

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        states, controls = x.split([n for n, _ in self.sizes], -1), u.split([m for _, m in self.sizes], -1)
        return sum_of([part.stage(a, b, k) for part, a, b in zip(self.parts, states, controls, strict=True)])

    def terminal(self, x: Tensor) -> Tensor:
        states = x.split([n for n, _ in self.sizes], -1)
        return sum_of([part.terminal(a) for part, a in zip(self.parts, states, strict=True)])

    def rest_controls(self, like: Tensor) -> Tensor:
        parts = zip(self.parts, like.split([m for _, m in self.sizes], -1), strict=True)
        return torch.cat([part.rest_controls(z) for part, z in parts], dim=-1)


def sum_of(parts: Sequence[Tensor]) -> Tensor:
    """Their sum, in their order."""
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return total


@dataclass(frozen=True)
class VehicleRows(WrappedConstraint):
    """Rows of one vehicle, whose states and controls begin after those of others."""

    first: tuple[int, int]
    size: tuple[int, int]

    batched: ClassVar[tuple[str, ...]] = ("constraint",)
    keeps_rows: ClassVar[bool] = True
    geometric = False  # type: ignore[assignment]
    bare = property(lambda self: self)  # type: ignore[assignment]  # the joint problem has no position to measure

    def bind(self, dims: Dimensions) -> VehicleRows:
        return self

    def row_shape(self, N: int) -> tuple[int, int] | None:
        return self.constraint.row_shape(N)

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return self.constraint.value(*self._own(X, U))

    def violation(self, X: Tensor, U: Tensor) -> Tensor:
        return self.constraint.violation(*self._own(X, U))

    def start_is_clear(self, x0: Tensor) -> Tensor:
        return self.constraint.start_is_clear(x0[:, self.first[0] : self.first[0] + self.size[0]])

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        (i, j), (n, m), one = self.first, self.size, X.shape[-1]
        blocks = H.new_zeros(*H.shape[:2], n + 1 + m, n + 1 + m)
        self.constraint.accumulate(*self._own(X, U), g, h, blocks)
        own = torch.tensor([*range(i, i + n), one, *range(one + 1 + j, one + 1 + j + m)], device=H.device)
        H[..., own.unsqueeze(-1), own] += blocks

    def _own(self, X: Tensor, U: Tensor) -> tuple[Tensor, Tensor]:
        (i, j), (n, m) = self.first, self.size
        return X[..., i : i + n], U[..., j : j + m]


@dataclass(frozen=True)
class Halfway(Constraint):
    """The rows of a separation where the vehicles are half a stage after knots 0..N-1."""

    separation: Separation
    model: JointDynamics
    knots: Any

    batched: ClassVar[tuple[str, ...]] = ("separation", "model")
    calls_function = property(lambda self: self.model.calls_function)
    in_metres = property(lambda self: True)  # type: ignore[assignment]

    def bind(self, dims: Dimensions) -> Halfway:
        return self

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return self._rows(X[:, self.knots], U[:, self.knots])

    def violation(self, X: Tensor, U: Tensor) -> Tensor:
        away = self._away(X[:, self.knots], U[:, self.knots])
        return (self.separation.kept - away.norm(dim=-1)).clamp(min=0.0)

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        cx, cu = jacobian(self._rows, X[:, self.knots], U[:, self.knots])
        add, along = H.new_zeros(*g.shape[:2], *H.shape[2:]), g.unsqueeze(-2)
        squares = [(h.unsqueeze(-1) * a).mT @ b for a, b in ((cx, cx), (cu, cu), (cu, cx))]
        add_blocks(add, X.shape[-1], (along @ cx).squeeze(-2), (along @ cu).squeeze(-2), *squares)
        H[:, self.knots] += add

    def _rows(self, x: Tensor, u: Tensor) -> Tensor:
        return self.separation.kept.square() - self._away(x, u).square().sum(-1)

    def _away(self, x: Tensor, u: Tensor) -> Tensor:
        model = self.model.at(torch.arange(x.shape[1], device=x.device))
        later = INTEGRATORS[model.integrator](lambda z: model.field(z, u), x, 0.5 * model.dt)
        return self.separation.away(later)


def joint_problem(fleet: Fleet, halfway: bool) -> Problem | None:
    """B problems, one per fleet; None where vehicles have costs, rows or maps that are theirs alone to compute.

    Args:
        halfway: whether there are rows halfway between the knots, too, where the models allow.
    """
    members = fleet.members
    if any(type(one.cost).total is not Cost.total for one in members):
        return None
    if any(part.joins_knots for one in members for part in one.constraints):
        return None
    if any(part.map is not None for one in members for part in one.obstacles):
        return None
    sizes = [(one.n, one.m) for one in members]
    first = [(sum(n for n, _ in sizes[:v]), sum(m for _, m in sizes[:v])) for v in range(len(members))]
    model = JointDynamics(tuple(one.dynamics for one in members))
    rows = _bounds(members)
    for one, begin, size in zip(members, first, sizes, strict=True):
        rows += [VehicleRows(part, begin, size) for part in one.constraints if not isinstance(part, Bounds)]
    pairs = fleet.distances.triu().nonzero().tolist()
    at = [(i, one.position) for (i, _), one in zip(first, members, strict=True)]
    places = [[i + k for k in range(where.start, where.stop)] for i, where in at]
    keep = fleet.distances[tuple(zip(*pairs, strict=True))].unsqueeze(0)
    problem = Problem(
        model, JointCost(tuple(one.cost for one in members), tuple(sizes)),
        [*rows, Separation(places, keep, pairs)], torch.cat([one.x0 for one in members], dim=-1), fleet.N,
    )  # fmt: skip
    if not (halfway and model.stretches):
        return problem
    *_, apart = problem.constraints
    assert isinstance(apart, Separation)
    return problem._with({"constraints": (*problem.constraints, Halfway(apart, model, slice(0, fleet.N)))})


def _bounds(members: Sequence[Problem]) -> list[Constraint]:
    """The bounds of all vehicles as one part for controls, and one for states."""
    found: list[Constraint] = []
    for of, kind in (("u", ControlBounds), ("x", StateBounds)):
        sides, count = [], members[0].N + (of == "x")
        for one in members:
            lower = one.x0.new_full((1, count, one.m if of == "u" else one.n), -torch.inf)
            upper = -lower
            for part in bounds_of(one.constraints, of):  # type: ignore[arg-type]
                low, high = part.over(count)
                lower, upper = torch.maximum(lower, low), torch.minimum(upper, high)
            sides.append((lower, upper))
        lower, upper = (_beside(side) for side in zip(*sides, strict=True))
        begin = 1 if of == "x" else 0
        if bool(torch.isfinite(torch.cat((lower, upper))[:, begin:]).any()):
            found.append(kind(lower[:, begin:], upper[:, begin:]))
    return found


def _beside(parts: Sequence[Tensor]) -> Tensor:
    """Tensors (B|1, K, size) side by side."""
    B = max(len(part) for part in parts)
    return torch.cat([part.expand(B, *part.shape[1:]) for part in parts], dim=-1)
