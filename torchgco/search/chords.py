"""Between two knots: a trajectory that cuts an obstacle there is solved again with grown obstacles.

Constraints hold at the knots. Where the vehicle turns around the corner of a box or a small sphere within one time
step, the straight line between two knots may come closer than both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from torchgco.base.options import Count, check_options
from torchgco.base.tree import take
from torchgco.lagrangian.quality import chord_clearance, has_arrived, violation
from torchgco.search.attempts import Search
from torchgco.search.converge import tightened
from torchgco.solvers.interior import InteriorPoint

MARGIN = 1.1  # times the missing clearance: by how much obstacles grow in a round
MIN_GROWTH = 0.1  # and at least this share of the allowed violation: solves differ by as much


@dataclass(frozen=True)
class ClearChords:
    """Replaces feasible trajectories that touch an obstacle between two knots by ones that keep clear of it.

    Obstacles grow by 1.1 times the clearance that the last solve missed, or a little more, and the solve continues from
    the best trajectory. A trajectory is replaced where the new one is feasible for the obstacles as they are, has
    arrived if the old one had, and keeps more clearance between the knots. Openings may leave no room for it.

    Args:
        rounds: solves at most, each with larger obstacles than the one before.
        solver: ends each of them.

    Raises:
        InputError: a field out of its range.
    """

    rounds: Count = 4
    solver: InteriorPoint = InteriorPoint()

    def __post_init__(self) -> None:
        check_options(self, "chords")

    def run(self, search: Search) -> None:
        """Solve; see the class."""
        best, problem, limit = search.best, search.call.problem, search.solver.violation_tolerance
        clearance = chord_clearance(problem, best.end.best.X)
        by, now = torch.zeros_like(clearance), clearance.clone()
        rows = ((best.end.best.violation <= limit) & (clearance < 0)).nonzero().flatten()
        for _ in range(self.rounds):
            if rows.numel() == 0:
                return
            best.next_attempt()
            by[rows] += (-MARGIN * now[rows]).clamp(min=MIN_GROWTH * limit)
            whole, old = problem.take(rows), take(best.end.best, rows)
            call = search.call.take(rows)
            call = replace(call, problem=call.problem.grown(by[rows]), U0=old.U, warm=old.multipliers)
            new = tightened(self.solver, call, best.attempt(call))
            found = replace(new.best, violation=violation(whole, new.best.X, new.best.U))
            now[rows] = chord_clearance(whole, found.X)
            serves = (found.violation <= limit) & (now[rows] > clearance[rows])
            serves &= has_arrived(whole, found.X) | ~has_arrived(whole, old.X)
            best.replace(rows, serves, found, new)
            clearance[rows] = torch.where(serves, now[rows], clearance[rows])
            rows = rows[clearance[rows] < 0]
