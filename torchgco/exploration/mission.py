"""Missions that learn of obstacles by a sensor, and what the vehicle saw and sought, found again from its flight.

Scans depend on the true world, the vehicle's states and the keys of all draws alone, and searches on the map and the
measured states: a log need not hold what it can be found again from. Plans are not made again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.dynamics.base import Dynamics
from torchgco.exploration.explorer import ARRIVES, Explorer, SensorName, Unknown
from torchgco.exploration.pilot import Exploration
from torchgco.exploration.sensing.sensors import Depth, Lidar
from torchgco.missions.disturbance import measured
from torchgco.missions.log import SeenLog
from torchgco.missions.mission import Mission
from torchgco.missions.pilot import Pilot
from torchgco.native.compiler import find_compiler
from torchgco.obstacles.body import check_no_body
from torchgco.problem.problem import Problem


@dataclass(frozen=True)
class SensorMission(Mission):
    """A closed loop that may know of the obstacles what a sensor sees on the way; see `Mission` for its other options.

    Args:
        sensor: what the vehicle knows of the obstacles: "full", all of them from the start, or what a "lidar" or a
            "depth" camera sees on the way.
        unknown: what plans make of space that hasn't been seen, with a lidar or a depth camera: "occupied" stay out of
            it and so can always stop in time, "free" plan as if nothing were there.
        lidar, depth, explorer: options of the sensors, and of flights with them.

    Raises:
        InputError: as `Mission`, and a latency with a sensor.
    """

    sensor: SensorName = "full"
    unknown: Unknown = "occupied"
    lidar: Lidar = field(default_factory=Lidar)
    depth: Depth = field(default_factory=Depth)
    explorer: Explorer = field(default_factory=Explorer)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.sees_all and self.latency:
            raise InputError("mission.latency", "0 with a sensor", self.latency)

    @property
    def sees_all(self) -> bool:
        """See `Mission`."""
        return self.sensor == "full"

    def check(self, dynamics: Dynamics) -> None:
        """See `Mission`."""
        super().check(dynamics)
        if not self.sees_all and find_compiler() is None:
            wanted = "full on a machine without a C compiler: sensors and their maps are computed in C (TORCHGCO_CC)"
            raise InputError("mission.sensor", wanted, self.sensor)

    def check_stated(self, problem: Problem) -> None:
        """See `Mission`."""
        super().check_stated(problem)
        if not self.sees_all:
            check_no_body(problem, "vehicle_radius", "a number for a mission with a sensor, whose vehicle is a ball")

    def begin(self, problem: Problem, x: Tensor, seed: int, ids: Tensor) -> Pilot:
        """Who plans for vehicles at plants x (B, 17): the planner, or with a sensor the explorer."""
        return super().begin(problem, x, seed, ids) if self.sees_all else self.exploration(problem, seed, ids)

    def exploration(self, problem: Problem, seed: int, ids: Tensor) -> Exploration:
        """The pilot that explores with the sensor."""
        sensor = self.lidar if self.sensor == "lidar" else self.depth
        return Exploration(self.explorer, self.planner, sensor, self.unknown, problem, seed, ids)


def replayed(
    mission: Mission, problem: Problem, x: Tensor, seed: int, number: int, report: Callable[[], object] = lambda: None
) -> tuple[SeenLog, list[np.ndarray]]:
    """What the vehicle of a mission saw and sought.

    Args:
        mission: as it was flown.
        problem: a batch of one: the planning problem it was flown from.
        x: (K, 17): true states at the starts of its control periods.
        seed, number: the key of its random draws.
        report: called after each control period.

    Returns:
        How the vehicle's map changed; its `safe` is empty, as plans are not made again. And for each period the path
        (P, 3), m, from the vehicle to its goal, over all cells that aren't known to be occupied; it ends early where
        there is none.

    Raises:
        InputError: a mission without a sensor, more than one problem, or states of another shape.
    """
    if problem.B != 1 or x.dim() != 2 or x.shape[1] != 17:
        raise InputError("x", "states (K, 17) of one mission", f"{tuple(x.shape)} of {problem.B}")
    if not isinstance(mission, SensorMission) or mission.sees_all:
        raise InputError("mission.sensor", "lidar or depth: only then is there something to see", "full")
    exploration = mission.exploration(problem, seed, torch.tensor([number], device="cpu"))
    period = float(problem.dynamics.dt)
    _, noise = mission.disturbance.draw(seed, [number], mission.periods(period), period)
    (scout,), sought = exploration.scouts, []
    for step, state in enumerate(x):
        true = state.unsqueeze(0)
        measurement = measured(true, noise[:, step])
        exploration.sense(step, true, measurement)
        exploration.seek(measurement)
        path = np.concatenate([measurement[0, None, :3].numpy(), scout.path[1:]])
        near = np.linalg.norm(path[-1] - scout.goal) <= ARRIVES * scout.seen.resolution
        sought.append(np.concatenate([path, scout.goal[None]]) if near else path)
        report()
    return scout.log, sought
