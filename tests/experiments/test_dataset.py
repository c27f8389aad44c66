"""Data sets of solved trajectories: what they hold, how they go on after a stop, what is refused."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

import torchgco
from tests.experiments.commands import ENVIRONMENT, problem_line
from torchgco import InputError
from torchgco.experiments.dataset import command
from torchgco.experiments.dataset.rows import cells, nested
from torchgco.experiments.results import lock
from torchgco.experiments.results.lock import held

HOLD = ["scenario=planar_random", "solver=hold", "scenario.stages=5", "study.workers=1"]
SOLVED = ["scenario=planar_random", "solver=al_ilqr", "solver.max_outer_iterations=3", "scenario.stages=12"]
ALONE = "study.workers=1"


def run(*words: object) -> int:
    return command.main([str(word) for word in words])


@pytest.mark.parametrize("shape", [(3,), (4, 2), (2, 5, 3), (3, 0, 2), (2, 2, 0), (1, 2, 3, 4), (0, 3)])
def test_arrays_come_back_in_their_shapes(shape: tuple[int, ...]) -> None:
    values = np.random.default_rng(0).standard_normal(shape)
    column = nested(values)
    assert len(column) == shape[0]
    if len(shape) > 1 and shape[0]:
        back = cells(pa.chunked_array([column]))
        # Behind an axis of length 0 nothing says how long the next is.
        assert all(np.array_equal(a, b) if b.size else a.size == 0 for a, b in zip(back, values, strict=True))


def test_arrays_of_different_shapes_stand_in_one_column() -> None:
    rng = np.random.default_rng(1)
    parts = [rng.standard_normal(shape) for shape in ((2, 3, 4), (3, 1, 2), (2, 0, 5), (1, 7, 4))]
    back = cells(pa.chunked_array([nested(part) for part in parts]))
    whole = [row for part in parts for row in part]
    assert all(a.shape == b.shape or a.size == b.size == 0 for a, b in zip(back, whole, strict=True))
    assert all(np.array_equal(a, b) for a, b in zip(back, whole, strict=True) if b.size)


@pytest.mark.slow
def test_rows_are_what_the_solver_returned_however_they_were_cut(tmp_path: Path) -> None:
    assert run(tmp_path / "a", *SOLVED, "study.layouts=5", "study.shard_size=2", ALONE) == 0
    assert run(tmp_path / "b", *SOLVED, "study.layouts=3", "study.batch_size=1", ALONE) == 0
    assert run(tmp_path / "b", *SOLVED, "study.layouts=5", ALONE) == 0  # longer than before
    setup = torchgco.compose([*SOLVED, "study.layouts=5"])
    task = setup.task()
    found = setup.solver.solve(task.problem, task.U0, seed=0, ids=torch.arange(5))
    for folder in ("a", "b"):
        rows = torchgco.read_dataset(tmp_path / folder)
        assert rows["layout"].tolist() == [*range(5)] and rows["cost"].notna().all()
        assert rows["status"].tolist() == [status.name for status in found.statuses]
        for name, values in {"X": found.X, "U": found.U, "K": found.K}.items():
            assert np.array_equal(np.stack(rows[name]), values.numpy()), name
        for i, lam in enumerate(found.multipliers.lam):
            assert np.array_equal(np.stack(rows[f"multipliers_{i}"]), lam.numpy())
        assert np.array_equal(np.stack(rows["centers"]), task.layouts.centers, equal_nan=True)
        assert np.array_equal(np.stack(rows["X"])[:, 0], np.stack(rows["start"]))
        verdict = torchgco.judge(task.problem, torch.from_numpy(np.stack(rows["U"])))
        np.testing.assert_allclose(rows["cost"], verdict.cost.numpy(), rtol=1e-12)


@pytest.mark.slow
def test_a_stopped_one_goes_on_and_another_configuration_is_refused(tmp_path: Path, monkeypatch, capsys) -> None:
    words, kept, folder = [*HOLD, "study.layouts=6", "study.shard_size=2"], [], tmp_path / "data"

    def stop(path: Path, save, real=command.write) -> None:
        real(path, save)
        kept.append(path)
        if len(kept) == 2:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(command, "write", stop)
        assert run(folder, *words) == 130
    before = {path: path.stat().st_mtime_ns for path in folder.glob("*.parquet")}
    (folder / "torchgco-left.part").touch()  # as a kill leaves it
    capsys.readouterr()
    assert run(folder, *words) == 0 and "4 of 6 layouts" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in before} == before and not list(folder.glob("*.part"))
    assert torchgco.read_dataset(folder)["layout"].tolist() == [*range(6)]
    for other in ("seed=1", "solver.name=h2", "scenario.num_obstacles=3"):
        assert run(folder, *words, other) == 2
        assert "of this very data set" in problem_line(capsys.readouterr().err)
    assert run(folder, *words, "--without", "K") == 2 and "left_out" in problem_line(capsys.readouterr().err)
    record = json.loads((folder / "run.json").read_text())
    assert record[1]["ended"] == "finished" and record[1]["command"].startswith("torchgco-dataset ")


def test_what_raises_before_the_first_layout_leaves_the_folder_free(tmp_path: Path, monkeypatch) -> None:
    words = [tmp_path, *HOLD, "study.layouts=2"]

    def fail(*arguments: object) -> None:
        raise InputError("a", "b", "c")

    with monkeypatch.context() as patch:
        patch.setattr(command, "_fly", fail)
        assert run(*words) == 2
    assert list(tmp_path.iterdir()) == []
    assert run(*words, "seed=1") == 0 and run(*words) == 2


@pytest.mark.slow
def test_a_damaged_file_is_named_and_redone_on_request(tmp_path: Path, capsys) -> None:
    words = [tmp_path, *HOLD, "study.layouts=4", "study.shard_size=2"]
    assert run(*words) == 0
    whole = torchgco.read_dataset(tmp_path)
    path = tmp_path / "layouts-000000002-000000003.parquet"
    path.write_bytes(path.read_bytes()[:200])
    capsys.readouterr()
    assert run(*words) == 2 and path.name in problem_line(capsys.readouterr().err)
    with pytest.raises(InputError, match=path.name):
        torchgco.read_dataset(tmp_path)
    assert run(*words, "study.repair=true") == 0
    assert np.array_equal(np.stack(torchgco.read_dataset(tmp_path)["X"]), np.stack(whole["X"]))
    (tmp_path / "dataset.json").unlink()
    capsys.readouterr()
    assert run(*words) == 2 and "dataset.json, which is missing" in problem_line(capsys.readouterr().err)


@pytest.mark.slow
def test_shares_make_one_data_set_and_a_second_start_is_refused_in_a_line(tmp_path: Path, monkeypatch, capsys) -> None:
    words = [tmp_path, *HOLD, "study.layouts=5", "study.shard_size=2"]
    for job in (1, 0):
        assert run(*words, "study.jobs=2", f"study.job={job}") == 0
    assert run(*words) == 0
    assert torchgco.read_dataset(tmp_path)["layout"].tolist() == [*range(5)]
    monkeypatch.setattr(lock, "PATIENCE", 0.05)
    monkeypatch.setattr(lock, "POLL", 0.01)
    capsys.readouterr()
    with held(tmp_path):
        assert run(*words) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if "waiting" not in line]
    assert len(lines) == 1 and "no other process" in lines[0]


def test_the_card_names_every_column_the_counts_and_the_license(tmp_path: Path) -> None:
    words = [*HOLD, "study.layouts=3", "--without", "K", "multipliers", "--license", "CC-BY-4.0"]
    assert run(tmp_path, *words) == 0
    text, rows = (tmp_path / "README.md").read_text(), torchgco.read_dataset(tmp_path)
    assert text.startswith('---\nlicense: "CC-BY-4.0"\n---\n') and "3 of 3 layouts" in text
    names = [line.split("|")[1].strip() for line in text.split("## Columns")[1].splitlines() if line.startswith("|")][
        2:
    ]
    assert names == rows.columns.tolist() and not {"K", "multipliers_0"} & set(names)
    status = rows["status"].iloc[0]
    assert f"| {status} | {(rows['status'] == status).sum()} |" in text
    assert "| X | double | (6, 6) |" in text and "heading [rad]" in text


@pytest.mark.parametrize(
    "layouts", [[True, False, True], np.array([False, True]), [0.5, 1.0], np.array([1.0]), ["0"], [None]]
)
def test_layouts_are_asked_for_by_whole_numbers(layouts: Any, tmp_path: Path) -> None:
    """A mask would be read as the layouts 0 and 1, and 0.5 as 0."""
    pq.write_table(pa.table({"layout": [0, 1, 2], "cost": [3.0, 4.0, 5.0]}), tmp_path / "layouts-0-2.parquet")
    with pytest.raises(InputError, match="layouts: expected whole numbers of layouts"):
        torchgco.read_dataset(tmp_path, layouts=layouts)
    for some in ([2, 0], range(3), np.array([1], np.uint8), []):
        assert torchgco.read_dataset(tmp_path, layouts=some)["layout"].tolist() == sorted(some)


@pytest.mark.slow
def test_layouts_of_different_lengths_and_maps_of_their_own(tmp_path: Path) -> None:
    assert run(tmp_path, "scenario=floors", "solver=hold", "study.layouts=3", ALONE) == 0
    rows, layouts = torchgco.read_dataset(tmp_path), torchgco.compose(["scenario=floors", "study.layouts=3"]).layouts()
    stages = np.broadcast_to(layouts.stages, 3).tolist()
    assert rows["stages"].tolist() == stages == [len(U) for U in rows["U"]] and len(set(stages)) > 1
    for i in range(3):
        assert np.array_equal(rows["map_occupied"][i], layouts.map.single(i).source.occupied)


def test_a_map_of_all_layouts_is_kept_once(tmp_path: Path) -> None:
    cells = np.zeros((30, 30), bool)
    cells[10:12, :20] = True
    np.savez(tmp_path / "map.npz", occupied=cells, origin=[0.0, 0.0], resolution=0.2)
    words = ["scenario=map", f"scenario.path={tmp_path / 'map.npz'}", "model=unicycle", "solver=hold", ALONE]
    assert run(tmp_path / "data", *words, "study.layouts=3") == 0
    with np.load(tmp_path / "data" / "map.npz") as arrays:
        assert np.array_equal(arrays["map_occupied"], cells)
    assert not [name for name in torchgco.read_dataset(tmp_path / "data") if name.startswith("map_")]
    assert "All layouts share map.npz" in (tmp_path / "data" / "README.md").read_text()


@pytest.mark.sampled(3)
@pytest.mark.parametrize("words, line", [
    (["experiment=mission"], "mission: expected null"),
    (["scenario=fleet_door"], "single vehicles"),
    (["study.baselines=[ipopt]"], "of one solver"),
    (["study.view=true"], "study.view: expected False"),
    (["study.layouts=0"], "study.layouts: expected a whole number of at least 1"),
    (["scenario=race", "solver=hold"], "choose the time"),
    (["seed=1", "seed=2"], "seed: expected one value"),
    (["--without", "Q"], "invalid choice: 'Q'"),
    (["scenario.num_obstacles=x"], "num_obstacles"),
])  # fmt: skip
def test_what_a_data_set_cannot_be_of_is_refused_before_a_folder_is_made(words, line, tmp_path: Path, capsys) -> None:
    assert run(tmp_path / "data", *words) == 2
    assert line in problem_line(capsys.readouterr().err) and not (tmp_path / "data").exists()


def test_a_folder_of_something_else_stays_as_it_is(tmp_path: Path, capsys) -> None:
    (tmp_path / "README.md").write_text("mine")
    assert run(tmp_path, *HOLD, "study.layouts=1") == 2
    assert "an empty folder" in problem_line(capsys.readouterr().err)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("README.md", "mine")]


def test_an_edited_file_of_layouts_makes_another_data_set(tmp_path: Path, capsys) -> None:
    words = ["scenario=layouts", f"scenario.path={tmp_path / 'two.npz'}", "model=planar", "solver=hold", ALONE]
    for shift, code in ((3, 0), (3, 0), (4, 2)):
        torchgco.Layouts(np.zeros((2, 1, 2)) + shift, np.ones((2, 1)), stages=5).save(tmp_path / "two.npz")
        assert run(tmp_path / "data", *words) == code
    assert "which holds another (file is" in capsys.readouterr().err


def test_a_file_with_fewer_layouts_is_refused_at_once(tmp_path: Path, capsys) -> None:
    torchgco.Layouts(np.zeros((2, 1, 2)) + 3, np.ones((2, 1))).save(tmp_path / "two.npz")
    words = ["scenario=layouts", f"scenario.path={tmp_path / 'two.npz'}", "model=planar", "solver=hold"]
    assert run(tmp_path / "data", *words, "study.layouts=3") == 2
    assert "at most the 2 layouts" in problem_line(capsys.readouterr().err)


def test_the_reader_takes_columns_and_layouts_and_names_what_is_not_there(tmp_path: Path) -> None:
    assert run(tmp_path, *HOLD, "study.layouts=6", "study.shard_size=2") == 0
    rows = torchgco.read_dataset(tmp_path, columns=["U"], layouts=[1, 4])
    assert rows.columns.tolist() == ["layout", "U"] and rows["layout"].tolist() == [1, 4]
    for more, line in (({"columns": ["Q"]}, "columns"), ({"layouts": [2, 6]}, "got 6")):
        with pytest.raises(InputError, match=line):
            torchgco.read_dataset(tmp_path, **more)
    with pytest.raises(InputError, match="a data set"):
        torchgco.read_dataset(tmp_path / "nothing")
    assert pq.read_table(tmp_path / "layouts-000000000-000000001.parquet")["X"].to_pylist()[0][0] is not None


@pytest.mark.slow
def test_a_killed_one_goes_on(tmp_path: Path) -> None:
    words = [str(tmp_path / "data"), *HOLD[:3], "study.layouts=60", "study.shard_size=2", "study.workers=2"]
    code = "import sys; from torchgco.experiments.dataset.command import main; sys.exit(main())"
    line = [sys.executable, "-c", code, *words]
    first = subprocess.Popen(line, env=ENVIRONMENT, stderr=subprocess.DEVNULL, start_new_session=True)
    while first.poll() is None and len(list(tmp_path.glob("data/layouts-*"))) < 2:
        time.sleep(0.05)
    os.kill(first.pid, signal.SIGKILL)
    first.wait()
    assert subprocess.run(line, env=ENVIRONMENT, capture_output=True, timeout=300).returncode == 0
    assert torchgco.read_dataset(tmp_path / "data", columns=["status"])["layout"].tolist() == [*range(60)]
