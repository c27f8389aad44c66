"""Causes of the shortfalls of `gco`: from synthetic numbers, and on one layout of a maze with few paths."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan
from pathlib import Path

import pandas as pd
import pytest
import torch

from benchmarks.causes import shortfalls
from benchmarks.causes.shortfalls import CAUSES, Search, cause, listed, refined, study, write
from benchmarks.lib.families import WORLDS
from torchgco import compose

FEW = Search(3, relaxed=[2, 0], compared=[2], chosen=2)
MORE = Search(6, relaxed=[2, 4, 0, 1], compared=[4, 2], chosen=4)
CLOSE = Search(6, relaxed=[3, 5], compared=[3], chosen=3)  # follows the paths of MORE closer
WITHOUT = Search(12, relaxed=[0, 1], compared=[])  # no proposal


@pytest.mark.parametrize(
    ("good", "searches", "name"),
    [
        ([], [FEW, MORE], "not among the paths"), ([0], [], "no path sought"), ([3], [FEW], "a later path"),
        ([6, 7], [FEW, MORE], "a later path"), ([1], [FEW], "dropped as tracked"),
        ([3, 5], [MORE], "dropped as tracked"), ([0], [FEW], "dropped as relaxed"),
        ([3, 1], [MORE], "dropped as relaxed"), ([2], [FEW], "lost in the solve"),
        ([2], [FEW, MORE], "lost in the solve"), ([0, 2, 7], [FEW], "lost in the solve"),
        ([1], [FEW, MORE], "dropped as relaxed"),  # the later search decides
        ([2], [FEW, WITHOUT], "lost in the solve"),  # unless it made no proposal
        ([2], [MORE, CLOSE], "lost in the solve"), ([3], [MORE, CLOSE], "lost in the solve"),  # or has the same paths
        ([0], [WITHOUT], "dropped as relaxed"), ([11], [MORE, WITHOUT], "dropped as tracked"),
    ],
)  # fmt: skip
def test_numbers_have_their_cause(good: list[int], searches: list[Search], name: str) -> None:
    costs = [104.0 if path in good else 106.0 if path % 2 else inf for path in range(12)]
    assert name in CAUSES and cause(100.0, True, costs, searches) == name


def test_causes_without_a_good_candidate() -> None:
    assert cause(nan, False, [90.0], [FEW]) == "no solution known"
    assert cause(100.0, True, [], []) == "another local solution"
    assert cause(100.0, False, [], []) == "not reached"
    assert cause(100.0, True, [106.0, inf], [FEW]) == "not among the paths"


@pytest.fixture(scope="module")
def maze():
    """Setup, layouts and task of mazes2, and the number of a layout where paths are sought."""
    setup = compose([*WORLDS["mazes2"].overrides(), "solver=gco", "device.threads=1"])
    layouts = setup.layouts(15)
    return setup.solver, layouts, setup.task(layouts), 14


@pytest.mark.slow
def test_the_record_of_a_solve_numbers_the_paths(maze) -> None:
    solver, _, task, i = maze
    problem, U0, ids = task.problem.take(torch.tensor([i])), task.U0[i : i + 1], torch.tensor([i])
    solution = replace(solver, local=replace(solver.local, record=True)).solve(problem, U0, ids=ids)
    searches = [Search.of(one) for one in solution.search.comparisons]
    assert searches[0].count == 6 and len(searches[0].relaxed) == 3 and len(searches[0].compared) <= 1
    for search in searches:
        assert set(search.compared) <= set(search.relaxed) <= set(range(search.count))
        assert search.chosen is None or search.chosen in search.compared
    # A search for more paths extends the list.
    few, more = (one.paths[0] for one in solution.search.comparisons[:2])
    assert len(searches) > 1 and torch.equal(few, more[:6])


def test_candidates_are_refined_to_their_costs(maze) -> None:
    _, _, task, i = maze
    problem = task.problem.take(torch.tensor([i]))
    costs, ends = refined(problem, 3)
    assert len(costs) == 6 and {path for path, cost in enumerate(costs) if cost < inf} == set(ends) != set()
    for X in ends.values():
        assert problem.goal.distance(X[None, -1, problem.position]) < 5  # m, of 21
        assert problem.geometric[0].clearances(X[None])[1] >= 0


@pytest.mark.slow
def test_a_layout_gets_a_row_and_a_picture(maze, tmp_path: Path) -> None:
    solver, layouts, task, i = maze
    row, example = study(solver, task, layouts, i, 0, 1.2 * layouts.best_cost[i], count=2)
    assert row["cause"] in CAUSES and row["sought"] >= 6 and row["ratio"] == pytest.approx(1.2)
    assert len(example.boxes) > 5 and example.path.shape == (task.problem.N + 1, 3)
    trials = pd.DataFrame([{"family": "mazes2", "layout": i, **row}, {"family": "mazes2", "layout": 0, "cause": None}])
    assert listed(trials).count("\n") == 2 and f"| mazes2 | {i} | 1.200 |" in listed(trials)
    page = tmp_path / "shortfalls.md"
    page.write_text("# Why\n<!-- shortfalls -->\n<!-- end shortfalls -->\n")
    write(page, trials, {row["cause"]: example}, 0)
    assert "| **short** |  | 1 of 2 |" in page.read_text() and "](shortfalls.png)" in page.read_text()
    assert page.with_suffix(".png").stat().st_size > 5000


def test_the_command_flies_and_writes_only_a_whole_run(capsys) -> None:
    assert shortfalls.main(["--worlds", "crossing10", "--first", "2"]) == 0
    assert "| **short** |  | 0 of 2 |" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        shortfalls.main(["--first", "2", "--write"])
