"""Between two knots: a trajectory that cuts an obstacle there is solved again with grown obstacles.

Constraints hold at the knots. Where the vehicle turns around the corner of a box or a small sphere within one time
step, the straight line between two knots may come closer than both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from torchgco.base.options import Count, check_options
from torchgco.base.status import is_over
from torchgco.base.tree import take
from torchgco.kernels import chord_clearance, measured
from torchgco.lagrangian.quality import leaves_goal
from torchgco.lagrangian.state import SolveEnd
from torchgco.search.attempts import Search
from torchgco.search.converge import continued, mapped
from torchgco.search.row import Row

MARGIN = 1.1  # times the missing clearance: by how much obstacles grow in a round
GROWN_BARRIER = 1e-4  # of warm solves among grown obstacles, which lie deeper than rounding
MIN_GROWTH = 0.1  # and at least this share of the allowed violation: solves differ by as much


@dataclass(frozen=True)
class ClearChords(Row):
    """Replaces feasible trajectories that touch an obstacle between two knots by ones that keep clear of it.

    Obstacles grow by 1.1 times the clearance that the last solve missed, or a little more, and the solve continues from
    the best trajectory. A trajectory is replaced where the new one is feasible for the obstacles as they are, has
    arrived if the old one had, and keeps more clearance between the knots. Openings may leave no room for it: there a
    dearer trajectory of the passes before that is clear is taken back.

    Args:
        rounds: solves at most, each with larger obstacles than the one before.

    Raises:
        InputError: a field out of its range.
    """

    rounds: Count = 4

    kinds: ClassVar[tuple[str, ...]] = ("moving", "maps", "bodies")

    def __post_init__(self) -> None:
        check_options(self, "chords")

    @property
    def problems(self) -> str:
        return "touching an obstacle between two knots"

    @property
    def does(self) -> str:
        return f"AL-iLQR and interior point among larger obstacles, {self.rounds} rounds; accepted with more clearance"

    def run(self, search: Search) -> None:
        """Solve; see the class."""
        best, problem, limit = search.best, search.call.problem, search.solver.violation_tolerance
        clearance = chord_clearance(problem, best.end.best.X)
        by, now = torch.zeros_like(clearance), clearance.clone()
        rows = touching = ((best.end.best.violation <= limit) & (clearance < 0)).nonzero().flatten()
        for _ in range(self.rounds):
            if rows.numel() == 0:
                break
            best.next_attempt()
            by[rows] += (-MARGIN * now[rows]).clamp(min=MIN_GROWTH * limit)
            old = take(best.end.best, rows)
            call = search.call.take(rows)
            call = replace(call, problem=call.problem.grown(by[rows]), U0=old.U, warm=old.multipliers)
            if mapped(call.problem):  # along whose one row per knot AL-iLQR takes many short steps
                grown = replace(search.interior, warm_barrier=GROWN_BARRIER)
                new = tight = continued(grown, replace(call, callback=None), old)
                serves, now[rows] = self._kept(search, rows, new, clearance[rows])
                clearance[rows] = torch.where(serves, now[rows], clearance[rows])
                rows = rows[clearance[rows] < 0]
                continue
            new = best.attempt(call)
            serves, now[rows] = self._kept(search, rows, new, clearance[rows])
            tight = continued(search.interior, replace(call, callback=None), new.best)
            least = torch.where(serves & is_over(tight.status), now[rows].clamp(max=0.0), torch.inf)
            too, clear = self._kept(search, rows, tight, least)
            now[rows] = torch.where(too, clear, now[rows])
            clearance[rows] = torch.where(serves, now[rows], clearance[rows])
            rows = rows[clearance[rows] < 0]
        best.restore(touching, clearance[touching] < 0)

    def _kept(self, search: Search, rows: Tensor, new: SolveEnd, least: Tensor) -> tuple[Tensor, Tensor]:
        """Where new trajectories of `rows` serve, with more clearance than `least`, they replace the best.

        Returns where they did, and their clearances.
        """
        best, problem = search.best, search.call.problem.take(rows)
        found = replace(new.best, violation=measured(problem, new.best.X, new.best.U))
        clearance = chord_clearance(problem, found.X)
        serves = (found.violation <= search.solver.violation_tolerance) & (clearance > least)
        serves &= ~leaves_goal(problem, found.X, take(best.end.best, rows).X)
        best.replace(rows, serves, found, new)
        return serves, clearance
