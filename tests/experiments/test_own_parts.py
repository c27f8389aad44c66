"""A user's constraints, bodies with parts and metrics in a study, from YAML files of a folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

import torchgco
from tests.experiments.commands import problem_line
from torchgco.experiments.dataset import command
from torchgco.experiments.flying.metrics import metric_columns
from torchgco.experiments.reports.report import main as report

OWN = '''
from dataclasses import dataclass
import torch
from torchgco import Dynamics

@dataclass(frozen=True)
class Truck(Dynamics):
    """x = [x, y, heading, trailer, speed], u = [acceleration, curvature]."""

    dt: float = 0.1
    n, m, position = 5, 2, slice(0, 2)
    state_names = ("x", "y", "heading", "trailer", "speed")

    def step(self, x, u):
        h, t, v = x[..., 2], x[..., 3], x[..., 4]
        rates = (v * h.cos(), v * h.sin(), v * u[..., 1], v * (h - t).sin(), u[..., 0])
        return x + self.dt * torch.stack(rates, -1)

def jackknife(x, most):
    return (x[..., 2:3] - x[..., 3:4]).square() - most**2

def fold(X, U, t, problem):
    return (X[..., 2] - X[..., 3]).abs().amax(-1)

def way(X, U, t, problem, scale=1.0):
    assert X.shape[1] == U.shape[1] + 1 == t.shape[1] and problem.B == len(X)
    return (scale * X[..., :2].diff(dim=1).norm(dim=-1).sum(-1)).numpy()

def of_knots(X, U, t, problem):
    return X[..., 0]

def nothing(X, U, t, problem):
    return X[:, 0, 0] * float("nan")

def fails(X):
    return 0

def words(X, U, t, problem):
    return ["a"] * len(X)
'''
MODEL = """
dimension: 2
vehicle:
  _target_: torchgco.scenarios.Vehicle
  name: truck
  dynamics: {_target_: own_parts.Truck}
  state_weight: [0.1, 0.1, 0, 0, 0.1]
  control_weight: [0.5, 0.5]
  terminal_weight: [200, 200, 0, 0, 10]
  control_reference: [0.3, 0.2]
  control_lower: [-2, -1]
  control_upper: [2, 1]
  start: [-2, 0, 0, 0, 0.5]
  goal: [2, 0, 0, 0, 0]
  radius: 0.3
  goal_radius: 0.5
  stages: 20
  shape:
    _target_: torchgco.Body
    offsets: [[0.2, 0]]
    radii: 0.25
    parts:
      - {_target_: torchgco.Body, offsets: [[-0.6, 0]], radii: 0.2, attitude: trailer, hinge: [-0.1, 0]}
  constraints:
    - _target_: torchgco.FunctionConstraint
      function: {_target_: own_parts.jackknife, _partial_: true, most: 0.1}
      name: jackknife
"""
EXPERIMENT = """
# @package _global_
defaults: [override /model: truck, override /scenario: layouts, override /solver: hold]
study:
  baselines: []
  workers: 1
  figures: false
  metrics:
    fold: own_parts.fold
    way: {_target_: own_parts.way, scale: 2.0}
"""


@pytest.fixture
def words(tmp_path: Path, monkeypatch) -> list[str]:
    (tmp_path / "own_parts.py").write_text(OWN)
    for group, name, text in (("model", "truck", MODEL), ("experiment", "truck", EXPERIMENT)):
        (tmp_path / "mine" / group).mkdir(parents=True)
        (tmp_path / "mine" / group / f"{name}.yaml").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    layouts = torchgco.Layouts(np.array([[[0.0, 1.2], [-1.4, 0.6]], [[3.0, 3.0], [-2.6, 0.9]]]), np.full((2, 2), 0.4))
    layouts.save(tmp_path / "two.npz")
    return ["experiment=truck", f"scenario.path={tmp_path / 'two.npz'}"]


def flown(stages: int = 20) -> np.ndarray:
    """The states (21, 5) to which the controls at rest lead."""
    x = np.array([-2, 0, 0, 0, 0.5])
    states = [x]
    for _ in range(stages):
        h, t, v = x[2:]
        x = x + 0.1 * np.array([v * np.cos(h), v * np.sin(h), v * 0.2, v * np.sin(h - t), 0.3])
        states.append(x)
    return np.array(states)


@pytest.mark.slow
def test_constraint_parts_and_metrics_are_those_of_plain_maths(run, words: list[str], tmp_path: Path, capsys) -> None:
    assert run("--config-dir", "mine", *words, "hydra.run.dir=out")[0] == 0
    table, X = pd.read_parquet(tmp_path / "out" / "trials.parquet"), flown()
    folded = np.abs(X[:, 2] - X[:, 3])
    np.testing.assert_allclose(table["fold"], folded.max())
    np.testing.assert_allclose(table["way"], 2 * np.linalg.norm(np.diff(X[:, :2], axis=0), axis=1).sum())

    def at(angle: int, along: float) -> np.ndarray:
        return along * np.stack((np.cos(X[:, angle]), np.sin(X[:, angle])), axis=-1)

    balls = ((X[:, :2] + at(2, 0.2), 0.25), (X[:, :2] + at(2, -0.1) + at(3, -0.6), 0.2))
    layouts = torchgco.Layouts.load(tmp_path / "two.npz")
    for i, row in table.iterrows():
        apart = [np.linalg.norm(p[1:, None] - layouts.centers[i], axis=-1) - 0.95 * (0.4 + r) for p, r in balls]
        assert row["clearance_knots"] == pytest.approx(np.min(apart), abs=1e-9)
        full = max(0.0, -np.min([gap - 0.05 * (0.4 + r) for gap, (_, r) in zip(apart, balls, strict=True)]))
        assert row["violation"] == pytest.approx(max(full, (folded[1:] ** 2 - 0.01).max(), 0.0), abs=1e-9)
    assert table["violation"].gt(1e-3).all() and not table["feasible"].any()
    capsys.readouterr()
    assert report([str(tmp_path / "out"), "--verify"]) == 2  # a class that isn't torchgco's
    assert report([str(tmp_path / "out"), "--verify", "--trust"]) == 0
    assert "fold, way" in capsys.readouterr().out


@pytest.mark.slow
def test_metrics_belong_to_a_study_and_reports_join_studies_with_and_without(run, words, tmp_path: Path) -> None:
    mine = ["--config-dir", "mine", *words]
    assert run(*mine, "hydra.run.dir=a")[0] == 0
    code, _, err = run(*mine, "study.metrics.way.scale=3", "hydra.run.dir=a")
    assert code == 2 and "study.metrics.way.scale is 2 there, 3 here" in problem_line(err)
    assert run(*mine, "~study.metrics.way", "~study.metrics.fold", "hydra.run.dir=b")[0] == 0
    for order in (("a", "b"), ("b", "a")):
        table = torchgco.read(*(tmp_path / name for name in order), trust=True)
        assert len(table) == 2 and table["way"].notna().all()


@pytest.mark.sampled(6)
@pytest.mark.parametrize("word, line", [
    ("+study.metrics.cost=own_parts.way", "study.metrics.cost: expected a name of its own"),
    ("+study.metrics.gates_passed=own_parts.way", "study.metrics.gates_passed: expected a name of its own"),
    ("+study.metrics.a-b=own_parts.way", "study.metrics.a-b: expected a name of its own"),
    ("+study.metrics.a=own_parts.of_knots", "a: expected numbers (2,), one for each trajectory, got float64"),
    ("+study.metrics.a=own_parts.words", "study.metrics.a: expected numbers (2,)"),
    ("+study.metrics.a=own_parts.nothing", "a: expected a number of each trajectory, got NaN on layout 0"),
    ("+study.metrics.a=own_parts.fails", "study.metrics.a: expected a function of (X, U, t, problem)"),
    ("+study.metrics.a=own_parts.none", "study.metrics.a: expected a function that Python can import"),
    ("+study.metrics.a=3", "study.metrics.a: expected text, got 3"),
    ("study.metrics=3", "study.metrics: expected functions by name"),
    ("study.metrics.way.scal=2", "scal"),
    ("model.vehicle.constraints=[3]", "vehicle.constraints: expected a list of objects of class Constraint"),
    ("model.vehicle.shape.parts.0.attitude=tail", "states named tail"),
    ("model.vehicle.shape.parts.0.offsets=[[0,0,0]]", "body.hinge: expected shape (3)"),
    ("+model.vehicle.footprint=[[-1,-1],[1,1]]", "vehicle.cells"),
    ("model.vehicle.shape=3", "vehicle.shape: expected an object of class Body"),
])  # fmt: skip
def test_what_is_wrong_is_named_in_a_line(run, words: list[str], word: str, line: str, tmp_path: Path) -> None:
    code, _, err = run("--config-dir", "mine", *words, word, "hydra.run.dir=bad")
    assert code == 2 and line in problem_line(err)
    assert not list(tmp_path.glob("bad/*.parquet"))


@pytest.mark.parametrize("more", [["scenario=fleet_door"], ["experiment=mission"]])
@pytest.mark.usefixtures("words")
def test_fleets_and_missions_have_no_metrics(run, more: list[str]) -> None:
    code, _, err = run(*more, "study.layouts=1", "+study.metrics.way=own_parts.way")
    assert code == 2 and "study.metrics: expected null for missions and fleets, got way" in problem_line(err)


@pytest.mark.parametrize("seed", range(3))
def test_a_metric_that_writes_into_its_arguments_changes_no_other(seed: int) -> None:
    draws = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.rand(*shape, generator=draws, dtype=torch.float64)
    problem = torchgco.Problem(
        torchgco.Unicycle(dt=0.1), torchgco.QuadraticCost([1.0] * 4, [1.0] * 2, [1.0] * 4), [], draw(3, 4), 6,
        horizon=torch.randint(2, 7, (3,), generator=draws),
    )  # fmt: skip

    def writes(X, U, t, problem):
        for argument in (X, U, t):
            argument.fill_(torch.inf)
        return X[:, 0, 0]

    metrics = {"end": lambda X, U, t, p: X[:, -1, 0], "effort": lambda X, U, t, p: U.square().sum((1, 2)),
               "last": lambda X, U, t, p: t[:, -1]}  # fmt: skip
    U = draw(3, 6, 2)
    want = metric_columns(metrics, problem, U, None, range(3))
    found = metric_columns({"writes": writes, **metrics}, problem, U, None, range(3))
    assert all(np.isfinite(want[name]).all() and np.array_equal(found[name], want[name]) for name in metrics)


def test_a_data_set_has_the_metrics_too(words: list[str], tmp_path: Path) -> None:
    more = [f"hydra.searchpath=[file://{tmp_path / 'mine'}]", *(word for word in words)]
    more = [word for word in more if not word.startswith("study.")]
    folder = str(tmp_path / "data")
    assert command.main([folder, *more]) == 0
    np.testing.assert_allclose(torchgco.read_dataset(folder)["fold"], np.abs(flown()[:, 2] - flown()[:, 3]).max())
