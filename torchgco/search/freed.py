"""The interior point with the time free, and clear of obstacles between the knots, which lie elsewhere at each time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from torchgco.base.status import Status
from torchgco.base.tree import put, take
from torchgco.kernels import chord_clearance, measured
from torchgco.problem.problem import Problem
from torchgco.search.chords import EXTRA, GROWN_BARRIER, MIN_GROWTH
from torchgco.solution import Solution
from torchgco.solvers.contracts import Call
from torchgco.solvers.interior import InteriorPoint

DEARER = 1e-3  # share of the cost up to which a trajectory that was cleared counts as converged
PARTS = "X", "U", "K", "d", "multipliers", "cost", "violation", "status"


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
        found = self.interior.run(call)
        solver, clearance = replace(self.interior, warm_barrier=GROWN_BARRIER), chord_clearance(call.problem, found.X)
        rows = ((found.violation <= self.limit) & (clearance < 0.0)).nonzero().flatten()
        dear, by, now = found.cost + DEARER * found.cost.abs(), torch.zeros_like(clearance), clearance.clone()
        for _ in range(self.rounds):
            if rows.numel() == 0 or call.late:
                break
            by[rows] += (-EXTRA * now[rows]).clamp(min=MIN_GROWTH * self.limit)
            old, part = found.take(rows), call.take(rows)
            larger = replace(part, problem=part.problem.grown(by[rows]), X0=old.X, U0=old.U, warm=old.multipliers)
            new = solver.run(larger)
            now[rows] = chord_clearance(part.problem, new.X)
            serves = (measured(part.problem, new.X, new.U) <= self.limit) & (now[rows] > clearance[rows])
            converged = torch.where(new.cost <= dear[rows], int(Status.CONVERGED), int(Status.FEASIBLE))
            new = replace(new, status=torch.where(new.status == Status.CONVERGED, converged, new.status))
            places = serves.nonzero().flatten()
            for name in PARTS:
                put(getattr(found, name), rows[places], take(getattr(new, name), places))
            found.iterations[rows] += new.iterations
            clearance[rows] = torch.where(serves, now[rows], clearance[rows])
            rows = rows[clearance[rows] < 0.0]
        return found
