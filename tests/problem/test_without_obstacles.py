"""A problem may have no obstacles, and a constraint without rows is satisfied."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

import torchgco
from tests.engines import compiled
from tests.problems import planar_batch, quick_gco
from tests.search.rows import proposed
from tests.slow import mostly
from torchgco import (
    ControlBounds,
    FunctionConstraint,
    Hold,
    InputError,
    IteratedMPPI,
    Layouts,
    Problem,
    Spheres,
    certify,
    judge,
)
from torchgco.experiments import app
from torchgco.search import MultiStart, PathProposals, Refine

GOAL = torch.tensor([1.0, 0.4], dtype=torch.float64)
BOUNDS = ControlBounds([-10, -10], [10, 10])
EMPTY = {
    "a list": Spheres([], [], 0.06),
    "shared": Spheres(np.zeros((0, 2)), np.zeros(0), 0.06),
    "one set each": Spheres(np.zeros((2, 0, 2)), np.zeros((2, 0)), 0.06),
    "moving": Spheres(np.zeros((2, 0, 2)), np.zeros((2, 0)), 0.06, np.zeros((2, 0, 2))),
    "absent": Spheres(np.full((3, 2), np.nan), np.full(3, np.nan), 0.06),
    "rows of x": FunctionConstraint(lambda x: x[..., :0]),
    "geometric": FunctionConstraint(lambda x: x[..., :0], geometric=True),
    "rows of u": FunctionConstraint(lambda u: u.new_zeros(*u.shape[:-1], 0), of="u"),
    "equality": FunctionConstraint(lambda x, u: x[..., :0], of="xu", sense="equality"),
}
GUIDED = quick_gco(planar_batch()[0])
SOLVERS = {
    "gco": GUIDED,
    "multistart": MultiStart(replace(GUIDED.local, guidance=None, max_outer_iterations=2), starts=2),
    "mppi": IteratedMPPI(iterations=2),
    "hold": Hold(),
}


def planar(*constraints) -> tuple[Problem, torch.Tensor]:
    problem, U0 = planar_batch(B=2, N=25)
    return Problem(problem.dynamics, problem.cost, constraints, problem.x0, problem.N), U0


@pytest.mark.sampled(7)
@pytest.mark.parametrize("kind", mostly(EMPTY, *list(EMPTY)[1::2]))
@pytest.mark.parametrize("solver", SOLVERS)
def test_empty_constraints_change_nothing(kind: str, solver: str) -> None:
    free, U0 = planar(BOUNDS)
    problem, _ = planar(EMPTY[kind], BOUNDS)
    expected, got = (torchgco.solve(p, U0, SOLVERS[solver]) for p in (free, problem))
    if solver == "gco":  # by another local solver where no constraint is geometric: the same, but not to the last bit
        torch.testing.assert_close(got.cost, expected.cost, rtol=1e-7, atol=0)
        assert got.guided.tolist() == [0, 0] and got.statuses == expected.statuses
        return
    assert torch.equal(got.U, expected.U) and got.status.tolist() == expected.status.tolist()
    assert got.violation.tolist() == expected.violation.tolist() and got.guided.tolist() == [0, 0]
    wanted, verdict = (judge(p, got.U, GOAL, 0.3) for p in (free, problem))
    for mine, theirs in zip(vars(verdict).values(), vars(wanted).values(), strict=True):
        assert mine.tolist() == theirs.tolist()
    assert verdict.clearance.tolist() == verdict.clearance_knots.tolist() == [torch.inf] * 2
    certificate = certify(problem, got.X, got.U)
    assert certificate.clearance.tolist() == [torch.inf] * 2
    assert certificate.kkt_residual.tolist() == certify(free, got.X, got.U).kkt_residual.tolist()


@pytest.mark.parametrize("kind", ["shared", "absent", "geometric"])
def test_no_path_is_proposed(kind: str) -> None:
    problem, _ = planar(EMPTY[kind], BOUNDS)
    assert not bool(proposed(PathProposals(), problem).found.any())


@pytest.mark.filterwarnings("ignore::torchgco.ContactWarning")  # 0.1 s between knots is long
@compiled
def test_empty_spheres_next_to_others_are_as_good_as_none() -> None:
    problem, U0 = planar_batch(B=2, N=25, obstacles=6, seed=4)
    more = Problem(problem.dynamics, problem.cost, [EMPTY["shared"], *problem.constraints], problem.x0, problem.N)
    expected, got = (torchgco.solve(p, U0, GUIDED) for p in (problem, more))
    assert int(expected.guided.sum()) > 0 and torch.equal(got.U, expected.U)
    alone, with_empty = (proposed(PathProposals(refine=Refine(top=2)), p) for p in (problem, more))
    assert torch.equal(alone.found, with_empty.found) and torch.equal(alone.U, with_empty.U)


def test_a_negative_radius_is_named_where_there_is_no_obstacle() -> None:
    with pytest.raises(InputError, match="at least 0 m, got -"):
        planar(Spheres(np.zeros((0, 2)), np.zeros(0), -0.5))


def test_a_constraint_that_is_no_sphere_decides_feasibility() -> None:
    """Its clearance is infinite, because no distance is known; its violation counts."""
    wall = FunctionConstraint(lambda x: x[..., :1] - 0.5, geometric=True)  # the goal lies behind it
    problem, U0 = planar(wall, BOUNDS)
    at_goal = torchgco.solve(planar(BOUNDS)[0], U0).U
    beyond, before = judge(problem, at_goal, GOAL, 0.3), judge(problem, U0, GOAL, 0.3)
    assert beyond.clearance.tolist() == before.clearance.tolist() == [torch.inf] * 2
    assert float(beyond.violation.min()) > 0.1
    assert beyond.feasible.tolist() == [False] * 2 and before.feasible.tolist() == [True] * 2


PEERS = ["hold", "mppi", "gco_paper", "al_ilqr", "multistart", "ipopt", "fatrop", "fatrop_guided"]
QUICK = ["scenario.stages=12", "study.layouts=2", "study.workers=1", f"study.baselines=[{','.join(PEERS)}]"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ["model=planar", "scenario=planar_random", "scenario.num_obstacles=0"],
        ["scenario=forest_moving", "scenario.density=0.001"],
        ["model=planar", "scenario=layouts", "scenario.path=none.npz"],
        ["model=planar", "scenario=layouts", "scenario.path=absent.npz"],
    ],
)
def test_every_solver_flies_an_empty_scene(words: list[str], tmp_path: Path, monkeypatch, capsys) -> None:
    state = np.array([-1.0, 0, 0, 0, 0, 0])
    for name, M in (("none", 0), ("absent", 2)):
        centers, radii = np.full((2, M, 2), np.nan), np.full((2, M), np.nan)
        layouts = Layouts(centers, radii, start=state, goal=-state, goal_radius=0.3, dt=0.1, stages=12)
        layouts.save(tmp_path / f"{name}.npz")
    quick = QUICK if "scenario=layouts" not in words else QUICK[1:]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["torchgco", *words, *quick, "hydra.run.dir=out"])
    assert app.main() == 0, capsys.readouterr().err
    trials = pd.read_parquet(tmp_path / "out" / "trials.parquet")
    assert trials.solver.nunique() == len(PEERS) + 1 and np.isinf(trials.clearance).all()
    assert np.isinf(trials.clearance_full[trials.feasible]).all() and (trials.guided == 0).all()
    assert len(list((tmp_path / "out" / "figures").iterdir())) > 0
