"""Pages of results, the columns of comparisons, and work with a limit of time."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks.lib import command, page
from benchmarks.lib.command import Command, parser_of
from benchmarks.lib.comparison import Comparison, cost_ratios, count, mean, median, named, share_within, within, worst
from benchmarks.lib.provenance import provenance
from tests.problems import planar_batch
from torchgco import solve


def test_a_table_replaces_the_one_between_the_marks_of_its_page(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(command, "RESULTS", tmp_path)
    file = tmp_path / "maze.md"
    file.write_text("before\n<!-- maze -->\nold\n<!-- end maze -->\nafter\n")
    main = Command(
        "python -m x: y.", "maze", lambda starts, names: f"| {starts + 1}, {names[0]} |", "{starts} starts of {names}",
        "CasADi", "to 1e-6", starts=(64, "number"), names=(["a", "b"], "which", ("a", "b")),
    )  # fmt: skip
    assert main([]) == 0 and "old" in file.read_text()
    assert main(["--write"]) == 0 and capsys.readouterr().out == "| 65, a |\n" * 2
    text, origin = file.read_text(), provenance("cpu")
    first = f"Measured on {origin['date']} at commit {origin['commit']}, 64 starts of a, b, {origin['processor']}"
    assert f"<!-- maze -->\n{first}; CasADi {origin['casadi']}; to 1e-6.\n\n| 65, a |\n" in text
    assert text.startswith("before\n") and text.endswith("after\n") and "old" not in text
    with pytest.raises(ValueError, match="no part between"):
        page.put(file, "barn", "")


def test_a_long_table_goes_into_a_file_and_its_short_form_into_the_page(tmp_path: Path) -> None:
    file = tmp_path / "worlds.md"
    file.write_text("<!-- worlds -->\n<!-- end worlds -->")
    rows = [["woods", "gco", "3 [1, 4]", "a \\| b, c"], ["woods", "ipopt", "1 [0, 2]", ""], ["mazes", "gco", "2", "d"]]
    table = page.markdown(("world", "solver", "reached", "code"), rows)
    short = page.crossed(table, "world", "solver", "reached")
    assert short == "| world | gco | ipopt |\n|---|---|---|\n| woods | 3 | 1 |\n| mazes | 2 | - |"
    few = page.chosen(table, ("world", "code"), solver=("gco",))
    assert few == "| world | code |\n|---|---|\n| woods | a \\| b, c |\n| mazes | d |"
    page.put(file, "worlds", f"Flown.\n\n{page.filed('all', table, few, short)}")
    assert f"Flown.\n\nAll 3 rows: [all.csv](all.csv).\n\n{few}\n\n{short}\n\n<!-- end" in file.read_text()
    assert (tmp_path / "all.csv").read_text().splitlines()[1] == 'woods,gco,"3 [1, 4]","a | b, c"'


@pytest.mark.parametrize("file", sorted(command.RESULTS.glob("*.md")), ids=lambda file: file.stem)
def test_a_page_is_a_question_whose_answer_is_of_the_tables_below(file: Path) -> None:
    """After a run whose tables replace these, read the answer again and name the new commit in it."""
    title, answer, *rest = file.read_text().split("\n\n")
    tables = re.findall(r"^<!-- (.*?) -->$(.*?)^<!-- end \1 -->$", "\n\n".join(rest), re.MULTILINE | re.DOTALL)
    assert title.startswith("# ") and title.endswith("?") and not answer.startswith(("Generated", "<!--"))
    named, flown = re.findall(r"\bcommit (\w{7,10})\b", answer), re.findall(r"\bcommit (\w{7,10})\b", str(tables))
    assert set(named) & set(flown), f"the answer is of {named}, the tables are of {flown}"


def test_numbers_are_shown_with_their_intervals() -> None:
    assert page.share(64, 64) == "64 of 64 [94, 100]" and page.share(1, 3, 1) == "1 of 3 [6.1, 79.2]"
    assert page.share(0, 0) == "-" and page.shown(float("nan"), ".2f") == "-" and page.shown(1.0, ".2f") == "1.00"
    assert page.markdown(["a", "b"], [[1, "x"]]) == "| a | b |\n|---|---|\n| 1 | x |"


def test_the_docstring_names_the_command() -> None:
    parser = parser_of("python -m benchmarks.outside.maze: a maze, flown.\n\nMore.", "results/maze.md")
    assert (parser.prog, parser.description) == ("python -m benchmarks.outside.maze", "a maze, flown.")
    assert parser.parse_args(["--write"]).write and not parser.parse_args([]).write
    assert not hasattr(parser_of("python -m x: y.").parse_args([]), "write")


def test_columns_count_problems_without_a_result_as_failures() -> None:
    nan = np.nan
    peer = pd.DataFrame({"solver": "IPOPT", "cost": 2.0, "violation": 0.0, "iterations": 9, "seconds": [1.0] * 5})
    lost = pd.DataFrame({
        "solver": "FATROP", "cost": [2.2, 1.0, 2.0, nan], "violation": [1e-7, 0.5, 1e-4, nan],
        "iterations": [10, 20, 30, nan], "seconds": [1.0, 2.0, 3.0, nan],
    })  # fmt: skip
    columns = [
        named("solver"), count, within(1e-3), share_within(1e-6), worst("violation"), cost_ratios(1e-3),
        median("iterations", 0), mean("seconds", 3),
    ]  # fmt: skip
    (row,) = Comparison(lambda *_: {}, [("", column) for column in columns]).rows([lost], peer)
    assert row[:5] == ["FATROP", 4, "2 of 4", "1 of 4 [5, 70] %", "5e-01"]
    assert row[5:] == ["1.0000, 1.0500, 1.1000", "20", "2.000"]
    none = lost.assign(violation=nan, iterations=nan)
    assert cost_ratios(1e-3)(none, peer) == "-" == median("iterations", 0)(none, peer)


def test_a_flight_is_what_the_judge_counts() -> None:
    problem, _ = planar_batch(B=2, N=10)
    judged = lambda problem, U: {"cost": U.square().sum((1, 2)), "violation": U.new_zeros(len(U))}
    comparison = Comparison(judged, [("solver", named("solver")), ("cost", median("cost", 3))])
    flight = comparison.fly("gco", problem, lambda: solve(problem), guess="rest")
    U = solve(problem).U
    assert flight.cost.tolist() == U.square().sum((1, 2)).tolist() and set(flight.guess) == {"rest"}
    assert flight.seconds.nunique() == 1 and flight.seconds[0] > 0 and len(flight.iterations) == 2
    text = comparison.table(comparison.rows([flight], flight))
    assert text.splitlines()[2] == f"| gco | {float(U.square().sum((1, 2)).mean()):.3f} |"
