"""Between two knots: a trajectory that cuts an obstacle there is solved again with grown obstacles.

Constraints hold at the knots. Where the vehicle turns around the corner of a box or a small sphere within one time
step, the straight line between two knots may come closer than both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from torchgco.base.options import Count
from torchgco.base.status import is_over
from torchgco.base.tree import put, take
from torchgco.kernels import measured, path_clearance
from torchgco.lagrangian.quality import leaves_goal
from torchgco.lagrangian.state import Iterate, SolveEnd
from torchgco.problem.problem import Problem
from torchgco.roadmap.scene import has_maps
from torchgco.search.best import is_sound
from torchgco.search.converge import continued
from torchgco.search.search import Search
from torchgco.search.table import Row
from torchgco.solvers.contracts import Call

EXTRA = 1.1  # times the missing clearance: by how much obstacles grow in a round
IN_MAPS = 2  # times as many rounds, which are short there
GROWN_BARRIER = 1e-4  # of warm solves among grown obstacles, which lie deeper than rounding
MIN_GROWTH = 0.1  # and at least this share of the allowed violation: solves differ by as much


@dataclass(frozen=True)
class ClearChords(Row):
    """Replaces feasible trajectories that touch an obstacle between two knots by ones that keep clear of it.

    Obstacles grow by 1.1 times the clearance that the last solve missed, or a little more, and the solve continues from
    the best trajectory: by AL-iLQR, and where that finds nothing by the interior point alone. A trajectory is replaced
    where the new one is feasible for the obstacles as they are, has arrived if the old one had, and keeps clearer of
    them between the knots. Openings may leave no room for it: there a more expensive trajectory of the passes before
    that is clear is taken back, or one along another way of a map, where it can be brought clear.

    Args:
        rounds: solves at most, each with larger obstacles than the one before; in maps, by the interior point alone,
            twice as many.

    Raises:
        InputError: a field out of its range.
    """

    rounds: Count = 4

    label: ClassVar[str] = "chords"
    kinds: ClassVar[tuple[str, ...]] = ("moving", "maps", "bodies")
    problems: ClassVar[str] = "touching an obstacle between two knots"

    @property
    def does(self) -> str:
        return f"AL-iLQR and interior point among larger obstacles, {self.rounds} rounds; accepted with more clearance"

    def run(self, search: Search) -> None:
        """Solve; see the class."""
        best = search.best

        def once(rows: Tensor, call: Call, old: Iterate, least: Tensor) -> tuple[Tensor, Tensor]:
            best.next_attempt()
            if has_maps(call.problem):  # along whose one row per knot AL-iLQR takes many short steps
                return self._continued(search, rows, call, old, least)
            serves, now = self._relaxed(search, rows, call, least)
            left = (~serves).nonzero().flatten()  # a relaxed solve may leave through a wall that is thin
            if left.numel() > 0:
                part = rows[left], call.take(left), take(old, left), least[left]
                serves[left], now[left] = self._continued(search, *part)
            return serves, now

        limit = search.solver.violation_tolerance
        rounds = self.rounds * (IN_MAPS if has_maps(search.call.problem) else 1)
        best.restore(*cleared(search.call, best.end.best, rounds, limit, once, best.clearance))
        _along_other_ways(search)

    def _continued(
        self, search: Search, rows: Tensor, call: Call, old: Iterate, least: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The interior point goes on from the best; as `_kept`."""
        grown = replace(search.interior, warm_barrier=GROWN_BARRIER)
        return self._kept(search, rows, continued(grown, replace(call, callback=None), old), least)

    def _relaxed(self, search: Search, rows: Tensor, call: Call, least: Tensor) -> tuple[Tensor, Tensor]:
        """AL-iLQR, and from where it serves the interior point; as `_kept`."""
        new = search.best.attempt(call)
        serves, now = self._kept(search, rows, new, least)
        some = serves.nonzero().flatten()
        if some.numel() > 0:
            tight = continued(search.interior, replace(call.take(some), callback=None), take(new.best, some))
            wanted = torch.where(is_over(tight.status), now[some].clamp(max=0.0), torch.inf)
            too, clear = self._kept(search, rows[some], tight, wanted)
            now[some] = torch.where(too, clear, now[some])
        return serves, now

    def _kept(self, search: Search, rows: Tensor, new: SolveEnd, least: Tensor) -> tuple[Tensor, Tensor]:
        """Where new trajectories of `rows` serve, with more clearance than `least`, they replace the best.

        Returns where they did, and their clearances.
        """
        best, problem = search.best, search.call.problem.take(rows)
        old, limit = best.of(rows).best, search.solver.violation_tolerance
        serves, found, clearance = serving(problem, new.best, old, least, limit)
        best.replace(rows, serves, found, new)
        return serves, clearance


Once = Callable[[Tensor, Call, Iterate, Tensor], tuple[Tensor, Tensor]]


def cleared(
    call: Call, best: Iterate, rounds: int, limit: float, once: Once, clearance: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Solve the feasible problems of a call that touch an obstacle between two knots again, among larger obstacles.

    Args:
        best: the trajectories so far, of all problems; `once` puts better ones into it.
        limit: violation up to which they are feasible.
        once: solves problems `rows` (b,), by a call with obstacles that have grown for them, from their trajectories,
            where more clearance than `least` (b,) is wanted. Returns where it has put new ones, and the clearances
            (b,) that it has found.
        clearance: `path_clearance` (B,) of `best`, where it is known.

    Returns:
        The problems that touched, and whether they still do.
    """
    clearance = path_clearance(call.problem, best.X, best.U) if clearance is None else clearance.clone()
    by, now = torch.zeros_like(clearance), clearance.clone()
    rows = touching = ((best.violation <= limit) & (clearance < 0)).nonzero().flatten()
    for _ in range(rounds):
        if rows.numel() == 0 or call.late:
            break
        by[rows] += (-EXTRA * now[rows]).clamp(min=MIN_GROWTH * limit)
        old, part = take(best, rows), call.take(rows)
        part = replace(part, problem=part.problem.grown(by[rows]), U0=old.U, warm=old.multipliers)
        serves, now[rows] = once(rows, part, old, clearance[rows])
        clearance[rows] = torch.where(serves, now[rows], clearance[rows])
        rows = rows[clearance[rows] < 0]
    return touching, clearance[touching] < 0


def clear_further(search: Search, call: Call, end: SolveEnd) -> None:
    """The interior point goes on among larger obstacles where solves of a call have ended in contact between knots.

    Args:
        end: how they have ended; the trajectories that are clearer take their places in it.
    """
    solver, limit = replace(search.interior, warm_barrier=GROWN_BARRIER), search.solver.violation_tolerance

    def once(rows: Tensor, larger: Call, old: Iterate, least: Tensor) -> tuple[Tensor, Tensor]:
        new = continued(solver, larger, old)
        serves, found, clearance = serving(call.problem.take(rows), new.best, old, least, limit)
        chosen = serves.nonzero().flatten()
        put(end.best, rows[chosen], take(found, chosen))
        end.status[rows[chosen]] = new.status[chosen]
        end.iterations[rows] += new.iterations
        return serves, clearance

    cleared(call, end.best, ClearChords().rounds, limit, once)


def _along_other_ways(search: Search) -> None:
    """Where the best can't be brought clear between the knots, the cheapest candidate of another way that can be."""
    best, limit = search.best, search.solver.violation_tolerance
    for row, others in sorted(best.others.items()):
        at = search.call.ids.new_tensor([row])
        call = replace(search.call.take(at), callback=None)
        for other in others:
            if search.call.late or bool(is_sound(call.problem, best.of(at).best, limit)):
                break
            clear_further(search, call, other)
            serves = is_sound(call.problem, other.best, limit)
            best.replace(at, serves & ~leaves_goal(call.problem, other.best.X, best.of(at).best.X), other.best, other)


def serving(
    problem: Problem, new: Iterate, old: Iterate, least: Tensor, limit: float
) -> tuple[Tensor, Iterate, Tensor]:
    """Where new trajectories may replace old ones, as they are among the problems' own obstacles, and their clearances.

    They do where they are feasible, arrive if the old ones do, and keep more clearance than `least`, (B,), m.
    """
    found = replace(new, violation=measured(problem, new.X, new.U))
    clearance = path_clearance(problem, found.X, found.U)
    serves = (found.violation <= limit) & (clearance > least)
    return serves & ~leaves_goal(problem, found.X, old.X), found, clearance
