"""Restarts in a batch: the same bits in any batch, progress that never decreases, and a trace that names attempts."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from tests.problems import assert_same_bits
from tests.search.gates import (
    CLOSED,
    FREE,
    LOCAL,
    PASSES,
    PATHS,
    SAMPLING,
    SHORT,
    SOLVER,
    Solve,
    gates,
)
from tests.search.rows import restarts
from torchgco import Problem, Restarts, Solution, Status
from torchgco.search.candidates import Candidates
from torchgco.solvers import contracts
from torchgco.solvers.contracts import Progress


def reports(solver: Restarts, problem: Problem, U0: Tensor, **options) -> list[Progress]:
    seen: list[Progress] = []
    solver.solve(problem, U0, callback=seen.append, **options)
    return seen


@pytest.mark.parametrize("options", [{}, dict(proposals=None), dict(every=True), dict(guidance=None)])
def test_progress_never_decreases_and_ends_at_the_total(options: dict, solves: list[Solve]) -> None:
    whole = dict(proposals=PATHS, guidance=SAMPLING, attempts=2)
    seen = reports(restarts(LOCAL, **whole | options), *gates())
    finished = [now.finished for now in seen]
    assert finished == sorted(finished) and finished[-1] == 4 and {now.total for now in seen} == {4}
    first = next(now for now in seen if now.passes == 1)
    assert first.rows.tolist() == [0, 1, 2, 3] and first.finished <= 1
    again = {b for s in solves[1:] for b in s.rows}
    assert {b for now in seen[12:] for b in now.rows.tolist()} <= again  # positions in the whole batch, not in a part


@pytest.mark.parametrize("rows", [[FREE], [PASSES], [SHORT], [CLOSED], [CLOSED, SHORT, PASSES, FREE], [SHORT, FREE]])
def test_a_problem_has_the_same_bits_alone_and_in_any_order(rows: list[int], whole: Solution) -> None:
    problem, U0 = gates()
    index = torch.tensor(rows)
    part = SOLVER.solve(problem.take(index), U0[index], seed=3, ids=index)
    assert_same_bits(part, whole.take(index))


@pytest.mark.parametrize("slots", [1, 2])
def test_slots_change_no_bits(slots: int, whole: Solution) -> None:
    few = SOLVER.in_slots(slots)
    seen = []
    solution = few.solve(*gates(), seed=3, callback=seen.append)
    assert max(now.rows.numel() for now in seen if now.candidates is None) == slots
    assert_same_bits(solution, whole)


def test_progress_names_the_candidates_that_are_solved() -> None:
    seen = [now for now in reports(SOLVER, *gates()) if now.candidates is not None]
    counts = [now.candidates for now in seen]
    assert counts and all(0 <= done <= total for done, total in counts) and counts[0][0] == counts[0][1]
    assert all(FREE not in now.rows.tolist() and now.finished >= 1 and now.state is None for now in seen)


def test_the_search_for_paths_ends_with_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock passes the limit while the first candidates are solved: no later step begins."""
    now = 0.0
    monkeypatch.setattr(contracts, "clock", SimpleNamespace(seconds=lambda: now))
    solved, steps = Candidates.solved, []

    def slow(self: Candidates, *args, **options) -> Candidates:
        nonlocal now
        now = 10.0
        steps.append(1)
        return solved(self, *args, **options)

    monkeypatch.setattr(Candidates, "solved", slow)
    solution = SOLVER.solve(*gates(), max_seconds=5.0)
    assert len(steps) == 1 and Status.TIME_LIMIT in solution.statuses
    assert bool(torch.isfinite(solution.X).all()) and Status.RUNNING not in solution.statuses


def test_a_problem_that_cannot_start_is_not_attempted_and_disturbs_no_other(
    whole: Solution, solves: list[Solve]
) -> None:
    problem, U0 = gates()
    x0 = problem.x0.clone()
    x0[FREE, :2], x0[CLOSED, 0] = problem.constraints[0].centers[FREE, 0], torch.nan
    solution = SOLVER.solve(replace(problem, x0=x0), U0, seed=3)
    assert solution.statuses[FREE] == Status.INVALID_START and solution.statuses[CLOSED] == Status.NON_FINITE
    assert {b for s in solves[1:] for b in s.rows} == {PASSES, SHORT}
    middle = torch.tensor([PASSES, SHORT])
    assert_same_bits(solution.take(middle), whole.take(middle))


@pytest.mark.slow
def test_the_trace_names_the_attempt() -> None:
    """It is the row of the table, counted from 1 in any batch, up to the first row that draws more than once."""
    problem, U0 = gates()
    solver = replace(SOLVER, local=replace(SOLVER.local, record=True))
    solution = solver.solve(problem, U0, seed=3)
    attempts = solution.trace.groupby("element")["attempt"].unique()
    assert {b: list(attempts[b]) for b in range(4)} == {
        FREE: [2],
        PASSES: [2, 5],
        SHORT: [2, 5, 6],
        CLOSED: [2, 10, 11],
    }
    names = solver.table()["pass"]
    assert list(names[[2, 5, 6, 10, 11]]) == ["Solve", "FromProposal", "IntoGoal", "FromSamples", "FromSamples"]
    for b in (SHORT, CLOSED):
        index = torch.tensor([b])
        alone = solver.solve(problem.take(index), U0[index], seed=3, ids=index).trace.drop(columns="element")
        mine = solution.trace[solution.trace["element"] == b].drop(columns="element").reset_index(drop=True)
        assert alone.equals(mine)
