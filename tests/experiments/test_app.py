"""The command line: results, resuming, sweeps, and one clear line for every mistake."""

from __future__ import annotations

import re
import subprocess
import sys
from functools import partial

import numpy as np
import pandas as pd
import pytest
import torch
from omegaconf import OmegaConf
from tqdm import tqdm

import torchgco
from tests.experiments.commands import ENVIRONMENT, ROOT, TINY, command, problem_line
from torchgco import kernels
from torchgco.experiments.config.build import compose, compose_config
from torchgco.experiments.config.groups import options_of
from torchgco.experiments.flying import progress
from torchgco.experiments.results.folder import COLUMNS
from torchgco.experiments.results.identity import decisive, digest
from torchgco.scenarios import Layouts
from torchgco.solvers.augmented_lagrangian import OuterLoop

DATA = ROOT / "benchmarks" / "data"
WALLS = f"scenario.path={DATA / 'walls.npz'}"
PLACES = [(at, then) for at in range(4) for then in range(at, 4)]
# Runs the command with a standard output that nobody reads.
PIPE = """
import os, sys
reader, writer = os.pipe()
os.close(reader)
os.dup2(writer, 1)
sys.stdout.reconfigure(line_buffering=True)
from torchgco.experiments.app import main
sys.exit(main())
"""


def test_a_study_writes_all_its_files(run, tmp_path) -> None:
    words = [*TINY, "hydra.run.dir=out", "study.baselines=[hold]"]
    done = command(*words, "seed=3", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    out = tmp_path / "out"
    trials = pd.read_parquet(out / "trials.parquet")
    assert tuple(trials.columns) == COLUMNS
    assert trials.solver.tolist() == ["gco"] * 3 + ["hold"] * 3 and trials.layout.tolist() == [0, 1, 2] * 2
    assert (trials.seed == 3).all() and (trials.version == torchgco.__version__).all()
    assert trials.batch_size.tolist() == [2, 2, 1] * 2 and (trials.threads == 1).all()
    for name in ("dynamics_residual", "clearance_full", "bound_violation", "kkt_residual"):
        assert (trials[name].notna() == trials.feasible).all() and trials.feasible.any()
    assert (trials.dynamics_residual.dropna() < 1e-12).all()
    with np.load(out / "solutions.npz", allow_pickle=False) as held:
        assert held["U"].shape == (2, 3, 12, 4) and held["solver"].tolist() == ["gco", "hold"]
        assert held["layout"].tolist() == [0, 1, 2]
    assert Layouts.load(out / "layouts.npz").count == 3
    assert (out / ".hydra" / "config.yaml").is_file() and (out / "summary.csv").is_file()
    assert {p.stem for p in (out / "figures").glob("*.png")} == {"rates", "layouts", "clearance", "violation"}
    assert not (out / "shards").exists()
    assert "gco" in done.stdout and "McNemar" in done.stdout and "3/3" in done.stdout
    assert "trial" in done.stderr  # a progress bar
    code, text, _ = run(*words, "seed=3")
    assert code == 0 and "nothing was flown again" in text
    code, _, err = run(*words, "seed=4")
    assert code == 2 and "seed is 3 there, 4 here" in problem_line(err)


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.usefixtures("without_report")
def test_the_bar_counts_the_solved_problems(workers: int, run, monkeypatch) -> None:
    monkeypatch.setattr("torchgco.experiments.flying.workers.tqdm", partial(tqdm, mininterval=0))
    monkeypatch.setattr(progress, "watched", lambda: True)
    words = ["solver=al_ilqr", "study.baselines=[]", *TINY[:4], f"study.workers={workers}", "hydra.run.dir=out"]
    code, _, err = run(*words)
    assert code == 0 and ("solved 2/2" if workers == 1 else "solved 3/3") in err
    assert "| 3/3 [" in err and "pass" not in err and ".0/" not in err


@pytest.mark.slow
def test_figures_may_be_left_out(run, tmp_path) -> None:
    words = ["solver=hold", "study.baselines=[]", *TINY[:4], "study.workers=1", "hydra.run.dir=out"]
    code, out, err = run(*words, "study.figures=false")
    assert code == 0 and "reached" in out and "drawing" not in err
    assert "hold: 3/3 trials" in err and "\r" not in err, "a log has a line in place of a bar"
    assert (tmp_path / "out" / "summary.csv").exists() and not (tmp_path / "out" / "figures").exists()
    code, _, err = run(*words)
    assert code == 0 and "drawing 4 figures" in err and (tmp_path / "out" / "figures" / "rates.png").exists()


def test_the_configuration_chooses_the_kernels() -> None:
    """For the whole process, and in the study's identity, because results differ in the last bits."""
    try:
        for name in ("eager", "native"):
            setup = compose([f"device.kernels={name}"])
            assert kernels.native() == (name == "native")
            assert decisive(setup.configuration, {})["device"] == {"name": "cpu", "dtype": "float64", "kernels": name}
    finally:
        kernels.use_native(True)


def test_the_order_of_a_table_is_part_of_a_study() -> None:
    """Its rows work one after another: in another order they give other results, in the same folder until now."""
    setup = compose([])
    settings = setup.configuration["solver"]
    turned = settings | {"passes": dict(reversed(settings["passes"].items()))}
    other_keys = dict(reversed(settings.items()))
    codes = [digest(decisive(setup.configuration, {"gco": solver})) for solver in (settings, turned, other_keys)]
    assert codes[0] != codes[1] and codes[0] == codes[2]


@pytest.mark.slow
@pytest.mark.usefixtures("without_report")
def test_results_do_not_depend_on_the_batch_size(run, tmp_path) -> None:
    """test_resume.py tests the same for the number of processes."""
    for size in (1, 3):  # one after the other, and in three slots
        pieces = [f"study.batch_size={size}", f"study.shard_size={size}", f"hydra.run.dir=b{size}"]
        assert run(*TINY[:2], *pieces, "study.workers=1", "study.baselines=[]")[0] == 0
    one, three = (pd.read_parquet(tmp_path / f"b{size}" / "trials.parquet") for size in (1, 3))
    measured = ["seconds", "batch_size"]
    pd.testing.assert_frame_equal(one.drop(columns=measured), three.drop(columns=measured), check_exact=True)
    assert one.success.isna().all()  # no best cost: one solver, and none in a file


@pytest.mark.slow
def test_out_of_memory_halves_the_batch(run, tmp_path, monkeypatch) -> None:
    def begin(self, rows, real=OuterLoop.begin):
        if rows.numel() > 1:
            raise torch.OutOfMemoryError("no more")
        return real(self, rows)

    monkeypatch.setattr(OuterLoop, "begin", begin)
    code, _, err = run(*TINY, "hydra.run.dir=out", "study.baselines=[]")
    assert code == 0 and "on with 1 problems at once" in err
    assert (pd.read_parquet(tmp_path / "out" / "trials.parquet").batch_size == 1).all()


@pytest.mark.slow
@pytest.mark.usefixtures("without_report")
def test_a_sweep_writes_separate_results(run, tmp_path) -> None:
    sweep = ["-m", "solver=hold,ilqr", "scenario.num_obstacles=2,3"]
    code, _, err = run(*sweep, "study.layouts=2", "scenario.stages=5", "study.baselines=[]", "study.workers=1")
    assert code == 0, err
    tables = [pd.read_parquet(p) for p in sorted((tmp_path / "outputs").rglob("trials.parquet"))]
    assert len(tables) == 4
    assert sorted(t.solver[0] for t in tables) == ["hold", "hold", "ilqr", "ilqr"]


@pytest.mark.slow
def test_start_inside_an_obstacle_is_a_status(run, tmp_path) -> None:
    centers = np.array([[[0.0, 0.5]], [[-1.0, 0.0]]])
    np.savez(tmp_path / "two.npz", centers=centers, radii=np.full((2, 1), 0.1))
    words = ["scenario=layouts", "scenario.path=two.npz", "model=planar", "study.baselines=[hold]", "solver=al_ilqr"]
    words += ["study.workers=1", "solver.max_outer_iterations=1", "solver.inner.max_iterations=3", "hydra.run.dir=out"]
    code, _, _ = run(*words)
    assert code == 0
    trials = pd.read_parquet(tmp_path / "out" / "trials.parquet")
    assert (trials.scenario == "two").all()
    assert (trials.status[trials.layout == 1] == "INVALID_START").all()
    assert not trials.feasible[trials.layout == 1].any()
    with np.load(tmp_path / "out" / "solutions.npz") as held:
        assert np.isnan(held["U"][:, 1]).all() and np.isfinite(held["U"][:, 0]).all()
    np.savez(tmp_path / "bad.npz", centers=centers[1:], radii=np.full((1, 1), 0.1))
    code, _, err = run(*[w.replace("two", "bad").replace("=out", "=bad") for w in words])
    assert code == 2 and "a layout whose start is outside its obstacles" in err


BAD = {
    "unknown group": (["planner=rrt"], "planner"),
    "unknown option": (["solver=rrt"], "rrt"),
    "added key": (["+solver.local.inner.speed=3"], "speed"),
    "missing path": (["scenario=layouts"], "scenario.path: expected the layout file: add scenario.path=FILE.npz"),
    "no such file": (["scenario=layouts", "scenario.path=nowhere.npz"], "scenario.path: expected a layout file"),
    "model misfit": (["model=planar"], "with 14 states, or scenario=planar_random or planar_trap, got model=planar"),
    "model misfit in a file": (["scenario=layouts", WALLS, "model=planar"], "model=quadrotor"),
    "too many layouts": (["scenario=layouts", WALLS, "study.layouts=40"], "study.layouts"),
    "negative radius": (["scenario.obstacle_radius=-1"], "obstacle_radius"),
    "weights": (["model.vehicle.control_weight=[1,1,1,-1]"], "cost.R"),
    "crossed bounds": (["model.vehicle.control_lower=[9,9,9,9]"], "control_bounds.lower"),
    "model dimension": (["model.dimension=2"], "model.dimension: expected 3, as its dynamics say, got 2"),
    "solver option": (["solver.local.inner.tolerance=-1"], "ilqr.tolerance"),
    "kernels": (["device.kernels=compiled"], "device.kernels: expected native or eager"),
    "dtype": (["device.dtype=float16"], "device.dtype"),
}  # fmt: skip


@pytest.mark.sampled(5)
@pytest.mark.parametrize("case", BAD)
def test_mistakes_get_one_clear_line(case: str, run) -> None:
    words, message = BAD[case]
    code, out, err = run("study.layouts=2", "scenario.stages=4", *words) if "layouts" not in words[0] else run(*words)
    assert code == 2 and message in problem_line(err), err
    assert "Traceback" not in err + out


def test_version_and_help(run) -> None:
    code, out, _ = run("--version")
    assert code == 0 and out.strip() == f"torchgco {torchgco.__version__}"
    code, out, _ = run("--help")
    assert code == 0 and "torchgco -m solver=al_ilqr,gco" in out and "planar_random" in out.split("Groups")[1]
    assert len(out.splitlines()) < 75 and max(map(len, out.splitlines())) <= 110
    for group in ("device", "experiment", "mission", "model", "plant", "scenario", "solver"):
        (listed,) = re.findall(rf"^  {group} +((?:.*\n {{18}})*.*)", out, re.MULTILINE)
        assert set(re.findall(r"\w+", listed)) == set(options_of(group))
    assert "forest*," in out and "walls*," in run("--help", "scenario=walls")[1]


WHERE = [[], ["model=planar", "scenario=planar_trap"], ["solver=gco_max", "experiment=mission"], ["experiment=race"]]


@pytest.mark.parametrize("words", WHERE)
def test_all_keys_are_printed_with_their_values(words: list[str], run) -> None:
    code, out, err = run("--cfg", "job", "--resolve", *words)
    assert code == 0, err
    assert "${" not in out and OmegaConf.to_container(OmegaConf.create(out)) == compose_config(words)


def test_flags_may_stand_between_words(run) -> None:
    words, flags = ["scenario=walls", "seed=3", "study.layouts=2"], ["--cfg", "job", "-p", "study"]
    wholes = [run(*words[:at], *flags[:2], *words[at:then], *flags[2:], *words[then:]) for at, then in PLACES]
    assert len(set(wholes)) == 1 and wholes[0][0] == 0 and "layouts: 2" in wholes[0][1]


@pytest.mark.parametrize("kind", ["job", "hydra", "all"])
def test_a_part_that_the_configuration_lacks_is_refused_in_one_line(kind: str, run) -> None:
    code, out, err = run("-p", "foo", "--cfg", kind)
    assert (code, out) == (2, "")
    assert problem_line(err) == "torchgco: -p: expected a group or a key of the configuration, got foo"


@pytest.mark.slow
def test_a_reader_that_has_read_enough_is_no_error(tmp_path) -> None:
    for words in ("--shell-completion install=bash", "--help", "--version", "--cfg job"):
        line = [sys.executable, "-c", PIPE, *words.split()]
        done = subprocess.run(line, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0 and not done.stderr, (words, done.stderr)
