"""The best trajectory of each problem of a call among several attempts at it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchgco.base.status import STOPPED
from torchgco.base.tree import copied, put, take
from torchgco.kernels import path_clearance
from torchgco.lagrangian.quality import arrive_alike, has_arrived, is_preferred
from torchgco.lagrangian.state import Iterate, SolveEnd
from torchgco.problem.problem import Problem
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.contracts import Call, Callback, Progress
from torchgco.solvers.ending import fails_between
from torchgco.solvers.history import Recorder


def is_sound(problem: Problem, one: Iterate, limit: float, clearance: Tensor | None = None) -> Tensor:
    """Whether trajectories are feasible, between the knots too, (B,) bool.

    Args:
        limit: violation at the knots.
        clearance: `path_clearance` (B,), where it is known.
    """
    sound = one.violation <= limit
    rows = sound.nonzero().flatten()
    if rows.numel() > 0:
        known = None if clearance is None else clearance[rows]
        sound[rows] = ~fails_between(problem.take(rows), one.X[rows], one.U[rows], known)
    return sound


class Best:
    """Keeps the best trajectory of each problem and the sums of all counts, during one solve."""

    def __init__(
        self, call: Call, first: SolveEnd, solver: AugmentedLagrangian, recorder: Recorder | None = None
    ) -> None:
        self.call, self.solver, self.recorder = call, solver, recorder
        self.end = copied(first)
        self.worked = torch.ones_like(call.ids, dtype=torch.bool)  # (B,): on which problems the present pass has
        self.spare: dict[int, SolveEnd] = {}  # by problem: the best clear trajectory that one in contact has replaced
        self.others: dict[int, list[SolveEnd]] = {}  # solved along other ways, in contact between two knots
        self.finished = call.problem.B - int((first.status == STOPPED).sum())  # as reported last
        self._arrived: dict[float, Tensor] = {}  # until a trajectory is replaced, as what follows
        self._clearance: Tensor | None = None

    def of(self, rows: Tensor) -> SolveEnd:
        """How the best attempts of problems `rows` (b,), ascending, have ended: to be read, not to be kept."""
        return self.end if rows.numel() == self.call.problem.B else take(self.end, rows)

    def arrived(self, tolerances: float = 1.0) -> Tensor:
        """Whether each problem's best trajectory is feasible and ends within `tolerances` goal tolerances, (B,)."""
        if tolerances not in self._arrived:
            best = self.end.best
            fits = best.violation <= self.solver.violation_tolerance
            self._arrived[tolerances] = fits & has_arrived(self.call.problem, best.X, tolerances)
        return self._arrived[tolerances]

    @property
    def clearance(self) -> Tensor:
        """`path_clearance` (B,) of the best trajectories."""
        if self._clearance is None:
            self._clearance = path_clearance(self.call.problem, self.end.best.X, self.end.best.U)
        return self._clearance

    def _forget(self) -> None:
        self._arrived.clear()
        self._clearance = None

    def next_attempt(self) -> None:
        """Count attempts in the trace, also those that no problem of this batch needs."""
        if self.recorder is not None:
            self.recorder.attempt += 1

    def improve(self, rows: Tensor, call: Call, **how: Any) -> None:
        """One more `attempt` at the problems in `rows`, by a call for them; the better trajectory is kept."""
        if rows.numel() > 0:
            self.keep(rows, self.attempt(call, **how))

    def attempt(self, call: Call, **how: Any) -> SolveEnd:
        """A solve with progress and trace of the whole, by further arguments of `AugmentedLagrangian.outer_loop`."""
        call = replace(call, callback=self._callback(call))
        return self.solver.outer_loop(call, recorder=self.recorder, by_arrival=True, **how)

    def keep(self, rows: Tensor, new: SolveEnd) -> None:
        """Keep the better of the old and the new trajectories of `rows`: arrived, then feasible, then cheapest."""
        problem, limit = self.call.problem.take(rows), self.solver.violation_tolerance
        old = self.of(rows)
        preferred = is_preferred(problem, new.best, old.best, limit)
        self._spare(problem, rows, preferred, old, new)
        self.replace(rows, preferred, new.best, new)

    def _spare(self, problem: Problem, rows: Tensor, preferred: Tensor, old: SolveEnd, new: SolveEnd) -> None:
        """Remember those of two feasible trajectories that lose to one that touches between two knots."""
        limit = self.solver.violation_tolerance
        fits = (old.best.violation <= limit) & (new.best.violation <= limit)
        if not bool(fits.any()):
            return
        chosen = preferred.view(-1, 1, 1)
        for winner in (False, True):  # of the pair, the one that loses first: mostly it isn't clear either
            some, swapped = fits.nonzero().flatten(), chosen if winner else ~chosen
            X, U = (torch.where(swapped, a, b)[some] for a, b in ((new.best.X, old.best.X), (new.best.U, old.best.U)))
            clear = path_clearance(problem.take(some), X, U) >= 0
            fits[some] &= ~clear if winner else clear
            if not bool(fits.any()):
                return
        for at in fits.nonzero().flatten():
            part, row = problem.take(at.unsqueeze(0)), int(rows[at])
            one = take(old if bool(preferred[at]) else new, at.unsqueeze(0))
            kept = self.spare.get(row)
            if kept is None or bool(is_preferred(part, one.best, kept.best, limit)):
                self.spare[row] = one

    def restore(self, rows: Tensor, touching: Tensor) -> None:
        """Take back the clear trajectories that ones of `rows` have replaced that were better only by their cost.

        That is where these are still `touching` an obstacle, (b,) bool, or have become more expensive by keeping clear.
        """
        for row, touches in zip(rows.tolist(), touching.tolist(), strict=True):
            one, at = self.spare.get(row), rows.new_tensor([row])
            if one is None or not bool(arrive_alike(self.call.problem.take(at), one.best.X, self.end.best.X[at])):
                continue
            if touches or bool(one.best.cost < self.end.best.cost[row]):
                self._take_back(row)

    def settle(self) -> None:
        """Take back the clear trajectories that others have replaced which aren't feasible between the knots."""
        rows = torch.tensor(sorted(self.spare), dtype=torch.int64, device=self.call.ids.device)
        if rows.numel() > 0:
            sound = is_sound(self.call.problem.take(rows), take(self.end.best, rows), self.solver.violation_tolerance)
            for row in rows[~sound].tolist():
                self._take_back(row)

    def _take_back(self, row: int) -> None:
        """Put the spare trajectory of a problem in the place of its best one."""
        one = self.spare.pop(row)
        self._forget()
        put(self.end.best, self.end.status.new_tensor([row]), one.best)
        self.end.status[row] = one.status

    def replace(self, rows: Tensor, where: Tensor, trajectories: Iterate, new: SolveEnd) -> None:
        """New trajectories of `rows` where a mask (b,) says so, and the counts of their solves."""
        self.worked[rows] = True
        chosen = where.nonzero().flatten()
        if chosen.numel() > 0:
            self._forget()
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
