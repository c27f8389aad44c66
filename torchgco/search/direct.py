"""The interior point beside a search, where it is cheap: from the guess, and from where the first solve was caught.

A vehicle that drives along its heading is steered along the paths, too (`pursue`); where that arrives there is no
search, and where it doesn't, only samples are left: tracking the same paths by iLQR takes a hundred times as long.

A first solve is stopped where a knot lies millimetres inside one obstacle, and may be at the optimum there. Among few
obstacles in the plane an interior point from there, or from the guess, takes a hundredth of the iterations that a
search takes. Its results compete with the search's by cost, at the end; they spare it only where it could save little.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from torchgco.base.options import Natural, NonNegative
from torchgco.base.tree import take
from torchgco.lagrangian.lagrangian import SolveEnd
from torchgco.lagrangian.quality import has_arrived, ranks_arrival
from torchgco.obstacles.base import Obstacles
from torchgco.problem.problem import Problem
from torchgco.roadmap.geometry import has_maps
from torchgco.search.nearby import WITHOUT_OBSTACLES, without_obstacles
from torchgco.search.search import Search
from torchgco.search.table import Row
from torchgco.search.tube import pursue
from torchgco.solvers.contracts import Call

FROM_CAUGHT = 1e-2  # barrier for iterates that lie inside of obstacles by little


@dataclass(frozen=True)
class Direct(Row):
    """Solves caught problems by the interior point too; the results are compared with the search's at its end.

    Where one arrives and costs little more than the trajectory without obstacles, which keeps all other constraints,
    there is no search: it could save no more than that. Nor is there where a vehicle that is steered along the paths
    arrives.

    Args:
        gap: how much more it may cost, as a share.
        most: obstacles at a knot, at most; and only in the plane.

    Raises:
        InputError: a field out of its range.
    """

    gap: NonNegative = 0.02
    most: Natural = 5

    label: ClassVar[str] = "direct"
    seeks_paths: ClassVar[bool] = True
    last: ClassVar[bool] = True

    @property
    def problems(self) -> str:
        return f"caught in the plane among at most {self.most} obstacles and no map"

    @property
    def does(self) -> str:
        return (
            f"interior point from the guess and from there; over {self.gap:.0%} more expensive than without obstacles, "
            "what drives along its heading is steered along the paths; search"
        )

    def run(self, search: Search) -> None:
        """Solve; see the class."""
        rows = search.rows("caught")
        if rows.numel() == 0 or not search.has_paths or not self.serves(search.call.problem):
            return
        call = replace(search.call.take(rows), callback=None, warm=None)
        bare = without_obstacles(call.problem)
        bound = torch.full_like(call.problem.x0[:, 0], -torch.inf)
        if bare is not None:
            free = WITHOUT_OBSTACLES.solved(replace(call, problem=bare))
            bound = free.best.cost
            search.best.end.iterations[rows] += free.iterations
        solver = search.interior  # what it solves counts as solved: `Tighten` leaves it as it is
        left = self._compared(search, rows, call, solver.solved(call), bound)
        if left.numel() > 0:
            start = take(search.caught.last, rows[left])
            call = replace(call.take(left), U0=start.U)
            solver = replace(solver, initial_barrier=FROM_CAUGHT)
            left = left[self._compared(search, rows[left], call, solver.solved(call, start.X), bound[left])]
        if left.numel() > 0:
            pursue(search, rows[left])

    def serves(self, problem: Problem) -> bool:
        """Whether the interior point is cheap for these problems: among few obstacles in the plane."""
        at = problem.position
        bodies = sum(part.absent.shape[1] for part in problem.geometric if isinstance(part, Obstacles))
        return at.stop - at.start == 2 and bodies <= self.most and not has_maps(problem)

    def _compared(self, search: Search, rows: Tensor, call: Call, end: SolveEnd, bound: Tensor) -> Tensor:
        """Keep results of `rows` that hardly exceed a bound (b,) on costs; places (b',) of the others, which wait."""
        serves = end.best.violation <= search.solver.violation_tolerance
        if ranks_arrival(call.problem):
            serves &= has_arrived(call.problem, end.best.X)
        quick = serves & (end.best.cost <= bound + self.gap * bound.abs())
        enough, left = quick.nonzero().flatten(), (~quick).nonzero().flatten()
        search.best.keep(rows[enough], take(end, enough))
        search.best.end.iterations[rows[left]] += end.iterations[left]  # now, and not once more at the end
        search.best.worked[rows] = True
        waits = take(end, left)
        search.waiting.append((rows[left], replace(waits, iterations=torch.zeros_like(waits.iterations))))
        return left


@dataclass(frozen=True)
class Join(Row):
    """Lets the results of `Direct` that wait compete with the best trajectories."""

    seeks_paths: ClassVar[bool] = True
    last: ClassVar[bool] = True
    problems: ClassVar[str] = "with results that wait"
    does: ClassVar[str] = "the cheaper counts"

    def run(self, search: Search) -> None:
        """Compare; see the class."""
        for rows, end in search.waiting:
            search.best.keep(rows, end)
        search.waiting.clear()
