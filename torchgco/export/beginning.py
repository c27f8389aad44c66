"""With what an exported solve begins that has no plan before: controls at rest and, in a free time, a plan."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchgco.api import solve
from torchgco.base.status import Status
from torchgco.constraints.norms import within_norms
from torchgco.export.tables import table
from torchgco.problem.free_time import FreeTime
from torchgco.problem.in_time import factors_of
from torchgco.problem.problem import Problem
from torchgco.solvers.timing import HELD_FIRST

FLYABLE = Status.CONVERGED, Status.FEASIBLE


@dataclass(frozen=True)
class Beginning:
    """That of B elements.

    Attributes:
        rest: controls of the solver (B, N, m') at rest.
        time: the user's free time, bound; None: it is fixed.
        stage: dt where the time is free, s.
        constraints: how many the user has.
        factors: of time, with which a solve from rest begins, (B, S); None where the time is fixed.
        plan: states (B, N+1, n), controls (B, N, m) and times (B, N+1), with which the first step begins where the time
            is free; None: it begins from rest.
    """

    rest: Tensor
    time: FreeTime | None
    stage: float
    constraints: int
    factors: Tensor | None = None
    plan: tuple[Tensor, Tensor, Tensor] | None = None

    @property
    def segments(self) -> int:
        """How many, 0 where the time is fixed."""
        return 0 if self.time is None else self.time.count

    @property
    def count(self) -> int:
        """How many numbers `tables` have."""
        return sum(part.numel() for part in (*(self.plan or ()), *(() if self.factors is None else [self.factors])))

    def tables(self) -> list[str]:
        """Constant arrays, one element after the other."""
        if self.time is None or self.factors is None:
            return []
        tables = [table("static const int first_stage[]", map(int, (*self.time.segments, self.rest.shape[1])))]
        tables.append(table("static const double first_factor[]", self.factors))
        plans = dict(zip("XUt", self.plan or (), strict=False))
        return tables + [table(f"static const double plan_{name}[]", part) for name, part in plans.items()]


def beginning(problem: Problem, controls: int) -> Beginning:
    """That of the user's problem, for a solver of so many controls.

    Where the time is free, it is solved here: what finds trajectories with a free time from nothing isn't in C.
    """
    at_rest = problem.cost.rest_controls(problem.x0.new_zeros(problem.B, problem.N, problem.m))
    rest = pad(within_norms(at_rest, problem.constraints), (0, controls - problem.m), value=1.0).contiguous()
    time, count = problem.time, len(problem.constraints)
    if time is None:
        return Beginning(rest, None, 0.0, count)
    solver = "gco" if problem.obstacles else "interior_point"
    solution = solve(problem, solver=solver, verbose=False)
    assert solution.times is not None
    factors = HELD_FIRST * factors_of(problem, solution.times) if time.guess is None else time.guess
    factors = torch.minimum(torch.maximum(factors, time.least), time.most)
    flyable = torch.stack([solution.status == status for status in FLYABLE]).any(0)
    plan = (solution.X, solution.U, solution.times) if bool(flyable.all()) else None
    return Beginning(rest, time, float(problem.dynamics.dt), count, factors, plan)
