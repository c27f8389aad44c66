"""The best of several attempts at each problem of a call, and the state that the passes of a search share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from torchgco.base.status import STOPPED, Status
from torchgco.base.tree import copied, put, take
from torchgco.kernels import chord_clearance
from torchgco.lagrangian.penalties import Penalty
from torchgco.lagrangian.quality import arrive_alike, has_arrived, is_preferred
from torchgco.lagrangian.state import Iterate, SolveEnd
from torchgco.problem.problem import Problem
from torchgco.roadmap.scene import has_paths
from torchgco.search.candidates import unwatched
from torchgco.search.proposals import PathProposals, Round
from torchgco.search.row import Row
from torchgco.solution import SearchRecord, Standing
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.contracts import Call, Callback, Guidance, Progress, RowEnd
from torchgco.solvers.history import Recorder
from torchgco.solvers.interior import InteriorPoint

ATTRACTED_WITHIN = 2.0  # times the goal tolerance: trajectories that end nearer are attracted to the goal


class Best:
    """Keeps the best trajectory of each problem and the sums of all counts, during one solve."""

    def __init__(
        self,
        call: Call,
        first: SolveEnd,
        solver: AugmentedLagrangian,
        recorder: Recorder | None = None,
        record: SearchRecord | None = None,
    ) -> None:
        self.call, self.solver, self.recorder, self.record = call, solver, recorder, record
        self.end = copied(first)
        self.worked = torch.ones_like(call.ids, dtype=torch.bool)  # (B,): on which problems the present pass has
        self.spare: dict[int, SolveEnd] = {}  # by problem: the best clear trajectory that a cheaper one has replaced
        self.finished = call.problem.B - int((first.status == STOPPED).sum())  # as reported last
        self._arrived: dict[float, Tensor] = {}  # until a trajectory is replaced

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
    def limited(self) -> Tensor:
        """The problems (b,) whose best trajectory is of a solve that a limit has ended."""
        limits = (Status.MAX_ITERATIONS, Status.LINE_SEARCH_FAILED, STOPPED)
        return torch.stack([self.end.status == int(limit) for limit in limits]).any(0).nonzero().flatten()

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
        """A solve with progress and trace of the whole; see `AugmentedLagrangian.outer_loop`. None: by its own."""
        call = replace(call, callback=self._callback(call))
        return (solver or self.solver).outer_loop(call, guidance, penalty, self.recorder, guide_first, by_arrival=True)

    def keep(self, rows: Tensor, new: SolveEnd) -> None:
        """Keep the better of the old and the new trajectories of `rows`: arrived, then feasible, then cheapest."""
        problem, limit = self.call.problem.take(rows), self.solver.violation_tolerance
        old = self.of(rows)
        preferred = is_preferred(problem, new.best, old.best, limit)
        self._spare(problem, rows, preferred, old, new)
        self.replace(rows, preferred, new.best, new)

    def _spare(self, problem: Problem, rows: Tensor, preferred: Tensor, old: SolveEnd, new: SolveEnd) -> None:
        """Remember those of two trajectories that lose by their cost alone to one that touches between two knots."""
        limit = self.solver.violation_tolerance
        fits = (old.best.violation <= limit) & (new.best.violation <= limit)
        if not bool(fits.any()):
            return
        fits &= arrive_alike(problem, new.best.X, old.best.X)
        if not bool(fits.any()):
            return
        before, now = (chord_clearance(problem, end.best.X) >= 0 for end in (old, new))
        for at in (fits & (before != now) & (before == preferred)).nonzero().flatten():
            one = take(old if bool(preferred[at]) else new, at.unsqueeze(0))
            kept = self.spare.setdefault(int(rows[at]), one)
            if bool(one.best.cost < kept.best.cost):
                self.spare[int(rows[at])] = one

    def restore(self, rows: Tensor, touching: Tensor) -> None:
        """Take back the clear trajectories that cheaper ones of `rows` have replaced.

        That is where these are still `touching` an obstacle, (b,) bool, or have become more expensive by keeping clear.
        """
        for row, touches in zip(rows.tolist(), touching.tolist(), strict=True):
            one = self.spare.pop(row, None)
            if one is not None and (touches or bool(one.best.cost < self.end.best.cost[row])):
                put(self.end.best, rows.new_tensor([row]), one.best)
                self.end.status[row] = one.status

    def replace(self, rows: Tensor, where: Tensor, trajectories: Iterate, new: SolveEnd) -> None:
        """New trajectories of `rows` where a mask (b,) says so, and the counts of their solves."""
        if self.record is not None:
            self.record.passes[-1][2].extend(self.call.rows[rows].tolist())
        self.worked[rows] = True
        chosen = where.nonzero().flatten()
        if chosen.numel() > 0:
            self._arrived.clear()
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
    """

    def __init__(
        self,
        call: Call,
        solver: AugmentedLagrangian,
        passes: Sequence[Row | None],
        guidance: Guidance | None,
        interior: InteriorPoint,
        recorder: Recorder | None = None,
    ) -> None:
        self.call, self.solver, self.guidance, self.recorder = call, solver, guidance, recorder
        self.interior = interior
        # Whether there is anything to do where a trajectory is caught, and whether that includes paths.
        self.guided = guidance is not None or any(row.seeks_paths for row in passes if row is not None)
        self.has_paths = self.guided and has_paths(call.problem)
        self.record = None if recorder is None else SearchRecord()
        self._best: Best | None = None
        self._caught: SolveEnd | None = None
        self._round: tuple[Tensor, Round] | None = None
        self.waiting: list[tuple[Tensor, SolveEnd]] = []  # rows and results that compete at the end
        self.proposed = torch.zeros_like(call.ids, dtype=torch.bool)  # (B,): whether there was ever a proposal
        # (B,): whether the vehicle has been steered along all paths, so that there is no use in tracking these.
        self.steered = torch.zeros_like(call.ids, dtype=torch.bool)
        self.rejected = torch.full_like(call.U0[:, 0, 0], torch.nan)  # (B,): mu of the proposals rejected so far

    @property
    def begun(self) -> bool:
        """Whether a first solve has been made."""
        return self._best is not None

    @property
    def best(self) -> Best:
        """The best trajectories so far."""
        assert self._best is not None
        return self._best

    @property
    def caught(self) -> SolveEnd:
        """The solves that were stopped where their trajectories were caught, and of other problems the first solve."""
        assert self._caught is not None
        return self._caught

    def begin(self, first: SolveEnd) -> None:
        """Keep the first solve of every problem."""
        self._best = Best(self.call, first, self.solver, self.recorder, self.record)
        self._caught = first  # of which `Best` has a copy

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
        self.record.passes = [(number, name, sorted(set(worked))) for number, name, worked in self.record.passes]
        return self.record.in_costs(unit, constant)

    def join(self) -> None:
        """Let the results that wait compete with the best trajectories."""
        for rows, end in self.waiting:
            self.best.keep(rows, end)
        self.waiting.clear()

    def rows(self, when: str) -> Tensor:
        """The problems (b,) that a word describes, all among those that were caught.

        "caught": all of them; "unarrived": no attempt has arrived yet; "far": none ends close to the goal either;
        "close": the best one does, but has not arrived; "unproposed": not arrived, and there was never a proposal.
        """
        rows = (self.caught.status == STOPPED).nonzero().flatten()
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

    def propose(self, proposals: PathProposals) -> None:
        """A pass of proposals: of a new round, or of the one that has begun."""
        if not proposals.continues:
            rows = self.rows(proposals.when)
            rows = rows[~self.steered[rows]]
            self._round = (rows, self._begun_round(proposals, rows)) if rows.numel() > 0 else None
        if self._round is not None:
            rows, begun = self._round
            self.best.worked[rows[begun.improve(proposals)]] = True

    def _begun_round(self, proposals: PathProposals, rows: Tensor) -> Round:
        watches = self.call.callback is not None or self.call.deadline is not None
        watch = partial(self._watched, rows) if watches else unwatched
        return Round(self.call.problem.take(rows), proposals.at_once, watch, self.call.rows[rows], self.record)

    def take_round(self) -> tuple[Tensor, Round] | None:
        """The problems of the round of proposals, and the round; it is over."""
        found, self._round = self._round, None
        return found

    def _watched(self, rows: Tensor, done: int, total: int) -> None:
        """Report that `done` of `total` candidates for `rows` are solved; raises Late after the deadline."""
        if self.call.late:
            raise Late
        if self.call.callback is not None:
            best, B = self.best, self.call.problem.B
            best.finished = max(best.finished, B - rows.numel())
            self.call.callback(Progress(0, self.call.rows[rows], best.finished, B, candidates=(done, total)))
