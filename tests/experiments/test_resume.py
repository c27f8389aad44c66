"""Studies that are stopped, resumed, refused, or flown in other shards and batches."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from tests.experiments.commands import HOLD, TINY, problem_line
from torchgco import InputError, MultiStart
from torchgco.experiments.flying import study
from torchgco.experiments.results.folder import StudyFolder
from torchgco.experiments.results.lock import held
from torchgco.scenarios import Layouts
from torchgco.solvers import AugmentedLagrangian
from torchgco.solvers.augmented_lagrangian import OuterLoop

HOW = ["seconds", "batch_size", "threads"]  # columns that describe how a trial was flown


def contents(folder: Path) -> dict[str, tuple[bytes, int]]:
    """Bytes and time of every file below a folder."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): (path.read_bytes(), path.stat().st_mtime_ns) for path in files}


def mine(folder: Path, limit: int) -> list[str]:
    """Arguments of a study with a user's baseline, whose configuration is written into `folder`."""
    (folder / "conf" / "solver").mkdir(parents=True, exist_ok=True)
    text = f"defaults: [al_ilqr, _self_]\nname: mine\nmax_outer_iterations: {limit}\n"
    (folder / "conf" / "solver" / "mine.yaml").write_text(text)
    return ["--config-dir", str(folder / "conf"), *HOLD[:1], "study.baselines=[mine]", *HOLD[2:]]


@pytest.mark.usefixtures("without_report")
def test_the_settings_of_a_baseline_are_part_of_a_study(run, tmp_path) -> None:
    assert run(*mine(tmp_path, 1), "hydra.run.dir=out")[0] == 0
    before = contents(tmp_path / "out")
    code, _, err = run(*mine(tmp_path, 2), "hydra.run.dir=out")
    assert code == 2 and "solvers.mine.max_outer_iterations is 1 there, 2 here" in problem_line(err)
    assert contents(tmp_path / "out") == before


@pytest.mark.slow
@pytest.mark.usefixtures("without_report")
def test_the_settings_of_a_baseline_are_part_of_the_default_folder(run, tmp_path) -> None:
    for limit in (1, 2, 1):
        assert run(*mine(tmp_path, limit))[0] == 0
    assert len(list((tmp_path / "outputs").iterdir())) == 2
    tables = [pd.read_parquet(path) for path in (tmp_path / "outputs").rglob("trials.parquet")]
    outer = [set(table.loc[table["solver"] == "mine", "outer_iterations"]) for table in tables]
    assert sorted(map(max, outer)) == [1, 2]


@pytest.mark.slow
@pytest.mark.usefixtures("without_report")
def test_a_stopped_study_is_not_finished_with_other_settings(run, run_until, tmp_path) -> None:
    run_until(3, *mine(tmp_path, 1), "study.shard_size=2", "hydra.run.dir=out")
    code, _, err = run(*mine(tmp_path, 2), "study.shard_size=2", "hydra.run.dir=out")
    assert code == 2 and "max_outer_iterations" in problem_line(err)


@pytest.mark.sampled(1)
@pytest.mark.usefixtures("without_report")
@pytest.mark.parametrize(
    "words", [["seed=1"], ["study.batch_size=0"], ["scenario.num_obstacles=4"], ["study.baselines=[mppi]"]]
)
def test_a_refused_command_leaves_the_folder_as_it_is(words, run, run_until, tmp_path) -> None:
    run_until(1, *HOLD, "study.shard_size=2", "hydra.run.dir=out")
    before = contents(tmp_path / "out")
    assert {"study.json", ".hydra/config.yaml", ".hydra/hydra.yaml", ".hydra/overrides.yaml"} < before.keys()
    code, _, err = run(*HOLD, *words, "hydra.run.dir=out")
    assert code == 2 and problem_line(err)
    assert contents(tmp_path / "out") == before


@pytest.mark.usefixtures("without_report")
@pytest.mark.parametrize("error", [InputError("a", "b", "c"), RuntimeError("broken"), KeyboardInterrupt()])
def test_what_raises_before_the_first_row_leaves_the_folder_free(error, run, tmp_path, monkeypatch) -> None:
    """A refusal that came late kept the folder for a study that had no row; one with rows keeps it."""
    words = [*HOLD, "study.shard_size=2", "hydra.run.dir=out"]

    def fail(*arguments: object) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(study, "_fly", fail)
        with suppress(RuntimeError):
            run(*words)
        with suppress(RuntimeError):
            run(*words, "study.jobs=2", "study.job=1")
    (tmp_path / "out").mkdir(exist_ok=True)
    assert contents(tmp_path / "out") == {}
    assert run(*words, "seed=1")[0] == 0
    with monkeypatch.context() as patch:
        patch.setattr(study.StudyFolder, "close", fail)
        (tmp_path / "out" / "done").unlink()
        with suppress(RuntimeError):
            run(*words, "seed=1")
    assert run(*words)[0] == 2 and run(*words, "seed=1")[0] == 0


@pytest.mark.usefixtures("without_report")
def test_a_share_that_fails_leaves_the_claim_to_the_others(run, tmp_path, monkeypatch) -> None:
    words, jobs = [*HOLD, "study.shard_size=2", "hydra.run.dir=out"], ["study.jobs=2"]

    def fail(*arguments: object) -> None:
        raise RuntimeError

    with monkeypatch.context() as patch:
        patch.setattr(study, "_fly", fail)
        with held(tmp_path / "out", 0, 2), pytest.raises(RuntimeError):
            run(*words, *jobs, "study.job=1")
    assert (tmp_path / "out" / "study.json").is_file()
    assert run(*words, "seed=1")[0] == 2
    assert run(*words, *jobs, "study.job=0")[0] == 0


@pytest.mark.slow
@pytest.mark.usefixtures("without_report")
def test_a_study_resumes_in_other_pieces_with_equal_bits(run, run_until, tmp_path) -> None:
    words = [TINY[1], TINY[4], "study.layouts=7", "study.baselines=[multistart,hold]"]
    assert run(*words, "study.workers=1", "study.shard_size=7", "study.batch_size=7", "hydra.run.dir=whole")[0] == 0
    pieces = ["study.shard_size=2", "study.batch_size=1", "study.workers=1", "hydra.run.dir=cut"]
    run_until(2, *words, *pieces)
    one = ["study.shard_size=1", "study.batch_size=2", "device.threads=2", "study.workers=1", "hydra.run.dir=cut"]
    run_until(1, *words, *one)
    names = sorted(path.name for path in (tmp_path / "cut" / "shards").iterdir())
    assert names == ["gco-000000-000001.npz", "gco-000002-000003.npz", "gco-000004-000004.npz"]
    assert run(*words, "study.shard_size=5", "study.workers=2", "hydra.run.dir=cut")[0] == 0
    whole, cut = (pd.read_parquet(tmp_path / name / "trials.parquet") for name in ("whole", "cut"))
    pd.testing.assert_frame_equal(whole.drop(columns=HOW), cut.drop(columns=HOW), check_exact=True)
    assert cut["threads"].tolist()[:5] == [1, 1, 1, 1, 2] and cut["batch_size"].tolist()[:5] == [1] * 5
    controls = [np.load(tmp_path / name / "solutions.npz")["U"] for name in ("whole", "cut")]
    assert controls[0].shape == (3, 7, 12, 4) and controls[0].tobytes() == controls[1].tobytes()
    code, out, _ = run(*words, "study.shard_size=3", "study.workers=1", "hydra.run.dir=cut")
    assert code == 0 and "nothing was flown again" in out


@pytest.mark.usefixtures("without_report")
def test_the_default_folder_does_not_depend_on_the_pieces(run, tmp_path) -> None:
    for words in ([], ["study.shard_size=3", "study.batch_size=1", "device.threads=2"]):
        assert run(*HOLD, *words)[0] == 0
    assert len(list((tmp_path / "outputs").iterdir())) == 1


@pytest.mark.slow
@pytest.mark.usefixtures("without_report")
def test_batch_size_is_how_many_ran_together(run, tmp_path) -> None:
    words = ["solver=al_ilqr", "study.layouts=5", TINY[1], "study.batch_size=4", "study.workers=1"]
    one = "solver.max_outer_iterations=1"  # the first four end in the same pass
    assert run(*words, one, "study.baselines=[hold,multistart,fatrop]", "hydra.run.dir=out")[0] == 0
    trials = pd.read_parquet(tmp_path / "out" / "trials.parquet")
    assert trials.groupby("solver")["batch_size"].agg(list).to_dict() == {
        "al_ilqr": [4, 4, 4, 4, 1],
        "hold": [5] * 5,  # all in one call
        "multistart": [4, 4, 4, 4, 1],
        "fatrop": [1] * 5,  # one after the other
    }


@pytest.mark.usefixtures("without_report")
def test_batch_size_counts_those_that_take_a_freed_slot(run, tmp_path, monkeypatch) -> None:
    passes = []

    def step(self, state, real=OuterLoop.advance):
        passes.append(state.rows.tolist())
        return real(self, state)

    monkeypatch.setattr(OuterLoop, "advance", step)
    words = ["solver=al_ilqr", "study.layouts=7", "scenario.stages=50", "study.batch_size=3", "study.workers=1"]
    words += ["solver.inner.as_printed=false"]  # which ends problems early
    assert run(*words, "solver.inner.tolerance=1e-3", "study.baselines=[]", "hydra.run.dir=out")[0] == 0
    want = [max(len(rows) for rows in passes if b in rows) for b in range(7)]
    assert pd.read_parquet(tmp_path / "out" / "trials.parquet")["batch_size"].tolist() == want
    assert want[:3] == [3] * 3 and [0, 1, 2] in passes and any(0 < len(set(rows) & {0, 1, 2}) < 3 for rows in passes)


@pytest.mark.usefixtures("without_report")
def test_out_of_memory_reaches_a_wrapped_solver(run, tmp_path, monkeypatch) -> None:
    seen = []

    def outer_loop(self, call, *rest, real=AugmentedLagrangian.outer_loop):
        seen.append(self.slots)
        if self.slots > 1:
            raise torch.OutOfMemoryError("no more")
        return real(self, call, *rest)

    monkeypatch.setattr(AugmentedLagrangian, "outer_loop", outer_loop)
    words = ["solver=multistart", "solver.starts=1", "solver.local.max_outer_iterations=1", "scenario.stages=5"]
    code, _, err = run(*words, "study.layouts=4", "study.baselines=[]", "study.workers=1", "hydra.run.dir=out")
    assert code == 0 and seen == [4, 2, 1] and "on with 1 problems at once" in err
    assert (pd.read_parquet(tmp_path / "out" / "trials.parquet")["batch_size"] == 1).all()
    assert MultiStart().local.slots is None


@pytest.fixture
def filed(tmp_path):
    """Arguments of a study of a layout file, and a function that writes best costs into the file."""

    def save(*best: float) -> None:
        start, goal = np.array([-1.0, 0, 0, 0, 0, 0]), np.array([-0.9, 0, 0, 0, 0, 0])
        held = Layouts(np.full((2, 1, 2), 3.0), np.full((2, 1), 0.1), start=start, goal=goal, best_cost=np.array(best))
        held.save(tmp_path / "two.npz")

    words = ["scenario=layouts", "scenario.path=two.npz", "model=planar", *HOLD[:2], "study.workers=1"]
    return [*words, "hydra.run.dir=out"], save


@pytest.mark.slow
def test_success_follows_the_best_costs_of_the_file(run, filed, tmp_path) -> None:
    words, save = filed
    save(1e6, 1e6)
    assert run(*words)[0] == 0
    out = tmp_path / "out"
    first = pd.read_parquet(out / "trials.parquet")
    assert first["success"].all() and set(first["best_from"]) == {"file"}
    picture = (out / "figures" / "rates.png").read_bytes()
    save(1e6, 1e-6)
    code, text, _ = run(*words)
    assert code == 0 and "nothing was flown again" in text and "computed again" in text
    again = pd.read_parquet(out / "trials.parquet")
    assert again["success"].tolist() == [True, False] and again["best_cost"].tolist() == [1e6, 1e-6]
    assert pd.read_csv(out / "summary.csv")["success_count"].tolist() == [1]
    assert (out / "figures" / "rates.png").read_bytes() != picture
    assert np.load(out / "layouts.npz")["best_cost"].tolist() == [1e6, 1e-6]
    judged = ["success", "best_cost"]
    pd.testing.assert_frame_equal(first.drop(columns=judged), again.drop(columns=judged), check_exact=True)
    before = contents(out)["trials.parquet"]
    code, text, _ = run(*words)
    assert code == 0 and "computed again" not in text and contents(out)["trials.parquet"] == before


@pytest.mark.slow
@pytest.mark.usefixtures("without_report")
def test_a_stop_while_success_is_computed_again_damages_nothing(run, filed, tmp_path, monkeypatch) -> None:
    words, save = filed
    save(1e6, 1e6)
    assert run(*words)[0] == 0
    save(1e6, 1e-6)

    def close(self) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(StudyFolder, "close", close)
        assert run(*words)[0] == 130
    code, _, err = run(*words)
    assert code == 0, err
    assert pd.read_parquet(tmp_path / "out" / "trials.parquet")["success"].tolist() == [True, False]
