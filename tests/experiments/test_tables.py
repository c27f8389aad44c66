"""Formats of a report, statistics of effort and cost, and studies that still run."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.experiments.commands import HOLD, problem_line
from tests.trials import flights, manifest, trials
from torchgco.experiments.ending import say
from torchgco.experiments.reports import report
from torchgco.experiments.reports.report import main
from torchgco.experiments.results.kinds import format_report, parts_of
from torchgco.experiments.results.merge import merge
from torchgco.experiments.statistics.paired import compare
from torchgco.experiments.statistics.statistics import plain, summarise
from torchgco.experiments.statistics.tables import OUTPUTS, format_frame

HITS = [i < 30 for i in range(32)]


def study(folder: Path, *rows: dict, number: int | None = None) -> Path:
    folder.mkdir(parents=True)
    trials(*rows).to_parquet(folder / "trials.parquet", index=False)
    if number is not None:
        given = manifest(scenario={"num_obstacles": number}, model={"vehicle": {"name": "quadrotor"}})
        (folder / "study.json").write_bytes(given)
    return folder


NAMES = ['=cmd|" /C calc"!A0', "+x", "-x", "@SUM(A1)", " =x", "＝x"]
WITHIN = {  # with other separators of cells
    "\t=x": "\t'=x", "\r=x": "\n'=x", "a;=x": "a;'=x", "a;b=x": "a;b=x", "a\r\n=x": "a\n\n'=x", "a\t-x": "a\t'-x",
}  # fmt: skip


def test_no_cell_of_a_csv_is_a_formula() -> None:
    """Names may be anybody's; numbers stay numbers, those held as text too."""
    table = pd.DataFrame({"scenario": [*NAMES, "-0.5", "plain"], "cost": [-1.0, *range(7)], "=n": pd.NA})
    table["mixed"] = pd.Series(["=a", -2, -2.5, None, "b", True, 1, "-"], dtype=object)
    table["kind"] = pd.Categorical(["=k"] * 8)
    lines = list(csv.reader(io.StringIO(format_frame(table, "csv"), newline="")))
    assert lines[0] == ["scenario", "cost", "'=n", "mixed", "kind"]
    assert [line[0] for line in lines[1:]] == [*(f"'{name}" for name in NAMES), "-0.5", "plain"]
    assert [float(line[1]) for line in lines[1:]] == table["cost"].tolist()
    assert [line[3] for line in lines[1:]] == ["'=a", "-2", "-2.5", "", "b", "True", "1", "'-"]
    assert {line[4] for line in lines[1:]} == {"'=k"}
    text = format_frame(pd.DataFrame({"name": list(WITHIN)}), "csv")
    assert [line[0] for line in csv.reader(io.StringIO(text, newline=""))][1:] == list(WITHIN.values())
    plain = table[["cost"]].assign(name="gco [max_outer_iterations=10]")
    assert format_frame(plain, "csv") == plain.to_csv(index=False).rstrip("\n")


def test_names_are_text_in_markdown_and_in_a_terminal(capsys) -> None:
    table = pd.DataFrame({"solver": ["</script><img src=x>", "a|b\nc\\|d"]})
    assert format_frame(table, "markdown").splitlines()[2:] == ["| \\</script>\\<img src=x> |", "| a\\|b c\\\\\\|d |"]
    say("title \x1b]0;x\x07 of\n\ta\x9b table")
    assert capsys.readouterr().out == "title ?]0;x? of\n\ta? table\n"


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    for number in (10, 30):
        scene = {"layout_digest": f"scene {number}", "settings_digest": "one"}
        rows = [*flights("gco", HITS, **scene), *flights("al_ilqr", HITS[::-1], cost=110.0, **scene)]
        study(tmp_path / str(number), *rows, number=number)
    return tmp_path


@pytest.fixture
def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports draw nothing: their figures take most of the time of a small report."""
    monkeypatch.setattr(report, "drawings", lambda part: {})


def read(text: str, form: str) -> pd.DataFrame:
    if form == "csv":
        return pd.read_csv(io.StringIO(text))
    if form == "json":
        return pd.DataFrame(json.loads(text)["summary"])
    lines = [line for line in text.split("\n\n")[0].splitlines() if " & " in line or line.startswith("| ")]
    split = " & " if form == "latex" else " | "
    cells = [[cell.strip(" |\\").replace("\\_", "_") for cell in line.split(split)] for line in lines]
    return pd.DataFrame([row for row in cells[1:] if row[0] != "---"], columns=cells[0])


@pytest.mark.usefixtures("without_figures")
@pytest.mark.parametrize("form", OUTPUTS[1:])
def test_stdout_holds_the_table_alone(form: str, sweep: Path, capsys) -> None:
    assert main([str(sweep), "--format", form]) == 0
    captured = capsys.readouterr()
    table = read(captured.out, form)
    column = "scenario.num_obstacles" if form in ("csv", "json") else "num_obstacles"
    assert table[column].astype(int).tolist() == [10, 10, 30, 30]
    assert table["solver"].tolist() == ["gco", "al_ilqr"] * 2
    assert "written to" in captured.err and "written to" not in captured.out
    if form in ("csv", "json"):
        assert table["reached_count"].tolist() == [30] * 4
        assert table["cost_ratio_median"].tolist() == pytest.approx([1, 1.1] * 2)
    else:
        assert all("30/32 94" in cell for cell in table["reached"]) and "gco - al" in captured.out


def test_json_gives_both_tables_without_a_number_that_json_lacks() -> None:
    table = trials(*flights("a", [False]), *flights("b", [False], cost=np.inf))
    held = json.loads(format_report(parts_of(table), "json"), parse_constant=pytest.fail)
    assert held["summary"][0]["cost_median_reached"] is None and len(held["paired"]) == 3


def test_latex_escapes_names() -> None:
    table = trials(*flights("al_ilqr [a_b=50%]", [True]))
    assert r"al\_ilqr [a\_b=50\%]" in format_report(parts_of(table), "latex")


@pytest.mark.slow
def test_the_command_writes_both_tables_and_a_figure_per_swept_variable(sweep: Path, capsys) -> None:
    assert main([str(sweep)]) == 0
    out = sweep / "report"
    assert len(pd.read_csv(out / "summary.csv")) == 4 and len(pd.read_csv(out / "paired.csv")) == 6
    assert (out / "figures" / "rates-scenario.num_obstacles.png").is_file()


def test_effort_has_median_and_ninety_per_cent_quantile() -> None:
    rows = [{"layout": i, "iterations": i, "seconds": 0.1 * i} for i in range(11)]
    (row,) = summarise(trials(*rows)).to_dict(orient="records")
    assert (row["iterations_median"], row["iterations_p90"]) == (5, 9)
    assert row["seconds_p90"] == pytest.approx(0.9)
    assert (row["guided_median"], row["outer_iterations_p90"]) == (2, 10)


def test_cost_ratios_are_those_of_reached_trials_with_a_best_cost() -> None:
    rows = [{"layout": 0, "cost": 110.0}, {"layout": 1, "cost": 130.0}, {"layout": 2, "cost": 500.0, "reached": False}]
    (row,) = summarise(trials(*rows, {"layout": 3, "best_cost": np.nan})).to_dict(orient="records")
    assert (row["cost_ratio_n"], row["cost_ratio_median"]) == (2, pytest.approx(1.2))


def test_statuses_are_counted() -> None:
    rows = [{"layout": i, "status": status} for i, status in enumerate(["CONVERGED", "FEASIBLE", "CONVERGED"])]
    summary = summarise(trials(*rows, {"solver": "b", "status": "REACHED"}))
    assert summary["status_CONVERGED"].tolist() == [2, 0] and summary["status_REACHED"].tolist() == [0, 1]


def test_paired_costs_are_compared_where_both_arrived() -> None:
    hits = [True] * 9 + [False]
    rows = [*flights("a", hits), *flights("b", [True] * 10)]
    for i, row in enumerate(rows):
        row["cost"] = 100.0 + row["layout"] if i < 10 else 50.0
    result = compare(trials(*rows)).iloc[0]
    assert (result.cost_n, result.cost_ratio) == (9, pytest.approx(2.08))
    # Order statistics 2 and 8 of 9: a fair coin falls outside with probability 2 (1 + 9) / 2^9 = 0.039.
    assert (result.cost_low, result.cost_high) == pytest.approx((2.02, 2.14))
    assert np.isnan(compare(trials(*rows[:3], *rows[10:13])).iloc[0].cost_low), "too few for an interval"


@pytest.mark.slow
@pytest.mark.usefixtures("without_report", "without_figures")
def test_a_study_that_still_runs_is_reported_with_a_note(run, run_until, tmp_path: Path, capsys) -> None:
    words = [*HOLD, "study.shard_size=2", "hydra.run.dir=out"]
    run_until(1, *words)
    out = tmp_path / "out"
    assert main([str(out)]) == 0
    captured = capsys.readouterr()
    assert captured.err == f"unfinished: 2 of 4 trials in {out}\n" and "0/2" in captured.out
    assert main([str(out), "--output", str(out)]) == 2 and not (out / "trials.parquet").exists()
    assert "--output" in problem_line(capsys.readouterr().err)
    part = plain(merge([out]))
    assert run(*words)[0] == 0, "the report disturbs nothing"
    whole = plain(merge([out]))
    pd.testing.assert_frame_equal(part.drop(columns="best_from"), whole.iloc[:2].drop(columns="best_from"))
    assert whole.attrs["unfinished"] == [] and len(whole) == 4


@pytest.mark.slow
@pytest.mark.usefixtures("without_report", "without_figures")
def test_a_study_without_trials_or_with_a_missing_table_is_named(run, run_until, tmp_path: Path, capsys) -> None:
    words = [*HOLD, "study.shard_size=2", "hydra.run.dir=out"]
    run_until(1, *words)
    for shard in (tmp_path / "out" / "shards").iterdir():
        shard.unlink()
    assert main([str(tmp_path / "out")]) == 2
    assert "none yet" in problem_line(capsys.readouterr().err)
    assert run(*words)[0] == 0
    (tmp_path / "out" / "trials.parquet").unlink()
    assert main([str(tmp_path / "out")]) == 2
    assert "trials.parquet" in problem_line(capsys.readouterr().err)


def test_a_command_without_folders_gets_one_line(capsys) -> None:
    for words in ([], ["--verify"]):
        assert main(words) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1
