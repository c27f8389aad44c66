"""The commands of docs/studies.md as printed, with smaller studies, under the launchers that need no cluster."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
from pathlib import Path

import pytest

from tests.cluster.results import same
from tests.experiments.commands import ROOT, command
from tests.test_documents import commands
from torchgco.experiments.reports.report import main as report_main

pytestmark = pytest.mark.slow
FEW = ["study.layouts=6", "scenario.stages=12", "study.baselines=[hold]"]
PRINTED = [line.partition(" #")[0].strip() for line in commands(ROOT / "docs" / "studies.md")]
CUT = [line for line in PRINTED if "launcher" in line and "study.jobs" in line and "slurm" not in line]
SWEEP = [line for line in PRINTED if "num_obstacles" in line]
PLUGINS = {
    "joblib": "hydra_plugins.hydra_joblib_launcher",
    "submitit_local": "hydra_plugins.hydra_submitit_launcher",
    "ray": "hydra_plugins.hydra_ray_launcher",
}


def launch(line: str, *more: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a printed command in a folder, with further arguments; skip where its launcher isn't installed."""
    for name in re.findall(r"hydra/launcher=(\w+)", line):
        pytest.importorskip(PLUGINS[name], reason=f"no launcher {name}")
    cwd.mkdir(exist_ok=True)
    return command(*shlex.split(line)[1:], *more, cwd=cwd)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """The study that is cut below, in one piece."""
    folder = tmp_path_factory.mktemp("whole")
    assert launch("torchgco", *FEW, cwd=folder).returncode == 0
    return folder


@pytest.mark.parametrize("line", CUT, ids=lambda line: re.findall(r"launcher=(\w+)", line)[0])
def test_a_study_cut_over_jobs_equals_one_in_a_single_piece(line: str, whole: Path, tmp_path) -> None:
    done = launch(line, *FEW, cwd=tmp_path / "cut")
    assert done.returncode == 0, done.stderr
    assert "paired" in done.stdout and "\r" not in done.stderr, "a table, no bars"
    same(whole, tmp_path / "cut")
    (folder,) = (tmp_path / "cut" / "outputs").glob("forest*")
    jobs = int(re.findall(r"study.jobs=(\d+)", line)[0])
    records = [json.loads((folder / f"run-{job}-of-{jobs}.json").read_text())[0] for job in range(jobs)]
    assert [record["ended"] for record in records] == ["share flown"] * jobs
    assert all(record["workers"] * record["threads"] == 1 for record in records if "joblib" in line)


def test_a_sweep_in_processes_equals_a_serial_one(tmp_path, monkeypatch, capsys) -> None:
    serial, parallel = SWEEP
    more = ["study.layouts=2", *FEW[1:]]
    for line, name in ((serial, "serial"), (parallel, "parallel")):
        done = launch(line, *more, cwd=tmp_path / name)
        assert done.returncode == 0, done.stderr
    same(tmp_path / "serial", tmp_path / "parallel", studies=4)
    (report,) = (shlex.split(line)[1:] for line in PRINTED if "torchgco-report" in line and "--output" in line)
    monkeypatch.chdir(tmp_path / "parallel")
    assert report_main(report) == 0
    assert "num_obstacles" in capsys.readouterr().out and Path("outputs/summer/trials.parquet").is_file()


@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_a_job_that_fails_in_another_process_gets_one_line(launcher: str, tmp_path) -> None:
    line = f"torchgco -m hydra/launcher={launcher} seed=-1,0 solver=hold study.layouts=2 scenario.stages=5"
    done = launch(line, "study.baselines=[]", cwd=tmp_path)
    assert done.returncode == 2 and len(list((tmp_path / "outputs").rglob("trials.parquet"))) == 1
    (told,) = (line for line in done.stderr.splitlines() if not line.startswith(("hold: ", "drawing ")))
    assert told.startswith("torchgco: job seed=-1: seed: expected a whole number")
