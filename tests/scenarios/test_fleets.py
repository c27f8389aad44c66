"""Fleets start and end apart, have room, and are what their files hold."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from torchgco import InputError, Layouts, compose
from torchgco.scenarios import FleetCircle, FleetDoor, FleetForest
from torchgco.scenarios.fleets import Swaps
from torchgco.scenarios.layouts import concatenate

EVERY = [FleetCircle(vehicles=5), FleetCircle(vehicles=9, heights=(-0.3, 0.3)), FleetDoor(vehicles=7),
         FleetDoor(vehicles=32), FleetForest(vehicles=16)]  # fmt: skip


@pytest.mark.parametrize("scenario", EVERY, ids=lambda one: f"{one.name}-{one.vehicles}")
def test_starts_and_goals_are_apart_and_clear(scenario: Swaps, tmp_path: Path) -> None:
    drawn = scenario.draw([0, 3], seed=2)
    assert scenario.draw([3], seed=2) == drawn.take([1]) and scenario.draw([3], seed=1) != drawn.take([1])
    V, d = scenario.vehicles, scenario.dimension
    assert drawn.vehicles == V and drawn.start.shape == drawn.goal.shape == (2, V, d) and drawn.apart == 0.4
    for places in (*drawn.start, *drawn.goal):
        away = np.linalg.norm(places[:, None] - places, axis=-1) + np.diag(np.full(V, np.inf))
        assert away.min() > 0.8
    for b in range(2):
        ends = np.vstack([drawn.start[b], drawn.goal[b]])
        gaps = np.linalg.norm(ends[:, None] - drawn.centers[b], axis=-1) - drawn.radii[b]
        assert (gaps > 0.2).all()
    drawn.save(tmp_path / "fleets.npz")
    assert replace(Layouts.load(tmp_path / "fleets.npz"), name=drawn.name) == drawn
    assert concatenate([drawn.take([0]), drawn.take([1])]) == drawn


def test_goals_lie_on_the_other_side() -> None:
    circle, door = FleetCircle(vehicles=6).draw([1], 0), FleetDoor(vehicles=6).draw([1], 0)
    np.testing.assert_allclose(circle.goal, -circle.start)
    assert (door.start[..., 0] * door.goal[..., 0] < 0).all()
    ends = {tuple(np.round(p, 9)) for p in door.start[0]}
    assert {tuple(np.round(p, 9)) for p in door.goal[0]} == ends  # each ends where another one starts


def test_a_vehicle_of_a_fleet_has_a_task() -> None:
    drawn, vehicle = FleetCircle(vehicles=3).draw([0, 1], 0), compose(["scenario=fleet_circle", "solver=hold"]).vehicle
    whole = vehicle.at_rest(drawn)
    assert whole.start.shape == (2, 3, 4) and (whole.start[..., 2:] == 0).all()
    task = vehicle.task(drawn.of_vehicle(2))
    np.testing.assert_array_equal(task.problem.x0[:, :2].numpy(), drawn.start[:, 2])
    with pytest.raises(InputError, match=r"layouts.apart: expected None: .*of_vehicle"):
        vehicle.task(drawn)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"goal": None}, "layouts.start: expected start and goal of each vehicle"),
        ({"start": np.zeros((1, 1, 2))}, "layouts.start: expected shape .* V >= 2"),
        ({"start": np.zeros((3, 2))}, "layouts.goal: expected 3 vehicles as start has, got 2"),
        ({"goal": np.zeros((2, 4)), "start": np.zeros((2, 6))}, "layouts.goal: expected n = 6 as start has"),
        ({"apart": 0.0}, "layouts.apart: expected"),
    ],
)
def test_malformed_fleets_are_named(changes, message) -> None:
    good = {"start": np.zeros((2, 2)), "goal": np.ones((2, 2)), "apart": 0.4}
    with pytest.raises(InputError, match=message):
        Layouts(np.empty((1, 0, 2)), np.empty((1, 0)), **(good | changes))


def test_a_forest_without_room_is_refused() -> None:
    with pytest.raises(InputError, match=r"scenario.density: expected room for"):
        FleetForest(density=3.0).draw([0], 0)
