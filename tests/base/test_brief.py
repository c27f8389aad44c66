"""Representations are short, and name what differs from the defaults."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
import torch

import torchgco
from tests.problems import boxed_batch, planar_batch, quadrotor_batch
from torchgco import ControlBounds, Dynamics, Planar, Spheres, presets
from torchgco.base.brief import TEXT_LETTERS
from torchgco.problem.problem import Problem


@pytest.mark.parametrize("make", [planar_batch, quadrotor_batch, boxed_batch])
def test_a_problem_takes_a_few_lines(make) -> None:
    problem: Problem = make()[0]
    lines = repr(problem).splitlines()
    sizes = f"B={problem.B}, N={problem.N}, n={problem.n}, m={problem.m}, float64"
    assert lines[0] == f"Problem({sizes}" and len(lines) == 5 and max(map(len, lines)) < 2 * TEXT_LETTERS
    assert type(problem.dynamics).__name__ in lines[1] and "ControlBounds" in lines[3] and "radius" in lines[4]


@pytest.mark.parametrize("name", presets.PRESETS)
def test_solvers_are_short_and_name_changed_options(name: str) -> None:
    assert len(repr(presets.PRESETS[name](2))) <= TEXT_LETTERS
    changed = replace(presets.al_ilqr(2), max_outer_iterations=17)
    assert "max_outer_iterations=17" in repr(changed) and "initial_penalty" not in repr(changed)


def test_parts_show_few_numbers_and_shapes_of_more() -> None:
    assert repr(ControlBounds([-1, -2], [1, 2])) == "ControlBounds(lower=[-1, -2], upper=[1, 2])"
    spheres = Spheres(torch.zeros(3, 40, 2).double(), torch.ones(3, 40).double(), 0.1)
    assert repr(spheres) == "Spheres(centers=tensor(3, 40, 2), radii=tensor(3, 40), vehicle_radius=0.1)"
    bound = planar_batch(B=4, obstacles=5)[0]
    assert repr(bound.obstacles[0]) == "Spheres(4 to 5 each of 4 problems)"
    assert "lower=[-10, -10]" in repr(bound.constraints[1])
    assert repr(Planar(dt=0.3)) == "Planar(dt=0.3)"


def test_a_users_own_representation_is_kept() -> None:
    @dataclass(frozen=True)
    class Mine(Dynamics):
        dt: float = 0.1
        n, m = 1, 1

        def __repr__(self) -> str:
            return "mine"

    @dataclass(frozen=True)
    class Other(Mine):
        gain: float = 1.0

    assert repr(Mine()) == repr(Other()) == "mine"


def test_wrong_options_are_named_as_before() -> None:
    with pytest.raises(torchgco.InputError, match=r"solver: expected .*got Planar"):
        torchgco.solve(planar_batch(B=1)[0], solver=Planar())  # type: ignore[arg-type]
