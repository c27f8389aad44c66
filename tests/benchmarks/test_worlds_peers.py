"""The kept flights of the worlds' peers: a stopped run resumes, a limit ends a flight, and the table reads the rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from benchmarks.families import worlds, worlds_peers
from benchmarks.lib import acados
from benchmarks.lib.families import WORLDS
from benchmarks.lib.kept import append, rows_of
from tests.problems import quadrotor_batch
from torchgco import Problem, compose, judge, presets
from torchgco.baselines import CasADiSolver
from torchgco.experiments.results.identity import layout_digests
from torchgco.scenarios import Layouts, Task


@pytest.fixture(autouse=True)
def without_acados(monkeypatch, tmp_path: Path) -> None:
    """Hide an installed acados: tests/benchmarks/test_acados.py tests it."""
    monkeypatch.setattr(acados, "ENVIRONMENT", tmp_path)


def tiny(folder: Path) -> worlds_peers.World:
    """A world of two small layouts."""
    problem, U0 = quadrotor_batch(B=2, N=40, obstacles=2)
    layouts = Layouts(np.zeros((2, 1, problem.position.stop)), np.ones((2, 1)))
    assert problem.goal is not None
    task = Task(problem, U0, problem.goal.position, 0.5, layouts)
    return worlds_peers.World("woods20", task, {0: "zero", 1: "one"}, folder)


def fly(world: worlds_peers.World, file: Path, solvers: list[str], layouts: list[int]) -> list[tuple]:
    """The flights that were made, as (solver, layout, guess)."""
    made = []
    for row in worlds_peers.flights(world, solvers, layouts, 60, file):
        append(file, worlds_peers.COLUMNS, row | {"date": "2026-01-01", "commit": "abc"})
        made.append((row["solver"], row["layout"], row["guess"]))
    return made


@pytest.mark.parametrize("name", ["crossing10", "mazes2"])
def test_kept_flights_are_those_of_the_layouts(name: str) -> None:
    """Where a digest takes in more than before, these flights are lost to the tables without a word."""
    setup = compose(WORLDS[name].overrides())
    now = layout_digests(setup.task().layouts, setup.configuration["model"]["vehicle"])
    rows = rows_of(worlds_peers.FILE, worlds_peers.COLUMNS)
    rows = rows[rows["world"] == name]
    assert len(rows) >= 96 and rows["layout_digest"].tolist() == rows["layout"].map(now).tolist()


@pytest.mark.slow
def test_a_stopped_run_resumes(tmp_path: Path) -> None:
    world, file = tiny(tmp_path), tmp_path / "peers.csv"
    assert fly(world, file, ["fatrop"], [0]) == [("fatrop", 0, "rest")]
    assert fly(world, file, ["fatrop", "fatrop_guided"], [0, 1]) == [
        ("fatrop_guided", 0, "path"), ("fatrop", 1, "rest"), ("fatrop_guided", 1, "path"),
    ]  # fmt: skip
    assert fly(world, file, ["fatrop"], [0, 1]) == []
    world.digests[1] = "changed"
    assert fly(world, file, ["fatrop"], [0, 1]) == [("fatrop", 1, "rest")]
    rows = rows_of(file, worlds_peers.COLUMNS)
    assert tuple(rows.columns) == worlds_peers.COLUMNS and len(rows) == 5
    solution = CasADiSolver("fatrop").solve(world.problem(0), world.task.U0[:1])
    verdict = judge(world.problem(0), solution.U, world.task.goal[:1], 0.5)
    assert rows["cost"][0] == pytest.approx(float(verdict.cost), rel=1e-8)
    assert bool(rows["reached"][0]) == bool(verdict.reached) and rows["status"][0] == solution.statuses[0].name


@pytest.mark.slow
def test_a_flight_beyond_its_limit_is_a_row(tmp_path: Path) -> None:
    world = tiny(tmp_path)

    class Endless:
        def of(self, problem: Problem) -> Endless:
            return self

        def solve(self, problem: Problem, U: torch.Tensor) -> None:
            while True:
                pass

    peers = worlds_peers.Peers(world, Endless(), presets.fatrop_guided(world.problem(0)), None)  # type: ignore[arg-type]
    flight = peers.fly("fatrop", 0, 1)
    row = worlds_peers._judged(world, "fatrop", 0, flight)
    assert (row["status"], row["seconds"], row["reached"]) == ("TIME_LIMIT", "1", False)


def test_nothing_is_guided_among_moving_obstacles(tmp_path: Path) -> None:
    world = worlds_peers.World.of(WORLDS["crossing10"], tmp_path)
    assert world.moving and not tiny(tmp_path).moving
    assert list(worlds_peers.flights(world, ["fatrop_guided"], [0], 60, tmp_path / "peers.csv")) == []


def test_the_table_counts_the_peers() -> None:
    """A row per peer, by the layouts that it flew; those of changed layouts and of other worlds are left out."""
    layouts = Layouts.load(WORLDS["woods20"].file())
    assert layouts.best_cost is not None
    best = layouts.best_cost
    digests = ["a", "b", "c", "d"]
    ours = pd.DataFrame({
        "scenario": "woods20", "model": "quadrotor", "seed": 0, "solver": "gco", "status": "CONVERGED",
        "layout": range(4), "layout_digest": digests, "feasible": True, "reached": [True, True, True, False],
        "clear_95": True, "success": True, "violation": 0.0, "clearance": 0.1, "cost": best[:4], "best_cost": best[:4],
        "iterations": 1, "outer_iterations": 1, "guided": 0, "seconds": 0.1,
    })  # fmt: skip
    flown = {"layout": [0, 1, 2, 3, 0], "layout_digest": ["a", "b", "changed", "d", "a"]}
    peers = pd.DataFrame({
        **flown, "world": ["woods20"] * 4 + ["woods40"], "solver": "fatrop", "status": "CONVERGED",
        "reached": [True, True, True, False, True], "violation": 0.0,
        "clearance": 0.1, "cost": [1.04 * best[0], 1.06 * best[1], best[2], np.nan, 1.0], "iterations": 10,
        "seconds": [1.0, 3.0, 9.0, 120.0, 5.0],
    })  # fmt: skip
    trials = worlds.with_peers("woods20", ours, peers)
    line = worlds.table(trials, {0, 1})[1]
    assert line[:3] == ["woods20", "`fatrop`", 3]
    assert [cell.split(" [")[0] for cell in line[3:6]] == ["2 of 3", "2 of 2", "1 of 3"]
    assert line[6:] == ["1.050", "3"]
    assert worlds.with_peers("woods60", ours, peers) is ours


def test_the_kept_rows_are_of_known_worlds_and_solvers() -> None:
    rows = rows_of(worlds_peers.FILE, worlds_peers.COLUMNS)
    assert set(rows["world"]) <= set(WORLDS) and set(rows["solver"]) <= set(worlds_peers.NAMES)
    assert not rows.duplicated(["world", "solver", "layout", "layout_digest"]).any()
