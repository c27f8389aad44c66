"""The interior point with the time free, and clear of obstacles between the knots, which lie elsewhere at each time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchgco.base.status import Status
from torchgco.base.tree import put, take
from torchgco.lagrangian.state import Iterate
from torchgco.problem.problem import Problem
from torchgco.search.chords import GROWN_BARRIER, cleared, serving
from torchgco.solution import Solution
from torchgco.solvers.contracts import Call
from torchgco.solvers.ending import DOUBTED
from torchgco.solvers.interior import InteriorPoint


@dataclass(frozen=True)
class Freed:
    """The interior point, which goes on among larger obstacles where its trajectory touches one between two knots.

    Args:
        interior: the solver.
        limit: violation up to which a trajectory is feasible.
        rounds: solves at most, each with larger obstacles than the one before.
    """

    interior: InteriorPoint
    limit: float
    rounds: int

    def take_states(self, problem: Problem) -> bool:
        """See `Solver`."""
        return self.interior.take_states(problem)

    def run(self, call: Call) -> Solution:
        """Solve a checked call, as `Solver.run` does."""
        found, solver = self.interior.run(call), replace(self.interior, warm_barrier=GROWN_BARRIER)
        best = Iterate(found.X, found.U, found.multipliers, found.cost, found.violation)
        dear = found.cost + DOUBTED * found.cost.abs()

        def once(rows: Tensor, larger: Call, old: Iterate, least: Tensor) -> tuple[Tensor, Tensor]:
            new = solver.run(replace(larger, X0=old.X))
            one = Iterate(new.X, new.U, new.multipliers, new.cost, new.violation)
            serves, one, clearance = serving(call.problem.take(rows), one, old, least, self.limit)
            found.iterations[rows] += new.iterations
            chosen = serves.nonzero().flatten()
            put(best, rows[chosen], take(one, chosen))
            near = (new.status != Status.CONVERGED) | (new.cost <= dear[rows])
            status = torch.where(near, new.status, int(Status.FEASIBLE))
            for own, other in ((found.K, new.K), (found.d, new.d), (found.status, status)):
                own[rows[chosen]] = other[chosen]
            return serves, clearance

        cleared(call, best, self.rounds, self.limit, once)
        return found
