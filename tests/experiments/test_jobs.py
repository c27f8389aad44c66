"""Studies that several jobs fly, and sweeps in which a job fails. tests/cluster has the launchers."""

from __future__ import annotations

import json
import platform
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from tests.cluster.results import same
from tests.experiments.commands import HOLD, problem_line
from torchgco.base.errors import InputError
from torchgco.base.files import PART
from torchgco.experiments.config import launching
from torchgco.experiments.config.build import compose
from torchgco.experiments.flying import jobs, progress
from torchgco.experiments.flying.flight import plan_of
from torchgco.experiments.results.files import create, write
from torchgco.experiments.results.folder import StudyFolder
from torchgco.experiments.results.identity import Manifest

# Two solvers, so that success compares rows of all jobs.
STUDY = ["solver=al_ilqr", "solver.max_outer_iterations=1", "study.baselines=[hold]", "study.layouts=5", *HOLD[3:]]


def folder_of(place: Path) -> Path:
    (found,) = (path for path in (place / "outputs").iterdir() if path.is_dir())
    return found


def shards(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / "shards").iterdir())


@pytest.mark.slow
@pytest.mark.usefixtures("without_report")
def test_a_study_cut_over_jobs_equals_one_in_a_single_piece(run, tmp_path) -> None:
    code, out, err = run("-m", "study.jobs=3", "study.job=range(0,3)", *STUDY)
    assert code == 0, err
    assert [f"Job {job} of 3: {n} trials flown" in out for job, n in ((0, 4), (1, 4), (2, 2))] == [True] * 3
    folder = folder_of(tmp_path)
    assert not (folder / "shards").exists() and not list((tmp_path / "outputs").glob(".jobs*"))
    assert run(*STUDY, f"hydra.run.dir=whole/{folder.name}")[0] == 0
    same(tmp_path / "outputs", tmp_path / "whole")
    code, out, _ = run(*STUDY)
    assert code == 0 and "nothing was flown again" in out


@pytest.mark.slow
@pytest.mark.usefixtures("without_report")
def test_missions_are_cut_over_jobs(run, tmp_path) -> None:
    few = ["experiment=mission_study", "solver=al_ilqr", "study.baselines=[]", "study.layouts=3", "study.workers=1"]
    few += ["mission.duration=0.3"]
    code, _, err = run("-m", "study.jobs=2", "study.job=range(0,2)", *few)
    assert code == 0, err
    assert run(*few, f"hydra.run.dir=whole/{folder_of(tmp_path).name}")[0] == 0
    same(tmp_path / "outputs", tmp_path / "whole")


@pytest.mark.slow
@pytest.mark.usefixtures("without_report")
def test_a_job_flies_its_share_whatever_the_others_do(run, tmp_path) -> None:
    words = [*HOLD[:2], "study.layouts=6", *HOLD[3:], "study.jobs=3"]
    for job, held in ((2, ["hold-000004-000005.npz"]), (0, ["hold-000000-000001.npz", "hold-000004-000005.npz"])):
        code, out, _ = run(*words, f"study.job={job}")
        assert code == 0 and "2 trials flown" in out
        assert shards(folder_of(tmp_path)) == held and not (folder_of(tmp_path) / "trials.parquet").exists()
    code, out, _ = run(*words, "study.job=2")
    assert code == 0 and "0 trials flown" in out
    code, out, _ = run(*words[:-1])
    assert code == 0 and "4 of 6 trials were flown before" in out
    code, out, _ = run(*words, "study.job=1")
    assert code == 0 and "already done" in out


@pytest.mark.slow
@pytest.mark.usefixtures("without_report")
def test_a_study_with_a_missing_share_gets_one_line_and_keeps_its_shards(run, tmp_path) -> None:
    code, _, err = run("-m", "study.jobs=2", "study.job=1", *HOLD)
    assert code == 2 and "2 of 4 trials missing" in problem_line(err)
    assert shards(folder_of(tmp_path)) == ["hold-000002-000003.npz"]
    assert run("-m", "study.jobs=2", "study.job=range(0,2)", *HOLD)[0] == 0


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("words", "got"),
    [
        (["study.jobs=4", "study.job=4"], "study.job=4 study.jobs=4"),
        (["study.jobs=4", "study.job=-1"], "study.job=-1"),
        (["study.jobs=4", "study.job=first"], "study.job=first"),
        (["study.jobs=4", "study.job=true"], "study.job=True"),
        (["study.jobs=4"], "study.job=None"),
        (["study.job=0"], "study.jobs=None"),
        (["study.jobs=0", "study.job=0"], "study.jobs: expected a whole number of at least 1"),
        (["study.jobs=many", "study.job=0"], "study.jobs: expected a whole number of at least 1"),
    ],
)
def test_a_malformed_share_gets_one_line(words: list[str], got: str, run, tmp_path) -> None:
    code, _, err = run(*HOLD, *words, "hydra.run.dir=out")
    assert code == 2 and got in problem_line(err)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("jobs", [1, 2, 3, 7, 12])
def test_every_layout_belongs_to_one_share(jobs: int) -> None:
    plan = plan_of(compose(HOLD))
    shares = [replace(plan, job=job, jobs=jobs).share(range(11), 11) for job in range(jobs)]
    assert [number for share in shares for number in share] == list(range(11))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1
    assert replace(plan, job=0, jobs=jobs).share([0, 10], 11) == [number for number in (0, 10) if number in shares[0]]


@pytest.mark.slow
@pytest.mark.usefixtures("without_report")
def test_a_failing_job_gets_one_line_and_the_others_are_kept(run, tmp_path) -> None:
    code, out, err = run("-m", *HOLD, "seed=-1,0", "scenario.num_obstacles=2,3")
    lines = [line for line in err.splitlines() if line.startswith("torchgco: ")]
    assert code == 2 and "Traceback" not in out + err and "Error executing" not in err
    expected = [f"torchgco: job seed=-1 scenario.num_obstacles={n}: seed: expected a whole number" for n in (2, 3)]
    assert [line.partition(" of at")[0] for line in lines] == expected
    assert len(list((tmp_path / "outputs").rglob("trials.parquet"))) == 2


@pytest.mark.parametrize(("launcher", "plugin"), [("joblib", "joblib"), ("submitit_slurm", "submitit"), ("ray", "ray")])
def test_a_launcher_that_is_not_installed_gets_one_line(launcher: str, plugin: str, run, monkeypatch) -> None:
    """It names a package: there may be no clone to install extras from."""
    monkeypatch.setattr(jobs, "find_spec", lambda name: None)
    code, _, err = run("-m", f"hydra/launcher={launcher}", *HOLD)
    assert code == 2 and f"pip install hydra-{plugin}-launcher, got {launcher}" in problem_line(err)


def test_a_malformed_number_of_processes_gets_one_line(run) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    code, _, err = run("-m", "hydra/launcher=joblib", "hydra.launcher.n_jobs=0", *HOLD)
    assert code == 2 and "hydra.launcher.n_jobs" in problem_line(err)


@pytest.mark.parametrize(
    ("launcher", "slurm", "cores"),
    [
        ({}, None, 8),
        ({}, "3", 3),
        ({"n_jobs": 3}, None, 2),
        ({"n_jobs": -1}, None, 1),
        ({"n_jobs": 20}, None, 1),
        ({"cpus_per_task": 4}, None, 4),
        ({"cpus_per_task": 4}, "4", 4),
        ({"ray": {"remote": {"num_cpus": 2}}}, None, 2),
    ],
)
def test_the_cores_of_a_machine_are_shared_by_its_jobs(launcher, slurm, cores, monkeypatch) -> None:
    monkeypatch.setattr(launching, "_launcher", lambda: OmegaConf.create(launcher))
    monkeypatch.setattr(launching.os, "sched_getaffinity", lambda _: set(range(8)))
    monkeypatch.delenv("SLURM_CPUS_PER_TASK", raising=False)
    if slurm:
        monkeypatch.setenv("SLURM_CPUS_PER_TASK", slurm)
    assert launching.allotted_cores() == cores


def test_of_many_processes_one_creates_a_file(tmp_path) -> None:
    def make(number: int) -> bool:
        return create(tmp_path / "study.json", lambda file: file.write(b"%d" % number))

    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(make, range(8)))
    assert made.count(True) == 1 and (tmp_path / "study.json").read_bytes() == b"%d" % made.index(True)
    assert not list(tmp_path.glob(f"*{PART[1]}"))


def test_two_studies_that_start_together_do_not_share_a_folder(tmp_path, monkeypatch) -> None:
    def manifest(seed: int) -> Manifest:
        config = {"version": "0", "seed": seed, "scenario": {}, "model": {"vehicle": {}}, "device": {"name": "cpu"}}
        return Manifest(config | {"device": {"name": "cpu", "dtype": "float64"}}, {"hold": {}}, {0: "a"})

    def refuse_foreign(self) -> None:  # at this moment the other study claims the folder
        monkeypatch.undo()
        StudyFolder(tmp_path, manifest(1)).claim()

    monkeypatch.setattr(StudyFolder, "_refuse_foreign", refuse_foreign)
    with pytest.raises(InputError, match="seed is 1 there, 0 here"):
        StudyFolder(tmp_path, manifest(0)).claim()
    StudyFolder(tmp_path, manifest(1)).claim()


@pytest.mark.parametrize("name", ["table", "shards/a.npz"])
def test_a_write_survives_the_end_of_the_study_in_another_process(name: str, tmp_path) -> None:
    """That process removes shards and what it takes for leftovers."""
    written = []

    def save(file) -> None:
        file.write(b"new")
        if not written:
            for part in tmp_path.rglob(f"*{PART[1]}"):
                part.unlink()
            if (tmp_path / "shards").exists():
                (tmp_path / "shards").rmdir()
        written.append(name)

    write(tmp_path / name, save)
    assert (tmp_path / name).read_bytes() == b"new" and len(written) == 2


@pytest.mark.slow
def test_a_record_of_every_start(run, run_until, tmp_path, without_report) -> None:
    words = [*HOLD, "study.shard_size=2", "hydra.run.dir=out"]
    run_until(1, *words)
    assert run(*words)[0] == 0
    stopped, done = json.loads((tmp_path / "out" / "run.json").read_text())
    assert [stopped["ended"], done["ended"]] == ["interrupted", "finished"]
    assert done["command"].startswith("torchgco solver=hold 'study.baselines=[]'")
    assert (done["workers"], done["threads"], done["seed"], done["job"]) == (1, 1, 0, None)
    assert done["processor_seconds"] >= 0 and 0 < done["wall_seconds"] < 600
    assert done["torchgco"]["version"] and done["packages"]["torch"].startswith("2.") and done["machine"]["cores"] >= 1


def test_a_job_shows_lines_in_place_of_a_bar(capsys, monkeypatch) -> None:
    monkeypatch.setattr(progress, "PERIOD", 0.0)
    with progress.Lines("Job 1 of 4", total=8, initial=2) as lines:
        lines.set_description("gco")
        lines.update(3)
    assert capsys.readouterr().err == "Job 1 of 4: 5/8 trials, gco\n"


def test_a_record_that_cannot_be_written_stops_no_study(run, tmp_path, without_report) -> None:
    (tmp_path / "out" / "run.json").mkdir(parents=True)
    assert run(*HOLD, "hydra.run.dir=out")[0] == 0
    assert (tmp_path / "out" / "trials.parquet").is_file()


def test_a_record_names_neither_host_nor_environment(run, tmp_path, without_report, monkeypatch) -> None:
    monkeypatch.setenv("PASSPHRASE", "open sesame")
    monkeypatch.setattr(platform, "node", lambda: "a-host-of-mine")
    assert run(*HOLD, "hydra.run.dir=out")[0] == 0
    text = (tmp_path / "out" / "run.json").read_text()
    assert "sesame" not in text and str(Path.home()) not in text and "a-host-of-mine" not in text
