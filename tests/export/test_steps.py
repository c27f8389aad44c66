"""An exported controller does what `MPC` does: in the same loops it gives the same bits, statuses and held plans."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import torchgco
from tests.export.exported import exported, needs_compiler
from tests.export.kinds import DT, car, car_rates, reference
from torchgco import (
    ControlBounds,
    FunctionCost,
    FunctionDynamics,
    InputError,
    LoadedController,
    Problem,
    Spheres,
    StateBounds,
    Status,
    load_c,
)

pytestmark = needs_compiler
WARM = {Status.CONVERGED}


def plant(x: np.ndarray, u: np.ndarray, h: float) -> np.ndarray:
    """The car after h seconds, in four steps of Runge and Kutta."""
    f = lambda z: car_rates(torch.from_numpy(z), torch.from_numpy(u)).numpy()
    for _ in range(4):
        s = h / 4
        a = f(x)
        b = f(x + s / 2 * a)
        c = f(x + s / 2 * b)
        x = x + s / 6 * (a + 2 * b + 2 * c + f(x + s * c))
    return x


def discs() -> Problem:
    return car(
        Spheres([[6.0, 1.6], [12.0, -1.0]], [0.5, 0.5], 0.3), StateBounds(-np.inf, [np.inf, np.inf, np.inf, 4.5])
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(discs(), tmp_path_factory.mktemp("car"))


def pair(folder: Path, period: float = DT, problem: Problem | None = None) -> tuple[LoadedController, torchgco.MPC]:
    limit = float("inf")
    mpc = torchgco.MPC(discs() if problem is None else problem, "interior_point", period, max_seconds=limit)
    return load_c(folder, period=period), mpc


@pytest.mark.sampled(2)
@pytest.mark.parametrize("push", [0.0, 0.02])
@pytest.mark.parametrize("period", [DT, 0.5 * DT, 0.17])
def test_200_periods_have_the_bits_of_python(folder: Path, period: float, push: float) -> None:
    c, mpc = pair(folder, period)
    x, draws = np.array([0.0, 0.0, 0.0, 3.0]), np.random.default_rng(0)
    for k in range(200):
        u, v = mpc.step(x, x_ref=reference(period * k)), c.step(x, x_ref=reference(period * k))
        assert torch.equal(u, v) and c.status == mpc.statuses[0] and c.held == bool(mpc.held), k
        assert mpc.answer is not None and c.workspace.iterations == int(mpc.answer.iterations[0])
        assert c.t == pytest.approx(mpc.t)
        x = plant(x, u.numpy(), period) + push * draws.standard_normal(4)


@pytest.mark.sampled(1)
@pytest.mark.filterwarnings("ignore::torchgco.StartWarning", "ignore::torchgco.ContactWarning")
@pytest.mark.parametrize("seed", [0, 1])
def test_pushed_into_discs_it_solves_what_python_solves_from_plans(folder: Path, seed: int) -> None:
    """Pushes of 0.15 m and m/s: bits are equal until a solve fails. Python then has ways to come to rest, which C
    hasn't."""
    c, mpc = pair(folder)
    x, draws, equal, failed = np.array([0.0, 0.0, 0.0, 3.0]), np.random.default_rng(seed), True, 0
    for k in range(200):
        u, v = mpc.step(x, x_ref=reference(DT * k)), c.step(x, x_ref=reference(DT * k))
        status = mpc.statuses[0]
        failed += c.held
        equal &= not c.held and not bool(mpc.held)
        assert c.held == (c.status not in WARM)
        assert (status == Status.INVALID_START) == (c.status == Status.INVALID_START) or not bool(mpc.held)
        if equal and bool(mpc.answer.warm[0]):
            assert torch.equal(u, v) and status == c.status
        assert bool((v >= torch.tensor([-3.0, -0.5])).all()) and bool((v <= torch.tensor([3.0, 0.5])).all())
        x = plant(x, u.numpy(), DT) + 0.15 * draws.standard_normal(4)
    assert failed < 100


def test_a_late_step_holds_the_plan_with_feedback(folder: Path) -> None:
    c, x = load_c(folder), np.array([0.0, 0.0, 0.0, 3.0])
    c.step(x)
    X, U, K = c.plan
    x = plant(x, U[0].numpy(), DT) + np.array([0.0, 0.3, 0.05, 0.0])
    for age in (1, 2):
        u = c.step(x, max_seconds=1e-9)
        want = U[age] + K[age] @ (torch.from_numpy(x) - X[age])
        torch.testing.assert_close(
            u, want.clamp(torch.tensor([-3.0, -0.5]), torch.tensor([3.0, 0.5])), rtol=0, atol=1e-12
        )
        assert c.held and c.status == Status.TIME_LIMIT and c.workspace.age == age
    assert not (c.step(x), c.held)[1] and c.status == Status.CONVERGED


def test_a_limit_of_iterations_is_the_same_everywhere(folder: Path) -> None:
    """What it leaves is where the next step begins; what keeps the constraints is flown."""
    c, x, steps = load_c(folder), np.array([0.0, 0.0, 0.0, 3.0]), list[Status]()
    c.workspace.max_iterations, u = 3, np.zeros(2)
    while Status.CONVERGED not in steps and len(steps) < 20:
        steps.append(Status(c.raw_step(x, 0.0, np.inf, u)))
        assert c.workspace.iterations <= 3 and c.held == (steps[-1] == Status.TIME_LIMIT)
    assert steps[-1] == Status.CONVERGED and len(steps) > 1


def test_a_guess_leads_to_the_plan_that_it_is_near(folder: Path) -> None:
    """As one that a search on a larger computer has found."""
    problem = discs()
    found = torchgco.solve(problem, solver="interior_point", verbose=False)
    c = load_c(folder)
    c.guess(found.X[0], found.U[0])
    u = c.step(problem.x0[0])
    torch.testing.assert_close(u, found.U[0, 0], rtol=0, atol=1e-6)
    assert c.status == Status.CONVERGED and c.workspace.iterations < 20
    for X, U in ((found.X, found.U[0]), (found.X[0], found.U[0, 1:])):
        with pytest.raises(InputError):
            c.guess(X, U)


def test_a_workspace_is_all_there_is(folder: Path) -> None:
    """A copy of its bytes goes on as the original does, and two controllers don't know each other."""
    one, other = load_c(folder), load_c(folder)
    x = np.array([0.0, 0.0, 0.0, 3.0])
    one.step(x)
    ctypes.memmove(ctypes.byref(other.workspace), ctypes.byref(one.workspace), ctypes.sizeof(one.workspace))
    other._begun, other.t = True, one.t
    far = x + np.array([0.3, 0.1, 0.0, 0.0])
    assert torch.equal(one.step(far), other.step(far))
    one.reset()
    again = load_c(folder)
    assert torch.equal(one.step(x), again.step(x)) and not torch.equal(other.step(far), again.step(far))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_bad_state_is_no_step(folder: Path, bad: float) -> None:
    """It flies the plan before without feedback, as of a sensor that fails for a period."""
    c, x = load_c(folder), np.array([0.0, 0.0, 0.0, 3.0])
    c.step(x)
    U = c.plan[1]
    with pytest.raises(InputError):
        c.step([0.0, bad, 0.0, 3.0])
    state, u = np.array([0.0, bad, 0.0, 3.0]), np.zeros(2)
    assert c.raw_step(state, 1.0, np.inf, u) == -1 and np.array_equal(u, U[1].numpy()) and c.held
    assert c.raw_step(x, -1.0, np.inf, u) == -1 and c.raw_step(x, np.nan, np.inf, u) == -1
    assert c.raw_step(plant(plant(x, U[0].numpy(), DT), U[1].numpy(), DT), 1.0, np.inf, u) == Status.CONVERGED


@pytest.mark.parametrize(
    ("name", "value"),
    [("x_ref", np.nan), ("radii", -0.1), ("R", -1.0), ("constraints_0_upper", [-4.0, 0.5]), ("centers", np.inf),
     ("constraints_0_lower", np.nan), ("constraints_0_lower", np.inf), ("constraints_0_upper", -np.inf),
     ("constraints_2_upper", 1.0)],
)  # fmt: skip
def test_numbers_that_the_problem_cannot_have_are_refused(folder: Path, name: str, value: Any) -> None:
    c, x = load_c(folder), np.array([0.0, 0.0, 0.0, 3.0])
    c.step(x)
    before = c.numbers[name].copy()
    u = c.step(x, numbers={name: np.broadcast_to(value, c.numbers[name].shape)})
    assert c.workspace.status == -2 and c.held
    assert bool((u.abs() <= torch.tensor([3.0, 0.5])).all()), "a bound that can't be isn't kept"
    with pytest.raises(InputError, match="numbers"):
        c.status  # noqa: B018
    c.step(x, numbers={name: before})
    assert c.status == Status.CONVERGED


@pytest.mark.parametrize("seed", range(3))
def test_a_step_that_is_refused_changes_nothing(folder: Path, seed: int) -> None:
    draws, c = np.random.default_rng(seed), load_c(folder)
    c.step([0.0, 0.0, 0.0, 3.0])
    new = {name: value + draws.uniform(0.0, 0.1, value.shape) for name, value in c.numbers.items()}
    before, t = {name: value.copy() for name, value in c.numbers.items()}, c.t
    name = str(draws.choice(list(new)))
    for wrong, told in (
        ({"numbers": new, name: new[name]}, f"each number once, got {name} twice"),
        ({"numbers": new | {"nothing": 1.0}}, "got nothing"),
        ({"numbers": new | {"x_ref": new["x_ref"][1:]}}, "x_ref: expected shape"),
        ({"numbers": new, "t": -1.0}, "a time after"),
    ):
        with pytest.raises(InputError, match=told):
            c.step([0.1, 0.0, 0.0, 3.0], **wrong)
        assert all(np.array_equal(c.numbers[each], before[each]) for each in before) and c.t == t


@pytest.mark.slow
def test_from_a_saddle_point_it_goes_on_beside(tmp_path: Path) -> None:
    """On the top between two valleys staying fulfils the conditions of first order, and neither C nor Python stays."""
    hill = lambda x: (x[..., 0].square() - 1.0).square()
    cost = FunctionCost(lambda x, u: hill(x) + 0.1 * u[..., 0].square(), lambda x: 5.0 * hill(x))
    model = FunctionDynamics(lambda x, u: u, 1, 1, DT)
    problem = Problem(model, cost, [ControlBounds(-2.0, 2.0)], [0.0], 12)
    c, mpc = pair(exported(problem, tmp_path), problem=problem)
    u, v = mpc.step([0.0]), c.step([0.0])
    assert torch.equal(u, v) and c.status == mpc.statuses[0] == Status.CONVERGED and abs(float(v[0])) > 0.1
    assert mpc.answer is not None and c.workspace.iterations == int(mpc.answer.iterations[0])


@pytest.mark.slow
def test_a_plan_can_be_without_a_receding_horizon(tmp_path: Path) -> None:
    folder = torchgco.export_c(discs(), tmp_path, name="sweep", receding=False)
    c, compiled = load_c(folder), torchgco.compile(discs(), "interior_point")
    for k in range(5):
        x = [0.1 * k, 0.0, 0.0, 3.0]
        assert torch.equal(c.step(x), compiled(x0=x).u[0]) and c.workspace.age == 0
