"""Rows that were changed after a study are found, column by column, and damaged files are named."""

from __future__ import annotations

import io
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.experiments.commands import problem_line
from tests.slow import mostly
from torchgco.experiments.reports.report import main
from torchgco.experiments.reports.verify import _differences

WORDS = ["solver=al_ilqr", "study.baselines=[hold]", "study.layouts=3", "scenario.stages=8", "study.workers=1"]
WORDS += ["study.figures=false"]
MISSIONS = ["experiment=mission_study", "study.layouts=2", "study.baselines=[]", "mission.duration=0.2"]
MISSIONS += ["scenario.num_obstacles=3", "study.workers=1", "study.figures=false"]


@pytest.fixture(scope="session")
def whole(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("verify")


@pytest.fixture
def out(run, tmp_path, whole) -> Path:
    """A copy of a finished study."""
    return copied(whole / "out", run, tmp_path, WORDS)


@pytest.fixture
def flown(run, tmp_path, whole) -> Path:
    """A copy of a finished study of missions."""
    return copied(whole / "missions", run, tmp_path, MISSIONS)


def copied(source: Path, run, tmp_path: Path, words: list[str]) -> Path:
    if not source.exists():
        assert run(*words, "hydra.run.dir=first")[0] == 0
        shutil.copytree(tmp_path / "first", source)
        shutil.rmtree(tmp_path / "first")
    shutil.copytree(source, tmp_path / "all" / source.name)
    return tmp_path / "all" / source.name


def change(folder: Path, column: str, row: int, value: object = None) -> None:
    table = pd.read_parquet(folder / "trials.parquet")
    old = table[column].iloc[row]
    if value is None:
        value = not old if isinstance(old, bool | np.bool_) else f"{old}x" if isinstance(old, str) else old + 1
    table[column] = table[column].where(table.index != row, value).astype(table[column].dtype)
    table.to_parquet(folder / "trials.parquet", index=False)


@pytest.mark.slow
def test_an_unchanged_study_is_confirmed(out, capsys) -> None:
    assert main(["--verify", str(out)]) == 0
    text = capsys.readouterr().out
    assert text.startswith("6 rows confirmed\n") and "goal_distance" in text
    assert "not computed again, but as the study wrote them (checksum): scenario, status, dynamics_residual, " in text
    assert text.splitlines()[-2:] == ["2 rows of summary.csv confirmed", "3 rows of paired.csv confirmed"]


TABLES = {"summary.csv": ("reached_count", "hold"), "paired.csv": ("only_a", "al_ilqr hold reached")}


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", TABLES)
def test_tables_that_count_the_rows_are_counted_again(name: str, out, capsys) -> None:
    column, key = TABLES[name]
    path = out / name
    kept = pd.read_csv(path)
    changed = kept.copy()
    changed.loc[1, column] += 1
    changed.to_csv(path, index=False)
    assert main(["--verify", str(out)]) == 1
    first, header, line, last, *_ = capsys.readouterr().out.splitlines()
    assert first == f"{path}: 1 value differs in {len(kept)} rows" and last == "0 rows confirmed"
    assert header.split()[-3:] == ["column", "held", "computed"]
    assert line.split() == [*key.split(), column, str(changed.loc[1, column]), str(kept.loc[1, column])]
    kept.iloc[1:].to_csv(path, index=False)
    assert main(["--verify", str(out)]) == 1
    assert f"{len(kept) - 1} rows, {len(kept.columns)} columns" in capsys.readouterr().out
    path.unlink()
    assert main(["--verify", str(out)]) == 0
    text = capsys.readouterr().out
    assert f"not confirmed: {path}, which is missing" in text and f"rows of {name}" not in text


def test_columns_of_another_version_are_named_and_the_others_judged(out, capsys) -> None:
    path = out / "summary.csv"
    kept = pd.read_csv(path)
    other = kept.drop(columns=["clear_95_count", "success_rate"]).assign(of_old=1.0)
    other = other[[*reversed(other.columns)]]
    other.to_csv(path, index=False)
    assert main(["--verify", str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    names = "lacks newer columns: success_rate, clear_95_count; older ones aren't confirmed: of_old"
    assert f"of another version: {path} ({names})" in lines and "2 rows of summary.csv confirmed" in lines
    assert main(["--verify", str(out), "--format", "csv"]) == 0
    row = pd.read_csv(io.StringIO(capsys.readouterr().out), keep_default_na=False).iloc[1]
    assert row["unconfirmed"] == "of_old" and "reached_count" in row["confirmed"].split()
    other.assign(reached_count=other["reached_count"] + 1).to_csv(path, index=False)
    assert main(["--verify", str(out)]) == 1
    assert f"{path}: 2 values differ in 2 rows" in capsys.readouterr().out


@pytest.mark.sampled(1)
@pytest.mark.parametrize("form", mostly(["csv", "json", "markdown", "latex"], "markdown", "latex"))
def test_the_formats_give_what_was_confirmed_and_what_was_not(form: str, out, flown, capsys) -> None:
    assert main(["--verify", str(out), str(flown), "--format", form]) == 0
    captured = capsys.readouterr()
    assert captured.err == "" and "rows confirmed" not in captured.out
    if form == "csv":
        table = pd.read_csv(io.StringIO(captured.out), keep_default_na=False)
        assert table["study"].tolist() == [str(out)] * 3 + [str(flown)] * 2
        assert table["file"].tolist() == [
            "trials.parquet",
            "summary.csv",
            "paired.csv",
            "trials.parquet",
            "summary.csv",
        ]
        assert table["rows"].tolist() == [6, 2, 3, 2, 1] and not table["differing"].any()
        held = pd.read_parquet(out / "trials.parquet")
        names = [set(table.loc[0, kind].split()) for kind in ("confirmed", "by_outcome", "checksum", "unconfirmed")]
        assert set().union(*names) == set(held.columns) - {"solver", "layout"} and not names[1] | names[3]
        assert table.loc[3, "by_outcome"].split() == ["status", "feasible", "reached"]
        assert "flight_time" in table.loc[3, "unconfirmed"].split() and table.loc[1, "confirmed"] == "all"
    change(out, "cost", 0)
    assert main(["--verify", str(out), "--format", form]) == 1
    assert "1 value differs" in capsys.readouterr().err


COLUMNS = [
    "cost", "violation", "clearance", "clearance_knots", "goal_distance", "feasible", "reached", "success", "clear_95",
    "best_from", "model", "seed", "version", "device", "dtype", "layout_digest", "settings_digest",
]  # fmt: skip


@pytest.mark.sampled(3)
@pytest.mark.parametrize("column", COLUMNS)
def test_a_changed_value_is_found(column: str, out, capsys) -> None:
    change(out, column, 4)
    held = pd.read_parquet(out / "trials.parquet").iloc[4]
    assert main(["--verify", str(out)]) == 1
    first, header, line, last, *_ = capsys.readouterr().out.splitlines()
    assert str(out) in first and "1 value differs" in first and last == "0 rows confirmed"
    assert header.split() == ["solver", "layout", "column", "held", "computed"]
    assert line.split()[:4] == [held["solver"], str(held["layout"]), column, str(held[column])]


def test_a_small_change_is_found_and_rounding_is_not(out, capsys) -> None:
    cost = pd.read_parquet(out / "trials.parquet")["cost"].iloc[0]
    change(out, "cost", 0, cost * (1 + 1e-6))
    assert main(["--verify", str(out)]) == 1
    change(out, "cost", 0, cost * (1 + 1e-13))
    assert main(["--verify", str(out)]) == 2, "only the checksum of the file tells"
    assert "trials.parquet" in problem_line(capsys.readouterr().err)


def test_changed_controls_and_layouts_are_found(out, capsys) -> None:
    for name, array in (("solutions", "U"), ("layouts", "centers")):
        path = out / f"{name}.npz"
        kept = path.read_bytes()
        held = dict(np.load(path))
        held[array][0] += 0.01
        np.savez(path, **held)
        assert main(["--verify", str(out)]) == 1
        assert ("layout_digest" in capsys.readouterr().out) == (name == "layouts")
        path.write_bytes(kept)
    assert main(["--verify", str(out)]) == 0


FILES = ["trials.parquet", "solutions.npz", "layouts.npz", "study.json"]


@pytest.mark.parametrize("name", FILES)
def test_damaged_and_missing_files_are_named(name: str, out, capsys) -> None:
    for damage in (lambda path: path.write_bytes(path.read_bytes()[:-30]), lambda path: path.unlink()):
        damage(out / name)
        assert main(["--verify", str(out)]) == 2
        line = problem_line(capsys.readouterr().err)
        assert str(out / name if (out / name).exists() or name != "study.json" else out) in line


def test_a_column_that_cannot_be_computed_is_guarded_by_the_checksum(out, capsys) -> None:
    change(out, "seconds", 0)
    assert main(["--verify", str(out)]) == 2
    assert "trials.parquet" in problem_line(capsys.readouterr().err)


def test_rows_that_are_missing_or_twice_are_refused(out, capsys) -> None:
    table = pd.read_parquet(out / "trials.parquet")
    for rows in (table.iloc[1:], pd.concat([table, table.iloc[:1]])):
        rows.to_parquet(out / "trials.parquet", index=False)
        assert main(["--verify", str(out)]) == 2
        assert "one row per solver and layout" in problem_line(capsys.readouterr().err)


@pytest.mark.slow
def test_several_studies_and_their_report(out, capsys, monkeypatch) -> None:
    monkeypatch.setattr("torchgco.experiments.reports.report.drawings", lambda part: {})
    shutil.copytree(out, out.parent / "second")
    assert main([str(out.parent)]) == 0
    capsys.readouterr()
    assert main(["--verify", str(out.parent)]) == 0
    assert "12 rows confirmed in 2 studies" in capsys.readouterr().out
    change(out, "reached", 0)
    assert main(["--verify", str(out.parent)]) == 1
    assert "6 rows confirmed\n" in capsys.readouterr().out


def test_a_study_that_still_runs_is_left_out(run_until, tmp_path, capsys, without_report) -> None:
    run_until(1, *WORDS, "hydra.run.dir=out")
    assert main(["--verify", str(tmp_path / "out")]) == 2
    assert "finished study" in problem_line(capsys.readouterr().err)


@pytest.mark.slow
def test_missions_are_confirmed_as_far_as_their_log_goes(flown, capsys) -> None:
    assert main(["--verify", str(flown)]) == 0
    text = capsys.readouterr().out
    assert text.startswith("2 rows confirmed\n") and "not confirmed: iterations, outcome, flight_time" in text.replace(
        "clearance, goal_distance, iterations", "iterations"
    )
    assert "agree with the outcome: status, feasible, reached\n" in text and "1 row of summary.csv confirmed" in text
    kept = (flown / "trials.parquet").read_bytes()
    for column in ("reached", "status", "violation", "clearance_knots", "planner_seconds_p99", "layout_digest"):
        change(flown, column, 1)
        assert main(["--verify", str(flown)]) == 1
        assert f" {column} " in capsys.readouterr().out
        (flown / "trials.parquet").write_bytes(kept)
    (flown / "mission.parquet").unlink()
    assert main(["--verify", str(flown)]) == 2
    assert "mission.parquet" in problem_line(capsys.readouterr().err)


@pytest.mark.parametrize("held", [0.5, -3.0, 1e300, -np.inf, np.nan, None])
def test_a_number_is_not_infinite(held: float | None) -> None:
    """A distance was confirmed, whatever it said, where there is nothing to keep one from."""
    kept, computed = pd.DataFrame({"clearance": [np.inf, held]}), pd.DataFrame({"clearance": [np.inf, np.inf]})
    kept.index = computed.index = pd.MultiIndex.from_product([["gco"], [0, 1]], names=["solver", "layout"])
    assert _differences(kept.astype(float), computed)["layout"].tolist() == [1]
