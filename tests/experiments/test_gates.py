"""Studies of races: their times are kept, confirmed, exported and shown, and so are flights in closed loop."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import torchgco
from torchgco.constraints.gates import gates_of
from torchgco.experiments.reports import report
from torchgco.experiments.reports.export import write_export
from torchgco.experiments.reports.verify import verify_study
from torchgco.plotting.layouts import layout_grid
from torchgco.plotting.study_figure import study_figure


@pytest.mark.slow
def test_a_study_keeps_the_times(run, tmp_path, monkeypatch) -> None:
    drawn = list[Figure]()
    for name, draw in (("layout_grid", layout_grid), ("study_figure", study_figure)):
        monkeypatch.setattr(
            report, name, lambda *words, draw=draw, **more: drawn.append(draw(*words, **more)) or drawn[-1]
        )
    words = ["scenario=race", "scenario.gates=[[-1.1,-1.6,3.6],[9.2,6.6,1.0]]", "scenario.stages=6", "study.layouts=2",
             "study.baselines=[]", "study.view=true", "study.figure=one", "study.workers=1",
             "hydra.run.dir=study"]  # fmt: skip
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
    assert len(drawn) == 3
    for i, (figure, place) in enumerate((figure, place) for figure in drawn for place in (0, 1)):
        shows_the_path(figure.axes[place], (0, 1) if i > 1 or place == 0 else (0, 2), U, times, 0 if i < 2 else place)


def shows_the_path(ax: Axes, plane: tuple[int, int], U: np.ndarray, times: np.ndarray, b: int) -> None:
    """Whether a map has the path that one step leads along from each knot, and where it is nearest to its gates."""
    setup = torchgco.compose(["scenario=race", "scenario.gates=[[-1.1,-1.6,3.6],[9.2,6.6,1.0]]", "scenario.stages=6"])
    problem = setup.task(setup.scenario.draw([b], 0)).problem
    x, path = problem.x0, [problem.x0[:, :3]]
    for k, h in enumerate(np.diff(times[b])):
        steps = [replace(problem.dynamics, dt=float(h) * share) for share in np.linspace(0.0, 1.0, 101)[1:]]
        within = [step.step(x, torch.from_numpy(U[b, k : k + 1])) for step in steps]
        path += [state[:, :3] for state in within]
        x = within[-1]
    true = torch.cat(path).numpy()
    (way,) = [line.get_xydata() for line in ax.lines if len(line.get_xdata()) > 19]
    assert len(way) > 100 and np.linalg.norm(true[:, None, list(plane)] - way, axis=-1).min(0).max() < 0.02
    (marks,) = [line.get_xydata() for line in ax.lines if line.get_marker() == "o"]
    gates = gates_of(problem).centers[0].numpy()
    nearest = [true[np.linalg.norm(true - center, axis=-1).argmin()] for center in gates]
    np.testing.assert_allclose(marks, np.array(nearest)[:, list(plane)], atol=0.03)


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
