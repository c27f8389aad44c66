"""Missions and environments that exported C plans for end with the bits of those that `MPC` plans for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import torchgco
from tests.export.exported import exported, needs_compiler
from tests.missions.missions import mission, scene
from torchgco import LoadedController, Status, load_c
from torchgco.envs import MissionVectorEnv
from torchgco.missions.mission import Flight
from torchgco.missions.planning_problem import airframe_of, planning_state

pytestmark = needs_compiler


def problem() -> Any:
    return scene(torch.tensor([[[0.9, 0.15, 0.0]]], dtype=torch.float64), 0.2, N=10, goal=1.8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(problem(), tmp_path_factory.mktemp("drone"))


def states(controller: Any) -> Tensor:
    """Of what is flown from now on, (1, K, 14)."""
    return controller.plan[0].unsqueeze(0) if isinstance(controller, LoadedController) else controller.plan.X


def flown(controller: Any) -> Any:
    """The log of a mission of a second, and of each period how the solve ended."""
    whole = problem()
    flight = Flight(mission(duration=1.0), whole, seed=3)
    ended = []
    while not flight.done:
        controller.step(planning_state(flight.x, airframe_of(whole.dynamics))[0])
        ended.append(int(controller.status))
        flight.step(states(controller))
    return flight.log, ended


def test_a_mission_ends_with_the_bits_of_python(folder: Path) -> None:
    own, ended = flown(load_c(folder))
    other, known = flown(torchgco.MPC(problem(), "interior_point", max_seconds=float("inf")))
    assert ended == known == [Status.CONVERGED] * 20
    assert torch.equal(own.x, other.x) and torch.equal(own.plan, other.plan)
    assert float(own.x[0, -1, -1, 0]) > 0.1


def acted(controller: Any) -> list[Tensor]:
    """States of an environment's vehicle, asked for what the plan has two periods later, as by `PlannerPolicy`."""
    env = MissionVectorEnv(1, problem(), mission(duration=2.0))
    env.reset(seed=5)
    passed = [env.episodes.x.clone()]
    for _ in range(15):
        controller.step(planning_state(env.episodes.measured(), env.episodes.airframe)[0])
        env.step(states(controller)[:, 2, 10:].to(torch.float32).numpy())
        passed.append(env.episodes.x.clone())
    return passed


def test_an_environment_ends_with_the_bits_of_python(folder: Path) -> None:
    own = acted(load_c(folder))
    other = acted(torchgco.MPC(problem(), "interior_point", max_seconds=float("inf")))
    assert all(map(torch.equal, own, other)) and float(own[-1][0, 0]) > 0.05
