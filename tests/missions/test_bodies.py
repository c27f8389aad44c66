"""Missions of vehicles with a body: contact by the simulated attitude, and flights that a ball doesn't fit or tell."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from tests.missions.missions import DOUBLE, SOLVER, far, mission
from tests.missions.test_contact import BLIND
from tests.missions.test_mission import assert_same_flights, ends
from torchgco import Body, Boxes, ControlBounds, InputError, Problem, Spheres
from torchgco.constraints import Constraint
from torchgco.envs.episodes import Episodes
from torchgco.exploration.mission import SensorMission
from torchgco.missions.contact import Contact
from torchgco.missions.outcome import Ending, Outcome, judge_flight
from torchgco.missions.planner import Planner
from torchgco.missions.planning_problem import Margin
from torchgco.missions.plant import hovering
from torchgco.obstacles.body import BoundBody

ARM, ROTOR = 0.3, 0.1  # m: a flat quadrotor, five balls in a plane
SIDE = ARM / math.sqrt(2.0)
CENTERS = np.array([[0.0, 0, 0], *([a * SIDE, b * SIDE, 0] for a in (-1, 1) for b in (-1, 1))])
FLAT = Body(CENTERS.tolist(), ROTOR, "quaternion")
GOAL = np.array([9.0, 0.0, 0.0])
MASS = 1.608  # kg, of the paper's quadrotor


def among(*obstacles: Constraint, B: int = 1) -> Problem:
    return replace(far(B, N=25), constraints=[*obstacles, ControlBounds([-5, -5, -5, 0.26], [5, 5, 5, 14.9])])


def slot(vehicle: Any, half: float, roll: float, thick: float = 0.05) -> Boxes:
    """Two slabs at x = 1 m that leave a gap of twice `half`, m, turned by `roll`, rad, about the way."""
    turn = [math.cos(0.5 * roll), math.sin(0.5 * roll), 0.0, 0.0]
    up = np.array([0.0, -math.sin(roll), math.cos(roll)])
    centers = [(np.array([1.0, 0, 0]) + side * (half + 2.0) * up).tolist() for side in (1, -1)]
    return Boxes(centers, [[thick, 20.0, 2.0]] * 2, vehicle, [turn] * 2)


def flown(roll: float, steps: int = 21) -> np.ndarray:
    """A straight flight through the slot's place without turning, states (T, 17)."""
    x = np.zeros((steps, 17))
    x[:, 0] = np.linspace(0.0, 2.0, steps)
    x[:, 6:8] = math.cos(0.5 * roll), math.sin(0.5 * roll)
    return x


def judged(x: np.ndarray, problem: Problem) -> Ending:
    return judge_flight(x, 0.01, Contact.among(problem), GOAL, 0.5)


def test_an_upright_slit_is_passed_on_edge_alone() -> None:
    slit = among(slot(FLAT, 0.25, 0.5 * math.pi))
    level, edge = judged(flown(0.0), slit), judged(flown(0.5 * math.pi), slit)
    assert level.outcome is Outcome.COLLISION and -0.05 < level.clearance < 0.0 and level.flight_time == 0.07
    whole = float(Contact.among(slit).along(torch.from_numpy(flown(0.0))[None], 0.01))
    assert whole == pytest.approx(0.25 - SIDE - 0.95 * ROTOR)
    assert edge.outcome is Outcome.TIMEOUT and edge.clearance == pytest.approx(0.25 - 0.95 * ROTOR)
    with pytest.raises(InputError, match=r"states .* of a vehicle with a Body"):
        judged(flown(0.0)[:, :3], slit)


def test_a_turn_between_two_samples_touches() -> None:
    """A rotor sweeps over a sphere, which it doesn't touch before or after; nothing else moves."""
    x = np.zeros((2, 17))
    for row, yaw in zip(x, (-0.6, 0.6), strict=True):
        row[[6, 9]] = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    problem = among(Spheres([[SIDE + 0.02, SIDE + 0.02, 0.0]], [0.05], FLAT))
    turned = Rotation.from_euler("z", 45, degrees=True).apply([ARM, 0, 0])
    assert np.allclose(turned, [SIDE, SIDE, 0.0])
    contact, held = Contact.among(problem), torch.from_numpy(x)
    assert float(contact.distance(held[:1], 0.0)) > 0.0 < float(contact.distance(held[1:], 0.0))
    assert judged(x, problem).outcome is Outcome.COLLISION
    swept = 2.0 * ARM * math.sin(0.6)
    assert float(contact.moved(held[:1], held[1:])) == pytest.approx(swept), "a rotor's way, at one position"


def by_hand(x: np.ndarray, turn: Rotation, center: np.ndarray) -> float:
    places = x[:3] + turn.apply(CENTERS)
    return float(np.linalg.norm(places - center, axis=-1).min()) - 0.95 * (0.3 + ROTOR)


def by_thrust(x: Tensor) -> Tensor:
    """Turned about z by the thrust's acceleration, of which the plant has the thrusts."""
    cos, sin, none = (0.1 * x[..., 13]).cos(), (0.1 * x[..., 13]).sin(), torch.zeros_like(x[..., 13])
    rows = ((cos, -sin, none), (sin, cos, none), (none, none, none + 1.0))
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


@pytest.mark.parametrize("attitude", ["quaternion", "function"])
def test_distances_are_those_of_the_turned_balls(attitude: str) -> None:
    rng = np.random.default_rng(3)
    center, velocity = np.array([0.4, 0.1, -0.2]), np.array([0.3, -0.5, 0.2])
    body = FLAT if attitude == "quaternion" else replace(FLAT, attitude=by_thrust)
    contact = Contact.among(among(Spheres([center.tolist()], [0.3], body, [velocity.tolist()]), B=3))
    x = rng.normal(0.0, 0.6, (3, 4, 17))
    found = contact.distances(torch.from_numpy(x), 0.4).numpy()
    for b in range(3):
        for k in range(4):
            w, *v = x[b, k, 6:10]
            turn = Rotation.from_quat([*v, w])
            if attitude == "function":
                turn = Rotation.from_rotvec([0.0, 0.0, 0.1 * x[b, k, 13:].sum() / MASS])
            assert found[b, k] == pytest.approx(by_hand(x[b, k], turn, center + 0.4 * k * velocity)), (b, k)


TILT, HALF = math.radians(30), 0.18  # a level vehicle's rotors reach SIDE sin 30 + ROTOR = 0.21 m across the gap


@pytest.mark.slow
def test_a_mission_rolls_through_a_slot_that_hits_what_flies_level() -> None:
    """The gap is less than half of what the ball around the body needs, and too narrow for the body flown level."""
    problem, radius = among(slot(FLAT, HALF, TILT)), torch.tensor([0.6], **DOUBLE)
    assert SIDE * math.sin(TILT) + 0.95 * ROTOR > HALF > ROTOR and 0.5 * FLAT.reach > HALF
    careful = mission(SOLVER, 1.7).fly(problem)
    (end,) = ends(careful, problem, radius)
    x = careful.x[0, :, 0]
    through = int((x[:, 0] > 1.0).nonzero()[0])
    roll = 2.0 * math.atan2(float(x[through, 7]), float(x[through, 6]))
    assert end.outcome is Outcome.TIMEOUT and end.clearance > 0.01 and float(x[-1, 0]) > 1.05 + FLAT.reach
    assert math.degrees(roll) == pytest.approx(30, abs=15)
    # Planned for the ball inside, the vehicle flies level.
    (end,) = ends(mission(SOLVER, 1.7).fly(among(slot(ROTOR, HALF, TILT))), problem, radius)
    assert end.outcome is Outcome.COLLISION
    blind = mission(BLIND, 1.7).fly(problem)
    (end,) = ends(blind, problem, radius)
    assert end.outcome is Outcome.COLLISION
    assert int(blind.steps()[0]) == math.ceil(end.flight_time / 0.05 - 1e-9), "the simulation has seen it, too"


@pytest.mark.slow
def test_plans_keep_the_body_in_all_their_parts_and_missions_do_not_depend_on_others() -> None:
    problem = among(slot(FLAT, HALF, TILT), B=2)
    x = hovering(problem.dynamics.airframe, problem.x0[:, :3])  # type: ignore[attr-defined]
    posed = Planner(SOLVER, margin_growth=0.02).problem(problem, x)
    parts = [part for part in posed.constraints if isinstance(part, BoundBody)]
    assert parts[0].knots == slice(1, 11) and parts[-1].knots.stop == 26
    assert all(len(part.balls) == 5 and part.points.knots == part.knots for part in parts)
    sizes = [float(part.vehicle_radius[0]) for part in parts]
    assert sizes == sorted(sizes) and sizes[0] == pytest.approx(ROTOR + 0.01)
    whole, one = mission(duration=0.1).fly(problem), torch.tensor([1])
    assert_same_flights(mission(duration=0.1).fly(problem.take(one), ids=one), whole, [1])


def test_the_margin_knows_the_ways_of_the_rotors() -> None:
    (part, _) = among(slot(FLAT, HALF, TILT)).constraints
    X = torch.zeros(1, 2, 14, **DOUBLE)
    X[0, :, 6], X[0, 1, 9] = 1.0, math.tan(0.2)  # turns by 0.4 rad in place
    step = torch.zeros(1, **DOUBLE)
    way, off = 2.0 * ARM * math.sin(0.2), ARM * (1.0 - math.cos(0.2))
    assert isinstance(part, BoundBody)
    assert float(Margin(0.01, 0.0, step, X).of(part)) == pytest.approx(0.01 + way**2 / (8.0 * ROTOR) + off)
    assert float(Margin(0.01, 0.0, step).of(part)) == 0.01


def test_who_plans_for_balls_alone_refuses_a_body() -> None:
    problem = among(slot(FLAT, HALF, TILT))
    with pytest.raises(InputError, match="vehicle_radius: expected a number for a mission with a sensor"):
        SensorMission(Planner(SOLVER), sensor="lidar").fly(problem)
    with pytest.raises(InputError, match="vehicle_radius: expected a number for an environment"):
        Episodes(mission(), problem, 1, "rates")
