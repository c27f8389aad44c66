"""The state that the passes of a search share, and the best trajectory of each problem among several attempts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import torch
from torch import Tensor

from torchgco.base.status import STOPPED
from torchgco.base.tree import copied, put, take
from torchgco.kernels import path_clearance
from torchgco.lagrangian.lagrangian import Iterate, SolveEnd
from torchgco.lagrangian.quality import arrive_alike, has_arrived, is_preferred
from torchgco.problem.problem import Problem
from torchgco.roadmap.geometry import has_paths
from torchgco.search.candidates import unwatched
from torchgco.search.proposals import Part, Round
from torchgco.search.table import Row
from torchgco.solution import SearchRecord, Standing
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.contracts import Call, Callback, Guidance, Progress, RowEnd
from torchgco.solvers.ending import Recorder, fails_between
from torchgco.solvers.interior import InteriorPoint, guessed


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
        self._arrived: dict[float, Tensor] = {}  # until a trajectory is replaced, as `clearance` and `sound`

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

    @cached_property
    def clearance(self) -> Tensor:
        """`path_clearance` (B,) of the best trajectories."""
        return path_clearance(self.call.problem, self.end.best.X, self.end.best.U)

    @cached_property
    def sound(self) -> Tensor:
        """Whether they are feasible, between the knots too, (B,) bool."""
        return is_sound(self.call.problem, self.end.best, self.solver.violation_tolerance, self.clearance)

    def _forget(self) -> None:
        self._arrived.clear()
        for name in ("clearance", "sound"):
            vars(self).pop(name, None)

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
        if rows.numel() == 0:
            return
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


ATTRACTED_WITHIN = 2.0  # times the goal tolerance: trajectories that end nearer are attracted to the goal


class Late(Exception):
    """The time limit has passed during the search for paths."""


class Search:
    """The state of one solve by passes.

    Args:
        call: in the units that the solver works in.
        passes: None for those that can't serve.
        interior: the interior point of the table.
        guidance: of attempts from samples; None: none can serve.
        recorder: of every iteration; None: nothing is recorded.
        again: makes a search of its own, by the same passes, for another call; None: there is none.

    Attributes:
        best: the best trajectories so far, once a first solve has been made.
        caught: the solves that were stopped where their trajectories were caught, and of other problems the first one.
    """

    best: Best
    caught: SolveEnd

    def __init__(
        self,
        call: Call,
        solver: AugmentedLagrangian,
        passes: Sequence[Row | None],
        guidance: Guidance | None,
        interior: InteriorPoint,
        recorder: Recorder | None = None,
        again: Callable[[Call], SolveEnd] | None = None,
    ) -> None:
        self.call, self.solver, self.guidance, self.recorder = call, solver, guidance, recorder
        self.interior, self.again = interior, again
        # Whether there is anything to do where a trajectory is caught, and whether that includes paths.
        self.guided = guidance is not None or any(row.seeks_paths for row in passes if row is not None)
        self.has_paths = self.guided and has_paths(call.problem)
        self.record = None if recorder is None else SearchRecord()
        self.begun = False  # whether a first solve has been made
        self.round: tuple[Tensor, Round] | None = None  # the problems (b,) with proposals, and these
        self.waiting: list[tuple[Tensor, SolveEnd]] = []  # rows and results that compete at the end
        self.proposed = torch.zeros_like(call.ids, dtype=torch.bool)  # (B,): whether there was ever a proposal
        # (B,): whether the first solve, which wasn't stopped, ended short of a goal that is within reach.
        self.stalled = torch.zeros_like(call.ids, dtype=torch.bool)
        # (B,): whether the vehicle has been steered along all paths, so that there is no use in tracking these.
        self.steered = torch.zeros_like(call.ids, dtype=torch.bool)
        self.rejected = torch.full_like(call.U0[:, 0, 0], torch.nan)  # (B,): mu of the proposals rejected so far

    @cached_property
    def guess(self) -> Iterate:
        """The trajectories that the call's controls lead to."""
        return guessed(self.call)

    def begin(self, first: SolveEnd) -> None:
        """Keep the first solve of every problem."""
        self.best = Best(self.call, first, self.solver, self.recorder)
        self.caught = first  # of which `Best` has a copy
        self.begun = True

    def next_pass(self, number: int, name: str) -> None:
        """Count the passes in the records."""
        if self.begun:
            self.best.worked.zero_()
        if self.recorder is not None and self.record is not None:
            self.recorder.attempt += number > 1
            self.record.passes.append((number, name, []))

    def end_pass(self, number: int, name: str) -> None:
        """Report a pass that worked on some problem, and record the best trajectories after it."""
        if self.call.callback is not None and self.begun and bool(self.best.worked.any()):
            best = self.best
            fits = best.end.best.violation <= self.solver.violation_tolerance
            row = RowEnd(number, name, *(int(rows.sum()) for rows in (best.worked, fits, best.arrived())))
            self.call.callback(Progress(0, self.call.rows[:0], best.finished, self.call.problem.B, row=row))
        if self.record is None:
            return
        if not self.begun:
            self.record.standings.append(None)
            return
        self.record.passes[-1][2].extend(self.call.rows[self.best.worked].tolist())
        problem, best = self.call.problem, self.best.end.best
        away = torch.full_like(best.cost, torch.nan)
        if problem.goal is not None:
            away = problem.goal.distance(best.X[:, -1, problem.position])
        held = best.cost.clone(), best.violation.clone()
        self.record.standings.append(Standing(self.call.rows, *held, away, self.best.arrived()))

    def finish_record(self, unit: Tensor, constant: Tensor) -> SearchRecord:
        """The record, at the end of the search, with costs times a unit, plus a constant, both by place."""
        assert self.record is not None
        rows = (self.caught.status == STOPPED).nonzero().flatten()
        self.record.caught = self.call.rows[rows], self.caught.last.X[rows]
        return self.record.in_costs(unit, constant)

    def rows(self, when: str) -> Tensor:
        """The problems (b,) that a word describes, all among those that were caught, or stalled.

        "caught": all of them; "unarrived": no attempt has arrived yet; "far": none ends close to the goal either;
        "close": the best one does, but has not arrived; "unproposed": not arrived, and there was never a proposal.
        """
        rows = ((self.caught.status == STOPPED) | self.stalled).nonzero().flatten()
        if when == "caught" or rows.numel() == 0:
            return rows
        rows = rows[~self.best.arrived()[rows]]
        if when == "far":
            rows = rows[~self.best.arrived(ATTRACTED_WITHIN)[rows]]
        elif when == "close":
            rows = rows[self.best.arrived(ATTRACTED_WITHIN)[rows]]
        elif when == "unproposed":
            rows = rows[~self.proposed[rows]]
        return rows

    def part(self, rows: Tensor) -> Part:
        """The problems in `rows`, to compare candidates for them outside of a round."""
        problem = self.call.problem.take(rows)
        return Part(problem.in_cost_units(), problem.at_rest[1], self.call.rows[rows], self.record)

    def begin_round(self, when: str, at_once: int) -> None:
        """Begin a round of proposals for the problems that a word describes, `at_once` of them together."""
        rows = self.rows(when)
        rows, self.round = rows[~self.steered[rows]], None
        if rows.numel() == 0:
            return
        watches = self.call.callback is not None or self.call.deadline is not None
        watch = partial(self._watched, rows) if watches else unwatched
        begun = Round(self.call.problem.take(rows), at_once, watch, self.call.rows[rows], self.record)
        self.round = rows, begun

    def _watched(self, rows: Tensor, done: int, total: int) -> None:
        """Report that `done` of `total` candidates for `rows` are solved; raises Late after the deadline."""
        if self.call.late:
            self.best.worked[rows] = True
            raise Late
        if self.call.callback is not None:
            best, B = self.best, self.call.problem.B
            best.finished = max(best.finished, B - rows.numel())
            self.call.callback(Progress(0, self.call.rows[rows], best.finished, B, candidates=(done, total)))
