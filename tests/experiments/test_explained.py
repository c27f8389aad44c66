"""`study.explain`: what happened to the layouts that the solver failed on."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from tests.experiments.commands import HOLD, TINY, problem_line
from torchgco.experiments.flying import study


@pytest.mark.slow
def test_failed_layouts_are_explained_also_of_a_finished_study(run, tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "EXPLAINED", 3)
    words = [*HOLD, "study.figures=false", "hydra.run.dir=out"]
    code, plain, _ = run(*words)
    assert code == 0 and "Why it ended" not in plain
    assert "hold did not reach 4 of 4 goals, the first 3 of them here. What to try:" in plain
    assert 'layouts 0, 1, 2: solver="gco", the default' in plain and "study.explain=true tells" in plain
    code, out, err = run(*words, "study.explain=true")
    assert code == 0 and "Already done" in out, err
    trials = pd.read_parquet(tmp_path / "out" / "trials.parquet")
    assert not trials.reached.any()
    assert "hold failed on 4 of 4 layouts, the first 3 of them here." in out
    for number in range(3):
        assert f"Layout {number}, solved by hold: {trials.status[number]}.\nResult:" in out
    assert "Layout 3, solved" not in out and out.count("goal not reached") == 3


@pytest.mark.slow
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


def map_file(folder, unknown: bool) -> list[str]:
    """A room with a door of 0.4 m, and the words of a study through it."""
    cells = np.zeros((100, 60), np.float32)
    cells[0] = cells[-1] = cells[:, 0] = cells[:, -1] = cells[50] = 1
    cells[50, 28:32] = 0
    if unknown:
        cells[10:30, 20:40] = np.nan
    np.savez(folder / "room.npz", occupied=cells, origin=[0.0, 0.0], resolution=0.1)
    where = ["scenario=map", "scenario.path=room.npz", "scenario.start=[2,3]", "scenario.goal=[8,3]", "model=unicycle"]
    return [*where, "study.layouts=1", "solver=hold", "study.baselines=[]", "study.figures=false"]


def test_a_door_that_is_too_narrow_is_told_after_the_table(run, tmp_path) -> None:
    code, out, err = run(*map_file(tmp_path, False), "scenario.vehicle_radius=0.3")
    told = " ".join(out.split())
    assert code == 0 and "the widest has room for 0.2 m" in told, err
    assert "a vehicle_radius of at most 0.2 m" in told and "layout 0: A goal on the start's side" in told


def test_a_start_in_unknown_cells_names_the_option(run, tmp_path) -> None:
    code, _, err = run(*map_file(tmp_path, True), "scenario.vehicle_radius=0.15")
    assert code == 2 and "or scenario.unknown=free, as unknown cells count as occupied" in problem_line(err)
