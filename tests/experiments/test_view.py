"""`torchgco-view` and `study.view`: pages of studies, of single trajectories and of missions."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from tests.experiments.commands import HOLD
from tests.view.test_packing import part
from torchgco import InputError
from torchgco.experiments.reports import finished, view
from torchgco.native.compiler import NativeError

WORDS = [*HOLD, "study.figures=false", "study.view=true", "study.figure=one"]
MISSION = [
    "experiment=mission", "solver=hold", "mission.duration=0.2", "scenario.num_obstacles=3", "study.layouts=2",
    "study.workers=1", "study.figures=false", "hydra.run.dir=flown",
]  # fmt: skip


@pytest.mark.slow
def test_a_study_writes_its_page_and_the_command_writes_it_again(run, tmp_path, capsys) -> None:
    code, out, err = run("scenario=yard", *WORDS, "hydra.run.dir=study")
    page = tmp_path / "study" / "view.html"
    assert code == 0 and f"Page: {page}" in out, err
    assert sorted(path.name for path in (tmp_path / "study" / "figures").iterdir()) == ["study.pdf", "study.png"]
    head, first = part(page.read_text(), "head"), part(page.read_text(), "part-0")
    assert [solver["name"] for solver in head["solvers"]] == ["hold"] and len(head["layouts"]) == 4
    assert head["body"] == "car" and head["dimension"] == 2
    held = np.load(tmp_path / "study" / "layouts.npz")
    count = int(np.isfinite(held["radii"][0]).sum()), int(np.isfinite(held["box_centers"][0, :, 0]).sum())
    assert [shapes["count"] for shapes in first["obstacles"]] == [number for number in count if number]
    (flight,) = first["flights"]
    assert flight["path"].shape == (6, 2) and flight["attitude"].shape == (6, 4)
    table = pd.read_parquet(tmp_path / "study" / "trials.parquet")
    assert ["status", table["status"][0]] in flight["rows"]
    written = page.read_text()
    assert view.main([str(page.parent), "--output", str(tmp_path / "other.html")]) == 0
    assert (tmp_path / "other.html").read_text() == written and "MB" in capsys.readouterr().out


def test_missions_show_track_and_plan(run, tmp_path) -> None:
    code, _, err = run(*MISSION, "study.figure=two")
    assert code == 2 and "study.figure: expected null for missions" in err
    code, _, err = run(*MISSION)
    assert code == 0, err
    assert view.main([str(tmp_path / "flown")]) == 0
    page = tmp_path / "flown" / "view.html"
    assert part(page.read_text(), "head")["mission"] is True and part(page.read_text(), "head")["body"] == "quadrotor"
    (flight,) = part(page.read_text(), "part-1")["flights"]
    count = len(flight["path"])
    assert count >= 2 and flight["attitude"].shape == (count, 4) and len(flight["notes"]) == count
    with np.load(tmp_path / "flown" / "plans.npz") as held:
        np.testing.assert_allclose(flight["plan"], held["plan"][0, 1, :count], atol=2e-3)


@pytest.mark.slow
def test_missions_with_a_sensor_show_what_was_seen(run, tmp_path, capsys, monkeypatch) -> None:
    words = ["experiment=mission_unknown", "mission.duration=0.3", "scenario.num_obstacles=5", "study.figures=false"]
    small = ["mission.lidar.rays=[60,10]", "mission.explorer.around=[4,2]", "study.view=true", "hydra.run.dir=unknown"]
    code, _, err = run(*words, *small)
    assert code == 0, err
    page = tmp_path / "unknown" / "view.html"
    (flight,) = part(page.read_text(), "part-0")["flights"]
    held, table = flight["sensed"], pd.read_parquet(tmp_path / "unknown" / "mission.parquet")
    assert held["safe"] == (table["safe"] == 1).tolist() and len(held["counts"]) == len(flight["path"]) == len(table)
    # Plans that the study's judge found safe keep to cells that the page shows as free.
    state, first, cells = np.zeros(held["shape"], np.uint8), 0, int(np.prod(held["shape"]))
    with np.load(tmp_path / "unknown" / "plans.npz") as plans:
        for count, plan, safe in zip(held["counts"], plans["plan"][0, 0], held["safe"], strict=True):
            changes = held["changes"][first : first + count]
            state.reshape(-1)[changes % cells], first = changes // cells, first + count
            at = np.floor((plan - held["corner"]) / held["resolution"]).astype(int)
            assert (state[tuple(at.T)] == 1).all() or not safe
    assert sum(held["safe"]) > 0
    assert ["periods with a safe plan", f"{100 * np.mean(held['safe']):.4g} %"] in flight["rows"]
    assert view.main([str(tmp_path / "unknown"), "--search", "0"]) == 2
    assert "--search: expected missions that know all obstacles" in capsys.readouterr().err

    # Where the map can't be found again, the page says so, and shows the rest.
    def refused(*words: object) -> None:
        raise NativeError("no C compiler found")

    for target, words in (("replayed", "no map: no C compiler found"), ("Study.mission", "no map: ")):
        with monkeypatch.context() as patch:
            patch.setattr(f"{finished.__name__}.{target}", refused if target == "replayed" else old)
            assert view.main([str(tmp_path / "unknown"), "--output", str(tmp_path / "less.html")]) == 0
        (note,) = part((tmp_path / "less.html").read_text(), "head")["notes"]
        (flight,) = part((tmp_path / "less.html").read_text(), "part-0")["flights"]
        assert words in note and "sensed" not in flight and len(flight["plan"]) == len(flight["path"])


@pytest.mark.slow
def test_the_search_for_the_first_plan_of_a_mission_is_shown(run, tmp_path) -> None:
    words = ["experiment=mission", "scenario=mazes", "scenario.stages=120", "mission.duration=0.05", "study.layouts=2"]
    code, _, err = run(*words, "study.figures=false", "study.workers=1", "hydra.run.dir=first")
    assert code == 0, err
    assert view.main([str(tmp_path / "first"), "--search", "1"]) == 0
    page = tmp_path / "first" / "view.html"
    first = part(page.read_text(), "part-1")
    assert part(page.read_text(), "part-0")["search"] is None
    assert first["search"]["passes"][0].startswith("gco: ") and first["search"]["rounds"]
    texts = [line["text"] for line in first["search"]["rounds"][0]["lines"]]
    assert any(text.startswith("path 1: ") for text in texts)
    assert any(text.startswith("candidate 1 along path ") for text in texts)


@pytest.mark.slow
def test_the_search_is_shown_where_it_is_asked_for(run, tmp_path, capsys) -> None:
    words = ["study.layouts=2", "study.workers=1", "study.figures=false", "hydra.run.dir=sought"]
    code, _, err = run("scenario=planar_trap", *words, "study.baselines=[al_ilqr]")
    assert code == 0, err
    assert view.main([str(tmp_path / "sought"), "--search", "0", "0"]) == 0
    page = tmp_path / "sought" / "view.html"
    assert part(page.read_text(), "part-1")["search"] is None
    search = part(page.read_text(), "part-0")["search"]
    assert search["passes"][0].startswith("gco: ") and search["rounds"]
    texts = [line["text"] for line in search["rounds"][0]["lines"]]
    assert any(text.startswith("path 1: ") for text in texts) and any("proposed" in text for text in texts)
    for line in search["rounds"][0]["lines"]:
        assert len(line["points"]) > 1 and np.isfinite(line["points"]).all()
    capsys.readouterr()
    assert view.main([str(tmp_path / "sought"), "--search", "7"]) == 2
    assert "--search: expected numbers of layouts of the study, got 7" in capsys.readouterr().err


def old(*words: object) -> None:
    raise InputError("mission.lidar", "another option", "beams")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "RUN"), (["nowhere"], "RUN: expected the folder of a study"), (["half"], "RUN: expected a finished study"),
        (["half", "--power", "1"], "--power"), (["half", "--output", "half"], "half"),
    ],
)  # fmt: skip
def test_what_has_no_page_is_refused_in_one_line(words, told, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "half").mkdir()
    (tmp_path / "half" / "study.json").write_text(json.dumps({}))
    assert view.main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("torchgco-view: ") and told in line
    assert list((tmp_path / "half").iterdir()) == [tmp_path / "half" / "study.json"]
