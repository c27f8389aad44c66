"""`torchgco new`: what it writes is an experiment that runs, and it overwrites nothing."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path

import pandas as pd
import pytest

import torchgco
from torchgco.experiments.new import TEMPLATE
from torchgco.experiments.reports import report

FILES = {"README.md", "own.py", "mine"}
SMALL = ["study.layouts=2", "study.workers=1", "study.baselines=[shooting]", "study.figure=null", "study.figures=false"]


def lines() -> list[list[str]]:
    """The commands of the README, as words."""
    text = (TEMPLATE / "README.md").read_text()
    return [shlex.split(line, comments=True) for line in re.findall(r"^    (torchgco.*)$", text, re.MULTILINE)]


def test_the_lines_of_its_readme_make_the_table_and_the_figures(run, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.delitem(sys.modules, "own", raising=False)
    monkeypatch.syspath_prepend(tmp_path)  # export PYTHONPATH=.
    code, out, err = run("new", ".")
    assert code == 0 and "own.py" in out and {path.name for path in tmp_path.iterdir()} == FILES, err
    assert len((tmp_path / "README.md").read_text().splitlines()) <= 12
    one, sweep, table, verify = lines()
    code, _, err = run(*one[1:-1], *SMALL, "scenario.stages=20", "solver=shooting", "study.baselines=[]")
    assert code == 2 and "study.baselines: expected one value" in err
    code, _, err = run(*one[1:-1], *SMALL, "solver.passes.paths.num_paths=1")
    assert code == 0, err
    few = "model.vehicle.dynamics.drag=0.5"
    code, _, err = run(*sweep[1:], *SMALL, few, "scenario.radius=0.2,0.3")
    assert code == 0, err
    assert report.main([*table[1 : table.index(">")]]) == 0
    assert "slalom & boat & 0.2 & 0.5 & gco" in capsys.readouterr().out
    figures = {path.name for path in (tmp_path / "outputs" / "paper" / "report" / "figures").iterdir()}
    assert {"rates.pdf", "rates-scenario.radius.pdf"} <= figures and all(name.endswith(".pdf") for name in figures)
    assert report.main(verify[1:]) == 0
    trials = torchgco.read(tmp_path / "outputs" / "paper")
    assert set(trials["scenario.radius"]) == {0.2, 0.3} and set(trials["solver"]) == {"gco", "shooting"}
    assert trials.loc[trials["solver"] == "gco", "reached"].all()
    sys.modules.pop("own")


def test_a_folder_with_a_space_and_folders_around_it(run, tmp_path: Path) -> None:
    code, out, err = run("new", "a/my <paper>")
    assert code == 0 and "a/my <paper>/own.py" in out, err
    assert {path.name for path in (tmp_path / "a" / "my <paper>").iterdir()} == FILES
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["my <paper>"]


@pytest.mark.parametrize("words", [[], ["a", "b"], ["--help"], ["full"], ["file"], ["file/inside"], [""]])
def test_nothing_is_overwritten(words: list[str], run, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "own.py").write_text("mine")
    (tmp_path / "file").write_text("mine")
    code, _, err = run("new", *words)
    assert code == 2 and len(err.splitlines()) == 1 and "torchgco new: expected" in err
    assert {path.name for path in tmp_path.iterdir()} == {"full", "file"}
    assert (tmp_path / "full" / "own.py").read_text() == "mine"


def test_its_python_is_that_of_the_manual() -> None:
    """The model and the solver are shown in the manual, where they are explained."""
    own, manual = (TEMPLATE / "own.py").read_text(), (TEMPLATE.parents[2] / "docs" / "extending.md").read_text()
    assert "class Shooting(Solver)" in own and pd.Series(["Boat", "Slalom", "Shooting"]).map(manual.count).gt(0).all()
