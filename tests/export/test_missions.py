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


def test_a_mission_of_several_vehicles_is_flown_by_elements(tmp_path: Path) -> None:
    """Each by a workspace of its own, with the bits of an MPC of all."""
    balls = torch.tensor([[[0.9, 0.15, 0.0]], [[0.8, -0.2, 0.1]]], dtype=torch.float64)
    whole, logs = scene(balls, 0.2, N=10, goal=1.8), []
    folder = exported(whole, tmp_path)
    for exports in (True, False):
        flight = Flight(mission(duration=0.5), whole, seed=3)
        controllers = [load_c(folder, element=b) for b in range(2)] if exports else []
        mpc = torchgco.MPC(whole, "interior_point", max_seconds=float("inf"))
        while not flight.done:
            measured = planning_state(flight.x, airframe_of(whole.dynamics))
            if exports:
                for c, x in zip(controllers, measured, strict=True):
                    c.step(x)
                flight.step(torch.stack([c.plan[0] for c in controllers]))
            else:
                mpc.step(measured)
                flight.step(states(mpc))
        logs.append(flight.log)
    assert torch.equal(logs[0].x, logs[1].x) and torch.equal(logs[0].plan, logs[1].plan)
    assert len(logs[0].x) == 2 and not torch.equal(logs[0].x[0], logs[0].x[1])
