"""A loop by `MPC`: what it returns, what it holds, and what it never does again."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import torchgco
from tests.compiled.test_compiled import CAR, DT, N, bicycle, path
from torchgco import (
    MPC,
    MPPI,
    ControlBounds,
    Dynamics,
    FunctionDynamics,
    InputError,
    Problem,
    QuadraticCost,
    RateBounds,
    Spheres,
    StateBounds,
    Status,
)
from torchgco.native import compiler
from torchgco.native.compiler import find_compiler

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
START = np.array([0.0, 0.0, 0.0, 3.0])
LOWER, UPPER = np.array([-3.0, -0.5]), np.array([3.0, 0.5])


def driven(B: int = 1, *more: Any, model: Dynamics = CAR) -> Problem:
    cost = QuadraticCost([1, 1, 0.1, 0.1], [0.1, 1], [10, 10, 1, 1], x_ref=path(0.0))
    parts = [ControlBounds(LOWER.tolist(), UPPER.tolist()), Spheres([[12.0, 1.2], [30.0, -1.0]], [0.8, 0.8], 0.5)]
    return Problem(model, cost, [*parts, *more], torch.tensor(np.tile(START, (B, 1))), N)


def rk4(x: np.ndarray, u: np.ndarray, h: float) -> np.ndarray:
    """Of the car, by itself."""
    rates = lambda x: np.array(
        [x[3] * np.cos(x[2]), x[3] * np.sin(x[2]), x[3] * np.tan(u[1]) / 2.5, u[0]]
    )  # fmt: skip
    a = rates(x)
    b = rates(x + 0.5 * h * a)
    c = rates(x + 0.5 * h * b)
    return x + h / 6 * (a + 2 * b + 2 * c + rates(x + h * c))


def test_steps_are_those_of_a_compiled_problem() -> None:
    mpc, other, x = MPC(driven()), torchgco.compile(driven(), receding=True), START
    for k in range(40):
        u, answer = mpc.step(x, x_ref=path(DT * k)), other(x0=x, x_ref=path(DT * k))
        assert torch.equal(u, answer.u[0]) and mpc.t == pytest.approx(DT * k)
        assert mpc.statuses == [Status.CONVERGED] and not bool(mpc.held)
        x = rk4(x, u.numpy(), DT)
    assert mpc.plan is not None and bool(mpc.answer.warm)
    torch.testing.assert_close(mpc.solution().X, mpc.plan.X)


@pytest.mark.parametrize("period", [0.02, 0.05, 0.1, 0.17])
def test_a_period_needs_no_whole_stage(period: float) -> None:
    """Each step is that of a solve from anew; plans moved on by parts of a stage are good guesses, too."""
    mpc, x, iterations = MPC(driven(), period=period, max_seconds=float("inf")), START, 0
    for k in range(30):
        u = mpc.step(x, x_ref=path(period * k))
        iterations += int(mpc.answer.iterations) if k else 0
        assert mpc.statuses == [Status.CONVERGED]
        if k % 10 == 9:
            fresh = torchgco.compile(driven(), "interior_point")(x0=x, x_ref=path(period * k))
            lasts = np.clip(period - DT * np.arange(N), 0.0, DT) / period  # shares of the period
            torch.testing.assert_close(u, torch.from_numpy(lasts @ fresh.U[0].numpy()), rtol=0, atol=1e-3)
        x = rk4(x, u.numpy(), period)
    assert iterations < 30 * 7  # a solve from rest takes 12


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("period", [0.13, 0.2, 0.3])
def test_a_period_of_several_stages_keeps_what_its_plan_keeps(period: float, late: bool) -> None:
    """The speed at its end is the plan's: the first stage's controls alone led 0.25 m/s above the limit."""
    cart = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), -1), 2, 1, DT, "rk4", position=slice(0, 1))
    parts = [ControlBounds(-2.0, 1.5), StateBounds([-np.inf, -2.0], [np.inf, 2.0])]
    problem = Problem(cart, QuadraticCost([1, 0.1], [0.01], [5, 1], x_ref=[8.0, 0.0]), parts, [0.0, 0.0], 40)
    mpc, (p, v) = MPC(problem, period=period, max_seconds=float("inf")), (0.0, 0.0)
    for k in range(round(6.0 / period)):
        u = float(mpc.step([p, v], max_seconds=1e-9 if late and k % 3 == 2 else None))
        assert bool(mpc.held) == (late and k % 3 == 2) and bool(mpc.feasible)
        p, v = p + period * (v + 0.5 * period * u), v + period * u
        assert abs(v) <= 2.001
        np.testing.assert_allclose(mpc.plan.at(mpc.t + period).x[0], [p, v], rtol=0, atol=0.05)
    assert abs(p - 8.0) < 0.1 and abs(v) < 0.1


def test_steps_come_when_they_come() -> None:
    """Times that are told move the plan by what lies between them."""
    told, regular = (MPC(driven(), period=0.25, max_seconds=float("inf")) for _ in range(2))
    x = START
    for k in range(6):
        u = regular.step(x, x_ref=path(0.25 * k))
        assert torch.equal(told.step(x, t=7.0 + 0.25 * k, x_ref=path(0.25 * k)), u)
        x = rk4(x, u.numpy(), 0.25)
    assert told.t == 8.25 and told.plan is not None
    torch.testing.assert_close(told.plan.t[0], 8.25 + DT * torch.arange(N + 1, dtype=torch.float64))


def test_a_late_solve_holds_the_plan_with_feedback() -> None:
    mpc = MPC(driven())
    mpc.step(START)
    plan, x = mpc.plan, rk4(START, mpc.plan.U[0, 0].numpy(), DT) + np.array([0.0, 0.3, 0.05, 0.0])
    u = mpc.step(x, x_ref=path(DT), max_seconds=1e-9)
    assert mpc.statuses == [Status.TIME_LIMIT] and bool(mpc.held)
    want = plan.U[0, 1] + plan.K[0, 1] @ (torch.tensor(x) - plan.X[0, 1])
    torch.testing.assert_close(u, want.clamp(torch.tensor(LOWER), torch.tensor(UPPER)))
    assert torch.equal(mpc.plan.X, plan.X) and float(mpc.plan.start[0]) == 0.0  # since then
    u = mpc.step(rk4(x, u.numpy(), DT), x_ref=path(2 * DT))
    assert mpc.statuses == [Status.CONVERGED] and not bool(mpc.held) and mpc.plan.start[0] == pytest.approx(2 * DT)


@pytest.mark.filterwarnings("ignore::torchgco.StartWarning")
def test_a_vehicle_that_fails_holds_its_plan_and_others_fly_on() -> None:
    mpc, alone = MPC(driven(3)), MPC(driven())
    x = np.tile(START, (3, 1)) + 0.1 * np.arange(3)[:, None]
    centers = np.tile([[12.0, 1.2], [30.0, -1.0]], (3, 1, 1))
    for k in range(4):
        if k == 2:
            centers[1, 0] = x[1, :2]  # the second vehicle is inside a disc
        u = mpc.step(x, x_ref=path(DT * k), centers=centers)
        assert torch.equal(u[2], alone.step(x[2], x_ref=path(DT * k), centers=centers[2]))
        held = [False, k >= 2, False]
        assert mpc.held.tolist() == held and [s == Status.CONVERGED for s in mpc.statuses] == [not h for h in held]
        assert mpc.statuses[1] == (Status.CONVERGED if k < 2 else Status.INVALID_START)
        assert mpc.feasible.tolist() == [not h for h in held]
        torch.testing.assert_close(mpc.plan.t[::2, 0], torch.tensor([DT * k, DT * k]).double())
        x = np.stack([rk4(*pair, DT) for pair in zip(x, u.numpy(), strict=True)])


def test_a_plan_between_its_knots() -> None:
    """By NumPy's own integration; a model with a step alone has straight lines."""
    mpc = MPC(driven(2), period=0.07, max_seconds=float("inf"))
    x = np.stack([START, START + 0.2])
    mpc.step(x)
    mpc.step(x := np.stack([rk4(x[b], mpc.plan.U[b, 0].numpy(), 0.07) for b in (0, 1)]))
    plan = mpc.plan
    for t in (0.07, 0.07 + 0.23, 0.07 + 19.99 * DT):
        k, h = divmod(t - 0.07, DT)
        for b in (0, 1):
            there = rk4(plan.X[b, int(k)].numpy(), plan.U[b, int(k)].numpy(), h)
            np.testing.assert_allclose(plan.at(t).x[b], there, rtol=0, atol=1e-9)
            assert torch.equal(plan.at(t).u[b], plan.U[b, int(k)])
    for t, knot in ((-1.0, 0), (0.07, 0), (0.07 + 3 * DT, 3), (0.07 + N * DT, N), (9.0, N)):
        torch.testing.assert_close(plan.at(t).x, plan.X[:, knot], rtol=0, atol=1e-9)
    step = FunctionDynamics(CAR.step, 4, 2, DT, "none", position=slice(0, 2))
    other = MPC(driven(model=step))
    other.step(START)
    torch.testing.assert_close(other.plan.at(0.125).x, 0.75 * other.plan.X[:, 1] + 0.25 * other.plan.X[:, 2])


def test_the_solver_is_one_that_serves_the_problem() -> None:
    """Among obstacles it is `gco`: a disc that is put into the way needs a search."""
    assert MPC(driven()).compiled.solver == "gco"
    free = Problem(CAR, QuadraticCost([1] * 4, [1] * 2, [1] * 4), [], START.tolist(), N)
    assert MPC(free).compiled.solver == "interior_point"
    assert MPC(driven(), "interior_point").compiled.solver == "interior_point"


def test_a_reset_begins_again() -> None:
    mpc = MPC(driven())
    first = mpc.step(START)
    mpc.step(START + 0.1)
    mpc.reset()
    assert mpc.plan is None and mpc.answer is None
    assert torch.equal(mpc.step(START), first) and mpc.t == 0.0


@pytest.mark.slow
def test_a_reset_forgets_the_controls_that_rates_count_from() -> None:
    bounds, random = RateBounds(-0.1, 0.1, previous=[0.0, 0.0]), np.random.default_rng(0)
    mpc, other = MPC(driven(1, bounds)), MPC(driven(1, bounds))
    first = other.step(START)
    for count in (1, 2, 5):
        for _ in range(count):
            mpc.step(START + 0.2 * random.standard_normal(4))
        mpc.reset()
        assert mpc.numbers["previous"].tolist() == [[0.0, 0.0]] and torch.equal(mpc.step(START), first)


def test_rates_count_from_the_controls_that_were_returned() -> None:
    mpc, x, last = MPC(driven(1, RateBounds(-0.4, 0.4, previous=[0.0, 0.0]))), START, np.zeros(2)
    for k in range(5):
        u = mpc.step(x, x_ref=path(DT * k) + np.array([2.0, 1.0, 0, 0])).numpy()
        assert mpc.statuses == [Status.CONVERGED] and np.abs(u - last).max() <= 0.4 + 1e-6
        x, last = rk4(x, u, DT), u
    assert np.abs(last).max() > 0.4


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("period", [0.02, 0.07])
def test_rates_are_those_of_time_where_a_period_is_shorter_than_a_stage(period: float, seed: int) -> None:
    """In every period, however short, they could change by as much as in a stage."""
    random = np.random.default_rng(seed)
    most, other = random.uniform(0.2, 0.6, (2, 2))
    bounds = RateBounds(-most, other, previous=[0.0, 0.0], knots=[0, 1, 2, 4, 3, *range(5, N)])
    mpc, x, last, steepest = MPC(driven(1, bounds), period=period, max_seconds=float("inf")), START, np.zeros(2), 0.0
    for k in range(8):
        u = mpc.step(x, x_ref=path(period * k) + np.array([2.0, 1.0, 0, 0]) * (-1) ** seed).numpy()
        rate = (u - last) / period
        assert mpc.statuses == [Status.CONVERGED]
        assert (rate <= other / DT + 1e-5).all() and (rate >= -most / DT - 1e-5).all()
        steepest = max(steepest, float((rate / np.where(rate > 0, other, most) * DT).__abs__().max()))
        x, last = rk4(x, u, period), u
    assert steepest > 0.99


@pytest.mark.parametrize("context", [torch.inference_mode, lambda: torch.device("meta")], ids=["inference", "device"])
def test_modes_and_default_devices_of_the_caller_change_nothing(context: Callable[[], Any]) -> None:
    mpc, other = MPC(driven()), MPC(driven())
    for k, late in enumerate((None, None, 1e-9)):
        with context():
            u, at = other.step(START + 0.1 * k, max_seconds=late), other.plan.at(0.1 * k + 0.03, START)
        assert torch.equal(mpc.step(START + 0.1 * k, max_seconds=late), u)
        assert torch.equal(mpc.plan.at(0.1 * k + 0.03, START).u, at.u)


WRONG: dict[str, tuple[Callable[[MPC], Any], str]] = {
    "shape": (lambda mpc: mpc.step(np.zeros(3)), r"x: expected shape \(1, 4\), or \(4,\)"),
    "NaN": (lambda mpc: mpc.step(START * np.nan), "x: expected finite states, got NaN or infinity"),
    "time": (lambda mpc: (mpc.step(START), mpc.step(START, t=0.0)), "t: expected a time after 0 s, got 0.0"),
    "number": (lambda mpc: mpc.step(START, speed=3.0), "numbers: expected one of x0, x_ref"),
    "start": (lambda mpc: mpc.step(START, x0=START), "numbers: expected other numbers than x0"),
    "start by name": (lambda mpc: mpc.step(START, numbers={"x0": START}), "numbers: expected other numbers than x0"),
    "twice": (
        lambda mpc: mpc.step(START, x_ref=path(0.0), numbers={"cost.x_ref": path(0.0)}),
        "numbers: expected each number once, got cost.x_ref twice, as cost.x_ref and x_ref",
    ),
    "no time": (lambda mpc: MPC(driven(), max_seconds=0.0), "max_seconds: expected .*above 0"),
    "period": (lambda mpc: MPC(driven(), period=0.0), "period: expected .*above 0 s"),
    "solver": (lambda mpc: MPC(driven(), "ipopt"), 'solver: expected "gco" or "interior_point", got'),
    "status": (lambda mpc: mpc.status, "mpc: expected a step before"),
    "plan": (lambda mpc: (mpc.step(START), mpc.plan.at(np.nan)), "t: expected a time in seconds, got nan"),
    "plan state": (lambda mpc: (mpc.step(START), mpc.plan.at(0.1, [1.0])), r"x: expected shape \(1, 4\)"),
    "horizon": (lambda mpc: MPC(shortened()), "problem.horizon: expected None"),
    "stages": (lambda mpc: MPC(stretched()), "dynamics.dt: expected stages of one length"),
}  # fmt: skip


def shortened() -> Problem:
    return Problem(CAR, QuadraticCost([1] * 4, [1] * 2, [1] * 4), [], START.tolist(), N, horizon=[5])


def stretched() -> Problem:
    lengths = torch.linspace(0.1, 0.2, N).double().view(1, N)
    model = FunctionDynamics(
        lambda x, u, dt: x + dt.unsqueeze(-1) * bicycle(x, u), 4, 2, DT, "none", knot_values={"dt": lengths}
    )
    return Problem(model, QuadraticCost([1] * 4, [1] * 2, [1] * 4), [], START.tolist(), N)


@pytest.mark.parametrize("name", WRONG)
def test_a_mistake_gets_one_line(name: str) -> None:
    act, message = WRONG[name]
    with pytest.raises(InputError, match=message):
        act(MPC(driven()))


def test_a_mistake_changes_nothing() -> None:
    mpc, other = MPC(driven()), MPC(driven())
    mpc.step(START), other.step(START)
    with pytest.raises(InputError):
        mpc.step(START + 0.1, x_ref=[1.0])
    assert mpc.t == 0.0 and torch.equal(mpc.step(START + 0.1), other.step(START + 0.1))


def resident() -> int:
    """Bytes of memory that the process holds."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.parametrize("steps", [300, pytest.param(3000, marks=pytest.mark.slow)])
def test_a_long_loop_calls_no_compiler_and_keeps_its_memory(steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    mpc, random, x = MPC(driven()), np.random.default_rng(0), START
    mpc.step(x)

    def refuse(*args: Any) -> None:
        raise AssertionError("a compiler is called")

    monkeypatch.setattr(compiler, "_start", refuse)
    before = 0
    for k in range(1, steps):
        u = mpc.step(x, x_ref=path(DT * k), max_seconds=1e-9 if k % 50 == 0 else None)
        mpc.plan.at(mpc.t + 0.03)
        x = rk4(x, u.numpy(), DT) + 0.02 * random.standard_normal(4) * [0.1, 0.1, 0.05, 0.3]
        before = resident() if k == steps // 3 else before
    assert resident() - before < 2**20


def test_a_plan_that_is_held_keeps_the_bounds_of_all_parts() -> None:
    inf = float("inf")
    parts = [ControlBounds([-1.0, -inf], [1.0, inf]), ControlBounds([-inf, -0.5], [inf, 0.5])]
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.2, position=slice(0, 2))
    problem = Problem(model, QuadraticCost([1.0] * 4, [0.1] * 2, [20.0] * 4), parts, [[1.0, 1.0, 0.0, 0.0]], 12)
    mpc = torchgco.MPC(problem, "interior_point")
    mpc.step([1.0, 1.0, 0.0, 0.0])
    u = mpc.step([1.5, 3.0, 0.0, 0.0], max_seconds=1e-9)
    assert bool(mpc.held.all()) and u.tolist() == [-1.0, -0.5]
    sampled = torchgco.MPPIController(problem, MPPI(samples=300, covariance=[0.5, 0.5], temperature=0.1))
    u = sampled.command([1.0, 3.0, 0.0, 0.0])
    assert bool((torch.as_tensor(u).abs() <= torch.tensor([1.0, 0.5])).all())
