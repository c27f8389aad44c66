"""Tables and arrays in a run's folder that aren't those of a study are one line, and cost no more than they may."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.experiments.commands import HOLD, problem_line
from tests.trials import flights, manifest, trials
from torchgco.experiments.reports import report, view
from torchgco.experiments.results.files import checksum
from torchgco.experiments.results.identity import digest
from torchgco.experiments.results.limits import read_log
from torchgco.experiments.results.merge import merge

COMMANDS = {"view": view.main, "verify": lambda words: report.main([*words, "--verify"]), "report": report.main}
CASES = {
    "lists in cells": lambda table: table.assign(violation=[[0.0]] * len(table)),
    "mappings in cells": lambda table: table.assign(settings_digest=[{"a": 1}] * len(table)),
    "no version": lambda table: table.drop(columns="version"),
    "no outcome": lambda table: table.drop(columns="reached"),
    "text for numbers": lambda table: table.assign(best_cost="1"),
}


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished study of solver `hold`, made once."""
    from torchgco.experiments.app import main

    folder = tmp_path_factory.mktemp("flown") / "run"
    words = ["scenario=yard", *HOLD, "study.figures=false", f"hydra.run.dir={folder}"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["torchgco", *words])
        with pytest.raises(SystemExit) as ended:
            raise SystemExit(main())
    assert not ended.value.code
    return folder


def copied(flown: Path, folder: Path) -> Path:
    folder.mkdir()
    for path in flown.iterdir():
        if path.is_file():
            (folder / path.name).write_bytes(path.read_bytes())
    return folder


def sealed(folder: Path) -> Path:
    """The folder, with checksums of its files as they are now."""
    sums = json.loads((folder / "done").read_text())
    (folder / "done").write_text(json.dumps({name: [checksum(folder / name)] for name in sums}))
    return folder


@pytest.mark.sampled(2)
@pytest.mark.parametrize("case", CASES)
def test_a_table_that_is_no_study_s_is_one_line(case: str, flown: Path, tmp_path: Path, capsys) -> None:
    folder = copied(flown, tmp_path / "run")
    table = pd.read_parquet(folder / "trials.parquet")
    CASES[case](table).to_parquet(folder / "trials.parquet")
    sealed(folder)
    for name, command in COMMANDS.items():
        code, told = command([str(folder)]), capsys.readouterr()
        if name == "verify" and code == 1:  # the rows differ from those that are computed
            assert "differ" in told.out
        elif name != "verify" or code:
            assert code == 2 and "trials.parquet" in problem_line(told.err), (name, told)


@pytest.mark.parametrize("part", ["device", "scenario", "model"])
def test_a_group_without_keys_is_one_line(part: str, tmp_path: Path, capsys) -> None:
    trials(*flights("gco", [True])).to_parquet(tmp_path / "trials.parquet")
    held = json.loads(manifest())
    held["configuration"][part] = 0.5
    del held["checksum"]
    (tmp_path / "study.json").write_text(json.dumps({**held, "checksum": digest(held)}))
    assert report.main([str(tmp_path)]) == 2
    assert "study.json, which is damaged" in problem_line(capsys.readouterr().err)


def test_a_group_that_is_null_is_none(tmp_path: Path) -> None:
    trials(*flights("gco", [True])).to_parquet(tmp_path / "trials.parquet")
    (tmp_path / "study.json").write_bytes(manifest(device=None))
    assert len(merge([tmp_path])) == 1


ARRAYS = {
    "of another solver": lambda held: held | {"solver": np.array(["other"])},
    "of other layouts": lambda held: held | {"layout": held["layout"][:0]},
    "of another form": lambda held: held | {"U": held["U"][0]},
    "without controls": lambda held: {name: held[name] for name in ("solver", "layout")},
}


@pytest.mark.parametrize("case", ARRAYS)
def test_arrays_that_are_no_study_s_are_one_line(case: str, flown: Path, tmp_path: Path, capsys) -> None:
    folder = copied(flown, tmp_path / "run")
    np.savez(folder / "solutions.npz", **ARRAYS[case](dict(np.load(folder / "solutions.npz"))))
    for name in ("view", "verify"):
        assert COMMANDS[name]([str(sealed(folder))]) == 2
        problem_line(capsys.readouterr().err)


def log(**changed: Any) -> pd.DataFrame:
    numbers = ["mission", "step", "cost", "violation", "clearance", "guided", *(f"x{i}" for i in range(17))]
    numbers += ["planner_seconds", "tracker_seconds", "tracking_violation"]
    return pd.DataFrame({name: [0, 1] for name in numbers} | {"solver": "gco", "source": "solved"} | changed)


@pytest.mark.parametrize("changed", [{"step": 10**9}, {"step": -1}, {"x5": "a"}, {"x5": None}, {"clearance": [[], []]}])
def test_a_log_that_is_no_mission_s_is_refused(changed: dict[str, Any], tmp_path: Path) -> None:
    """A step beyond all rows would be as many gigabytes."""
    path = tmp_path / "mission.parquet"
    log().to_parquet(path)
    assert len(read_log(path)) == 2
    log(**changed).to_parquet(path)
    with pytest.raises(ValueError, match=r"column|a step beyond"):
        read_log(path)


def test_the_shards_of_a_study_of_a_map_are_reported(run, run_until, tmp_path: Path, capsys) -> None:
    """A map has a path, too, and no best costs."""
    (tmp_path / "map.pgm").write_bytes(b"P5\n40 40\n255\n" + bytes([254]) * 1600)
    words = ["scenario=map", "model=planar", "scenario.path=map.pgm", "scenario.resolution=0.2", "scenario.start=[1,1]"]
    words += ["scenario.goal=[6,6]", "solver=hold", "study.baselines=[]", "study.workers=1", "hydra.run.dir=out"]
    run_until(1, *words)
    capsys.readouterr()
    assert report.main(["out"]) == 0
    assert "1 of 1 trials" in (told := capsys.readouterr()).out + told.err
