"""The model of the racing drone, its commands, its gates and its estimate of the thrust, beside slow, obvious maths."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import torchgco
from benchmarks.outside.drone_racing_model import (
    GRAVITY,
    OPENING,
    OUTER,
    RISE,
    Strength,
    axis,
    commanded,
    frames,
    rates,
    tilt_state,
)
from benchmarks.outside.drone_racing_plan import (
    CAREFUL_SPEED,
    DECELERATION,
    DISPLACED,
    MODEL,
    ROUNDING_AREA,
    SIGHT,
    Limits,
    Plan,
    Track,
    as_soon,
    haste,
    posed,
    smoothness,
)
from torchgco import ControlBounds, FreeTime, FunctionConstraint, FunctionCost, InteriorPoint, Problem


def test_tilts_and_their_rates_are_those_of_a_turning_body() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        start, spin, h = Rotation.from_euler("xyz", rng.uniform(-0.8, 0.8, 3)), rng.uniform(-4.0, 4.0, 3), 1e-5
        later, sooner = (start * Rotation.from_rotvec(sign * h * spin) for sign in (1, -1))
        a, b, *turn = tilt_state(start.as_quat(), spin)
        np.testing.assert_allclose(axis(torch.tensor([a, b])).numpy(), start.as_matrix()[:, 2], atol=1e-12)
        change = (tilt_state(later.as_quat(), spin)[:2] - tilt_state(sooner.as_quat(), spin)[:2]) / (2 * h)
        np.testing.assert_allclose(turn, change, atol=1e-6)


def test_a_commanded_tilt_is_the_same_at_any_heading() -> None:
    tilt = np.array([0.5, -0.7])
    for heading in (0.0, 0.6, -1.4):
        R = Rotation.from_euler("xyz", commanded(tilt, heading)).as_matrix()
        np.testing.assert_allclose(R[:, 2], axis(torch.from_numpy(tilt)).numpy(), atol=1e-12)


def test_a_drone_hovers_and_falls() -> None:
    x = torch.zeros(11, dtype=torch.float64)
    x[10] = GRAVITY
    u = torch.tensor([0.0, 0.0, GRAVITY], dtype=torch.float64)
    assert float(rates(x, u).abs().max()) < 1e-12
    x[10] = 0.0
    assert rates(x, 0 * u)[3:6].tolist() == [0.0, 0.0, -GRAVITY]


def test_frames_leave_the_opening_and_stand_on_the_floor() -> None:
    turn = Rotation.from_euler("xyz", [0.0, 0.0, 0.7])
    center = np.array([1.0, 2.0, 0.7])
    centers, halves, quaternions = frames(center[None], turn.as_quat()[None])
    back = Rotation.from_quat(np.roll(quaternions, -1, axis=-1)).inv()
    rng = np.random.default_rng(0)
    for reach, free in ((OPENING, True), (OUTER, False)):
        side = rng.uniform(-reach, reach, (400, 2))
        points = center + turn.apply(np.c_[np.zeros(400), side])
        inside = np.stack(
            [(np.abs(r.apply(points - c)) <= h).all(1) for r, c, h in zip(back, centers, halves, strict=True)]
        )
        expected = np.abs(side).max(1) >= OPENING
        assert (inside[:4].any(0) == expected).all() and (not expected.any()) == free
    assert centers[4, 2] + halves[4, 2] == center[2] - OUTER


def test_the_thrust_is_learnt_from_velocities() -> None:
    rng, strength, up = np.random.default_rng(1), Strength(), np.array([0.0, 0.0, 1.0])
    lift, period = 0.0, 0.02
    for _ in range(100):
        command, before = rng.uniform(6.0, 14.0), lift
        steps = command + (before - command) * np.exp(-RISE * np.linspace(0.0, period, 201))
        lift = steps[-1]
        push = 0.9 * float(np.mean(0.5 * (steps[1:] + steps[:-1]))) * up + rng.normal(0.0, 0.3, 3)
        strength.flown(command, period, push, up, counts=True)
    assert abs(strength.share - 0.9) < 0.015 and abs(strength.lift - lift) < 1e-9


def moving(at: list[float], speed: float) -> torch.Tensor:
    x = torch.zeros(1, 11, dtype=torch.float64)
    x[0, :3], x[0, 3], x[0, 10] = torch.tensor(at), speed, GRAVITY
    return x


def test_near_gates_that_are_not_seen_the_speed_is_bounded_and_braking_in_time_keeps_the_bound() -> None:
    gate, careful = torch.tensor([[1.0, 0.0]]).double(), torch.tensor([[CAREFUL_SPEED]]).double()
    rounded = (DECELERATION / SIGHT * ROUNDING_AREA / 2) / (
        2 * CAREFUL_SPEED
    )  # the most that the rounded corner adds, at the edge
    for height in (0.3, 1.5):  # gates are seen by their distance in the plane
        near = haste(moving([1.0, 0.0, height], CAREFUL_SPEED + 0.1), gate, careful)
        assert 0.08 < float(near) < 0.12
        edge = haste(moving([1.0 - SIGHT, 0.0, height], CAREFUL_SPEED), gate, careful)
        np.testing.assert_allclose(float(edge), -rounded, rtol=1e-6)
    for far in (0.05, 0.2, 0.5):
        braked = (CAREFUL_SPEED**2 + 2 * DECELERATION * far) ** 0.5
        assert float(haste(moving([1.0 - SIGHT - far, 0.0, 1.0], braked), gate, careful)) <= 0.0


def test_the_bound_is_that_of_the_leg_to_a_gate_that_is_not_seen_and_not_below_the_speed_now() -> None:
    gates = np.array([[0.5, 0.0, 1.0], [3.0, 0.0, 1.0]])
    track = Track(gates, np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)), np.array([[9.0, 9.0, 1.5]]), np.array([True]),
                  np.array([False, False]))  # fmt: skip
    x = moving([0.0, 0.0, 1.0], 2.0)[0].numpy()
    for met, expected in (([False, False], (2.04, CAREFUL_SPEED)), ([True, False], (100.0, CAREFUL_SPEED))):
        problem = posed(replace(track, met=np.array(met)), x, 0, 1.0, Limits())
        (row,) = (part for part in problem.constraints if getattr(part, "name", "") == "haste")
        bounds = np.ravel(vars(row)["knot_values"]["careful"])
        np.testing.assert_allclose(bounds[[1, 24, 25, -1]], np.repeat(expected, 2))


def test_a_detour_does_not_replace_a_plan_that_still_holds() -> None:
    def plan(end: float, speed: float) -> Plan:
        return Plan(np.array([1.0, end]), np.zeros((2, 11)), np.zeros((1, 3)), 0, np.zeros((1, 3)), speed)

    kept, fast = plan(3.0, 2.0), plan(3.0, 4.0)
    assert as_soon(plan(3.05, 2.0), kept, 1.0, 0.1) and as_soon(plan(2.0, 4.0), kept, 1.0, 0.1)
    assert not as_soon(plan(3.2, 2.0), kept, 1.0, 0.1) and not as_soon(plan(3.2, 4.0), kept, 1.0, 0.1)
    assert as_soon(plan(5.0, 2.0), fast, 1.0, 0.1) and not as_soon(plan(5.2, 2.0), fast, 1.0, 0.1)


@pytest.mark.slow
def test_at_the_careful_speed_a_gate_that_is_displaced_can_still_be_met() -> None:
    limits, N = Limits(), 24
    rows = [
        ControlBounds([-limits.tilt, -limits.tilt, limits.lift[0] * GRAVITY],
                      [limits.tilt, limits.tilt, limits.lift[1] * GRAVITY]),
        FunctionConstraint(lambda x: x[..., 6:8].square() - limits.tilt**2),
        FunctionConstraint(lambda x: torch.stack((x[..., 1] - DISPLACED, x[..., 4]), -1), "equality", knots=[N]),
    ]  # fmt: skip
    start = moving([0.0, 0.0, 1.0], CAREFUL_SPEED)
    problem = Problem(MODEL, FunctionCost(smoothness), rows, start, N, time=FreeTime(0.01, 4.0, guess=0.6))
    guess = torch.tensor([0.0, 0.0, GRAVITY]).double().repeat(1, N, 1)
    found = torchgco.solve(problem, guess, InteriorPoint(tolerance=1e-5))
    assert found.statuses[0].name == "CONVERGED"
    assert abs(0.7 / CAREFUL_SPEED - float(found.t[0, -1])) < 0.01
