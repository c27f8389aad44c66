"""Studies of races: their times are kept, confirmed, exported and shown, and so are flights in closed loop."""

import numpy as np
import pandas as pd
import pytest

from torchgco.experiments.reports.export import write_export
from torchgco.experiments.reports.verify import verify_study


@pytest.mark.slow
def test_a_study_keeps_the_times(run, tmp_path) -> None:
    words = ["scenario=race", "scenario.gates=[[-1.1,-1.6,3.6],[9.2,6.6,1.0]]", "scenario.stages=6", "study.layouts=2",
             "study.baselines=[]", "study.view=true", "study.workers=1", "hydra.run.dir=study"]  # fmt: skip
    code, _, err = run(*words)
    assert code == 0, err
    folder = tmp_path / "study"
    trials = pd.read_parquet(folder / "trials.parquet")
    assert trials["reached"].all() and trials["gates_passed"].tolist() == [2, 2]
    with np.load(folder / "solutions.npz") as held:
        times, U = held["times"][0], held["U"][0]
    np.testing.assert_allclose(times[:, -1], trials["duration"])
    lengths = np.diff(times, axis=1).reshape(2, 3, 6)
    np.testing.assert_allclose(lengths, lengths[..., :1] * np.ones(6))
    assert U.shape == (2, 18, 4) and (np.ptp(lengths[..., 0], axis=1) > 1e-3).all()
    assert not verify_study(folder).differs
    table = pd.read_csv(write_export(folder, layouts=[1])[0])
    np.testing.assert_allclose(table["t [s]"], times[1])
    assert (folder / "figures" / "layouts.png").is_file() and (folder / "view.html").is_file()


@pytest.mark.slow
def test_a_race_in_closed_loop_is_logged_drawn_and_kept(run, tmp_path) -> None:
    words = ["experiment=race", "scenario.gates=[[-1.1,-1.6,3.6],[9.2,6.6,1.0]]", "scenario.stages=6"]
    words += ["study.layouts=2", "study.shard_size=1", "study.view=true", "study.workers=1", "hydra.run.dir=out"]
    code, out, err = run(*words)
    assert code == 0, err
    assert "race 1, gco: REACHED after" in out and "2 gates passed, at most 0.2" in out
    folder = tmp_path / "out"
    trials, log = (pd.read_parquet(folder / f"{name}.parquet") for name in ("trials", "mission"))
    assert trials["gates_passed"].tolist() == [2, 2] and (trials["gate_distance"] <= 0.3).all()
    assert trials["duration"].equals(trials["flight_time"]) and trials["duration"].between(2.5, 4.5).all()
    first = log[log["mission"] == 0]
    assert first["gates_passed"].iloc[0] == 0 and first["gates_passed"].iloc[-1] == 2
    assert first["gates_passed"].diff().dropna().isin([0, 1]).all()
    assert not verify_study(folder).differs
    assert {"0-gco.gif", "1-gco-snapshots.png"} <= {path.name for path in (folder / "figures").iterdir()}
    assert (folder / "view.html").is_file()
    code, out, _ = run(*words)
    assert code == 0 and "Already done" in out
