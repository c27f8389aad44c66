"""The tracker: its equality and limits, its rates, and a dense solution of the same problem by SciPy."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.missions.missions import DOUBLE
from tests.reference import models, tracking
from torchgco import Airframe, InputError, Problem, compose
from torchgco.costs import QuadraticCost
from torchgco.dynamics.quadrotor import RotorTracking
from torchgco.missions.planning_problem import RotorLimits
from torchgco.missions.plant import RotorPlant, hovering
from torchgco.missions.tracker import Reference, Tracker, Tracking

FRAME = Airframe()
PERIOD = 0.05
WORDS = ("experiment=mission", "mission=paper", "solver=gco_paper")


def printed() -> Tracker:
    """The paper's tracker."""
    mission = compose(WORDS).mission
    assert mission is not None
    return mission.tracker


def smooth() -> Tracker:
    """At the commands' limits its problems are solved by one call; with the default weights, by several."""
    return Tracker(effort=1e5)


def plan(rates: list[list[float]], acceleration: list[float], B: int = 1) -> Reference:
    """A plan with these rates and thrust accelerations at its knots, the same for B vehicles."""
    X = torch.zeros(B, len(rates), 14, **DOUBLE)
    X[..., 10:13], X[..., 13] = torch.tensor(rates, **DOUBLE), torch.tensor(acceleration, **DOUBLE)
    return Reference(X, PERIOD, FRAME)


def turning(B: int = 1, size: float = 0.4) -> Reference:
    """A second of gentle turns and climbs, different for each vehicle."""
    t = PERIOD * torch.arange(21, **DOUBLE)
    X = torch.zeros(B, 21, 14, **DOUBLE)
    for b in range(B):
        for i in range(3):
            X[b, :, 10 + i] = size * torch.sin((2.0 + i + b) * t) * (0.2 if i == 2 else 1.0)
        X[b, :, 13] = 9.81 + 2.0 * torch.sin((3.0 + b) * t)
    return Reference(X, PERIOD, FRAME)


def fly(reference: Reference, x: Tensor, steps: int, tracker: Tracker) -> tuple[list[Tensor], list[Tracking]]:
    """States of the plant and answers of the tracker for some time steps."""
    plant, states, answers = RotorPlant(), [x], []
    for k in range(steps):
        answers.append(tracker.track(states[-1], reference, k * tracker.dt, answers[-1] if answers else None))
        states.append(plant.advance(states[-1], answers[-1].commands, x.new_zeros(len(x), 3)))
    return states, answers


def planned(x: Tensor, answer: Tracking, b: int = 0) -> np.ndarray:
    """The states (N+1, 7) that the tracker plans for vehicle b, by NumPy."""
    return tracking.rollout(x[b, 10:].numpy(), answer.U[b].numpy(), 0.01, models.QuadrotorParameters())


def test_a_reference_is_interpolated_and_its_last_value_held() -> None:
    reference = plan([[0, 0, 0], [1, 2, 3], [5, 2, -3]], [9.0, 10.0, 12.0])
    rates, acceleration = reference.at(0.0, 0.025, 6)
    expected = [[0, 0, 0], [0.5, 1, 1.5], [1, 2, 3], [3, 2, 0], [5, 2, -3], [5, 2, -3]]
    torch.testing.assert_close(rates[0], torch.tensor(expected, **DOUBLE), rtol=0, atol=1e-12)
    torch.testing.assert_close(acceleration[0], torch.tensor([9.0, 9.5, 10, 11, 12, 12], **DOUBLE), rtol=0, atol=1e-12)


def test_thrusts_sum_up_to_the_plan_and_rates_follow_it() -> None:
    reference, tracker = turning(), Tracker()
    states, answers = fly(reference, hovering(FRAME, torch.zeros(1, 3, **DOUBLE)), 60, tracker)
    for k in range(10, 60):
        X = planned(states[k], answers[k])
        rates, acceleration = reference.at(0.01 * k, 0.01, 7)
        np.testing.assert_allclose(X[1:, 3:].sum(-1), FRAME.mass * acceleration[0, 1:].numpy(), rtol=0, atol=1e-5)
        assert float(answers[k].violation) <= 1e-5
        np.testing.assert_allclose(X[3:, :3], rates[0, 3:].numpy(), rtol=0, atol=5e-3)  # Euler reaches rates in 2 steps
        now, _ = reference.at(0.01 * k, 0.01, 1)
        np.testing.assert_allclose(states[k][0, 10:13].numpy(), now[0, 0].numpy(), rtol=0, atol=0.04)


def test_limits_of_the_thrusts_are_kept() -> None:
    """A steep climb with a turn that takes more torque than the rotors have left: some are at the limit."""
    reference, tracker = plan([[0.1, 0.0, 0.0]] * 6, [14.3] * 6), Tracker(stages=4, limits="thrusts", effort=0.01)
    x = hovering(FRAME, torch.zeros(1, 3, **DOUBLE))
    x[0, 13:] = 5.5
    answer = tracker.track(x, reference, 0.0)
    F = planned(x, answer)[1:, 3:]
    assert FRAME.thrust_max - 1e-3 <= F.max() <= FRAME.thrust_max + 1e-6 and F.min() >= FRAME.thrust_min - 1e-6
    np.testing.assert_allclose(F.sum(-1), FRAME.mass * 14.3, rtol=0, atol=1e-6)


def test_a_jump_of_the_rates_is_caught_up() -> None:
    """No rotor can turn the vehicle as fast as asked for: it turns later, and stays up meanwhile."""
    wanted, reference = [1.0, -0.5, 0.2], plan([[1.0, -0.5, 0.2]] * 6, [9.81] * 6)
    least = {}
    for tracker in (Tracker(), printed()):
        states, answers = fly(reference, hovering(FRAME, torch.zeros(1, 3, **DOUBLE)), 60, tracker)
        least[tracker.limits] = min(float(x[0, 13:].sum()) / FRAME.mass for x in states)
        np.testing.assert_allclose(states[-1][0, 10:13].numpy(), wanted, rtol=0, atol=0.02)
        for x in states:
            assert bool((x[:, 13:] <= FRAME.thrust_max).all()) and bool((x[:, 13:] >= FRAME.thrust_min).all())
        if tracker.limits == "commands":
            commands = torch.cat([answer.commands for answer in answers])
            assert torch.allclose(commands, FRAME.reachable(commands), rtol=0, atol=30.0)
    assert least["commands"] >= 9.81 - 0.05 and least["thrusts"] <= 9.81 - 1.0


def test_rotor_limits_have_the_derivatives_of_autodiff() -> None:
    limits = Problem(
        RotorTracking(0.01), QuadraticCost([0.0] * 7, [0.0] * 4, [0.0] * 7), [RotorLimits(FRAME)], torch.zeros(2, 7), 3
    ).constraints[0]
    X, U = torch.zeros(2, 4, 7, **DOUBLE), 5000.0 + 2000.0 * torch.rand(2, 3, 4, **DOUBLE)
    c = limits.value(X, U)
    low, high = FRAME.rotor_speeds
    assert c.shape == (2, 3, 8) and bool(((c <= 0).all(-1) == ((low <= U) & (high >= U)).all(-1)).all())
    g, h = torch.rand_like(c), torch.rand_like(c)
    H = torch.zeros(2, 4, 12, 12, **DOUBLE)
    limits.accumulate(X, U, g, h, H)
    J = torch.autograd.functional.jacobian(lambda U: limits.value(X, U)[1, 2], U)[:, 1, 2]
    torch.testing.assert_close(H[1, 2, 8:, 7], J.T @ g[1, 2])
    torch.testing.assert_close(H[1, 2, 8:, 8:], J.T @ torch.diag(h[1, 2]) @ J)
    torch.testing.assert_close(H, H.transpose(-1, -2))


CASES = {
    "hover": ([0.0, 0.0, 0.0], [3.944, 3.944, 3.944, 3.944], [0.05, -0.02, 0.01], 9.9),
    "turning": ([0.3, -0.2, 0.1], [3.6, 4.2, 4.1, 3.7], [0.25, -0.1, 0.12], 9.6),
    "climbing": ([0.0, 0.1, 0.0], [4.6, 4.7, 4.65, 4.6], [0.0, 0.15, -0.02], 11.7),
    "commands at their limits": ([0.0, 0.0, 0.0], [5.85, 5.85, 5.85, 5.85], [0.05, 0.0, 0.0], 14.55),
    "thrusts at their limits": ([0.0, 0.0, 0.0], [5.85, 5.85, 5.85, 5.85], [0.05, 0.0, 0.0], 14.7),
}


FREE = list(CASES)[:3]


@pytest.mark.sampled(2)
@pytest.mark.filterwarnings("ignore:Values in x were outside bounds:RuntimeWarning")  # of SLSQP before SciPy 1.16
@pytest.mark.parametrize(
    ("name", "tracker"),
    [
        *((name, Tracker) for name in FREE),
        *(pytest.param(name, printed, marks=pytest.mark.slow) for name in FREE),
        ("commands at their limits", smooth),
        ("thrusts at their limits", printed),
    ],
)
def test_commands_have_the_effect_of_a_dense_solution(name: str, tracker: Callable[[], Tracker]) -> None:
    w, F, wanted, acceleration = CASES[name]
    x = hovering(FRAME, torch.zeros(1, 3, **DOUBLE))
    x[0, 10:] = torch.tensor(w + F, **DOUBLE)
    reference = plan([w, wanted, wanted], [acceleration] * 3)
    tried = tracker()
    answer = tried.track(x, reference, 0.01)
    rates, a = reference.at(0.01, 0.01, 7)
    options = {"commands": tried.limits == "commands", "effort": tried.effort}
    X, U = tracking.solve(x[0, 10:].numpy(), rates[0].numpy(), a[0, 1:].numpy(), 0.01, **options)
    mine, parameters = planned(x, answer), models.QuadrotorParameters()
    np.testing.assert_allclose(mine[1], X[1], rtol=0, atol=1e-3)  # what the first command leads to
    np.testing.assert_allclose(mine[:, :3], X[:, :3], rtol=0, atol=1e-4)
    np.testing.assert_allclose(X[1:, 3:].sum(-1), FRAME.mass * a[0, 1:].numpy(), rtol=0, atol=1e-9)
    costs = [
        tracking.cost(*flown, rates[0].numpy(), parameters, tried.effort)
        for flown in ((mine, answer.U[0].numpy()), (X, U))
    ]
    assert costs[0] == pytest.approx(costs[1], rel=1e-2, abs=1e-7)


def test_a_batch_equals_its_parts() -> None:
    tracker, reference = Tracker(), turning(4)
    x = hovering(FRAME, torch.zeros(4, 3, **DOUBLE))
    x[:, 10:13] = 0.3 * torch.randn(4, 3, generator=torch.Generator().manual_seed(1), **DOUBLE)
    states, answers = fly(reference, x, 4, tracker)
    for rows in ([2], [3, 1], [3, 2, 1, 0]):
        part, own = fly(Reference(reference.X[rows], PERIOD, FRAME), x[rows], 4, tracker)
        for k in range(4):
            assert torch.equal(own[k].U, answers[k].U[rows]) and torch.equal(
                own[k].violation, answers[k].violation[rows]
            )
            assert torch.equal(part[k + 1], states[k + 1][rows])
    index = torch.tensor([3, 1])
    some = Reference(reference.X[index], PERIOD, FRAME)
    later = tracker.track(states[-1][index], some, 0.04, answers[-1].take(index))
    assert torch.equal(later.U, tracker.track(states[-1], reference, 0.04, answers[-1]).U[index])


def test_the_papers_tracker_starts_every_call_from_the_beginning() -> None:
    """Ten outer iterations from hovering rotors and zero multipliers, whatever the call before has found."""
    tracker, reference = printed(), turning()
    x = hovering(FRAME, torch.zeros(1, 3, **DOUBLE))
    _, answers = fly(reference, x, 5, tracker)
    last = answers[-1]
    assert last.multipliers.mu.tolist() == [20.0 * 2.0**10]
    alone, again = tracker.track(x, reference, 0.0), tracker.track(x, reference, 0.0, last)
    assert torch.equal(alone.U, again.U) and torch.equal(alone.U, answers[0].U)
    going_on = Tracker().track(x, reference, 0.0, fly(reference, x, 5, Tracker())[1][-1])
    assert not torch.equal(going_on.U, Tracker().track(x, reference, 0.0).U)


def test_the_papers_tracker_flies_as_the_default_does() -> None:
    """With the same limits and weights; with the default's, rates are a little later."""
    x = hovering(FRAME, torch.zeros(1, 3, **DOUBLE))
    three = Tracker(limits="thrusts", effort=0.01), printed(), Tracker()
    states, answers = zip(*(fly(turning(), x, 40, tracker) for tracker in three), strict=True)
    torch.testing.assert_close(
        torch.stack(states[2])[..., 10:13], torch.stack(states[1])[..., 10:13], rtol=0, atol=0.05
    )
    torch.testing.assert_close(torch.stack(states[0]), torch.stack(states[1]), rtol=0, atol=1e-4)
    for mine, papers in zip(*answers[:2], strict=True):
        torch.testing.assert_close(mine.commands, papers.commands, rtol=0, atol=1.0)
        assert float(papers.violation) <= 1e-6


@pytest.mark.parametrize(
    ("name", "value"),
    [("penalty", 0.0), ("penalty_growth", 0.5), ("multipliers", "kept"), ("dt", -0.01), ("stages", 0)],
)
def test_bad_fields_are_named(name: str, value: Any) -> None:
    with pytest.raises(InputError) as caught:
        Tracker(**{name: value})
    assert caught.value.field == f"tracker.{name}"
