"""What a solve shows: lines on request, a bar where somebody watches, and nothing that changes a result."""

from __future__ import annotations

import re

import pytest
import torch

import torchgco
from tests.problems import planar_batch, quick_gco
from tests.search.gates import gates
from torchgco import InputError
from torchgco.solvers import watching
from torchgco.solvers.contracts import Progress

ROW = re.compile(r"row +(\d+) (\w+) +(\d+) problems?; all in all (\d+) feasible, (\d+) at the goal; [\d.]+ s")


@pytest.mark.slow
def test_a_line_for_every_row_that_worked_and_one_at_the_end(capsys: pytest.CaptureFixture[str]) -> None:
    problem, U0 = gates()
    solver = quick_gco(problem)
    quiet = torchgco.solve(problem, U0, solver=solver, seed=3, record=True)
    assert capsys.readouterr().out == ""
    loud = torchgco.solve(problem, U0, solver=solver, seed=3, verbose=True)
    assert torch.equal(loud.U, quiet.U) and torch.equal(loud.iterations, quiet.iterations)
    *lines, end = capsys.readouterr().out.splitlines()
    rows = [found.groups() for line in lines if (found := ROW.fullmatch(line))]
    assert len(rows) == len(lines)
    assert quiet.search is not None
    worked = [(str(number), name, str(len(at))) for number, name, at in quiet.search.passes if at]
    assert [row[:3] for row in rows] == worked
    last = quiet.search.standings[-1]
    assert last is not None and int(rows[-1][4]) == int(last.arrived.sum())
    assert int(rows[-1][3]) == int((last.violation <= solver.local.violation_tolerance).sum())
    assert end.startswith("Restarts: 4 problems: ")


@pytest.mark.parametrize("name", ["al_ilqr", "interior_point", "hold"])
def test_solvers_without_a_table_say_how_many_have_ended(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    problem, U0 = planar_batch(B=3, N=20, obstacles=2)
    solution = torchgco.solve(problem, U0, solver=name, verbose=True)
    *lines, end = capsys.readouterr().out.splitlines()
    passes = [int(line.split()[1].rstrip(":")) for line in lines]
    assert passes == [2**i for i in range(len(passes))] and (len(passes) > 0) == (name != "hold")
    statuses = {status.name for status in solution.statuses}
    assert end.startswith(f"{name}: 3 problems: ") and all(status in end for status in statuses)


def test_a_bar_appears_where_somebody_watches_a_long_solve(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    problem, U0 = planar_batch(B=3, N=20, obstacles=2)
    for seen, after, verbose, expected in (
        (True, 0.0, None, True), (True, 60.0, None, False), (False, 0.0, None, False), (True, 0.0, False, False),
    ):  # fmt: skip
        monkeypatch.setattr(watching, "watched", lambda seen=seen: seen)
        monkeypatch.setattr(watching, "AFTER", after)
        monkeypatch.setattr(watching, "BAR_STEP", 0.0)
        torchgco.solve(problem, U0, solver="al_ilqr", verbose=verbose)
        out, err = capsys.readouterr()
        assert out == "" and ("al_ilqr: " in err) == expected
    monkeypatch.setattr(watching, "watched", lambda: True)
    monkeypatch.setattr(watching, "AFTER", 0.0)
    watcher = watching.Watcher("some", 4, False, None)
    watcher(Progress(1, torch.arange(4), 2, 4))
    watcher(Progress(0, torch.arange(2), 2, 4, candidates=(3, 9)))
    assert watcher.bar.n == 2 and "candidates 3/9" in str(watcher.bar)
    watcher.close()


def test_a_solve_that_fails_takes_its_bar_away(monkeypatch: pytest.MonkeyPatch) -> None:
    closed = list[bool]()
    monkeypatch.setattr(watching.Watcher, "close", lambda self: closed.append(True))
    problem, U0 = planar_batch(B=1, N=5, obstacles=1)
    with pytest.raises(InputError):
        torchgco.solve(problem, U0[:, :3], verbose=True)
    assert closed == [True]
    with pytest.raises(InputError, match="verbose"):
        torchgco.solve(problem, U0, verbose="yes")  # type: ignore[arg-type]
