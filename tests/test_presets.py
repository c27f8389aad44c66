"""Commands, API and presets have the same settings for every solver, and `solve` uses those of `solver=gco`."""

from __future__ import annotations

import pytest
import torch

import torchgco
from tests.problems import planar_batch
from torchgco import InputError, Problem, QuadraticCost, presets, solve
from torchgco.presets import PRESETS

MODELS = {"planar": (2, "planar_trap"), "quadrotor": (3, "forest"), "unicycle": (2, "yard")}


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("model", MODELS)
def test_the_configuration_of_a_solver_is_its_preset(model: str, name: str) -> None:
    space, scenario = MODELS[model]
    words = [f"model={model}", f"scenario={scenario}", "scenario.stages=5"]
    setup = torchgco.compose([*words, f"solver={name}"])
    assert setup.solver == PRESETS[name](space) == PRESETS[name](setup.task(setup.layouts(1)).problem)


@pytest.mark.parametrize("model", MODELS)
def test_solve_gives_the_bits_of_the_configuration_gco(model: str) -> None:
    _, scenario = MODELS[model]
    setup = torchgco.compose([f"model={model}", f"scenario={scenario}", "scenario.stages=40"])
    task = setup.task(setup.layouts(2))
    mine, theirs = solve(task.problem), setup.solver.solve(task.problem, task.U0, seed=setup.seed)
    assert torch.equal(mine.U, theirs.U) and torch.equal(mine.iterations, theirs.iterations)


def test_an_option_on_the_command_line_changes_that_option_alone() -> None:
    setup = torchgco.compose(["solver.paths.num_paths=3", "solver.local.inner.max_iterations=7"])
    solver = presets.gco(3)
    assert setup.solver.paths.num_paths == 3 and setup.solver.paths.roadmap == solver.paths.roadmap
    assert setup.solver.local.inner.max_iterations == 7 and setup.solver.sampling == solver.sampling
    with pytest.raises(InputError, match="num_path"):
        torchgco.compose(["solver.paths.num_path=3"])


def test_a_problem_without_a_position_gets_the_planar_settings() -> None:
    dynamics = torchgco.FunctionDynamics(lambda x, u: u, 1, 1, 0.1)
    problem = Problem(dynamics, QuadraticCost([1.0], [1.0], [1.0]), [], torch.ones(1, 1, dtype=torch.float64), 5)
    assert presets.gco(problem) == presets.gco(2) != presets.gco(3)


def test_solve_takes_the_name_of_a_preset() -> None:
    problem, _ = planar_batch(B=2, N=8, obstacles=1)
    for name in ("al_ilqr", "hold"):
        assert torch.equal(solve(problem, solver=name).U, solve(problem, solver=presets.PRESETS[name](problem)).U)
    for name in ("none", "", "gco "):
        with pytest.raises(InputError, match=r"^solver: expected one of gco, gco_fast, .*, or a solver, got '"):
            solve(problem, solver=name)
