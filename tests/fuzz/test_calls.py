"""Any value for any argument of the public parts is accepted, or refused in one clear line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

import torchgco
from tests.fuzz.tally import accepted_or_refused, examples
from tests.problems import planar_batch
from torchgco import (
    Boxes,
    ControlBounds,
    FunctionConstraint,
    FunctionDynamics,
    Planar,
    Problem,
    QuadraticCost,
    QuadrotorPlanning,
    Spheres,
    StateBounds,
    judge,
)
from torchgco.problem.goal import Goal
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.ilqr import ILQR

pytestmark = pytest.mark.slow

QUICK = AugmentedLagrangian(ILQR(max_iterations=3), initial_penalty=0.1, max_outer_iterations=2)
WHOLE, REST = planar_batch(B=2, N=6, obstacles=2)
NUMBERS = st.one_of(
    st.integers(-3, 8), st.floats(-3, 3), st.sampled_from([0.0, np.nan, np.inf, -np.inf, 1e200, 1e-320, 10**24, -1])
)
OBJECTS = st.sampled_from(
    [
        None, True, "abc", "", b"x", {}, {"a": 1}, (), [], [[]], [None], ["a"], [[1, 2], [3]], object(), int, len, 1j,
        slice(1, 3), range(3), {1, 2}, np.datetime64("2020-01-01"), Path("x"), WHOLE, Planar(dt=0.1),
    ]
)  # fmt: skip
SHAPES = arrays.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=6)
DTYPES = st.sampled_from(
    [torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.int64, torch.bool, torch.complex128]
)


@st.composite
def tensors(draw: Any) -> torch.Tensor:
    held = torch.from_numpy(draw(arrays.arrays(float, draw(SHAPES), elements=st.floats(-3, 3))))
    made = held.to(draw(DTYPES))
    if made.is_floating_point() and draw(st.integers(0, 5)) == 0:
        return made.requires_grad_()
    return made


ARRAYS = arrays.arrays(float, SHAPES, elements=st.floats(-3, 3))
ANY = st.one_of(NUMBERS, OBJECTS, tensors(), ARRAYS, st.lists(NUMBERS, max_size=6))


def problem(**given: Any) -> Any:
    parts = {"dynamics": WHOLE.dynamics, "cost": WHOLE.cost, "constraints": WHOLE.constraints, "x0": WHOLE.x0, "N": 6}
    made = Problem(**{**parts, **given})
    return made


def with_constraint(kind: Any) -> Callable[..., Any]:
    return lambda **given: problem(constraints=[kind(**given)])


def with_cost(**given: Any) -> Any:
    return problem(cost=QuadraticCost(**given))


def solve(**given: Any) -> Any:
    given = {"problem": WHOLE, "U0": REST, **given}
    return QUICK.solve(**given)


def first_state(x: torch.Tensor) -> torch.Tensor:
    return x[..., :1]


def drive(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    return torch.cat((x[..., 3:], u, u[..., :1]), dim=-1)


# Each part with arguments that it accepts.
PARTS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "Problem": (problem, {"dynamics": None, "cost": None, "constraints": None, "x0": None, "N": None, "goal": None}),
    "Spheres": (
        with_constraint(Spheres),
        {"centers": [[0.0, 0.5]], "radii": [0.1], "vehicle_radius": 0.05, "velocities": [[0.1, 0.0]], "knots": [1, 2]},
    ),
    "Boxes": (
        with_constraint(Boxes),
        {"centers": [[0.0, 0.5]], "half_sizes": [[0.1, 0.1]], "vehicle_radius": 0.05, "rotations": [0.3], "knots": [1]},
    ),
    "ControlBounds": (with_constraint(ControlBounds), {"lower": [-1.0, -1.0], "upper": [1.0, 1.0]}),
    "StateBounds": (with_constraint(StateBounds), {"lower": [-9.0] * 6, "upper": [9.0] * 6}),
    "FunctionConstraint": (
        with_constraint(FunctionConstraint),
        {"function": first_state, "sense": "equality", "knots": [6], "of": "x", "geometric": False},
    ),
    "QuadraticCost": (
        with_cost, {"Q": [1.0] * 6, "R": [0.1] * 2, "Qf": [5.0] * 6, "x_ref": [0.5] * 6, "u_ref": [0.0, 0.0]},
    ),
    "Planar": (lambda **given: problem(dynamics=Planar(**given)), {"dt": 0.1}),
    "FunctionDynamics": (
        lambda **given: problem(dynamics=FunctionDynamics(**given)),
        {"function": drive, "n": 6, "m": 2, "dt": 0.1, "integrator": "rk4", "position": slice(0, 2)},
    ),
    "QuadrotorPlanning": (lambda **given: QuadrotorPlanning(**given), {"dt": 0.1}),
    "Goal": (lambda **given: problem(goal=Goal(**given)), {"position": [0.5, 0.4], "radius": 0.1}),
    "judge": (
        lambda **given: judge(**{"problem": WHOLE, "U": REST, "goal": [[0.5, 0.4]] * 2, "goal_radius": 0.1, **given}),
        {"U": REST, "goal": [[0.5, 0.4]] * 2, "goal_radius": 0.1},
    ),
    "solve": (
        solve,
        {"U0": REST, "seed": 0, "ids": torch.arange(2), "warm": None, "callback": None, "max_seconds": 9.0},
    ),
    "torchgco.solve": (
        lambda **given: torchgco.solve(WHOLE, **{"solver": QUICK, **given}),
        {"U0": REST, "solver": QUICK, "ids": None, "seed": 0, "max_seconds": 9.0, "warm": None},
    ),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("part", PARTS)
@settings(max_examples=examples(150))
@given(data=st.data())
def test_any_value_of_an_argument(part: str, data: st.DataObject) -> None:
    make, sound = PARTS[part]
    name = data.draw(st.sampled_from(list(sound)))
    given_ = {} if part in ("Problem", "judge", "solve", "torchgco.solve") else dict(sound)
    given_[name] = data.draw(ANY)
    accepted_or_refused("arguments from Python", lambda: make(**given_))
