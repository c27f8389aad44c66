"""Damaged, foreign and missing files of a study, and a system that refuses to write."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.experiments.commands import HOLD, problem_line
from tests.slow import mostly
from torchgco.base.errors import InputError
from torchgco.experiments.reports.report import main as report
from torchgco.experiments.results import files
from torchgco.experiments.results.files import write

WORDS = [*HOLD, "study.shard_size=2", "hydra.run.dir=out"]


def flip(path: Path) -> None:
    """Flip one bit of the content: of the seed in a JSON file, else at a third of the file."""
    held = bytearray(path.read_bytes())
    place = held.index(b'"seed": ') + 8 if path.suffix == ".json" else len(held) // 3
    held[place] ^= 1
    path.write_bytes(bytes(held))


DAMAGE = {
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-30]),
    "flipped": flip,
    "text": lambda path: path.write_text("see the other folder\n"),
    "missing": lambda path: path.unlink(),
}
FINISHED = ["study.json", "trials.parquet", "solutions.npz", "layouts.npz"]


@pytest.fixture(scope="session")
def whole(tmp_path_factory) -> Path:
    """The folder of a finished study; the first test that needs the study makes it."""
    return tmp_path_factory.mktemp("whole") / "out"


@pytest.fixture
def out(run, tmp_path, whole) -> Path:
    """A copy of a finished study."""
    if not whole.exists():
        assert run(*WORDS)[0] == 0
        shutil.copytree(tmp_path / "out", whole)
    else:
        shutil.copytree(whole, tmp_path / "out")
    return tmp_path / "out"


def results(folder: Path) -> tuple[pd.DataFrame, bytes]:
    with np.load(folder / "solutions.npz") as held, np.load(folder / "layouts.npz") as layouts:
        assert layouts["centers"].shape[0] == 4
        return pd.read_parquet(folder / "trials.parquet").drop(columns="seconds"), held["U"].tobytes()


def same(one: tuple[pd.DataFrame, bytes], other: tuple[pd.DataFrame, bytes]) -> None:
    pd.testing.assert_frame_equal(one[0], other[0], check_exact=True)
    assert one[1] == other[1]


@pytest.mark.sampled(1)
@pytest.mark.usefixtures("without_report")
@pytest.mark.parametrize("damage", mostly(DAMAGE, "empty", "text", "cut"))
@pytest.mark.parametrize("name", FINISHED)
def test_a_damaged_file_of_a_finished_study_is_named_and_repaired(name: str, damage: str, run, out) -> None:
    before = results(out)
    DAMAGE[damage](out / name)
    code, _, err = run(*WORDS)
    line = problem_line(err)
    assert code == 2 and str(out / name) in line and "study.repair=true" in line
    assert run(*WORDS, "study.repair=true")[0] == 0
    same(results(out), before)


@pytest.mark.sampled(0)
@pytest.mark.usefixtures("without_report")
@pytest.mark.parametrize("damage", mostly(DAMAGE, "empty", "text"))
def test_a_damaged_shard_is_named_and_repaired(damage: str, run, run_until, tmp_path, out) -> None:
    before = results(out)
    shutil.rmtree(out)
    run_until(2, *WORDS)
    shard = out / "shards" / "hold-000000-000001.npz"
    kept = (out / "shards" / "hold-000002-000003.npz").stat().st_mtime_ns
    DAMAGE[damage](shard)
    if damage != "missing":  # a missing one is flown again
        code, _, err = run(*WORDS)
        line = problem_line(err)
        assert code == 2 and str(shard) in line and "study.repair=true" in line
    run_until(1, *WORDS, "study.repair=true")
    assert shard.is_file() and (out / "shards" / "hold-000002-000003.npz").stat().st_mtime_ns == kept
    assert run(*WORDS)[0] == 0
    same(results(out), before)


@pytest.mark.slow
@pytest.mark.usefixtures("without_report")
def test_a_damaged_mark_of_a_finished_study_is_named_and_repaired(run, out) -> None:
    before = results(out)
    for damage in ("empty", "text"):
        DAMAGE[damage](out / "done")
        code, _, err = run(*WORDS)
        assert code == 2 and str(out / "done") in problem_line(err)
        assert run(*WORDS, "study.repair=true")[0] == 0
        same(results(out), before)


def test_the_report_names_a_damaged_table_and_manifest(out, capsys) -> None:
    for name in ("trials.parquet", "study.json"):
        kept = (out / name).read_bytes()
        flip(out / name)
        assert report([str(out)]) == 2
        assert str(out / name) in problem_line(capsys.readouterr().err)
        (out / name).write_bytes(kept)
    assert report([str(out)]) == 0


FOREIGN = {
    "layouts": (["hold-000002-000003.npz"], []),
    "settings": (["hold-000000-000001.npz"], ["solver.violation_tolerance=1e-4"]),
    "scene": (["hold-000000-000001.npz"], ["scenario.num_obstacles=4"]),
    "seed": (["hold-000000-000001.npz"], ["seed=1"]),
}


@pytest.mark.sampled(0)
@pytest.mark.usefixtures("without_report")
@pytest.mark.parametrize("case", mostly(FOREIGN, "scene", "layouts"))
def test_a_shard_of_something_else_is_refused(case: str, run, run_until, tmp_path, out) -> None:
    before = results(out)
    (source,), words = FOREIGN[case]
    shutil.rmtree(out)
    run_until(2, *WORDS[:-1], *words, "hydra.run.dir=other")
    run_until(2, *WORDS)
    shard = out / "shards" / "hold-000000-000001.npz"
    shutil.copy(tmp_path / "other" / "shards" / source, shard)
    code, _, err = run(*WORDS)
    assert code == 2 and str(shard) in problem_line(err)
    assert run(*WORDS, "study.repair=true")[0] == 0
    same(results(out), before)


@pytest.mark.usefixtures("without_report")
def test_repair_does_not_overwrite_another_study(run, out) -> None:
    (out / "study.json").unlink()
    before = (out / "trials.parquet").read_bytes()
    code, _, err = run(*WORDS, "seed=1", "study.repair=true")
    assert code == 2 and "holds another" in problem_line(err)
    assert (out / "trials.parquet").read_bytes() == before


STEPS = ["study.json", "config.yaml", "hold-000002-000003.npz", "trials.parquet", "layouts.npz", "summary.csv"]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", mostly([*STEPS, "rates.png", "done"], *STEPS[1:4], "rates.png"))
def test_a_full_disk_gets_one_line_and_leaves_no_parts(name: str, run, tmp_path, monkeypatch, request) -> None:
    if name not in ("summary.csv", "rates.png"):
        request.getfixturevalue("without_report")

    def full(real):
        def move(part, place):
            if Path(place).name == name:
                raise OSError(errno.ENOSPC, "No space left on device")
            real(part, place)

        return move

    with monkeypatch.context() as patch:
        patch.setattr(files.os, "replace", full(os.replace))
        patch.setattr(files.os, "link", full(os.link))
        code, _, err = run(*WORDS)
    line = problem_line(err)
    assert code == 2 and name in line and "No space left on device" in line
    assert not list(tmp_path.rglob("*.part")) and not list(tmp_path.rglob(name))
    assert run(*WORDS)[0] == 0


@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt(), KeyError()])
def test_a_failed_write_keeps_the_old_file(failure: BaseException, tmp_path) -> None:
    path = tmp_path / "table"
    write(path, lambda file: file.write(b"old"))

    def save(file) -> None:
        file.write(b"half")
        raise failure

    with pytest.raises(InputError if isinstance(failure, OSError) else type(failure)):
        write(path, save)
    assert [held.name for held in tmp_path.iterdir()] == ["table"] and path.read_bytes() == b"old"


@pytest.mark.usefixtures("without_report")
def test_a_folder_that_may_not_be_written_to_gets_one_line(run, tmp_path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "shards").write_text("in the way")
    code, _, err = run(*WORDS)
    assert code == 2 and "shards" in problem_line(err)
    code, _, err = run(*HOLD, "hydra.run.dir=out/shards/deeper")
    assert code == 2 and "hydra.run.dir" in problem_line(err)
