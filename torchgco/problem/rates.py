"""Limits on how far controls change from one stage to the next, for solvers: the control before becomes a state.

Rows of two knots fit no recursion over stages. With the states [x, controls of the stage before], they are rows of one
knot; all other parts see the first n states.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Self

import torch
from torch import Tensor

from torchgco.constraints.bounds import RateBounds
from torchgco.dynamics.base import WrappedDynamics
from torchgco.problem.problem import Problem

RATES_FORM = "with controls before"  # what is kept with the form of the problem for this one


def with_controls_before(problem: Problem) -> Problem:
    """The problem with the controls of the stage before among its states, last; itself where no rates are bounded.

    Constraints keep their places, rows and knots, and so multipliers their shapes.
    """
    bounds = rates_of(problem)
    if bounds is None:
        return problem
    n, m, controls, x0, free = problem.n, problem.m, bounds.controls, problem.x0, problem.free_start
    parts: dict[str, object] = {
        "dynamics": _Dynamics(problem.dynamics, controls),
        "cost": problem.cost.with_more(n, len(controls)),
        "constraints": tuple(c.with_more(n, m) for c in problem.constraints),
        "x0": torch.cat((x0, bounds.before.expand(problem.B, -1)), dim=-1),
        "free_start": None if free is None else torch.nn.functional.pad(free, (0, len(controls))),
    }
    return problem._with(parts, known=problem.known.of_lifted(RATES_FORM))


def rates_of(problem: Problem) -> RateBounds | None:
    """The bounds on rates, of which a problem has one at most; None where there are none."""
    return next((part for part in problem.constraints if isinstance(part, RateBounds)), None)


@dataclass(frozen=True)
class _Dynamics(WrappedDynamics):
    """A model whose states are followed by some of the controls of the stage before."""

    controls: Tensor  # (r,) int64: which controls

    batched: ClassVar[tuple[str, ...]] = ("model",)

    n = property(lambda self: self.model.n + len(self.controls))  # type: ignore[assignment]

    def at(self, k: int | Tensor) -> Self:
        model = self.model.at(k)
        return self if model is self.model else replace(self, model=model)

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.cat((self.model.step(x[..., : self.model.n], u), u[..., self.controls]), dim=-1)

    def jacobians(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        n, r = self.model.n, len(self.controls)
        by_x, by_u = self.model.jacobians(x[..., :n], u)
        fx, fu = x.new_zeros(*x.shape, n + r), x.new_zeros(*x.shape, u.shape[-1])
        fx[..., :n, :n], fu[..., :n, :] = by_x, by_u
        fu[..., n + torch.arange(r), self.controls] = 1.0
        return fx, fu
