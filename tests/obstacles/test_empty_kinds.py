"""A kind of obstacles of which there are none, beside others, changes no bit of an answer."""

from __future__ import annotations

import random
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
import torch

import torchgco
from tests.slow import mostly
from torchgco import (
    Boxes,
    Capsules,
    ControlBounds,
    FunctionConstraint,
    FunctionDynamics,
    Goal,
    OscillatingBoxes,
    Problem,
    QuadraticCost,
    RateBounds,
    Spheres,
    StateBounds,
    certify,
    judge,
)
from torchgco.base.errors import InputError
from torchgco.maps import Field, OccupancyGrid

NAN, R = float("nan"), 0.2


def none(*shape: int) -> torch.Tensor:
    return torch.zeros(*shape, dtype=torch.float64)


PRESENT: dict[str, Any] = {
    "spheres": Spheres([[3.0, 0.1]], [0.5], R),
    "boxes": Boxes([[3.0, 0.1]], [[0.3, 0.8]], R),
    "capsules": Capsules([[3.0, -0.5]], [[3.0, 0.6]], [0.2], R),
    "absent too": Spheres([[3.0, 0.1], [NAN, NAN]], [0.5, NAN], R),
}
EMPTY: dict[str, Any] = {
    "spheres": Spheres([], [], R),
    "spheres per problem": Spheres(none(2, 0, 2), none(2, 0), R),
    "absent spheres": Spheres([[NAN, NAN]] * 2, [NAN] * 2, R),
    "moving spheres": Spheres(none(0, 2), none(0), R, velocities=none(0, 2)),
    "boxes": Boxes([], [], R),
    "turned boxes": Boxes(none(0, 2), none(0, 2), R, rotations=none(0)),
    "absent boxes": Boxes([[NAN, NAN]], [[NAN, NAN]], R),
    "capsules": Capsules([], [], [], R),
    "absent capsules": Capsules([[NAN, NAN]], [[NAN, NAN]], [NAN], R),
    "oscillating boxes": OscillatingBoxes(Boxes(none(0, 2), none(0, 2), R), *[none(0, 1, 2)] * 3),
}
ROWS: dict[str, Any] = {
    "states": StateBounds([-9, -9, -2, -2], [9, 9, 2, 2]),
    "a function": FunctionConstraint(lambda x: x[..., 2:].square().sum(-1, keepdim=True) - 4.0),
    "rates": RateBounds(-1.5, 1.5),
    "controls": ControlBounds([-3, -3], [3, 3]),
}


def problem_of(constraints: list[Any]) -> Problem:
    """Two points of mass, two states and two speeds each, behind an obstacle."""
    step = lambda x, u: torch.cat((x[..., 2:], u), dim=-1)
    model = FunctionDynamics(step, 4, 2, 0.4, "euler", slice(0, 2))
    cost = QuadraticCost(Q=[0.1] * 4, R=[0.1] * 2, Qf=[50.0] * 4, x_ref=[6.0, 0, 0, 0])
    x0 = torch.tensor([[0, 0, 0, 0], [0, 0.4, 0, 0]], dtype=torch.float64)
    limits = ControlBounds([-2, -2], [2, 2])
    return Problem(model, cost, [limits, *constraints], x0, 15, Goal([6.0, 0], 0.5))


DRAWS = [*((seed, "native") for seed in range(8)), (2, "eager"), (7, "eager")]


@pytest.mark.sampled(1)
@pytest.mark.filterwarnings("ignore::torchgco.base.errors.ContactWarning")
@pytest.mark.parametrize(("seed", "native"), mostly(DRAWS, *DRAWS[4:], several=True), indirect=["native"])
def test_an_empty_kind_changes_no_bit(seed: int, native: bool) -> None:
    draw = random.Random(seed)
    present = [PRESENT[name] for name in draw.sample(sorted(PRESENT), 1 if seed % 2 else 2)]
    few = [*present, ROWS[sorted(ROWS)[seed % len(ROWS)]]]
    more = list(few)
    for name in draw.sample(sorted(EMPTY), 2):
        more.insert(draw.randrange(len(more) + 1), EMPTY[name])
    solver = "gco" if native else "gco_fast"
    plain, other = (problem_of(constraints) for constraints in (few, more))
    solution, again = (torchgco.solve(one, solver=solver, verbose=False) for one in (plain, other))
    for name in ("X", "U", "K", "d", "cost", "violation", "status", "iterations"):
        assert torch.equal(getattr(solution, name), getattr(again, name)), name
    pairs = [(judge(one, solution.U), certify(one, solution.X, solution.U)) for one in (plain, other)]
    for a, b in zip(*pairs, strict=True):
        for field in fields(a):
            assert torch.equal(getattr(a, field.name), getattr(b, field.name)), field.name


@pytest.mark.slow
def test_oscillating_boxes_and_maps_that_hold_nothing() -> None:
    """These are searched otherwise than no obstacle is; the answer is as good."""
    few = [PRESENT["boxes"], ROWS["states"]]
    absent = OscillatingBoxes(Boxes([[NAN, NAN]], [[NAN, NAN]], R), *[none(1, 1, 2)] * 3)
    empty = Field(OccupancyGrid(np.zeros((9, 9), bool), [-1, -1], 1.0), vehicle_radius=R)
    expected = torchgco.solve(problem_of(few), verbose=False)
    for part in (absent, empty):
        other = problem_of([part, *few])
        found = torchgco.solve(other, verbose=False)
        assert found.statuses == expected.statuses
        assert bool((found.violation <= 1e-6).all()) and bool((found.cost < 1.05 * expected.cost).all())
        assert torch.equal(judge(other, found.U).clearance, judge(problem_of(few), found.U).clearance)


@pytest.mark.parametrize("name", [name for name in EMPTY if "absent" not in name])
def test_of_an_empty_kind_absent_ones_can_be_chosen(name: str) -> None:
    (part,) = problem_of([EMPTY[name]]).obstacles
    chosen = part.chosen(torch.full((2, 3), -1))
    X, U = torch.ones(2, 16, 4).double(), torch.ones(2, 15, 2).double()
    assert chosen.absent.tolist() == [[True] * 3] * 2
    assert bool((chosen.value(X, U) == -1).all())
    assert bool(torch.isinf(chosen.signed_distance(X[..., :2], torch.arange(16).double())).all())


def test_numbers_of_an_empty_kind_are_checked_as_those_of_others() -> None:
    with pytest.raises(InputError, match="velocities"):
        problem_of([Spheres(none(0, 2), none(0), R, velocities=none(1, 2))])
