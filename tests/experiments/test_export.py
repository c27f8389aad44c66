"""`torchgco-export`: single trajectories as the study kept them, missions as they were flown."""

from __future__ import annotations

import numpy as np
import pandas as pd

from tests.experiments.commands import HOLD
from tests.experiments.test_view import MISSION
from torchgco.experiments.reports import export
from torchgco.missions.tables import STATES


def test_single_trajectories(run, tmp_path, capsys) -> None:
    code, _, err = run("scenario=yard", *HOLD, "study.figures=false", "hydra.run.dir=study")
    assert code == 0, err
    folder = tmp_path / "study"
    assert export.main([str(folder), "--layout", "2", "0"]) == 0 and "2 files" in capsys.readouterr().out
    assert sorted(path.name for path in (folder / "export").iterdir()) == ["hold-0.csv", "hold-2.csv"]
    table = pd.read_csv(folder / "export" / "hold-2.csv")
    with np.load(folder / "solutions.npz") as held:
        U = held["U"][held["solver"].tolist().index("hold"), held["layout"].tolist().index(2)]
    heads = ["t [s]", "x [m]", "y [m]", "heading [rad]", "speed [m/s]", "vx [m/s]", "vy [m/s]", "ax [m/s^2]"]
    assert list(table.columns[:8]) == heads
    np.testing.assert_allclose(table[["acceleration [m/s^2]", "turn rate [rad/s]"]].to_numpy()[:-1], U, atol=1e-12)
    assert export.main([str(folder), "--rate", "50", "--output", str(tmp_path / "out")]) == 0
    fine = pd.read_csv(tmp_path / "out" / "hold-2.csv")
    np.testing.assert_allclose(fine["t [s]"], np.arange(len(fine)) / 50, atol=1e-12)
    np.testing.assert_allclose(fine["t [s]"].iloc[-1], table["t [s]"].iloc[-1], atol=0.02)


def test_missions_as_they_were_flown(run, tmp_path) -> None:
    code, _, err = run(*MISSION)
    assert code == 0, err
    assert export.main([str(tmp_path / "flown"), "--solver", "hold"]) == 0
    log = pd.read_parquet(tmp_path / "flown" / "time_steps.parquet")
    for number in (0, 1):
        table = pd.read_csv(tmp_path / "flown" / "export" / f"hold-{number}.csv")
        own = log[log["mission"] == number]
        x = own[[f"x{i}" for i in range(STATES)]].to_numpy()
        np.testing.assert_allclose(table.iloc[:, 1 : STATES + 1], x, atol=1e-9)
        np.testing.assert_allclose(table["thrust [N]"], x[:, 13:].sum(1), atol=1e-9)
        np.testing.assert_allclose(table["rotor 1 [rpm]"], own["u1"], atol=1e-6)
        change = (x[2:, 5] - x[:-2, 5]) / (own["t"].to_numpy()[2:] - own["t"].to_numpy()[:-2])
        np.testing.assert_allclose(table["az [m/s^2]"][1:-1], change, atol=1e-9)
    (tmp_path / "flown" / "time_steps.parquet").unlink()  # as of studies of many missions: control steps
    assert export.main([str(tmp_path / "flown"), "--rate", "40"]) == 0
    coarse = pd.read_csv(tmp_path / "flown" / "export" / "hold-1.csv")
    np.testing.assert_allclose(np.diff(coarse["t [s]"]), 0.025, atol=1e-12)
    q = coarse[["qw", "qx", "qy", "qz"]].to_numpy()
    np.testing.assert_allclose((q**2).sum(1), 1.0, atol=1e-12)


def test_a_mistake_gets_one_line(run, tmp_path, capsys) -> None:
    code, _, err = run("scenario=yard", *HOLD, "study.figures=false", "hydra.run.dir=study")
    assert code == 0, err
    for words, line in (
        (["study", "--layout", "77"], "--layout: expected among 0, 1"),
        (["study", "--solver", "gco"], "--solver: expected among hold of the study, got gco"),
        (["study", "--rate", "0"], "--rate: expected a number above 0"),
        (["study", "--output", "study/study.json"], "--output: expected a folder"),
        (["elsewhere"], "RUN: expected the folder of a study"),
        (["study", "--speed"], "command line: expected RUN and the options of --help"),
    ):
        assert export.main([str(tmp_path / words[0]), *words[1:]] if words[0] != "elsewhere" else words) == 2
        told = capsys.readouterr().err
        assert line in told and told.count("\n") == 1
