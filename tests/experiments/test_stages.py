"""Studies of layouts with numbers of stages of their own: each is flown as it is alone, and all files agree."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from torchgco import judge
from torchgco.baselines import PathPursuit
from torchgco.experiments.config.build import compose
from torchgco.experiments.reports.report import main
from torchgco.scenarios import Layouts, Vehicle

WORDS = [
    "scenario=floors", "scenario.size=[9,7]", "scenario.apart=4", "scenario.tracks=0.5", "seed=2", "study.layouts=4",
]  # fmt: skip


@pytest.mark.slow
def test_each_layout_is_flown_as_it_is_alone(run, tmp_path: Path, capsys) -> None:
    words = [*WORDS, "solver=path_pursuit", "study.baselines=[hold]", "study.shard_size=2", "study.workers=1"]
    code, _, err = run(*words, "study.view=true", "hydra.run.dir=out")
    assert code == 0, err
    folder = tmp_path / "out"
    layouts, rows = Layouts.load(folder / "layouts.npz"), pd.read_parquet(folder / "trials.parquet")
    assert isinstance(layouts.stages, np.ndarray) and len(np.unique(layouts.stages)) > 1
    with np.load(folder / "solutions.npz") as held:
        U = held["U"]
    assert U.shape == (2, 4, layouts.stages.max(), 2)
    setup = compose(WORDS)
    for i, stages in enumerate(layouts.stages.tolist()):
        task = setup.task(layouts.take([i]))
        assert stages == task.problem.N and task.problem.horizon is None
        alone = PathPursuit().solve(task.problem, task.U0)
        assert np.array_equal(alone.U[0].numpy(), U[0, i, :stages]) and not U[0, i, stages:].any()
        row = rows[(rows["solver"] == "path_pursuit") & (rows["layout"] == i)].iloc[0]
        assert row["cost"] == float(judge(task.problem, alone.U).cost)
    padded = judge(setup.task(layouts).problem, torch.from_numpy(U[0]))
    own = rows[rows["solver"] == "path_pursuit"]
    np.testing.assert_allclose(padded.cost.numpy(), own["cost"].to_numpy(), rtol=1e-12)
    np.testing.assert_array_equal(padded.reached.numpy(), own["reached"].to_numpy(dtype=bool))
    assert main(["--verify", str(folder)]) == 0
    assert capsys.readouterr().out.startswith("8 rows confirmed")


def test_failures_are_explained_layout_by_layout(run, tmp_path: Path) -> None:
    words = [*WORDS, "solver=interior_point", "study.baselines=[]", "study.explain=true", "study.figures=false"]
    code, out, err = run(*words, "study.workers=1", "hydra.run.dir=out")
    assert code == 0, err
    assert "interior_point failed on" in out and out.count("Layout ") >= 2


def test_a_study_makes_its_problems_once(run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two solvers, the judge, pictures and advice share those of layouts with as many stages."""
    made, task = [], Vehicle.task
    monkeypatch.setattr(Vehicle, "task", lambda *words: made.append(words[1].count) or task(*words))
    words = [*WORDS, "solver=path_pursuit", "study.baselines=[hold]", "study.workers=1", "hydra.run.dir=out"]
    code, _, err = run(*words)
    assert code == 0, err
    layouts = compose(WORDS).layouts()
    assert sorted(made) == sorted(len(group) for group in layouts.alike()) and len(made) > 1
