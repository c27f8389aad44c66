"""`torchgco-view` and `study.view`: pages of studies, of single trajectories and of missions."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.experiments.commands import HOLD
from tests.view.test_packing import read
from torchgco.experiments.reports import view

WORDS = [*HOLD, "study.figures=false", "study.view=true"]
MISSION = [
    "experiment=mission", "solver=hold", "mission.duration=0.2", "scenario.num_obstacles=3", "study.layouts=2",
    "study.workers=1", "study.figures=false", "hydra.run.dir=flown",
]  # fmt: skip


def part(page: Path, name: str):
    text = page.read_text()
    at = text.index(f'id="{name}"')
    return read(text[text.index(">", at) + 1 : text.index("</script>", at)])


def test_a_study_writes_its_page_and_the_command_writes_it_again(run, tmp_path, capsys) -> None:
    code, out, err = run("scenario=yard", *WORDS, "hydra.run.dir=study")
    page = tmp_path / "study" / "view.html"
    assert code == 0 and f"Page: {page}" in out, err
    head, first = part(page, "head"), part(page, "part-0")
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
    code, _, err = run(*MISSION)
    assert code == 0, err
    assert view.main([str(tmp_path / "flown")]) == 0
    page = tmp_path / "flown" / "view.html"
    assert part(page, "head")["mission"] is True and part(page, "head")["body"] == "quadrotor"
    (flight,) = part(page, "part-1")["flights"]
    count = len(flight["path"])
    assert count >= 2 and flight["attitude"].shape == (count, 4) and len(flight["notes"]) == count
    with np.load(tmp_path / "flown" / "plans.npz") as held:
        np.testing.assert_allclose(flight["plan"], held["plan"][0, 1, :count], atol=2e-3)


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
