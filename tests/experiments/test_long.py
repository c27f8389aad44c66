"""Swept keys as columns of every run, and all trials as one long table."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import torchgco
from tests.experiments.commands import ENVIRONMENT
from tests.trials import flights, trials
from torchgco import InputError
from torchgco.experiments.reports import export
from torchgco.experiments.reports.report import main
from torchgco.experiments.reports.verify import verify
from torchgco.experiments.results.folder import COLUMNS
from torchgco.experiments.statistics.paired import compare
from torchgco.experiments.statistics.statistics import summarise

NUMBER, LIMIT = "scenario.num_obstacles", "solver.max_iterations"
WORDS = ["study.layouts=2", "scenario.stages=5", "study.workers=1", "study.figures=false"]
SWEEP = ["-m", "solver=ilqr", "study.baselines=[hold]", f"{NUMBER}=2,3", f"{LIMIT}=1,2", *WORDS]


@pytest.fixture
def swept(run, tmp_path: Path) -> Path:
    code, _, err = run(*SWEEP)
    assert code == 0, err
    return tmp_path / "outputs"


def tables(folder: Path) -> list[pd.DataFrame]:
    paths = [path for path in sorted(folder.rglob("trials.parquet")) if path.parent.name != "report"]
    return [pd.read_parquet(path) for path in paths]


def test_swept_keys_are_columns_of_every_run_and_of_the_long_table(swept: Path) -> None:
    runs = tables(swept)
    assert len(runs) == 4 and all(list(run.columns) == [*COLUMNS, NUMBER, LIMIT] for run in runs)
    by_hand = pd.concat(runs)
    assert set(by_hand.loc[by_hand["solver"] == "ilqr", LIMIT]) == {1, 2}
    assert by_hand.loc[by_hand["solver"] == "hold", LIMIT].isna().all(), "hold has no such option"
    table = torchgco.read(swept)
    assert len(table) == 12 and table.attrs["repeated"] == 4, "hold's flights were the same in two runs"
    assert set(table["solver"]) == {"ilqr [max_iterations=1]", "ilqr [max_iterations=2]", "hold"}
    flown = table[table["solver"] != "hold"].groupby([NUMBER, LIMIT]).size()
    assert flown.to_dict() == {(number, limit): 2 for number in (2, 3) for limit in (1, 2)}
    assert not any(isinstance(column.dtype, pd.CategoricalDtype) for _, column in table.items())
    pairs = compare(table)
    assert set(pairs["n"]) <= {0, 2} and (pairs.loc[pairs["outcome"] == "feasible", "n"] == 2).all()
    assert list(summarise(table)[LIMIT].dropna()) == [1, 2] * 2


def test_csv_files_of_a_sweep_name_layout_solver_and_swept_values(swept: Path) -> None:
    folder = next(swept.glob("*/trials.parquet")).parent
    number, limit = pd.read_parquet(folder / "trials.parquet")[[NUMBER, LIMIT]].iloc[0]
    summary = pd.read_csv(folder / "summary.csv")
    assert (summary[NUMBER] == number).all() and summary[LIMIT].fillna(-1).tolist() == [limit, -1]
    assert (pd.read_csv(folder / "paired.csv")[NUMBER] == number).all()
    assert export.main([str(folder)]) == 0
    table = pd.read_csv(folder / "export" / "ilqr-1.csv")
    assert list(table.columns[-7:]) == ["scenario", "model", "layout", "seed", "solver", NUMBER, LIMIT]
    last = table[["layout", "solver", NUMBER, LIMIT]].drop_duplicates().to_numpy().tolist()
    assert last == [[1, "ilqr", number, limit]] and table.columns[0] == "t [s]"


@pytest.mark.slow
def test_a_run_that_was_flown_alone_gets_the_columns_of_its_sweep(run, tmp_path: Path) -> None:
    """A study alone has the columns of before, whatever its command changes."""
    code, _, err = run("solver=ilqr", "study.baselines=[hold]", f"{NUMBER}=2", f"{LIMIT}=1", *WORDS)
    assert code == 0, err
    (alone,) = tables(tmp_path / "outputs")
    assert list(alone.columns) == list(COLUMNS)
    code, out, err = run(*SWEEP)
    assert code == 0 and "Already done" in out, err
    runs = tables(tmp_path / "outputs")
    assert [list(table.columns[-2:]) for table in runs] == [[NUMBER, LIMIT]] * 4
    verified, _ = verify([tmp_path / "outputs"])
    assert all({NUMBER, LIMIT} <= set(study.tables[0].columns) and not study.differs for study in verified)


@pytest.mark.slow
def test_a_changed_swept_value_is_found(swept: Path) -> None:
    folder = next(swept.glob("*/trials.parquet")).parent
    table = pd.read_parquet(folder / "trials.parquet")
    table.assign(**{NUMBER: table[NUMBER] + 1}).to_parquet(folder / "trials.parquet", index=False)
    (study,), _ = verify([folder])
    assert set(study.tables[0].differences["column"]) == {NUMBER}


@pytest.mark.slow
def test_jobs_that_share_studies_of_a_sweep_give_them_its_columns(run, tmp_path: Path) -> None:
    code, _, err = run(*SWEEP, "study.jobs=2", "study.job=range(0,2)")
    assert code == 0, err
    assert [list(table.columns[-2:]) for table in tables(tmp_path / "outputs")] == [[NUMBER, LIMIT]] * 4


@pytest.mark.slow
def test_the_long_table_as_a_file_and_on_the_terminal(swept: Path, tmp_path: Path, capsys) -> None:
    capsys.readouterr()
    output = tmp_path / "a folder"
    assert main([str(swept), "--long", "--output", str(output), "--format", "csv"]) == 0
    printed = capsys.readouterr().out
    assert (output / "trials.csv").read_text().rstrip("\n") == printed.rstrip("\n")
    table, read = torchgco.read(swept), pd.read_csv(output / "trials.csv")
    assert list(read.columns) == list(table.columns) and len(read) == 12
    np.testing.assert_allclose(read["cost"], table["cost"], rtol=1e-15)
    assert main([str(swept), "--long"]) == 0 and "12 trials, 37 columns" in capsys.readouterr().out
    assert not (swept / "report" / "summary.csv").exists()
    assert len(torchgco.read(swept)) == 12, "a report below the folder is passed over"


def test_what_is_no_study_is_one_line(tmp_path: Path) -> None:
    for folders in ((), (tmp_path,), (tmp_path / "none",)):
        with pytest.raises(InputError, match="folders: expected"):
            torchgco.read(*folders)
    (tmp_path / "trials.parquet").write_bytes(b"no table")
    with pytest.raises(InputError, match="readable parquet file"):
        torchgco.read(tmp_path)


def test_formulas_in_names_are_inert_in_the_long_table(tmp_path: Path) -> None:
    trials(*flights("=1+1", [True]), *flights("<b>", [True])).to_parquet(tmp_path / "trials.parquet")
    assert main([str(tmp_path), "--long", "--output", str(tmp_path / "out")]) == 0
    assert pd.read_csv(tmp_path / "out" / "trials.csv")["solver"].tolist() == ["'=1+1", "<b>"]


@pytest.mark.slow
def test_reading_loads_neither_hydra_nor_matplotlib() -> None:
    code = "import sys, torchgco; torchgco.read; print([m for m in ('hydra', 'matplotlib') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["[]"]


# Names that other programs read: files, columns in their order, arrays.
NAMES = [
    "scenario", "layout", "seed", "model", "solver", "status", "feasible", "reached", "success", "cost", "best_cost",
    "violation", "clearance", "clearance_knots", "goal_distance", "iterations", "outer_iterations", "guided", "seconds",
    "batch_size", "threads", "device", "dtype", "version",
]  # fmt: skip
FILES = {"trials.parquet", "summary.csv", "layouts.npz", "solutions.npz", ".hydra"}


@pytest.mark.slow
def test_a_sweep_keeps_the_names_of_before(swept: Path) -> None:
    for table, path in zip(tables(swept), sorted(swept.glob("*/trials.parquet")), strict=True):
        assert [name for name in table.columns if name in NAMES] == NAMES
        assert {file.name for file in path.parent.iterdir()} >= FILES
        with np.load(path.parent / "solutions.npz", allow_pickle=False) as arrays:
            assert arrays["U"].shape == (2, 2, 5, 4) and arrays["solver"].tolist() == ["ilqr", "hold"]
            assert arrays["layout"].tolist() == [0, 1]
