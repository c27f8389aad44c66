"""Exported C with a free start: the bits of `compile`, which chooses it anew in every call."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import torchgco
from tests.export.exported import M7, SAME, exported, needs, needs_compiler, on_board
from tests.export.kinds import car, point
from tests.slow import mostly
from torchgco import InputError, Problem, Spheres, StateBounds, Status, load_c

pytestmark = [
    needs_compiler,
    pytest.mark.usefixtures("quickly"),
    pytest.mark.filterwarnings("ignore::torchgco.ContactWarning"),
]
FREE = [False, True, True, False]


@pytest.fixture
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHGCO_CFLAGS", "-O1")


def within(**more: Any) -> Problem:
    """A point whose height and speed at the start are free within bounds, beside a disc."""
    inf = np.inf
    first = StateBounds([-inf, -0.2, -2.0, -inf], [inf, 0.6, 2.0, inf], knots=[0])
    return point(Spheres([[0.0, 0.1]], [0.3], 0.1), first, free_start=FREE, **more)


KINDS = {
    "alone": lambda: point(free_start=FREE),
    "bounds": within,
    "speed": lambda: car(Spheres([[2.5, 0.8]], [0.3], 0.2), free_start=[False, False, False, True]),
    "a place": lambda: point(Spheres([[0.0, 0.5]], [0.3], 0.1), free_start=[True, True, False, False]),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(within(), tmp_path_factory.mktemp("free"))


@pytest.mark.parametrize("push", [0.0, 0.03])
def test_40_periods_have_the_bits_of_python(folder: Path, push: float) -> None:
    c, compiled = load_c(folder), torchgco.compile(within(), "interior_point", receding=True)
    x, draws = within().x0[0].numpy(), np.random.default_rng(0)
    for k in range(40):
        answer = compiled(x0=x)
        assert torch.equal(c.step(x), answer.u[0]) and c.status == answer.statuses[0] == Status.CONVERGED, k
        assert torch.equal(c.plan[0], answer.X[0]) and c.workspace.iterations == int(answer.iterations[0])
        start = c.plan[0][0].numpy()
        assert (start[[0, 3]] == x[[0, 3]]).all() and -0.2 <= start[1] <= 0.6 and abs(start[2]) <= 2.0 + 1e-8
        x = answer.X[0, 1].numpy() + push * draws.standard_normal(4)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("receding", [True, False])
@pytest.mark.parametrize("kind", mostly(KINDS, "alone", "speed"))
def test_steps_have_the_bits_of_python(kind: str, receding: bool, tmp_path: Path) -> None:
    problem = KINDS[kind]()
    c = load_c(torchgco.export_c(problem, tmp_path, "car", receding))
    compiled = torchgco.compile(problem, "interior_point", receding=receding)
    x, draws = problem.x0[0].numpy(), np.random.default_rng(1)
    for k in range(8):
        answer = compiled(x0=x)
        u = c.step(x)
        if bool(answer.warm[0]) or k == 0:
            assert torch.equal(u, answer.u[0]) and torch.equal(c.plan[0], answer.X[0]), k
        assert c.status == answer.statuses[0] == Status.CONVERGED
        x = problem.x0[0].numpy() + 0.1 * draws.standard_normal(4)


def test_what_is_free_of_a_measured_state_is_a_first_guess(folder: Path) -> None:
    """It leads nowhere else, and has to be finite."""
    starts = []
    for height in (-0.2, 0.55, 3.0):
        c = load_c(folder)
        c.step([-1.0, height, 5.0 * height, 0.0])
        assert c.status == Status.CONVERGED
        starts.append(c.plan[0][0])
    torch.testing.assert_close(starts[1], starts[2], rtol=0, atol=1e-5)
    u = np.zeros(2)
    assert c.raw_step(np.array([-1.0, np.nan, 0.0, 0.0]), 1.0, np.inf, u) == -1 and c.held
    with pytest.raises(InputError):
        c.step([-1.0, np.nan, 0.0, 0.0])


def test_a_guess_in_an_obstacle_is_none_that_is_stood_in(tmp_path: Path) -> None:
    problem = KINDS["a place"]()
    c = load_c(exported(problem, tmp_path))
    c.step([0.0, 0.52, 0.0, 0.0])
    assert c.status != Status.INVALID_START


def test_compiled_problems_choose_the_start_in_c() -> None:
    """Warm calls give what solves from nothing give."""
    problem, draws = KINDS["alone"](), np.random.default_rng(2)
    compiled = torchgco.compile(problem, "interior_point")
    compiled()
    for _ in range(4):
        x = problem.x0 + 0.1 * torch.from_numpy(draws.standard_normal((1, 4)))
        answer = compiled(x0=x)
        same = Problem(problem.dynamics, problem.cost, list(problem.constraints), x, problem.N, free_start=FREE)
        fresh = torchgco.solve(same, solver="interior_point", verbose=False)
        assert bool(answer.warm[0]) and answer.statuses == fresh.statuses == [Status.CONVERGED]
        torch.testing.assert_close(answer.X, fresh.X, rtol=0, atol=1e-5)


@pytest.mark.slow
@needs("arm-none-eabi-gcc", "qemu-system-arm")
def test_a_cortex_m7(folder: Path, tmp_path: Path) -> None:
    assert on_board(M7, "-Os", "car.c", "car_test.c", folder=folder, program=tmp_path / "run").startswith(SAME)
