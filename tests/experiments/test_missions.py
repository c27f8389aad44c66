"""The command with missions: files, columns, one line per mission or a table, resuming, and bad input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.experiments.commands import problem_line
from torchgco import compose, presets
from torchgco.experiments import report
from torchgco.simulation import Mission, Planner

SHORT = ["mission.duration=0.2", "scenario.num_obstacles=3", "study.workers=1", "hydra.run.dir=out"]
OWN = [
    "outcome", "flight_time", "energy", "missed_deadlines", "shifted_plans", "planner_seconds_median",
    "planner_seconds_p99", "tracker_seconds_median", "tracking_violation",
]  # fmt: skip
CLOCK = ["seconds", "planner_seconds_median", "planner_seconds_p99", "tracker_seconds_median", "missed_deadlines"]


def trials(folder: Path) -> pd.DataFrame:
    return pd.read_parquet(folder / "out" / "trials.parquet")


def test_one_mission_writes_log_figures_and_animation(run, tmp_path) -> None:
    code, out, _ = run("experiment=mission", *SHORT)
    assert code == 0 and "forest 0, gco: TIMEOUT after 0.20 s" in out
    table, log = trials(tmp_path), pd.read_parquet(tmp_path / "out" / "mission.parquet")
    assert set(OWN) <= set(table.columns) and table["status"].tolist() == ["TIMEOUT"] and not table["reached"].any()
    assert log["step"].tolist() == [0, 1, 2, 3] and np.allclose(log["t"], [0.0, 0.05, 0.1, 0.15])
    wanted = [*(f"x{i}" for i in range(17)), "f1", "f4", "clearance", "planner_seconds", "tracker_seconds", "source"]
    assert set(wanted) <= set(log.columns) and log["source"].isin(["solved", "shifted"]).all()
    assert log.loc[0, ["x0", "x1", "x2"]].tolist() == [1.0, 1.0, 0.0]
    figures = {path.name for path in (tmp_path / "out" / "figures").iterdir()}
    assert {"outcomes.png", "0-compute.png", "0-distance.png", "0-gco-snapshots.png", "0-gco.gif"} <= figures
    code, out, _ = run("experiment=mission", *SHORT)
    assert code == 0 and "Already done" in out and "TIMEOUT after 0.20 s" in out


def test_a_study_of_missions_compares_planners_and_is_cut_as_one_likes(run, tmp_path) -> None:
    words = ["experiment=mission_study", *SHORT[:3], "study.layouts=5"]
    code, out, _ = run(*words, "study.shard_size=2", "hydra.run.dir=out")
    assert code == 0 and "gco - al_ilqr" in out
    first = next(line for line in out.splitlines() if line.startswith("gco  "))
    assert first.split()[:2] == ["gco", "5"]
    table = trials(tmp_path)
    assert table.groupby("solver", sort=False).size().to_dict() == {"gco": 5, "al_ilqr": 5}
    assert table["success"].isna().all() and (tmp_path / "out" / "figures" / "outcomes.png").exists()
    assert not (tmp_path / "out" / "plans.npz").exists()
    assert run(*words, "hydra.run.dir=whole")[0] == 0
    whole = pd.read_parquet(tmp_path / "whole" / "trials.parquet")
    others = [name for name in table.columns if name not in (*CLOCK, "batch_size")]
    pd.testing.assert_frame_equal(table[others], whole[others], check_exact=True)


def test_a_start_in_contact_is_a_collision_and_the_others_fly(run, tmp_path) -> None:
    centers = np.array([[[-0.8, 1.0, 0.0]], [[9.0, 9.0, 0.0]]])
    np.savez(tmp_path / "two.npz", centers=centers, radii=np.full((2, 1), 0.6), vehicle_radius=0.36)
    words = ["scenario=layouts", f"scenario.path={tmp_path / 'two.npz'}", "~scenario.start"]
    code, out, _ = run("experiment=mission_study", *words, "mission.duration=0.1", "study.layouts=2", *SHORT[2:])
    assert code == 0, out
    assert trials(tmp_path)["outcome"].tolist()[:2] == ["COLLISION", "TIMEOUT"]


@pytest.mark.parametrize(
    ("words", "field"),
    [
        (["mission.latency=2"], "mission.latency"), (["mission.duration=0"], "mission.duration"),
        (["mission.planner.margin=-1"], "planner.margin"), (["mission.tracker.stages=0"], "tracker.stages"),
        (["mission.disturbance.wind=-1"], "disturbance.wind"), (["plant.mass_error=-1"], "plant.mass_error"),
        (["scenario.dt=0.033"], "scenario.dt"), (["device.dtype=float32"], "device"),
        (["mission.planner.max_seconds=0"], "planner.max_seconds"), (["+plant.wheels=4"], "plant"),
    ],
)  # fmt: skip
def test_bad_missions_are_refused_in_one_line(run, tmp_path, words: list[str], field: str) -> None:
    code, _, err = run("experiment=mission", *SHORT, *words)
    assert code == 2 and field in problem_line(err)
    assert not (tmp_path / "out" / "study.json").exists()


def test_a_plant_needs_a_mission(run) -> None:
    code, _, err = run("plant=rotors", "hydra.run.dir=out")
    assert code == 2 and "experiment=mission" in problem_line(err)


def test_a_sweep_over_missions_becomes_columns_of_one_report(run, tmp_path, capsys) -> None:
    words = ["experiment=mission_study", *SHORT[:3], "study.layouts=2", "study.baselines=[]"]
    for wind in (0.0, 1.0):
        assert run(*words, f"mission.disturbance.wind={wind}", f"hydra.run.dir=all/{wind}")[0] == 0
    assert run(*words, "plant.drag=0.5", "hydra.run.dir=all/drag")[0] == 0
    assert report.main([str(tmp_path / "all"), "--output", str(tmp_path / "report")]) == 0
    merged = pd.read_parquet(tmp_path / "report" / "trials.parquet")
    assert merged.groupby(["mission.disturbance.wind", "plant.drag"]).size().to_dict() == {
        (0.0, 0.0): 2, (0.0, 0.5): 2, (1.0, 0.0): 2,
    }  # fmt: skip
    assert merged["layout_digest"].nunique() == 6 and "wind" in capsys.readouterr().out


def test_the_configuration_has_the_defaults_of_the_classes() -> None:
    assert compose(["experiment=mission"]).mission == Mission(Planner(presets.gco(3)))
