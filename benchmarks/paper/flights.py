"""The missions behind Figures 8 to 12, A4 and A5 of paper.md: flights with three planners, and their times."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import pandas as pd
import torch

from benchmarks.paper.runs import FOREST, FOREST_LAYOUT, PAPERS_LOOP, Sampling, Witness
from torchgco import compose
from torchgco.dynamics.quadrotor import Airframe
from torchgco.missions.contact import Contact
from torchgco.missions.mission import Mission
from torchgco.missions.outcome import Ending, clearances, ending, mission_frame, mission_row, samples
from torchgco.missions.planner import MissionPlan, Planner
from torchgco.missions.tracker import Tracker, Tracking
from torchgco.plotting.bodies import bodies
from torchgco.plotting.course import Course
from torchgco.problem.problem import Problem
from torchgco.scenarios import Task

SOLVERS = ("al_ilqr", "gco_paper", "gco")
REPEATS = 5  # flights with each planner: alike in all but their times
OWN_LOOP = ("mission=default", "plant=rotors")


@dataclass(frozen=True)
class Flight:
    """One mission with one planner."""

    name: str  # of the solver
    course: Course
    period: float  # s
    frame: pd.DataFrame  # a row per control step
    fine: pd.DataFrame  # a row per time step of the plant: t, x0 to x16, f1 to f4 and u1 to u4
    plans: np.ndarray  # (K, N+1, 3), m
    end: Ending
    row: Mapping[str, object]  # see `flights.mission_row`
    tolerance: float  # violation up to which a new plan is flown
    sampled: Sequence[Sampling | None]  # the last call of MPPI in each control step; empty with gco


def mission_of(name: str, duration: float) -> tuple[Mission, Task]:
    """The paper's closed loop with al_ilqr or gco_paper, the library's with gco; and the task of Figure 6."""
    loop = OWN_LOOP if name == "gco" else PAPERS_LOOP
    setup = compose([*FOREST, *loop, f"solver={name}", f"mission.duration={duration}", "device.threads=1"])
    task = setup.task(setup.scenario.draw([FOREST_LAYOUT], setup.seed))
    assert setup.mission is not None
    return setup.mission, task


@dataclass(frozen=True)
class TimedPlanner(Planner):
    """A planner whose seconds are those of the processor, which other programs hardly change."""

    def plan(self, *arguments: Any, **options: Any) -> tuple[MissionPlan, Problem, float]:
        began = time.process_time()
        plan, problem, _ = super().plan(*arguments, **options)
        return plan, problem, time.process_time() - began


@dataclass(frozen=True)
class TimedTracker(Tracker):
    """A tracker that keeps the processor seconds of its calls."""

    seconds: list[float] = field(default_factory=list)

    def track(self, *arguments: Any, **options: Any) -> Tracking:
        began = time.process_time()
        tracking = super().track(*arguments, **options)
        self.seconds.append(time.process_time() - began)
        return tracking


def fly(names: Sequence[str] = SOLVERS, duration: float = 15.0) -> list[Flight]:
    """Fly the mission of Figure 6's layout for at most `duration`, s, with each planner in turn, `REPEATS` times.

    Times are the least of all flights, step by step.
    """
    logs: dict[str, list[dict[str, np.ndarray]]] = {name: [] for name in names}
    sampled: dict[str, list[Sampling | None]] = {}
    for _ in range(REPEATS):
        for name in names:
            mission, task = mission_of(name, duration)
            arrays, sampled[name] = _flown(mission, task.problem)
            logs[name].append(arrays)
    return [_flight(name, logs[name], sampled[name], *mission_of(name, duration)) for name in names]


def _flight(
    name: str, logs: Sequence[dict[str, np.ndarray]], sampled: list[Sampling | None], mission: Mission, task: Task
) -> Flight:
    """One of several flights, which differ in their times alone, with the least of these."""
    arrays = dict(logs[0])
    assert all(np.array_equal(arrays["x"], other["x"], equal_nan=True) for other in logs)
    for part in ("planner_seconds", "tracker_seconds"):
        arrays[part] = np.min([other[part] for other in logs], axis=0)
    radius, period = mission.goal_radius, float(task.problem.dynamics.dt)
    assert radius is not None
    contact, place = Contact.among(task.problem), task.goal[0].numpy()
    course = Course(bodies(task.layouts.arrays(), 0), place, radius)
    t, x = samples(arrays, 0, period)
    end = ending(arrays, 0, period, contact, place, radius)
    frame = mission_frame(arrays, [FOREST_LAYOUT], period, clearances(arrays, period, contact))
    row, fine = mission_row(arrays, 0, period, end, Airframe()), _fine(t, x, arrays["commands"][0])
    tolerance = mission.planner.tolerance
    return Flight(name, course, period, frame, fine, arrays["plan"][0], end, row, tolerance, sampled)


def _flown(mission: Mission, problem: Problem) -> tuple[dict[str, np.ndarray], list[Sampling | None]]:
    """The arrays of a flight, and the last call of MPPI in each control step; none where the solver has no GCO."""
    solver: Any = mission.planner.solver
    guidance = getattr(solver, "guidance", None)
    witness = None if guidance is None else Witness(guidance)
    solver = solver if witness is None else replace(solver, guidance=witness)
    planner = TimedPlanner(**_options(mission.planner) | {"solver": solver})
    tracker = TimedTracker(**_options(mission.tracker))
    log = replace(mission, planner=planner, tracker=tracker).fly(problem, ids=torch.tensor([FOREST_LAYOUT]))
    arrays = log.arrays(plans=True)
    spent = np.array(tracker.seconds).reshape(-1, log.commands.shape[2]).sum(axis=1)
    arrays["tracker_seconds"] = np.full_like(arrays["tracker_seconds"], np.nan)
    arrays["tracker_seconds"][0, : len(spent)] = spent
    calls = [] if witness is None else [[step.sampling for step in steps] for steps in witness.solves]
    return arrays, [next((call for call in reversed(made) if call is not None), None) for made in calls]


def _options(part: Any) -> dict[str, Any]:
    return {option.name: getattr(part, option.name) for option in fields(part)}


def _fine(t: np.ndarray, x: np.ndarray, commands: np.ndarray) -> pd.DataFrame:
    """A row per time step; a command holds from its row to the next, and the last is repeated."""
    u = commands.reshape(-1, 4)[: len(t) - 1]
    u = np.concatenate((u, u[-1:]))
    columns = {"t": t} | {f"x{i}": x[:, i] for i in range(17)}
    columns |= {f"f{i + 1}": x[:, 13 + i] for i in range(4)} | {f"u{i + 1}": u[:, i] for i in range(4)}
    return pd.DataFrame(columns)
