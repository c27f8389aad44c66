"""A study as a job array of a real SLURM, started here: `pytest -m slurm`, as root, with slurm-wlm and munge installed.

Takes some minutes, because SLURM counts time limits in minutes.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pandas as pd
import pytest

from tests.cluster.results import same
from tests.experiments.commands import ENVIRONMENT, HOLD, command

PROGRAMS = ("sbatch", "slurmctld", "slurmd", "munged")
pytestmark = [
    pytest.mark.slurm,
    pytest.mark.skipif(os.geteuid() != 0, reason="slurmd needs root"),
    pytest.mark.skipif(not all(map(shutil.which, PROGRAMS)), reason="needs Debian's slurm-wlm and munge"),
]
SCRIPT = Path(__file__).with_name("slurm.sh")


@pytest.fixture(scope="module")
def slurm(tmp_path_factory) -> Iterator[dict[str, str]]:
    """The environment in which sbatch finds the SLURM of this test."""
    folder = tmp_path_factory.mktemp("slurm")
    subprocess.run([SCRIPT, "start", folder], check=True, timeout=120)
    yield {**ENVIRONMENT, "SLURM_CONF": str(folder / "slurm.conf")}
    subprocess.run([SCRIPT, "stop", folder], check=True, timeout=60)


@pytest.fixture
def submit(slurm, tmp_path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run a study as two jobs of SLURM, to its end."""

    def call(*words: str) -> subprocess.CompletedProcess[str]:
        launch = ["hydra/launcher=submitit_slurm", "study.jobs=2", "study.job=range(0,2)"]
        line = [sys.executable, "-m", "torchgco", "-m", *words, *launch]
        return subprocess.run(line, cwd=tmp_path, env=slurm, capture_output=True, text=True, timeout=900)

    return call


def test_a_study_cut_over_two_jobs_equals_an_undisturbed_one(submit, tmp_path) -> None:
    words = ["solver=al_ilqr", "solver.max_outer_iterations=2", "study.baselines=[hold]", *HOLD[2:4]]
    done = submit(*words, "hydra.launcher.cpus_per_task=1")
    assert done.returncode == 0, done.stderr
    (tmp_path / "whole").mkdir()
    assert command(*words, cwd=tmp_path / "whole").returncode == 0
    same(tmp_path / "outputs", tmp_path / "whole")


@pytest.mark.parametrize("workers", [1, 2])
def test_jobs_that_reach_their_time_limit_resume(workers: int, submit, tmp_path) -> None:
    """The batches take more time than two jobs get: two minutes each, less SLURM's allowance and their start."""
    folder = tmp_path / "conf" / "solver"
    folder.mkdir(parents=True)
    (folder / "paced.yaml").write_text(f"name: paced\n_target_: tests.cluster.paced.Paced\nseconds: {8.0 * workers}\n")
    words = ["--config-dir", str(tmp_path / "conf"), "solver=paced", "study.baselines=[]", "study.layouts=30"]
    words += ["scenario.stages=5", "study.shard_size=1", f"study.workers={workers}"]
    limit = ["timeout_min=2", "signal_delay_s=20", "cpus_per_task=1", "max_num_timeout=20"]
    done = submit(*words, *(f"hydra.launcher.{word}" for word in limit))
    assert done.returncode == 0, done.stderr
    (study,) = (tmp_path / "outputs").glob("forest*")
    assert (study / "summary.csv").is_file()
    starts = [json.loads((study / f"run-{job}-of-2.json").read_text()) for job in range(2)]
    endings = [[start["ended"] for start in held] for held in starts]
    assert all(ended[-1] == "share flown" for ended in endings)
    assert any("interrupted" in ended for ended in endings)
    assert pd.read_parquet(study / "trials.parquet")["layout"].tolist() == list(range(30))
