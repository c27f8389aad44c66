"""The families: studies of them are counted, best costs are only ever lowered, and generators draw what files hold."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from benchmarks.families import oracle, quality
from benchmarks.lib import ROOT, studies
from benchmarks.lib.families import FAMILIES
from torchgco import compose
from torchgco.base.errors import InputError
from torchgco.experiments import app
from torchgco.experiments.flying import study
from torchgco.scenarios import Layouts


@pytest.fixture
def studies_here(monkeypatch) -> None:
    """Run the studies of `quality` in this process, without figures."""

    def started(command: list[str], cwd: Path, **_: object) -> None:
        assert command[:3] == [sys.executable, "-m", "torchgco"]
        monkeypatch.chdir(cwd)
        monkeypatch.setattr(sys, "argv", command[2:])
        assert app.main() == 0

    monkeypatch.setattr(studies, "subprocess", SimpleNamespace(run=started, DEVNULL=subprocess.DEVNULL))
    monkeypatch.setattr(study, "write_report", lambda *arguments: "")


@pytest.mark.sampled(3)
@pytest.mark.parametrize("search", oracle.SEARCH)
def test_every_search_of_the_oracle_is_a_solver(search: str) -> None:
    compose(oracle.SEARCH[search])


def test_the_oracle_only_ever_lowers_a_cost(tmp_path: Path) -> None:
    path, nan = tmp_path / "layouts.npz", float("nan")
    replace(Layouts.load(ROOT / "benchmarks/data/planar_random.npz").take([0, 1, 2]), best_cost=None).save(path)
    for costs, best in (
        ([500.0, nan, nan], [500.0, nan, nan]),
        ([600.0, 300.0, nan], [500.0, 300.0, nan]),
        ([400.0, nan, nan], [400.0, 300.0, nan]),
    ):
        oracle.keep(path, np.array(costs), "here")
        np.testing.assert_array_equal(Layouts.load(path).best_cost, best)


@pytest.mark.slow
@pytest.mark.usefixtures("studies_here")
def test_the_oracle_keeps_drawn_layouts_and_success_is_judged_for_them(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr("benchmarks.lib.families.DATA", tmp_path)
    monkeypatch.setattr(oracle, "SEARCH", {"hold": ["solver=hold"]})
    words = ["--families", "planar_random", "--fresh", "2", "--seed", "7"]
    for _ in range(2):  # the second call finds the file
        assert oracle.main([*words, "--search", "hold"]) == 0
    family = FAMILIES["planar_random"]
    drawn = Layouts.load(family.file(2, 7))
    np.testing.assert_array_equal(drawn.centers, compose(family.overrides(3, 7)).layouts(2).centers)
    assert drawn.best_cost is None  # a vehicle that holds still never arrives
    with pytest.raises(InputError, match="fresh: expected the layouts that"):
        oracle.held(family, 3, 7)
    oracle.keep(family.file(2, 7), np.array([100.0, np.nan]), "here")
    flown = ["--solvers", "hold", "--outputs", str(tmp_path / "quality"), "study.workers=1"]
    assert quality.main(["--families", "planar_random", "--fresh", "3", "--seed", "7", *flown]) == 0
    assert "| 0 of 1 [0, 79] |" in capsys.readouterr().out


def test_no_best_cost_is_above_a_peers() -> None:
    for family in FAMILIES.values():
        best, theirs = Layouts.load(family.file()).best_cost, oracle.reference(family)
        assert best is not None and not bool((best > theirs).any())


@pytest.mark.slow
def test_the_quality_of_one_family(tmp_path: Path, capsys) -> None:
    words = ["--families", "planar_trap", "--solvers", "hold", "--fresh", "3", "--outputs", str(tmp_path)]
    assert quality.main([*words, "study.workers=1"]) == 0
    row = capsys.readouterr().out.splitlines()[-1].split(" | ")
    assert row[0] == "| planar_trap" and row[1:4] == ["`hold`", "3", "3 [44, 100]"] and row[4] == "0 [0, 56]"


@pytest.mark.slow
@pytest.mark.usefixtures("studies_here")
def test_success_is_judged_with_the_current_best_cost(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("benchmarks.lib.families.DATA", tmp_path)
    family = FAMILIES["planar_trap"]
    layouts = Layouts.load(ROOT / "benchmarks/data/planar_trap.npz").take([0, 1])
    layouts.save(family.file())
    arguments = quality._parser().parse_args(["--solvers", "hold", "--outputs", str(tmp_path / "quality")])
    arguments.overrides = ["study.layouts=2", "study.workers=1"]
    flown = quality.fly(family, arguments)
    assert flown["solver"].unique().tolist() == ["hold"] and not flown["success"].any()
    lower = replace(layouts, best_cost=0.9 * layouts.best_cost)
    lower.save(family.file())
    again = quality.fly(family, arguments)  # a finished study may be judged again
    np.testing.assert_array_equal(again["best_cost"], lower.best_cost)
    there = flown.assign(reached=[True, False], cost=flown["best_cost"])
    assert quality.succeeded(there, layouts)["success"].tolist() == [True, False]
    assert quality.succeeded(there, lower)["success"].tolist() == [False, False]


@pytest.mark.slow
def test_the_generators_draw_the_families_of_the_files() -> None:
    """Fresh layouts have as many obstacles as the files' layouts, of the same size, and the same start and goal."""
    for family in FAMILIES.values():
        drawn, held = compose(family.overrides(fresh=2)).layouts(), Layouts.load(family.file())
        task, other = (compose(family.overrides(fresh=f)).task(layouts) for f, layouts in ((2, drawn), (0, held)))
        assert (task.problem.N, task.goal_radius) == (other.problem.N, other.goal_radius)
        torch.testing.assert_close(task.problem.x0[0], other.problem.x0[0])
        np.testing.assert_allclose(np.nanmax(drawn.radii), np.nanmax(held.radii))
        if family.name != "walls":
            assert drawn.centers.shape[1:] == held.centers.shape[1:]
