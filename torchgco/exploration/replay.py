"""What a vehicle with a sensor saw and sought, found again from the states of its flight.

Scans depend on the true world, the vehicle's states and the keys of all draws alone, and searches on the map and the
measured states: a log need not hold what it can be found again from. Plans are not made again.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.exploration.mission import SensorMission
from torchgco.exploration.scout import ARRIVES
from torchgco.missions.disturbance import measured
from torchgco.missions.log import SeenLog
from torchgco.missions.mission import Mission
from torchgco.problem.problem import Problem


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
