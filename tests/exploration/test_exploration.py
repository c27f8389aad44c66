"""Short missions with a sensor: goals, safe plans, the log, and the same bits alone and in a batch."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.missions.missions import REST
from torchgco import Airframe, Boxes, ControlBounds, Goal, Problem, QuadraticCost, QuadrotorPlanning, Spheres, presets
from torchgco.base.errors import InputError
from torchgco.exploration.explorer import Explorer, steady_yaw
from torchgco.exploration.mission import SensorMission
from torchgco.exploration.pilot import Exploration
from torchgco.exploration.safety import safe_arrays
from torchgco.exploration.sensing import Depth, Lidar
from torchgco.missions import Planner
from torchgco.missions.contact import Contact
from torchgco.missions.log import MissionLog
from torchgco.missions.outcome import SENSED, Outcome, ending, mission_frame, mission_row, packed, unpacked
from torchgco.missions.plant import RotorPlant, hovering

GOALS = torch.tensor([[4.0, 0.0, 0.0], [3.0, 0.5, 0.2]]).double()
EXPLORER = Explorer(around=(2.5, 1.5), stages=40)
LIDAR = Lidar(rays=(150, 30), range=8.0)


def walled(side: float = 0.0) -> Problem:
    """Two missions behind a wall with its middle at `side`, m: the way is around it."""
    cost = QuadraticCost(
        Q=[1.0] * 14, R=[1.0] * 4, Qf=[1.0] * 14, x_ref=[4.0, 0.0, 0.0, *REST[3:]], u_ref=[0, 0, 0, 9.81]
    )
    wall = Boxes([[2.0, side, 0.0]], [[0.2, 0.8, 2.5]], 0.2)
    bounds = ControlBounds([-5, -5, -5, 0.26], [5, 5, 5, 14.9])
    x0 = torch.tensor([REST, REST]).double()
    return Problem(QuadrotorPlanning(dt=0.05), cost, [wall, bounds], x0, 20, Goal(GOALS, 0.4))


def mission(**options: Any) -> SensorMission:
    parts: dict[str, Any] = {"sensor": "lidar", "lidar": LIDAR, "explorer": EXPLORER, "duration": 6.0} | options
    return SensorMission(Planner(presets.gco(3)), **parts)


@pytest.fixture(scope="module")
def flown() -> tuple[Problem, MissionLog]:
    problem = walled()
    return problem, mission().fly(problem, seed=1)


@pytest.mark.slow
def test_goals_behind_a_wall_that_was_not_known_are_reached(flown: tuple[Problem, MissionLog]) -> None:
    problem, log = flown
    for b in range(2):
        end = ending(log.arrays(), b, log.period, Contact.among(problem), GOALS[b].numpy(), 0.5)
        assert end.outcome is Outcome.REACHED and end.clearance > 0.02


@pytest.mark.slow
def test_every_period_holds_a_safe_plan(flown: tuple[Problem, MissionLog]) -> None:
    problem, log = flown
    safe = safe_arrays(log, problem)["safe"]
    for b, K in enumerate(log.steps()):
        assert (safe[b, :K] == 1).all() and np.isnan(safe[b, K:]).all() and K > 20


def test_a_period_without_a_safe_plan_is_found_out(flown: tuple[Problem, MissionLog]) -> None:
    problem, log = flown
    seen = log.seen[0]
    wrong = replace(seen, safe=[plan + np.array([1.5, 0.0, 0.0]) for plan in seen.safe])
    safe = safe_arrays(replace(log, seen=[wrong, log.seen[1]]), problem)["safe"]
    assert safe[0, 0] == 0 and np.nanmean(safe[1]) == 1


def test_the_log_is_kept_whole_and_becomes_tables(flown: tuple[Problem, MissionLog]) -> None:
    problem, log = flown
    arrays = log.arrays(plans=True) | safe_arrays(log, problem)
    back = unpacked(packed(arrays), log.commands.shape[2], sensed=True)
    assert set(back) == set(arrays)
    assert all(np.array_equal(back[name], arrays[name], equal_nan=True) for name in arrays)
    frame = mission_frame(arrays, [7, 8], log.period, arrays["cost"])
    assert set(SENSED) <= set(frame.columns) and (frame["safe"] == 1).all()
    parts = frame[["map_seconds", "field_seconds", "search_seconds"]].sum(axis=1)
    assert (parts <= 2.0 * frame["planner_seconds"]).all() and (frame["search_seconds"] > 0).all()
    end = ending(arrays, 0, log.period, Contact.among(problem), GOALS[0].numpy(), 0.5)
    row = mission_row(arrays, 0, log.period, end, Airframe())
    assert row["safe_share"] == 1.0


def test_plans_keep_the_speed_and_end_at_rest(flown: tuple[Problem, MissionLog]) -> None:
    _, log = flown
    for b, K in enumerate(log.steps()):
        assert float(log.x[b, :K, 0, 3:6].abs().max()) <= EXPLORER.speed
        ends = log.plan[b, :K, -1] - log.plan[b, :K, -2]
        assert float(ends.norm(dim=-1).max()) <= 0.1 * log.period


@pytest.mark.slow
def test_a_mission_is_the_same_alone(flown: tuple[Problem, MissionLog]) -> None:
    problem, log = flown
    second = torch.tensor([1])
    alone = replace(mission(), duration=1.0).fly(problem.take(second), seed=1, ids=second)
    assert torch.equal(alone.x[0, :20], log.x[1, :20])


def test_a_mission_without_a_sensor_has_no_such_columns() -> None:
    log = MissionLog.blank(torch.zeros(1, 17).double(), 2, 5, 0.05, 3)
    assert "map_seconds" not in log.arrays() and safe_arrays(log, walled().take(slice(0, 1))) == {}


@pytest.mark.slow
def test_a_dead_end_is_left() -> None:
    """A pocket whose mouth is at the start: from within, the way on is back and around."""
    pocket = Boxes(
        [[2.4, 0.0, 0.0], [1.4, 1.1, 0.0], [1.4, -1.1, 0.0]], [[0.2, 1.3, 2.5], [0.8, 0.2, 2.5], [0.8, 0.2, 2.5]], 0.2
    )
    problem = walled().take(slice(0, 1))
    problem = replace(problem, constraints=[pocket, problem.constraints[1]], goal=Goal(GOALS[:1], 0.4))
    near = replace(LIDAR, range=2.0)  # it sees the end of the pocket from within alone
    log = mission(lidar=near, duration=12.0).fly(problem)
    end = ending(log.arrays(), 0, log.period, Contact.among(problem), GOALS[0].numpy(), 0.5)
    assert end.outcome is Outcome.REACHED
    safe = safe_arrays(log, problem)["safe"]
    assert np.nanmean(safe) == 1.0


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"sensor": "sonar"}, "mission.sensor"),
        ({"unknown": "maybe"}, "mission.unknown"),
        ({"latency": 1}, "mission.latency"),
    ],
)
def test_options_that_do_not_fit_are_named(options: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError, match=field):
        mission(**options)


def test_plans_on_a_map_are_no_first_plans() -> None:
    with pytest.raises(InputError, match=r"mission\.sensor"):
        mission().first_plans(walled())


def test_an_explorer_names_what_is_wrong() -> None:
    with pytest.raises(InputError, match=r"mission\.explorer\.stages"):
        Explorer(stages=2)


def test_a_depth_camera_flies_too() -> None:
    log = mission(sensor="depth", depth=Depth(rays=(60, 45)), duration=0.5).fly(walled())
    assert bool(torch.isfinite(log.x[:, 0]).all()) and len(log.seen) == 2


@pytest.mark.parametrize("rate", [10.0, 20.0])
def test_scans_and_searches_take_turns(rate: float) -> None:
    problem, planner = walled(), Planner(presets.gco(3))
    exploration = Exploration(EXPLORER, planner, replace(LIDAR, rate=rate), "occupied", problem, 0, torch.arange(2))
    x, plan, searched, scanned = hovering(Airframe(), problem.x0[:, :3]), None, [], []
    for step in range(6):
        exploration.sense(step, x, x)
        before = [scout.search._round for scout in exploration.scouts]
        plan, _ = exploration.plan(step, x, plan)
        searched.append(
            all(scout.search._round > round for scout, round in zip(exploration.scouts, before, strict=True))
        )
        scanned.append(exploration.scouts[0].scanned)
    assert scanned == [True, rate == 20] * 3
    assert searched == ([True] * 6 if rate == 20 else [True, True, False, True, False, True])


@pytest.mark.slow
def test_known_moving_bodies_are_made_way_for() -> None:
    """A sphere comes along the straight way towards the vehicle."""
    problem = walled(9.0)
    sphere = Spheres([[8.0, 0.0, 0.0]], [0.6], 0.2, velocities=[[-1.5, 0.0, 0.0]])
    problem = replace(problem, constraints=[sphere, problem.constraints[1]]).take(slice(0, 1))
    log = mission(explorer=replace(EXPLORER, movers="known")).fly(problem, seed=1)
    end = ending(log.arrays(), 0, log.period, Contact.among(problem), GOALS[0].numpy(), 0.5)
    assert end.outcome is not Outcome.COLLISION and end.clearance > 0.1 and end.goal_distance < 2.0


@pytest.mark.slow
def test_plans_in_unknown_space_weigh_what_the_vehicle_weighs() -> None:
    """On the moon, too: it neither falls nor rises in the first half second."""
    moon = Airframe(gravity=1.62)
    task = replace(walled(), dynamics=QuadrotorPlanning(dt=0.05, airframe=moon))
    log = mission(plant=RotorPlant(moon), duration=0.5).fly(task, seed=1)
    assert bool((log.x[:, :, 0, 2].abs() < 0.05).all())
    assert bool((log.x[:, -1, -1, 0] > 0.0).all())  # on their way


def test_plans_yaw_no_faster_than_costs_no_thrust() -> None:
    """From turning one way to turning the other in a period, the rotors that rise do so by half of what they can."""
    airframe, model = Airframe(), QuadrotorPlanning(dt=0.05)
    most = float(steady_yaw(model, torch.zeros(1).double()))
    turn = 2.0 * most / float(model.rate_time_constant)  # rad/s^2
    change = turn * airframe.inertia[2][2] / (4.0 * airframe.rotor_torque)  # N per rotor
    hover = torch.tensor(airframe.mass * 9.81 / 4.0).double()
    rise = 0.05 * airframe.thrust_rate(hover, torch.tensor(airframe.rotor_speeds[1]).double())
    assert change == pytest.approx(0.5 * float(rise)) and 0.5 < most < 2.0
    several = QuadrotorPlanning(dt=0.05, rate_time_constant=torch.tensor([1.5, 3.0]).double())
    assert steady_yaw(several, torch.zeros(1).double()).flatten().tolist() == pytest.approx([most, 2 * most])
