"""The best of several attempts at each problem of a call."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from torchgco.base.tree import copied, put, take
from torchgco.lagrangian.penalties import Penalty
from torchgco.lagrangian.quality import has_arrived, is_preferred
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.contracts import Call, Callback, Guidance, Progress
from torchgco.solvers.history import Recorder
from torchgco.solvers.state import STOPPED, Iterate, SolveEnd


class Best:
    """Keeps the best trajectory of each problem and the sums of all counts, during one solve."""

    def __init__(
        self, call: Call, first: SolveEnd, solver: AugmentedLagrangian, recorder: Recorder | None = None
    ) -> None:
        self.call, self.solver, self.recorder = call, solver, recorder
        self.end = copied(first)
        self.finished = call.problem.B - int((first.status == STOPPED).sum())  # as reported last

    def arrived(self, tolerances: float = 1.0) -> Tensor:
        """Whether each problem's best trajectory is feasible and ends within `tolerances` goal tolerances, (B,)."""
        best = self.end.best
        fits = best.violation <= self.solver.violation_tolerance
        return fits & has_arrived(self.call.problem, best.X, tolerances)

    def next_attempt(self) -> None:
        """Count attempts in the trace, also those that no problem of this batch needs."""
        if self.recorder is not None:
            self.recorder.attempt += 1

    def improve(
        self,
        rows: Tensor,
        call: Call,
        guidance: Guidance | None = None,
        penalty: Penalty | None = None,
        guide_first: bool = False,
    ) -> None:
        """One more attempt at the problems in `rows`, by a call for them; the better trajectory is kept."""
        if rows.numel() > 0:
            self.keep(rows, self.attempt(call, guidance, penalty, guide_first))

    def attempt(
        self,
        call: Call,
        guidance: Guidance | None = None,
        penalty: Penalty | None = None,
        guide_first: bool = False,
        solver: AugmentedLagrangian | None = None,
    ) -> SolveEnd:
        """A solve with progress and trace of the whole; see `AugmentedLagrangian.iterate`. None: by the own solver."""
        call = replace(call, callback=self._callback(call))
        return (solver or self.solver).iterate(call, guidance, penalty, self.recorder, guide_first, by_arrival=True)

    def keep(self, rows: Tensor, new: SolveEnd) -> None:
        """Keep the better of the old and the new trajectories of `rows`: arrived, then feasible, then cheapest."""
        problem, limit = self.call.problem.take(rows), self.solver.violation_tolerance
        old = take(self.end.best, rows)
        self.replace(rows, is_preferred(problem, new.best, old, limit), new.best, new)

    def replace(self, rows: Tensor, where: Tensor, trajectories: Iterate, new: SolveEnd) -> None:
        """New trajectories of `rows` where a mask (b,) says so, and the counts of their solves."""
        chosen = where.nonzero().flatten()
        put(self.end.best, rows[chosen], take(trajectories, chosen))
        self.end.status[rows[chosen]] = new.status[chosen]
        for name in ("iterations", "outer", "guided"):
            getattr(self.end, name)[rows] += getattr(new, name)

    def _callback(self, call: Call) -> Callback | None:
        """Reports an attempt's progress as the batch's, where all other problems have finished; it never falls."""
        if call.callback is None:
            return None
        report, total = call.callback, self.call.problem.B

        def onward(now: Progress) -> None:
            self.finished = max(self.finished, total - now.total + now.finished)
            report(replace(now, finished=self.finished, total=total))

        return onward
