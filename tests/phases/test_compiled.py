"""Compiled phases beside `solve`, the numbers that calls change, and what is left of phases in a loop."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import torchgco
from tests.engines import compiled
from tests.phases.test_phases import CART, bounces, drive, solved
from torchgco import (
    Dynamics,
    FreeTime,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    InputError,
    Integral,
    Jump,
    Link,
    NormBounds,
    Phases,
    PhasesMPC,
    Problem,
    QuadraticCost,
    Spheres,
)

pytestmark = compiled
D = torch.float64
G = 9.81
BALL = FunctionDynamics(lambda x, u: torch.stack((x[..., 1], u[..., 0] - G), -1), n=2, m=1, dt=0.05, integrator="rk4")
EFFORT = FunctionCost(lambda x, u: 0.05 * u[..., 0] ** 2)
GROUND = FunctionConstraint(lambda x: x[..., :1], "equality", knots=[-1], name="ground")
FREE = FreeTime(0.1, 4.0, weight=1.0)


def ball(height: Any = 1.0, speed: Any = 0.0, kept: Any = 0.5, there: Any = (1.0, 0.0), **times: Any) -> Phases:
    """A ball that falls, keeps a share of its speed, and is pushed back; numbers are given for each of B problems."""
    B = max(np.size(one) for one in (height, speed, kept))
    column = lambda values: torch.as_tensor(values, dtype=D).reshape(-1, 1).expand(B, 1).clone()
    ends = torch.as_tensor(there, dtype=D).expand(B, 2).clone()
    back = FunctionConstraint(lambda x, there: x - there, "equality", knots=[-1], name="back", values={"there": ends})
    bounce = Jump(
        lambda x, kept: torch.stack((x[..., 0], -kept[..., 0] * x[..., 1]), -1), values={"kept": column(kept)}
    )
    x0 = torch.cat((column(height), column(speed)), dim=1)
    fall = Problem(BALL, EFFORT, [GROUND], x0, 20, time=times.get("fall", FREE))
    rise = Problem(BALL, EFFORT, [back], x0.new_tensor([[0.0, 2.0]]).repeat(B, 1), 20, time=times.get("rise", FREE))
    return Phases([fall, rise], [bounce])


def same(answer: torchgco.PhasesAnswer, phases: Phases) -> None:
    """What a solve of these phases gives: both stop within 1e-6 of stationary, which leaves the states some 1e-5."""
    found = torchgco.solve(phases)
    assert answer.statuses == found.statuses
    torch.testing.assert_close(answer.begins, found.begins, rtol=1e-5, atol=1e-6)
    for one, other in zip(answer, found, strict=True):
        torch.testing.assert_close(one.X, other.X, rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(one.U, other.U, rtol=1e-3, atol=1e-3)


def test_a_call_with_other_numbers_is_a_solve_of_other_phases() -> None:
    height = np.array([1.0, 1.2])
    fast = torchgco.compile(ball(height))
    same(fast(), ball(height))
    more = {"phases[1].constraints[0].there": [0.9, 0.1], "jumps[0].kept": [[0.5], [0.65]]}
    answer = fast(x0=[[1.1, 0.0], [1.3, -0.2]], numbers=more)
    assert bool(answer.warm.all())
    expected = ball([1.1, 1.3], [0.0, -0.2], [0.5, 0.65], (0.9, 0.1))
    same(answer, expected)
    solution = fast.solution()
    verdict = torchgco.judge(expected, solution)
    assert bool(verdict.feasible.all())
    torch.testing.assert_close(solution.cost, torchgco.solve(expected).cost, rtol=1e-8, atol=0.0)
    same(fast(numbers={"phases[1].time.most": [0.4]}), ball(
        [1.1, 1.3], [0.0, -0.2], [0.5, 0.65], (0.9, 0.1), rise=FreeTime(0.1, 0.4, weight=1.0)
    ))  # fmt: skip
    torch.testing.assert_close(answer.u, answer[0].U[:, 0])


def test_references_of_fixed_times_change() -> None:
    """Which the whole has copies of."""

    def halves(there: float) -> Phases:
        rest = QuadraticCost([0.1, 0.1], [0.1], [5.0, 1.0], x_ref=[there, 0.0])
        return Phases([Problem(BALL, cost, [], torch.tensor([1.0, 0.0], dtype=D), 10) for cost in (EFFORT, rest)])

    fast = torchgco.compile(halves(1.0))
    fast()
    answer = fast(numbers={"phases[1].cost.x_ref": np.tile([2.0, 0.0], (1, 11, 1))})
    assert bool(answer.warm.all())
    same(answer, halves(2.0))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", ["obstacles", "impulses", "free start", "a lap", "Python", "fixed times"])
def test_kinds_of_phases(kind: str) -> None:
    free, held = [False, False, True, True], {"fall": None, "rise": None}
    made: dict[str, Callable[[], tuple[Phases, dict[str, Any], Phases]]] = {
        "obstacles": lambda: (
            among([1.5, 0.7]), {"phases[1].constraints[1].centers": [[1.5, 0.6]]}, among([1.5, 0.6]),
        ),
        "impulses": lambda: (pushed(0.5), {"jumps[0].constraints[0].upper": [0.4]}, pushed(0.4)),
        "free start": lambda: (bounces(0.5), {}, bounces(0.5)),
        "a lap": lambda: (
            lap := Phases(
                [drive(torch.zeros(1, 4, dtype=D), [1.0, 0.0], free_start=free, N=8),
                 drive(torch.zeros(1, 4, dtype=D), [0.0, 1.0], N=8)], [Link()], loop=Link(components=[0, 1])
            ), {}, lap,
        ),
        "Python": lambda: (
            given := Phases([drive([0.0] * 4, [1.0, 0.0], unseen(0.8)), drive([1.0, 0, 0, 0], [2.0, 1.0])]), {}, given,
        ),
        "fixed times": lambda: (ball(**held), {"phases[0].x0": [1.2, 0.1]}, ball(1.2, 0.1, **held)),
    }  # fmt: skip
    phases, numbers, expected = made[kind]()
    fast = torchgco.compile(phases)
    fast()
    same(fast(numbers=numbers), expected)
    assert fast.stale() is None


def among(second: list[float]) -> Phases:
    """Two drives, each past a disc."""
    first, then = ([Spheres([at], [0.15], 0.05)] for at in ([0.5, 0.2], second))
    return Phases([drive([0.0] * 4, [1.0, 0.0], *first), drive([1.0, 0, 0, 0], [2.0, 1.0], *then)])


def pushed(most: float) -> Phases:
    """Two drives with an impulse between them."""
    push = Jump(
        lambda x, v: torch.cat((x[..., :2], x[..., 2:] + v), -1), 2, lambda x, v: v.square().sum(-1),
        constraints=[NormBounds("u", upper=torch.tensor([most], dtype=D))],
    )  # fmt: skip
    return Phases([drive([0.0] * 4, [1.0, 0.0]), drive([1.0, 0, 0, 0], [2.5, 1.0])], [push])


def unseen(most: float) -> FunctionConstraint:
    """A bound of a speed that branches on values, which only Python runs."""

    def row(x: torch.Tensor) -> torch.Tensor:
        speed = x[..., 2:3]
        return speed - most if bool((speed < 10.0).all()) else speed - 2.0 * most

    return FunctionConstraint(row, name="speed")


def test_a_bad_element_ends_by_itself() -> None:
    fast = torchgco.compile(ball([1.0, 1.2]))
    fast()
    answer = fast(x0=[[1.1, 0.0], [np.nan, 0.0]])
    assert [status.name == "CONVERGED" for status in answer.statuses] == [True, False]
    found = torchgco.solve(ball(1.1))
    torch.testing.assert_close(answer[0].X[:1], found[0].X, rtol=1e-4, atol=1e-4)
    same(fast(x0=[[1.1, 0.0], [1.2, 0.0]]), ball([1.1, 1.2]))


class Steps(Dynamics):
    n, m = 1, 1

    def step(self, x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return x + 0.1 * u


def test_a_model_without_a_time_step_has_an_answer_without_times() -> None:
    row = FunctionConstraint(lambda x: x - 1.0, "equality", knots=[-1])
    one = Problem(Steps(), FunctionCost(lambda x, u: u.square().sum(-1)), [row], torch.zeros(1, 1, dtype=D), 4)
    answer = torchgco.compile(Phases([one, one], [Jump(lambda x: 0.5 * x)]))()
    assert answer[1].t is None and float(answer[1].X[0, 0, 0]) == pytest.approx(0.5)
    with pytest.raises(InputError, match="phases: expected models with a time step"):
        _ = answer.begins


def fly(x: np.ndarray, u: float, seconds: float) -> np.ndarray:
    """The ball's state later, by its closed form."""
    a = u - G
    return np.array([x[0] + x[1] * seconds + 0.5 * a * seconds**2, x[1] + a * seconds])


@pytest.mark.sampled(0)
@pytest.mark.parametrize("times", [{}, {"rise": None}, {"fall": FreeTime(0.6, 0.6, weight=0.0), "rise": None}])
def test_a_loop_flies_all_phases_as_they_were_planned(times: dict[str, Any]) -> None:
    """Without disturbance what is left of an optimum is one."""
    phases = ball(**times)
    planned, loop = solved(phases), PhasesMPC(phases, period=0.02, max_seconds=np.inf)
    x, now, spent, phase = np.array([1.0, 0.0]), 0.0, 0.0, 0
    for _ in range(200):
        u = float(loop.step(x, t=now)[0])
        assert loop.phase == phase and not loop.held
        until = min(now + 0.02, loop.begins[0])
        x, spent, now = fly(x, u, until - now), spent + u * u * (until - now), until
        if now >= loop.begins[0] - 1e-9:
            if phase == 1:
                break
            x, phase = np.array([x[0], -0.5 * x[1]]), 1
    assert phase == 1 and now == pytest.approx(float(planned.duration), rel=5e-3)
    np.testing.assert_allclose(x, [1.0, 0.0], atol=2e-2)
    effort = sum(float(one.U.square().sum() * one.duration / 20) for one in planned)
    assert spent == pytest.approx(effort, rel=1e-2)
    with pytest.raises(InputError, match="t: expected a time before"):
        loop.step(x, t=now + 0.01)


# Just before the end of a phase what is left of its rows is as small as what counts as feasible.
@pytest.mark.filterwarnings("ignore::torchgco.base.errors.ScaleWarning")
def test_a_measured_jump_begins_the_next_phase() -> None:
    """The ground is 0.1 m higher than the model says: the ball lands early, and the loop goes on from there."""
    loop = PhasesMPC(ball(), period=0.02, max_seconds=np.inf)
    x, now, phase = np.array([1.0, 0.0]), 0.0, None
    while loop.phase == 0:
        x, now = fly(x, float(loop.step(x, t=now, phase=phase)[0]), 0.02), now + 0.02
        if phase is None and x[0] < 0.1:
            x, phase = np.array([x[0], -0.5 * x[1]]), 1
    while now < loop.begins[-1] - 1e-9:
        u, seconds = float(loop.step(x, t=now)[0]), min(0.02, loop.begins[-1] - now)
        x, now = fly(x, u, seconds), now + seconds
    np.testing.assert_allclose(x, [1.0, 0.0], atol=3e-2)


def test_numbers_stay_through_the_phases_and_a_failure_flies_the_plan_before() -> None:
    loop = PhasesMPC(ball(), period=0.02, max_seconds=np.inf)
    x = np.array([1.0, 0.0])
    u = float(loop.step(x, there=[1.3, 0.0])[0])
    assert u == pytest.approx(float(torchgco.solve(ball(there=(1.3, 0.0)))[0].U[0, 0, 0]), rel=2e-2)
    x, before = fly(x, u, 0.02), list(loop.begins)
    held = loop.step(x, max_seconds=1e-9)
    assert loop.held and loop.begins == before and bool(torch.isfinite(held).all())
    loop.step(np.array([0.0, 2.5]), phase=1)
    assert not loop.held and float(loop.answer[0].X[0, -1, 0]) == pytest.approx(1.3)  # type: ignore[index]
    loop.reset()
    assert loop.phase == 0 and loop.answer is None
    loop.step(np.array([1.0, 0.0]), numbers={"phases[0].time.most": [0.3]})  # of 1 s, and no longer from then on
    loop.step(fly(np.array([1.0, 0.0]), float(loop.answer.u), 0.02))  # type: ignore[attr-defined]
    assert loop.begins[0] == pytest.approx(0.3, abs=1e-6)


def _cut(*rows: Any, **more: Any) -> Phases:
    parts: dict[str, Any] = {"cost": EFFORT, "time": None} | more
    one = Problem(BALL, parts["cost"], [GROUND, *rows], torch.tensor([[1.0, 0.0]], dtype=D), 20, time=parts["time"])
    return Phases([one, one])


WRONG: list[tuple[Callable[[], Any], str]] = [
    (lambda: torchgco.compile(ball(), receding=True), "receding: expected False of phases, which PhasesMPC serves"),
    (lambda: torchgco.compile(ball(), "al_ilqr"), 'solver: expected "gco" or "interior_point"'),
    (lambda: torchgco.compile(ball())(shift=1), "shift: expected None of phases"),
    (lambda: torchgco.compile(ball(fall=None))(elapsed=1.0), "elapsed: expected None of phases"),
    (lambda: torchgco.compile(ball())(x=1), "numbers: expected one of x0"),
    (lambda: torchgco.compile(ball())(kept=[1.0, 2.0]), r"jumps\[0\].kept: expected shape"),
    (lambda: torchgco.compile(_cut(Integral(lambda x, u: u[..., 0] ** 2, 9.0))), "without Integral in compiled"),
    (lambda: torchgco.compile(ball()).solution(), "a call before its solution"),
    (
        lambda: torchgco.MPC(ball()),  # type: ignore[arg-type]
        "problem: expected a Problem; PhasesMPC takes phases",
    ),
    (
        lambda: PhasesMPC(ball().problems[0]),  # type: ignore[arg-type]
        "phases: expected Phases; MPC serves one problem",
    ),
    (lambda: PhasesMPC(ball([1.0, 1.1])), "phases: expected those of one vehicle"),
    (lambda: PhasesMPC(bounces(0.5)), r"phases.problems\[0\].free_start"),
    (lambda: PhasesMPC(_cut(FunctionConstraint(lambda x: x[..., 1:] - 9.0, knots=[3]))), "rows at knots"),
    (lambda: PhasesMPC(_cut(time=FreeTime(0.1, 4.0, segments=[10]))), "several segments"),
    (
        lambda: PhasesMPC(_cut(cost=QuadraticCost([1.0, 1], [1.0], [1.0, 1], x_ref=torch.rand(21, 2, dtype=D)))),
        r"phases.problems\[0\].cost: expected what stays the same",
    ),
    (
        lambda: PhasesMPC(Phases([drive([0.0] * 4, [1.0, 0.0], Spheres([[0.5, 0.9]], [0.1], 0.1, [[0.0, 0.1]]))])),
        "obstacles that move",
    ),
    (lambda: PhasesMPC(ball(), period=0.02).step([1.0, 0.0], phase=2), "phase: expected one of 0 to 1"),
    (lambda: PhasesMPC(ball(), period=0.02).step([1.0]), r"x: expected shape \(1, 2\)"),
]


@pytest.mark.parametrize("i", range(len(WRONG)))
def test_wrong_use_gets_one_line(i: int) -> None:
    call, message = WRONG[i]
    with pytest.raises(InputError, match=message if "\\" in message else re.escape(message)) as told:
        call()
    assert "\n" not in str(told.value)


def test_rows_of_the_start_of_a_phase_are_over_with_it() -> None:
    fast = FunctionConstraint(lambda x: x[..., 2:3] - 0.3, "equality", knots=[0], name="fast enough")
    phases = Phases([drive([0.0] * 4, [1.0, 0.0]), drive([1.0, 0, 0, 0], [2.0, 1.0], fast)])
    loop = PhasesMPC(phases, period=0.1, max_seconds=np.inf)
    x = np.zeros(4)
    for k in range(30):
        if k == 15:
            assert x[2] == pytest.approx(0.3, abs=1e-6)
            x[2] = 0.4  # measured, and not what the row asks for
        u = loop.step(x)
        assert not loop.held and loop.phase == (k >= 15)
        x = CART.step(torch.tensor(x), u).numpy()
    np.testing.assert_allclose(x[:2], [2.0, 1.0], atol=0.1)
