"""Problems with a free time, compiled once and solved many times, and in loops."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from tests.solvers.test_free_time import carts, least_time
from torchgco import (
    MPC,
    ControlBounds,
    FreeTime,
    FunctionDynamics,
    Goal,
    InputError,
    Problem,
    QuadraticCost,
    RateBounds,
    Spheres,
    Status,
)
from torchgco.kernels import choice
from torchgco.native import compiler
from torchgco.native.compiler import find_compiler
from torchgco.problem.in_time import Elapsed, times_of
from torchgco.tracing import Facts

pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="no C compiler"),
    pytest.mark.filterwarnings("ignore::torchgco.ContactWarning"),
]
D, N = torch.float64, 12
ALIKE: dict[str, Any] = {"rtol": 0.0, "atol": 2e-6}  # of two solves to a tolerance of 1e-8 from different guesses
CROSSING = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.25, "rk4", position=slice(0, 2))


def refuse(*args: object) -> None:
    raise AssertionError("traced or compiled")


def crossing(n: dict[str, Any]) -> Problem:
    """Points that cross a plane beside a disc, with bounded changes of thrust, in two segments."""
    rates = RateBounds(n["lower"], n["upper"], previous=n["previous"])
    parts = [ControlBounds(-n["thrust"], n["thrust"]), Spheres(n["centers"], 0.4), rates]
    time = FreeTime(n["least"], 4.0, n["weight"], segments=2)
    goal = Goal(state=n["goal"], required=True)
    return Problem(CROSSING, QuadraticCost([0.0] * 4, [0.05] * 2, [0.0] * 4), parts, n["x0"], N, goal, time=time)


def drawn(seed: int, B: int = 4) -> dict[str, Any]:
    random = np.random.default_rng(seed)
    near = lambda value, by: np.asarray(value) + by * random.uniform(-1, 1, (B, *np.shape(value)))
    return {
        "x0": near([0.0, 0, 0.3, 0], 0.05), "goal": near([4.0, 0, 0, 0], 0.05), "centers": near([[2.0, 0.36]], 0.02),
        "thrust": near([2.0, 2.0], 0.3), "lower": near([-1.0, -1], 0.2), "upper": near([1.0, 1], 0.2),
        "previous": near([0.1, 0.0], 0.1), "least": near([0.3, 0.3], 0.1), "weight": near(1.0, 0.3),
    }  # fmt: skip


@pytest.mark.slow
def test_a_call_gives_what_a_solve_of_the_same_numbers_gives() -> None:
    numbers = drawn(0)
    compiled = torchgco.compile(crossing(numbers), "interior_point")
    answer, first = compiled(), torchgco.solve(crossing(numbers), solver="interior_point")
    assert torch.equal(answer.X, first.X) and torch.equal(answer.t, first.t)
    warm = 0
    for seed in (1, 2):
        numbers = drawn(seed)
        named = dict(numbers)
        thrust = named.pop("thrust")
        rates = {f"constraints[2].{side}": named.pop(side) for side in ("lower", "upper")}
        bounds = {"constraints[0].lower": -thrust, "constraints[0].upper": thrust}
        named["goal.state"] = named.pop("goal")
        answer = compiled(numbers={**named, **rates, **bounds})
        found, other = compiled.solution(), torchgco.solve(crossing(numbers), solver="interior_point")
        fresh = torchgco.solve(
            crossing(numbers), solver="interior_point", warm=found
        )  # the same of two ways past a disc
        assert answer.statuses == [Status.CONVERGED] * 4, "at the knots: between them a cold solve says more"
        assert set(fresh.statuses) <= {Status.CONVERGED, Status.INFEASIBLE} and float(fresh.violation.max()) <= 1e-6
        warm += int(answer.warm.sum())
        for part in ("X", "U", "t", "duration"):
            torch.testing.assert_close(getattr(answer, part), getattr(fresh, part), **ALIKE)
        torch.testing.assert_close(found.cost, fresh.cost, rtol=0.0, atol=1e-7)
        assert bool((found.cost < other.cost + 1e-7).all()) and int((found.cost > other.cost - 1e-7).sum()) >= 2
        assert bool(torchgco.judge(crossing(numbers), found.U, times=found.t).clear_95.all())
    assert warm >= 6 and compiled.stale() is None


def test_a_repeated_solve_traces_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Switches of segments and rows of the goal are tensors made for each problem; their contents are the same."""
    monkeypatch.setattr(choice, "_engines", {})
    for seed in (0, 1):
        first = torchgco.solve(crossing(drawn(seed)), solver="interior_point")
        monkeypatch.setattr(choice, "Engine", refuse)
    problem = crossing(drawn(1))
    facts = Facts(problem.constraints[-1])
    assert float(first.violation.max()) <= 1e-6 and facts.hold
    problem.constraints[-1].components[0] = 3  # type: ignore[attr-defined]
    assert not facts.hold


@pytest.mark.slow
def test_references_follow_the_time_as_they_are_now() -> None:
    path = lambda y: np.stack(
        (np.linspace(0, 3, N + 1), y * np.sin(np.linspace(0, 3, N + 1)), *np.zeros((2, N + 1))), -1
    )
    time = FreeTime(0.4, 2.0, weight=0.5)
    problem = lambda y: Problem(
        CROSSING, QuadraticCost([1.0, 1, 0, 0], [0.05] * 2, [5.0, 5, 0, 0], path(y)), [], [[0.0] * 4], N, time=time
    )
    compiled = torchgco.compile(problem(0.5), "interior_point")
    compiled()
    answer = compiled(x_ref=path(1.0))
    fresh = torchgco.solve(problem(1.0), solver="interior_point")
    assert bool(answer.warm.all())
    torch.testing.assert_close(answer.duration, fresh.duration, **ALIKE)
    resting = torchgco.compile(crossing(drawn(0)), "interior_point")
    with pytest.raises(InputError, match="x_ref: expected the same at all stages"):
        resting(x_ref=path(1.0))


@pytest.mark.parametrize("seconds", [0.0, 0.3, 0.9, 5.0])
def test_what_is_left_of_a_plan_lies_on_it(seconds: float) -> None:
    """Knots of what is left lie at times of the plan, and mean controls lead to where it does."""
    problem = carts(N=10, B=2, segments=[4], least=0.01)
    assert problem.time is not None
    factors = torch.tensor([[0.5, 1.0], [0.2, 0.9]], dtype=D)
    t, draws = times_of(problem, factors), torch.Generator().manual_seed(0)
    U = torch.rand(2, 10, 1, generator=draws, dtype=D)
    X = torch.cat((torch.zeros(2, 1, 1, dtype=D), (U * t.diff(dim=1).unsqueeze(-1)).cumsum(1)), dim=1)  # integrals
    at = Elapsed.of(problem, factors, seconds)
    new = times_of(problem, at.factors)
    for b in range(2):
        left = np.clip(seconds + new[b].numpy(), 0.0, float(t[b, -1]))
        torch.testing.assert_close(at.states(X)[b, :, 0].numpy(), np.interp(left, t[b], X[b, :, 0]))
        if seconds < t[b, -1]:
            assert float(new[b, -1]) == pytest.approx(float(t[b, -1]) - seconds)
            moved = at.states(X)[b].diff(dim=0) / new[b].diff().unsqueeze(-1)
            torch.testing.assert_close(at.controls(U, t.diff(dim=1))[b], moved)
    early = t[:, 4] > seconds  # the first segment is under way: the other lasts as long as before
    torch.testing.assert_close(at.factors[early, 1], factors[early, 1])


def test_a_loop_comes_to_rest_in_the_least_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Carts that are pushed: no compiler, no trace after the first step; periods end between knots."""
    problem = replace(carts(N=30, B=1, least=0.02), x0=torch.tensor([[2.0, 0.5]], dtype=D))
    mpc = MPC(problem, period=0.06, max_seconds=float("inf"))  # a period's time depends on what else the machine does
    x, h, arrived = torch.tensor([[2.0, 0.5]], dtype=D), 0.06, 0.0
    before = float("nan")
    best = float(least_time(x)[0])
    mpc.step(x)
    mpc.reset()

    monkeypatch.setattr(compiler, "_start", refuse)
    monkeypatch.setattr(choice, "Engine", refuse)
    for k in range(70):
        u = mpc.step(x)
        assert mpc.statuses == [Status.CONVERGED] and mpc.plan is not None
        end = float(mpc.plan.end)
        if k > 0 and end - mpc.t > 0.2:  # as that of the plan before, but for the push
            assert abs(end - before) < 0.05
        before = end
        assert mpc.plan.t.shape == (1, 31) and torch.allclose(mpc.plan.at(mpc.t).x, x)
        x = torch.stack((x[:, 0] + h * x[:, 1] + 0.5 * h * h * u[:, 0], x[:, 1] + h * u[:, 0]), -1)
        x[:, 1] += 0.02 * np.sin(k) if k < 12 else 0.0  # before it brakes, as then little more is a second way
        if not arrived and float(x.norm()) < 0.03:
            arrived = mpc.t + h
    assert arrived == pytest.approx(best, abs=0.1) and float(x.norm()) < 0.02


@pytest.mark.slow
def test_mean_controls_are_those_of_a_fine_grid() -> None:
    mpc = MPC(carts(N=10, B=3, least=0.2), period=0.5, max_seconds=float("inf"))
    u = mpc.step(carts(N=10, B=3).x0)
    assert mpc.plan is not None
    fine: list[Tensor] = [mpc.plan.at(0.5 * (i + 0.5) / 4000).u for i in range(4000)]
    torch.testing.assert_close(u, torch.stack(fine).mean(0), rtol=0, atol=1e-3)
    assert torch.equal(mpc.plan.mean(0.0, 1e-3), mpc.plan.at(0.0).u)


def test_without_c_a_solve_begins_with_what_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled = torchgco.compile(carts(N=10, B=2), "interior_point")
    monkeypatch.setattr(compiled, "_kept", None)
    compiled()
    last = compiled.solution()
    answer = compiled(x0=Elapsed.of(carts(N=10, B=2), last.t[:, -1:] / 3.0, 0.1).states(last.X)[:, 0], elapsed=0.1)
    assert bool(answer.warm.all())
    torch.testing.assert_close(answer.duration, last.duration - 0.1, rtol=0, atol=0.05)


def test_what_is_not_served_is_refused() -> None:
    free = carts(N=10, B=2)
    for call, what in (
        (lambda: torchgco.compile(free, receding=True), "receding: expected False where the time is free"),
        (lambda: torchgco.compile(free)(shift=1), "shift: expected None where the time is free"),
        (lambda: torchgco.compile(replace(free, time=None))(elapsed=0.1), "elapsed: expected None where the time is f"),
        (lambda: torchgco.compile(free)(elapsed=-1.0), "elapsed: expected a number of seconds"),
        (lambda: torchgco.compile(free)(least=np.full((2, 1), 30.0)), "time.least at most"),
        (lambda: MPC(free, period=0.1), "time.least: expected a shortest duration of at least a period"),
        (lambda: MPC(crossing(drawn(0)), period=0.1), "rate_bounds.previous: expected None in a loop"),
    ):
        with pytest.raises(InputError, match=what):
            call()
