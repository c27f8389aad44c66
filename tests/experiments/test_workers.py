"""Worker processes that are killed, interrupted or orphaned."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.experiments import doomed
from tests.experiments.commands import begin, problem_line
from torchgco.base.errors import InputError
from torchgco.experiments.flying import workers
from torchgco.experiments.flying.workers import run_all

pytestmark = pytest.mark.slow
WAIT = 120  # s, an upper limit for steps that take a few


def flown(jobs: list[tuple[int, str]], kept: list[int], messages: list[str]) -> list[float]:
    """Run jobs of `doomed`; returns the sums that were shown."""
    seen: list[float] = []
    run_all(doomed.work, jobs, 2, doomed.prepare, (), kept.append, messages.append, seen.append)
    return seen


def test_the_jobs_of_a_killed_worker_are_done_by_a_new_pool(tmp_path) -> None:
    kept: list[int] = []
    messages: list[str] = []
    flown([(0, ""), (1, str(tmp_path / "killed")), (2, ""), (3, "")], kept, messages)
    assert sorted(kept) == [0, 2, 4, 6]
    assert len(messages) == 1 and "worker process died" in messages[0]


def test_progress_of_all_workers_is_summed_and_survives_a_new_pool(tmp_path) -> None:
    """Each job of `doomed` counts a trial before it dies or ends; that of a job that died counts once."""
    assert flown([(0, ""), (1, str(tmp_path / "killed")), (2, ""), (3, "")], [], [])[-1] == 4


def test_workers_that_always_die_end_in_one_line_and_lose_no_result(monkeypatch) -> None:
    monkeypatch.setattr(workers, "NEW_POOLS", 1)
    kept: list[int] = []
    messages: list[str] = []
    with pytest.raises(InputError, match=r"study\.workers: .*same command resumes"):
        flown([(1, "always"), (2, ""), (3, "")], kept, messages)
    assert sorted(kept) == [4, 6] and len(messages) == 1


def test_an_error_in_a_worker_is_raised_and_ends_the_pool() -> None:
    with pytest.raises(ValueError, match="job -1"):
        flown([(-1, ""), (1, "")], [], [])


def arguments(folder: Path, solver: str) -> list[str]:
    """Arguments of a study of a solver in `doomed`: four layouts, two shards, two processes."""
    (folder / "conf" / "solver").mkdir(parents=True)
    text = f"name: doomed\n_target_: tests.experiments.doomed.{solver}\n"
    (folder / "conf" / "solver" / "doomed.yaml").write_text(text)
    given = ["solver=doomed", "study.baselines=[]", "study.layouts=4", "scenario.stages=5", "study.shard_size=2"]
    # The bound is below hover thrust: infeasible trajectories get no certificate, whose import takes seconds.
    bounds = "model.vehicle.control_upper=[5,5,5,9]"
    return ["--config-dir", str(folder / "conf"), *given, bounds, "study.workers=2", "hydra.run.dir=out"]


@pytest.mark.usefixtures("without_report")
def test_a_study_whose_workers_die_ends_and_resumes(run, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(workers, "NEW_POOLS", 1)
    study = arguments(tmp_path, "Doomed")
    code, _, err = run(*study)
    lines = [line for line in err.splitlines() if "worker process died" not in line]
    assert code == 2 and "study.workers" in problem_line("\n".join(lines))
    shards = [path.name for path in (tmp_path / "out" / "shards").iterdir()]
    assert shards == ["doomed-000000-000001.npz"]
    (tmp_path / "spared").touch()
    assert run(*study)[0] == 0
    assert pd.read_parquet(tmp_path / "out" / "trials.parquet")["layout"].tolist() == [0, 1, 2, 3]


@pytest.fixture
def slow(tmp_path):
    """A running study with one shard written and a worker busy with the other, and the study's arguments."""
    study = arguments(tmp_path, "Slow")
    process = begin(*study, cwd=tmp_path)
    wait_for(lambda: list((tmp_path / "out" / "shards").glob("*.npz")) or process.poll() is not None)
    yield process, study
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    for pipe in (process.stdout, process.stderr):
        if pipe is not None:
            pipe.close()


def wait_for(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + WAIT
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def workers_of(process: subprocess.Popen[str]) -> list[int]:
    """Process ids of the workers in a study's process group."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            group = int((place / "stat").read_text().rsplit(")", 1)[1].split()[2])
            if group == process.pid and b"spawn_main" in (place / "cmdline").read_bytes():
                found.append(int(place.name))
        except (OSError, IndexError):  # gone meanwhile
            continue
    return found


def test_a_study_outlives_the_kill_of_a_worker(slow, tmp_path) -> None:
    process, _ = slow
    (tmp_path / "spared").touch()
    for worker in workers_of(process):
        os.kill(worker, signal.SIGKILL)
    _, err = process.communicate(timeout=WAIT)
    assert process.returncode == 0 and "worker process died" in err
    assert pd.read_parquet(tmp_path / "out" / "trials.parquet")["layout"].tolist() == [0, 1, 2, 3]


def test_ctrl_c_ends_all_processes_with_one_line(slow) -> None:
    process, _ = slow
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=WAIT)
    assert process.returncode == 130 and "the same command resumes" in problem_line(err)
    wait_for(lambda: not workers_of(process))


@pytest.mark.usefixtures("without_report")
def test_a_killed_study_leaves_no_workers_and_resumes(slow, run, tmp_path) -> None:
    process, study = slow
    assert workers_of(process)
    process.kill()
    process.wait()
    wait_for(lambda: not workers_of(process))
    (shard,) = (tmp_path / "out" / "shards").glob("*.npz")
    assert not (tmp_path / "out" / "done").exists()
    with np.load(shard) as held:  # mark the shard: finished layouts must not be flown again
        rows, U = json.loads(str(held["rows"])), held["U"]
    rows["iterations"] = [777] * len(rows["iterations"])
    np.savez(shard, U=U, rows=np.array(json.dumps(rows)))
    (tmp_path / "spared").touch()
    assert run(*study)[0] == 0
    trials = pd.read_parquet(tmp_path / "out" / "trials.parquet")
    assert trials["layout"].tolist() == [0, 1, 2, 3] and trials["iterations"].tolist() == [777, 777, 0, 0]
