"""`study.explain`: what happened to the layouts that the solver failed on."""

from __future__ import annotations

import pandas as pd
import pytest

from tests.experiments.commands import HOLD, TINY, problem_line
from torchgco.experiments.reports import explained


def test_failed_layouts_are_explained_also_of_a_finished_study(run, tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(explained, "EXPLAINED", 3)
    words = [*HOLD, "study.figures=false", "hydra.run.dir=out"]
    code, plain, _ = run(*words)
    assert code == 0 and "Why it ended" not in plain
    code, out, err = run(*words, "study.explain=true")
    assert code == 0 and "Already done" in out, err
    trials = pd.read_parquet(tmp_path / "out" / "trials.parquet")
    assert not trials.reached.any()
    assert "hold failed on 4 of 4 layouts, the first 3 of them here." in out
    for number in range(3):
        assert f"Layout {number}, solved by hold: {trials.status[number]}.\nResult:" in out
    assert "Layout 3, solved" not in out and out.count("goal not reached") == 3


def test_a_search_is_told_and_has_the_results_of_the_study(run, tmp_path) -> None:
    code, out, err = run(*TINY, "study.baselines=[]", "study.figures=false", "study.explain=true", "hydra.run.dir=out")
    assert code == 0, err
    trials = pd.read_parquet(tmp_path / "out" / "trials.parquet")
    failed = trials[~trials.reached]
    assert len(failed) > 0 and out.count("Passes:") == len(failed)
    for row in failed.itertuples():
        part = out.partition(f"Layout {row.layout}, solved by gco: {row.status}.")[2].partition("\nLayout")[0]
        assert f"after {row.iterations} iterations" in part


def test_missions_are_refused(run) -> None:
    code, _, err = run("experiment=mission", "study.explain=true")
    assert code == 2 and "study.explain: expected false in missions" in problem_line(err)
