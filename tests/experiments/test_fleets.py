"""Studies of fleets: flown, stopped and resumed, confirmed, drawn, exported and shown; and what they refuse."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from tests.experiments.commands import problem_line
from tests.view.test_packing import part
from torchgco import Layouts, compose, read, solve
from torchgco.experiments.reports.export import write_export
from torchgco.experiments.reports.verify import confirmed_text, verify_study
from torchgco.experiments.reports.view import main as view
from torchgco.experiments.statistics.statistics import summarise

WORDS = ["experiment=fleet", "scenario.vehicles=3", "study.layouts=3", "study.workers=1"]


def test_a_study_of_fleets(run, run_until, tmp_path) -> None:
    """Stopped after a fleet, and gone on with: the rows are those of `solve`, by the stored controls too."""
    run_until(1, *WORDS, "study.shard_size=1", "hydra.run.dir=out")
    code, out, err = run(*WORDS, "study.shard_size=2", "study.view=true", "hydra.run.dir=out")
    assert code == 0, err
    assert "out: 1 of 3 trials were flown before." in out and "3/3 100 %" in out and "makespan" in out
    folder = tmp_path / "out"
    trials, rows = (pd.read_parquet(folder / f"{name}.parquet") for name in ("trials", "vehicles"))
    assert trials["reached"].all() and (trials["least_distance"] >= 0.95 * 0.4).all()
    assert (trials["vehicles"] == 3).all() and (trials["makespan"] < 6.0).all() and trials["success"].isna().all()
    assert len(rows) == 9 and rows["apart"].all() and rows["reached"].all()
    np.testing.assert_allclose(rows.groupby("layout")["cost"].sum(), trials["cost"])
    setup = compose([*WORDS[:2], "solver=gco"])
    found = solve(setup.fleet(setup.layouts(3)))
    with np.load(folder / "solutions.npz") as held:
        np.testing.assert_array_equal(held["U"][0], torch.cat([one.U for one in found], dim=-1).numpy())
    confirmed = verify_study(folder)
    assert not confirmed.differs and "9 rows of vehicles.parquet confirmed" in confirmed_text([confirmed])
    _check_that_changes_of_vehicles_show(folder, rows)
    files = [path.name for path in write_export(folder, layouts=[1])]
    assert files == ["gco-1-0.csv", "gco-1-1.csv", "gco-1-2.csv"]
    table = pd.read_csv(folder / "export" / files[2])
    np.testing.assert_allclose(table["x [m]"], found[2].X[1, :, 0], atol=1e-9)
    pictures = {path.name for path in (folder / "figures").iterdir()}
    assert {"rates.png", "fleet_circle-0.png", "fleet_circle-2.gif"} <= pictures
    page = (folder / "view.html").read_text()
    assert [one["name"] for one in part(page, "head")["solvers"]] == ["vehicle 0", "vehicle 1", "vehicle 2"]
    assert run(*WORDS, "hydra.run.dir=out")[1].startswith("Already done")


def _check_that_changes_of_vehicles_show(folder: Path, rows: pd.DataFrame) -> None:
    """They passed as confirmed: no one looked at this table."""
    path, random = folder / "vehicles.parquet", np.random.default_rng(0)
    for name in rows.columns:
        changed, i = rows.copy(), random.integers(len(rows))
        others = {"b": not changed[name].iloc[i], "i": 7, "f": 0.5}
        changed.loc[i, name] = others.get(changed[name].dtype.kind, "al_ilqr")
        changed.to_parquet(path, index=False)
        verified = verify_study(folder)
        assert verified.differs and f"{path}: 1 value differs in 9 rows" in confirmed_text([verified])
    rows.iloc[1:].to_parquet(path, index=False)
    assert verify_study(folder).differs
    path.unlink()
    assert f"not confirmed: {path}, which is missing" in confirmed_text([verify_study(folder)])
    rows.to_parquet(path, index=False)


@pytest.mark.slow
def test_rates_over_the_number_of_vehicles(run, tmp_path) -> None:
    words = [WORDS[0], "scenario=fleet_door", "study.layouts=1", "study.workers=1", "study.figures=false"]
    code, _, err = run("-m", *words, "scenario.vehicles=2,3")
    assert code == 0, err
    report = summarise(read(tmp_path / "outputs"))
    assert report["scenario.vehicles"].tolist() == [2, 3] and report["reached_rate"].tolist() == [1.0, 1.0]
    assert {"reached_low", "reached_high", "makespan_median", "makespan_p90"} <= set(report)


def test_a_file_of_fleets(run, tmp_path) -> None:
    """Layouts of a file, in which start and goal have a row for each vehicle, and a disc stands in the middle."""
    starts = np.array([[-2.0, 0.0], [2.0, 0.1], [0.0, -2.0]])
    drawn = Layouts(np.zeros((1, 1, 2)), np.full((1, 1), 0.3), start=starts, goal=-starts, apart=0.4, dt=0.1, stages=60)
    drawn.save(tmp_path / "mine.npz")
    assert Layouts.load(tmp_path / "mine.npz") == drawn.__class__(**{**vars(drawn), "name": "mine"})
    words = ["scenario=layouts", "scenario.path=mine.npz", "model=disc", "study.figures=false", "study.workers=1"]
    code, out, err = run(*words, "study.baselines=[]", "hydra.run.dir=out")
    assert code == 0 and "1/1 100 %" in out, err


def test_a_fleet_that_starts_badly_is_a_row_of_its_own(run, tmp_path) -> None:
    """The others are solved as without it; where no fleet starts well the study says what it needs."""
    starts = np.array([[[-2.0, 0.0], [2.0, 0.1]], [[-2.0, 0.0], [-1.8, 0.1]], [[0.0, -2.0], [0.1, 2.0]]])
    none = {"centers": np.zeros((3, 0, 2)), "radii": np.zeros((3, 0))}
    drawn = Layouts(**none, start=starts, goal=-starts, apart=0.4, dt=0.1, stages=60)
    for name, rows in (("mine", [0, 1, 2]), ("bad", [1]), ("good", [0, 2])):
        drawn.take(rows).save(tmp_path / f"{name}.npz")
    words = ["scenario=layouts", "model=disc", "study.figures=false", "study.workers=1", "study.baselines=[]"]
    assert run(*words, "scenario.path=mine.npz", "hydra.run.dir=mine")[0] == 0
    assert run(*words, "scenario.path=good.npz", "hydra.run.dir=good")[0] == 0
    trials, others = (pd.read_parquet(tmp_path / name / "trials.parquet") for name in ("mine", "good"))
    assert trials["reached"].tolist() == [True, False, True] and others["reached"].all()
    assert trials["status"].tolist()[1] == "INVALID_START" and not trials["feasible"][1]
    assert trials["cost"].tolist()[::2] == others["cost"].tolist()
    assert not verify_study(tmp_path / "mine").differs
    code, _, err = run(*words, "scenario.path=bad.npz", "hydra.run.dir=bad")
    assert code == 2 and "a fleet whose vehicles start outside their obstacles, and apart" in problem_line(err)


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["device.dtype=float32"], "device: expected device=cpu in float64 for fleets"),
        (["study.explain=true"], "study.explain: expected false for fleets, got True"),
        (["study.figure=two"], "study.figure: expected null for fleets, got two"),
        (["scenario.vehicles=1"], "scenario.vehicles: expected"),
        (["scenario.apart=0"], "scenario.apart: expected"),
        (["model=quadrotor"], "model: expected model=planar or"),
    ],
)
def test_what_a_study_of_fleets_refuses(run, tmp_path, words, line) -> None:
    code, _, err = run(*WORDS, *words, "hydra.run.dir=out")
    assert (code == 2 and problem_line(err).startswith(f"torchgco: {line}")) or line in err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_pages_of_fleets_have_no_search(run, tmp_path) -> None:
    assert run(*WORDS[:2], "study.layouts=1", "study.figures=false", "study.workers=1", "hydra.run.dir=out")[0] == 0
    assert view([str(tmp_path / "out"), "--search", "0"]) == 2
