"""The command with missions: files, columns, one line per mission or a table, resuming, and bad input."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation
from torch import Tensor
from tqdm import tqdm

from tests.experiments.commands import problem_line
from tests.trials import missions
from tests.trials import trials as hand_made
from torchgco.experiments.flying import progress, workers
from torchgco.experiments.reports import report
from torchgco.experiments.reports.verify import verify
from torchgco.experiments.results.kinds import mission_lines
from torchgco.missions import RotorPlant
from torchgco.plotting import missions as draw

SHORT = ["mission.duration=0.2", "scenario.num_obstacles=3", "study.workers=1", "hydra.run.dir=out"]
OWN = [
    "outcome", "flight_time", "energy", "missed_deadlines", "shifted_plans", "planner_seconds_median",
    "planner_seconds_p99", "tracker_seconds_median", "tracking_violation",
]  # fmt: skip
CLOCK = ["seconds", "planner_seconds_median", "planner_seconds_p99", "tracker_seconds_median", "missed_deadlines"]


def trials(folder: Path) -> pd.DataFrame:
    return pd.read_parquet(folder / "out" / "trials.parquet")


def test_one_mission_writes_log_figures_and_animation(run, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(workers, "tqdm", partial(tqdm, mininterval=0))
    monkeypatch.setattr(progress, "watched", lambda: True)
    code, out, err = run("experiment=mission", *SHORT)
    assert code == 0 and "forest 0, gco: TIMEOUT after 0.20 s" in out
    assert "t = 0.1 of 0.2 s" in err and "step=" not in err and " 50%|" in err
    assert err.index("drawing 7 figures") > err.index("t = 0.2 of 0.2 s")
    table, log = trials(tmp_path), pd.read_parquet(tmp_path / "out" / "mission.parquet")
    assert set(OWN) <= set(table.columns) and table["status"].tolist() == ["TIMEOUT"] and not table["reached"].any()
    assert log["step"].tolist() == [0, 1, 2, 3] and np.allclose(log["t"], [0.0, 0.05, 0.1, 0.15])
    wanted = [*(f"x{i}" for i in range(17)), "f1", "f4", "clearance", "planner_seconds", "tracker_seconds", "source"]
    assert set(wanted) <= set(log.columns) and log["source"].isin(["solved", "shifted"]).all()
    assert log.loc[0, ["x0", "x1", "x2"]].tolist() == [1.0, 1.0, 0.0]
    figures = {path.name for path in (tmp_path / "out" / "figures").iterdir()}
    assert {"0-compute.png", "0-distance.png", "0-gco-snapshots.png", "0-gco.gif"} <= figures
    assert "outcomes.png" not in figures, "a bar of one mission says nothing"
    code, out, _ = run("experiment=mission", *SHORT)
    assert code == 0 and "Already done" in out and "TIMEOUT after 0.20 s" in out


@pytest.fixture
def few_figures(monkeypatch) -> None:
    """No animation, and empty figures of what has no place: the first test draws them all, for most of its time."""
    monkeypatch.setattr(report, "mission_animation", lambda *_: None)
    for name in ("compute", "commands", "states", "tracking"):
        monkeypatch.setattr(draw, f"{name}_figure", lambda *_: Figure())


@pytest.mark.slow
@pytest.mark.usefixtures("few_figures")
def test_a_mission_with_a_footprint_is_drawn_and_verified_with_it(run, tmp_path) -> None:
    """The command's own judge: a flat body beside a sphere, which it touches unless it is turned, as by hand."""
    body = ["+model.vehicle.footprint=[[-0.3,-0.3,-0.1],[0.3,0.3,0.1]]", "+model.vehicle.cells=[2,2,1]"]
    assert run("experiment=mission", *SHORT, *body)[0] == 0
    log, held = pd.read_parquet(tmp_path / "out" / "mission.parquet"), np.load(tmp_path / "out" / "layouts.npz")
    corners = np.array([[a, b, 0.0] for a in (-0.15, 0.15) for b in (-0.15, 0.15)])
    turns = Rotation.from_quat(log[["x7", "x8", "x9", "x6"]].to_numpy())
    places = log[["x0", "x1", "x2"]].to_numpy()[:, None] + np.stack([turns.apply(c) for c in corners], axis=1)
    away = np.linalg.norm(places[:, :, None] - held["centers"][0], axis=-1) - 0.95 * held["radii"][0]
    assert np.allclose(log["clearance"], np.nanmin(away, axis=(1, 2)) - 0.5 * np.linalg.norm([0.3, 0.3, 0.2]))
    assert (tmp_path / "out" / "figures" / "0-distance.png").exists()
    (verified,), _ = verify([tmp_path / "out"])
    assert not verified.differs


@pytest.mark.slow
@pytest.mark.usefixtures("few_figures")
def test_the_figures_show_all_commands(run, tmp_path, monkeypatch) -> None:
    seen = {}
    for name in ("commands", "states", "distance"):
        monkeypatch.setattr(draw, f"{name}_figure", lambda frame, *_, name=name: seen.update({name: frame}) or Figure())
    assert run("experiment=mission", *SHORT)[0] == 0
    fine = pd.read_parquet(tmp_path / "out" / "time_steps.parquet").drop(columns="solver")
    assert np.allclose(fine["t"], 0.01 * np.arange(21))
    for frame in (seen["commands"], seen["states"], seen["distance"]["gco"]):
        pd.testing.assert_frame_equal(frame.drop(columns="solver"), fine)
    log = pd.read_parquet(tmp_path / "out" / "mission.parquet")
    for i in range(1, 5):
        by_step = fine[f"u{i}"][:20].groupby(np.arange(20) // 5)
        assert (
            by_step.min().tolist() == log[f"u{i}_low"].tolist() and by_step.max().tolist() == log[f"u{i}_high"].tolist()
        )


@pytest.mark.slow
def test_missions_fly_without_figures_which_are_drawn_when_asked_for(run, tmp_path) -> None:
    words = ["experiment=mission", *SHORT]
    code, out, err = run(*words, "study.figures=false")
    assert code == 0 and "TIMEOUT" in out and "drawing" not in err and not (tmp_path / "out" / "figures").exists()
    code, out, _ = run(*words)
    assert code == 0 and "Already done" in out and (tmp_path / "out" / "figures" / "0-gco-commands.png").exists()
    code, _, err = run(*words, "study.figures=some")
    assert code == 2 and "study.figures: expected true or false, got 'some'" in problem_line(err)


@pytest.mark.slow
def test_times_of_a_batch_are_not_printed_as_latencies(run) -> None:
    code, out, _ = run("experiment=mission", *SHORT, "study.layouts=2", "study.figures=false")
    lines = out.splitlines()[:2]
    assert code == 0 and all(" per mission of a batch of 2. " in line and "deadline" not in line for line in lines)
    words = ["experiment=mission_study", *SHORT[:-1], "study.layouts=5", "study.baselines=[]", "study.figures=false"]
    code, out, _ = run(*words, "hydra.run.dir=five")
    head = next(line.split() for line in out.splitlines() if "flight time" in line)
    assert code == 0 and "divided by its missions" in out and head[-3:-1] == ["missed", "kept"]
    cells = out.splitlines()[[line.split() for line in out.splitlines()].index(head) + 1].split()
    assert cells[-2] == "-" and cells[4] == "5", "no deadlines, and five at once"


@pytest.mark.parametrize(("missed", "text"), [(0, "0 missed deadlines of 4"), (1, "1 missed deadline of 4")])
def test_a_mission_alone_has_its_deadlines_and_both_times(missed: int, text: str) -> None:
    row = missions("gco", "R", missed_deadlines=missed, outer_iterations=4)
    line = mission_lines(hand_made(*row))
    assert f"planner 12 ms (99 %: 25 ms) and tracker 7 ms per control period, {text}. " in line


@pytest.mark.slow
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
    assert run(*words, "hydra.run.dir=whole", "study.figures=false")[0] == 0
    whole = pd.read_parquet(tmp_path / "whole" / "trials.parquet")
    others = [name for name in table.columns if name not in (*CLOCK, "batch_size")]
    pd.testing.assert_frame_equal(table[others], whole[others], check_exact=True)


def test_a_start_in_contact_is_a_collision_and_the_others_fly(run, tmp_path) -> None:
    centers = np.array([[[-0.8, 1.0, 0.0]], [[9.0, 9.0, 0.0]]])
    np.savez(tmp_path / "two.npz", centers=centers, radii=np.full((2, 1), 0.6), vehicle_radius=0.36)
    words = ["scenario=layouts", f"scenario.path={tmp_path / 'two.npz'}"]
    code, out, _ = run("experiment=mission_study", *words, "mission.duration=0.1", "study.figures=false", *SHORT[2:])
    assert code == 0 and "two 0, gco: COLLISION after 0.00 s" in out and "no plan made" in out and "nan" not in out
    assert trials(tmp_path)["outcome"].tolist()[:2] == ["COLLISION", "TIMEOUT"]


@pytest.mark.sampled(2)
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


@pytest.mark.parametrize("experiment", ["mission", "mission_study"])
@pytest.mark.parametrize(
    "words",
    [
        ["scenario=woods", "scenario.density=0.05", "scenario.stages=60"],
        ["scenario=mazes", "scenario.walls=1", "scenario.loose=2", "scenario.stages=60"],
    ],
    ids=["woods", "mazes"],
)
@pytest.mark.slow
def test_missions_fly_through_woods_and_mazes(run, tmp_path, experiment: str, words: list[str]) -> None:
    several = experiment == "mission_study"  # whose figures are those of each mission, drawn for the other experiment
    layouts = ["study.layouts=1", "study.baselines=[al_ilqr]", "study.figures=false"] if several else []
    short = [*words, "mission.duration=0.1", "study.workers=1", "hydra.run.dir=out"]
    code, out, _ = run(f"experiment={experiment}", *short, *layouts)
    assert code == 0 and f"{words[0].partition('=')[2]} 0, gco: TIMEOUT after 0.10 s" in out
    table, log = trials(tmp_path), pd.read_parquet(tmp_path / "out" / "mission.parquet")
    assert (table["clearance"] > 0).all() and np.isfinite(table["clearance_knots"]).all()
    nearest = log.groupby("solver", sort=False)["clearance"].min()
    assert nearest.tolist() == pytest.approx(table["clearance_knots"].tolist())
    assert (tmp_path / "out" / "figures" / "0-gco.gif").exists() != several
    verified, unfinished = verify([tmp_path / "out"])
    assert not unfinished and not any(study.differs for study in verified)


def test_a_plant_needs_a_mission(run) -> None:
    code, _, err = run("plant=rotors", "hydra.run.dir=out")
    assert code == 2 and "experiment=mission" in problem_line(err)


@dataclass(frozen=True)
class OfFile(RotorPlant):
    """A plant whose mass lies in a file."""

    model: str = ""

    def advance(self, x: Tensor, u: Tensor, force: Tensor) -> Tensor:
        return RotorPlant(self.airframe, self.dt, float(Path(self.model).read_text())).advance(x, u, force)


@pytest.mark.slow
def test_what_a_plants_file_says_belongs_to_the_study(run, tmp_path) -> None:
    (tmp_path / "plant").mkdir()
    (tmp_path / "plant" / "mine.yaml").write_text(f"_target_: {__name__}.OfFile\nmodel: mass.txt\n")
    words = ["--config-dir", str(tmp_path), "experiment=mission_study", "plant=mine", "study.layouts=1"]
    words += ["mission.duration=0.05", "study.baselines=[]", "study.figures=false", *SHORT[1:]]
    (tmp_path / "mass.txt").write_text("0.1")
    assert run(*words)[0] == 0
    assert "nothing was flown again" in run(*words)[1]
    (tmp_path / "mass.txt").write_text("0.2")
    code, _, err = run(*words)
    assert code == 2 and "files.mass.txt is" in problem_line(err)
    (tmp_path / "mass.txt").unlink()  # what was flown is confirmed without it
    verified, unfinished = verify([tmp_path / "out"], trust=True)
    assert not unfinished and not any(one.differs for one in verified)


@pytest.mark.slow
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
    text = capsys.readouterr().out
    assert merged["layout_digest"].nunique() == 6 and "wind" in text
    (tmp_path / "report" / "summary.csv").unlink()
    single = ["study.layouts=2", "solver=hold", "study.baselines=[]", "scenario.num_obstacles=3", "study.figures=false"]
    assert run(*single, "study.workers=1", "hydra.run.dir=all/single")[0] == 0
    assert report.main([str(tmp_path / "all"), "--output", str(tmp_path / "report")]) == 0
    both = capsys.readouterr().out
    assert text.split("written to")[0].rstrip() in both, "the missions are reported as without the trajectories"
    assert "hydra.run.dir" not in both and "forest (quadrotor), seed 0" in both
