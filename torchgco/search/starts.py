"""Further solves by the interior point from random guesses: the multi-start of problems without obstacles."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import torch
from torch import Tensor

from torchgco.base.draws import DrawKey, smooth_normal
from torchgco.base.options import Count, Positive
from torchgco.base.status import UNMOVED, Status, is_over
from torchgco.base.tree import take
from torchgco.lagrangian.state import Iterate
from torchgco.search.converge import Converge, keep_tight
from torchgco.search.search import Search
from torchgco.search.table import Row
from torchgco.solvers.contracts import Call
from torchgco.solvers.interior import half_ranges

KNOTS = 4  # of the noise: with 8, guesses are bent more often than optima are, and lead to fewer of them
STREAM = 1 << 21  # outer iteration that keys the noise: no solve makes so many


@dataclass(frozen=True)
class Starts(Row):
    """Solves by the interior point from random guesses, of problems without obstacles; the best result is kept.

    A guess has states on the straight line from the start to the end of the best trajectory, bent by smooth noise, and
    the controls given, with smooth noise: swing-ups and manoeuvres have many local minima, and random controls alone
    lead chaotic systems far away. Guesses are keyed by (seed, id, start).

    Args:
        count: of guesses.
        when: "unsolved": where the first solve failed or the best trajectory is infeasible; "all".
        bend: standard deviation of the noise in the states half-way, as a share of the range of each along the best
            trajectory.
        change: standard deviation of the noise in the controls, as a share of half their range.

    Raises:
        InputError: a field out of its range.
    """

    count: Count = 8
    when: Literal["unsolved", "all"] = "unsolved"
    bend: Positive = 0.2
    change: Positive = 0.1

    label: ClassVar[str] = "starts"
    last: ClassVar[bool] = True

    @property
    def problems(self) -> str:
        return f"without obstacles, {'all' if self.when == 'all' else 'unsolved at first'}"

    @property
    def does(self) -> str:
        return f"interior point from {self.count} guesses, bent by {self.bend:g}, controls by {self.change:g}"

    def run(self, search: Search) -> None:
        """Solve; see the class."""
        problem, left = search.call.problem, self._rows(search)
        if not Converge.begins(problem) or left.numel() == 0:  # which `split` would make one empty batch of
            return
        slots = search.solver.slots or problem.B * self.count
        for rows in left.split(max(1, slots // self.count)):
            if search.call.late:
                return
            self._solve(search, rows)

    def _rows(self, search: Search) -> Tensor:
        """The problems to solve again, (b,)."""
        if self.when == "all":
            return torch.arange(search.call.problem.B, device=search.call.ids.device)
        first = search.caught.status
        failed = ~is_over(first) & (first != Status.CONVERGED)
        lost = ~(search.best.end.best.violation <= search.solver.violation_tolerance) & (first != UNMOVED)
        return (failed | lost).nonzero().flatten()

    def _solve(self, search: Search, rows: Tensor) -> None:
        """All starts of the problems in `rows` as one batch."""
        each = rows.repeat_interleave(self.count)
        start = torch.arange(self.count, device=rows.device).repeat(rows.numel())
        call = replace(search.call.take(each), callback=None, warm=None)
        X, U = self._guess(call, take(search.best.end.best, each), start)
        end = search.interior.solved(replace(call, U0=U), X)
        for number in range(self.count):
            keep_tight(search, rows, take(end, slice(number, None, self.count)))

    def _guess(self, call: Call, best: Iterate, start: Tensor) -> tuple[Tensor, Tensor]:
        """States (b, N+1, n) and controls (b, N, m) to begin with, for starts of the numbers (b,)."""
        bends, changes = (DrawKey(call.seed, call.ids, STREAM + 2 * start + part) for part in (0, 1))
        X, way = best.X, torch.linspace(0.0, 1.0, call.problem.N + 1, dtype=best.X.dtype, device=best.X.device)
        way = way.view(1, -1, 1)
        size = 4.0 * way * (1.0 - way) * (X.amax(1) - X.amin(1)).unsqueeze(1)
        line = X[:, :1] + way * (X[:, -1:] - X[:, :1])
        U = call.U0 + self.change * half_ranges(call.problem, call.U0) * smooth_normal(changes, KNOTS, call.U0)
        return line + self.bend * size * smooth_normal(bends, KNOTS, X), U
