"""The state that the passes of a search share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from torchgco.base.status import STOPPED
from torchgco.lagrangian.state import SolveEnd
from torchgco.roadmap.scene import has_paths
from torchgco.search.best import Best
from torchgco.search.candidates import unwatched
from torchgco.search.proposals import Part, Round
from torchgco.search.table import Row
from torchgco.solution import SearchRecord, Standing
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.contracts import Call, Guidance, Progress, RowEnd
from torchgco.solvers.history import Recorder
from torchgco.solvers.interior import InteriorPoint

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
