"""Commands, API and presets have the same settings for every solver, and `solve` uses those of `solver=gco`."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any

import pytest
import torch

import torchgco
from tests.problems import planar_batch
from tests.slow import mostly
from torchgco import InputError, Problem, QuadraticCost, judge, presets, solve
from torchgco.experiments.config.groups import _tree
from torchgco.experiments.results.identity import flat
from torchgco.presets import PRESETS
from torchgco.search import Passes, Starts
from torchgco.solvers.interior import InteriorPoint

MODELS = {"planar": (2, "planar_trap"), "quadrotor": (3, "forest"), "unicycle": (2, "yard")}


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("model", MODELS)
def test_the_configuration_of_a_solver_is_its_preset(model: str, name: str) -> None:
    space, scenario = MODELS[model]
    words = [f"model={model}", f"scenario={scenario}", "scenario.stages=5"]
    setup = torchgco.compose([*words, f"solver={name}"])
    assert setup.solver == PRESETS[name](space) == PRESETS[name](setup.task(setup.layouts(1)).problem)


@pytest.mark.filterwarnings("ignore::torchgco.HorizonWarning")  # 40 stages are few for a unicycle
@pytest.mark.parametrize("model", mostly(["planar", "quadrotor", "unicycle"], "quadrotor", "unicycle"))
def test_solve_gives_the_bits_of_the_configuration_gco(model: str) -> None:
    _, scenario = MODELS[model]
    setup = torchgco.compose([f"model={model}", f"scenario={scenario}", "scenario.stages=40"])
    task = setup.task(setup.layouts(2))
    mine, theirs = solve(task.problem), setup.solver.solve(task.problem, task.U0, seed=setup.seed)
    assert torch.equal(mine.U, theirs.U) and torch.equal(mine.iterations, theirs.iterations)


def test_an_option_on_the_command_line_changes_that_option_alone() -> None:
    setup = torchgco.compose(["solver.passes.paths.num_paths=3", "solver.local.inner.max_iterations=7"])
    solver = presets.gco(3)
    inner = replace(solver.local.inner, max_iterations=7)
    assert setup.solver.local == replace(solver.local, inner=inner)
    changed = replace(solver.passes.paths, num_paths=3)
    assert changed != solver.passes.paths and setup.solver.passes.names == solver.passes.names
    assert setup.solver.passes == solver.passes.changed(paths=changed)
    with pytest.raises(InputError, match=r"^solver\.passes\.paths\.num_path: .*such as num_paths"):
        torchgco.compose(["solver.passes.paths.num_path=3"])


def test_a_row_is_left_out_on_the_command_line() -> None:
    setup = torchgco.compose(["~solver.passes.samples"])
    assert setup.solver.passes == presets.gco(3).passes.changed(samples=None)
    assert "samples" not in setup.solver.passes.names


def changed(value: Any, place: str, words: list[str]) -> Any:
    """The rows, with another value for every number in them; `words` collects the overrides that lead there."""
    if is_dataclass(value):
        names = [field.name for field in fields(value)]
        return replace(value, **{name: changed(getattr(value, name), f"{place}.{name}", words) for name in names})
    if isinstance(value, Passes):
        return Passes({name: changed(row, f"{place}.{name}", words) for name, row in value.items()})
    if isinstance(value, tuple) and any(map(is_dataclass, value)):
        return tuple(changed(item, f"{place}.{number}", words) for number, item in enumerate(value))
    new = other(value)
    if new != value:
        words.append(f"{place}={listed(new)}")
    return new


def other(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(map(other, value))
    if type(value) is int:
        return value + 1 if value > 1 else value
    return (0.9 * value or 0.05) if type(value) is float else value


def listed(value: Any) -> str:
    return f"[{','.join(map(listed, value))}]" if isinstance(value, tuple) else str(value)


@pytest.mark.parametrize("model", ["planar", "quadrotor"])
def test_every_number_of_a_row_changes_by_the_name_of_its_row(model: str) -> None:
    space, scenario = MODELS[model]
    words: list[str] = []
    passes = changed(presets.gco(space).passes, "solver.passes", words)
    setup = torchgco.compose([f"model={model}", f"scenario={scenario}", *words])
    assert setup.solver == replace(presets.gco(space), passes=passes)
    assert len(words) > 15 and any(".paths.follow.stiffness=[" in word for word in words)


def test_the_table_of_the_default_is_short() -> None:
    """What a person can read in a minute, and change: kinds of rows, and options of rows and solvers."""
    for space in (2, 3):
        solver = presets.gco(space)
        assert len({type(row) for row in solver.passes}) <= 7 and len(solver.passes) <= 8
        assert len([name for name in flat(_tree(solver)) if not name.endswith("_target_")]) <= 62
        assert all(row.problems not in ("", "none") for row in solver.passes)


@pytest.mark.slow
def test_more_effort_costs_no_more() -> None:
    """`gco_max` makes the passes of `gco`, then more: its results arrive wherever those do, and cost no more."""
    for words in (["scenario=woods"], ["scenario=mazes"], ["model=planar", "scenario=planar_random"]):
        setup = torchgco.compose([*words, "seed=7"])
        problem = setup.task(setup.layouts(3)).problem
        usual, more = (judge(problem, solve(problem, solver=name).U) for name in ("gco", "gco_max"))
        assert bool((more.reached | ~usual.reached).all()), words
        assert bool((more.cost <= usual.cost * (1 + 1e-9))[usual.reached].all()), words


def test_the_most_thorough_preset_has_the_rows_of_the_default_and_more() -> None:
    for space in (2, 3):
        usual, more = presets.gco(space), presets.gco_max(space)
        begin, end = usual.passes[:-2], (*usual.passes[-2:], Starts(when="all"))
        assert more.local == usual.local and len(more.passes) > len(usual.passes)
        assert more.passes[: len(begin)] == begin and more.passes[-3:] == end


def test_the_exact_preset_has_the_rows_of_the_default_with_tighter_ends() -> None:
    for space in (2, 3):
        usual, exact = presets.gco(space), presets.gco_exact(space)
        assert exact == replace(usual, interior=InteriorPoint(tolerance=1e-12, violation_tolerance=1e-9)) != usual


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
