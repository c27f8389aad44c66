"""The best of several attempts at each problem of a call."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchgco.evaluation import GOAL_TOLERANCE, has_arrived, is_better
from torchgco.penalties import Penalty
from torchgco.problem import Problem
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.contracts import Call, Callback, Guidance
from torchgco.solvers.state import Iterate, SolveEnd
from torchgco.solvers.trace import Recorder
from torchgco.tree import copied, put, take


class Best:
    """Keeps the best trajectory of each problem and the sums of all counts; created and dropped by one solve."""

    def __init__(
        self, call: Call, first: SolveEnd, solver: AugmentedLagrangian, recorder: Recorder | None = None
    ) -> None:
        self.call, self.first, self.solver, self.recorder = call, first, solver, recorder
        self.end = copied(first)

    def arrived(self, tolerances: float = 1.0) -> Tensor:
        """Whether the best trajectory of each problem is feasible and ends within so many goal tolerances, (B,)."""
        return self._arrived(self.call.problem, self.end.best, tolerances)

    def improve(
        self, rows: Tensor, call: Call, guidance: Guidance | None = None, penalty: Penalty | None = None
    ) -> None:
        """One more attempt at the problems in `rows`, by a call for these problems."""
        if rows.numel() == 0:
            return
        if self.recorder is not None:
            self.recorder.attempt += 1
        call = replace(call, callback=self._callback(call))
        self.keep(rows, self.solver.iterate(call, guidance, penalty, self.recorder))

    def keep(self, rows: Tensor, new: SolveEnd) -> None:
        """The better of the former trajectories of `rows` and new ones: arrived, then feasible, then cheap."""
        problem, limit = self.call.problem.take(rows), self.solver.violation_tolerance
        old = take(self.end.best, rows)
        better = is_better(new.best.cost, new.best.violation, old.cost, old.violation, limit)
        arrived, before = (self._arrived(problem, path, 1.0) for path in (new.best, old))
        chosen = torch.where(arrived == before, better, arrived).nonzero().flatten()
        put(self.end.best, rows[chosen], take(new.best, chosen))
        self.end.status[rows[chosen]] = new.status[chosen]
        for name in ("iterations", "outer", "guided"):
            getattr(self.end, name)[rows] += getattr(new, name)

    def _arrived(self, problem: Problem, path: Iterate, tolerances: float) -> Tensor:
        fits = path.violation <= self.solver.violation_tolerance
        return fits & has_arrived(problem, path.X, tolerances * GOAL_TOLERANCE)

    def _callback(self, call: Call) -> Callback | None:
        """Progress of an attempt as progress of the batch: the problems that are not attempted have finished."""
        if call.callback is None:
            return None
        report, total = call.callback, self.call.problem.B
        return lambda now: report(replace(now, finished=total - now.total + now.finished, total=total))
