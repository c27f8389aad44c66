"""Problems with rows of two knots, for solvers: what the rows need of the earlier knot becomes states.

Rows of two knots fit no recursion over stages. With states that carry something along, they are rows of one knot; all
other parts see the first n states.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.tree import is_users
from torchgco.constraints.base import Constraint
from torchgco.constraints.carried import Carried, Carrying, Taken, joined
from torchgco.dynamics.base import WrappedDynamics
from torchgco.problem.problem import Problem

CARRYING_FORM = "with carried states"  # what is kept with the form of the problem for this one


def with_carried(problem: Problem) -> Problem:
    """The problem with what its rows of two knots carry among its states, last; itself where no row is of two knots.

    Constraints keep their places, rows and knots, and so multipliers their shapes.
    """
    carried = carried_of(problem)
    if carried is None:
        return problem
    n, m, more, free = problem.n, problem.m, len(carried.taken), problem.free_start
    parts: dict[str, object] = {
        "dynamics": _Dynamics(problem.dynamics, carried.taken),
        "cost": problem.cost.with_more(n, more),
        "constraints": tuple(c.with_more(n, m) for c in rows_of_one_knot(problem, n)),
        "x0": torch.cat((problem.x0, carried.start), dim=-1),
        "free_start": None if free is None else torch.nn.functional.pad(free, (0, more)),
    }
    return problem._with(parts, known=problem.known.of_lifted(CARRYING_FORM))


def carried_of(problem: Problem) -> Carried | None:
    """What all rows of two knots carry, those of one constraint after the other's; None where there are none."""
    parts = [constraint.carries(problem.x0, problem.N) for constraint in problem.constraints if constraint.joins_knots]
    return joined(parts, problem.B, problem.N) if parts else None


def rows_of_one_knot(problem: Problem, first: int) -> list[Constraint]:
    """The constraints where the states from `first` on are those of `carried_of`."""
    rows = []
    for constraint in problem.constraints:
        if constraint.joins_knots:
            count = len(constraint.carries(problem.x0, problem.N).taken)
            constraint, first = constraint.with_carried(first), first + count
        rows.append(constraint)
    return rows


@dataclass(frozen=True)
class _Dynamics(WrappedDynamics):
    """A model whose states are followed by carried ones."""

    taken: Carrying
    k: Any = field(default=None, repr=False)  # the stage or the stages (K,), set by `at` where they differ

    batched: ClassVar[tuple[str, ...]] = ("model", "taken")

    calls_function = property(lambda self: is_users(self.model) or not isinstance(self.taken, Taken))
    n = property(lambda self: self.model.n + len(self.taken))  # type: ignore[assignment]

    def at(self, k: int | Tensor) -> Self:
        model = self.model.at(k)
        if self.taken.by_stage:
            return replace(self, model=model, k=k)
        return self if model is self.model else replace(self, model=model)

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        state, carried = x[..., : self.model.n], x[..., self.model.n :]
        self._check_stage()
        return torch.cat((self.model.step(state, u), self.taken.after(state, u, carried, self.k, self.model)), dim=-1)

    def jacobians(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        if not isinstance(self.taken, Taken):
            return super().jacobians(x, u)
        self._check_stage()
        n, r, stages = self.model.n, torch.arange(len(self.taken), device=x.device), self.taken.stages
        by_x, by_u = self.model.jacobians(x[..., :n], u)
        fx, fu = x.new_zeros(*x.shape, x.shape[-1]), x.new_zeros(*x.shape, u.shape[-1])
        fx[..., :n, :n], fu[..., :n, :] = by_x, by_u
        taken = x.new_ones(len(r)) if stages is None else stages[self.k]
        new = x.new_zeros(*taken.shape, n + u.shape[-1])
        new[..., r, self.taken.components] = taken
        fx[..., n:, :n], fu[..., n:, :] = new[..., :n], new[..., n:]
        fx[..., n + r, n + r] = 1.0 - taken
        return fx, fu

    def _check_stage(self) -> None:
        if self.taken.by_stage and self.k is None:
            raise InputError("dynamics", "a stage, as in `dynamics.at(k).step(x, u)`", "none")
