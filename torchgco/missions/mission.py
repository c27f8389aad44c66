"""The mission: planner, tracker and plant in closed loop, for a batch of vehicles in lockstep (section 5.2.2).

Every control period the planner solves from the measured state; every step of the plant the tracker commands the rotors
along the plan. A vehicle that reaches its goal, touches an obstacle or diverges leaves the batch.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Annotated

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.options import Above, AtMost, Meters, Seed, Within, check_options, check_value
from torchgco.base.shapes import computing_on
from torchgco.base.tree import take
from torchgco.dynamics.base import Dynamics
from torchgco.dynamics.quadrotor import Airframe
from torchgco.missions.contact import Contact
from torchgco.missions.disturbance import Disturbance, measured
from torchgco.missions.log import MissionLog
from torchgco.missions.outcome import FARTHEST
from torchgco.missions.planner import Plan, Planner
from torchgco.missions.planning_problem import airframe_of
from torchgco.missions.plant import Plant, RotorPlant, hovering
from torchgco.missions.sensing.sensors import Depth, Lidar
from torchgco.missions.tracker import Reference, Tracker, Tracking
from torchgco.missions.unknown.exploration import Exploration
from torchgco.missions.unknown.explorer import Explorer, SensorName, Unknown
from torchgco.native.compiler import find_compiler
from torchgco.problem.problem import Problem, current_problem
from torchgco.solution import Solution
from torchgco.solvers.contracts import check_ids

LONGEST = 3600.0  # s of a mission
SEED_STEP = 7_919  # between the seeds of two control steps
Report = Callable[[int, int], None]  # of a control step and the number of vehicles that still fly


@dataclass(frozen=True)
class Mission:
    """The closed loop.

    Args:
        planner: makes a plan in every control period, which is a time step of the planning problems.
        tracker: its time step divides the control period, and is the plant's.
        plant: the vehicle; parameters that differ between missions are (B,). Its airframe is the one of the planning
            model, which planner and tracker use; its errors are deviations from that.
        disturbance: wind and noise.
        duration: s, after which a mission ends with TIMEOUT.
        goal_radius: m, within which the goal counts as reached; None: the problems' own.
        latency: control periods between a measurement and the first use of the plan made from it, 0 or 1. With 1, a
            plan starts where the former plan leads within the period, and without `first_step`.
        sensor: what the vehicle knows of the obstacles: "full", all of them from the start, or what a "lidar" or a
            "depth" camera sees on the way.
        unknown: what plans make of space that hasn't been seen, with a lidar or a depth camera: "occupied" stay out of
            it and so can always stop in time, "free" plan as if nothing were there.
        lidar, depth, explorer: options of the sensors, and of flights with them.

    Raises:
        InputError: a field out of its range, or periods that don't fit each other.
    """

    planner: Planner
    tracker: Tracker = field(default_factory=Tracker)
    plant: Plant = field(default_factory=RotorPlant)
    disturbance: Disturbance = field(default_factory=Disturbance)
    duration: Annotated[float, Above(0, "s"), AtMost(LONGEST, "s")] = 15.0
    goal_radius: Meters | None = 0.5
    latency: Annotated[int, Within(0, 1, "control periods")] = 0
    sensor: SensorName = "full"
    unknown: Unknown = "occupied"
    lidar: Lidar = field(default_factory=Lidar)
    depth: Depth = field(default_factory=Depth)
    explorer: Explorer = field(default_factory=Explorer)

    def __post_init__(self) -> None:
        check_options(self, "mission")
        if self.sensor != "full" and self.latency:
            raise InputError("mission.latency", "0 with a sensor", self.latency)
        if self.plant.dt != self.tracker.dt:
            raise InputError("tracker.dt", f"the plant's {self.plant.dt} s", self.tracker.dt)

    def check(self, dynamics: Dynamics) -> None:
        """Raise InputError unless these dynamics of a planning problem can be flown."""
        frame, flown = airframe_of(dynamics), getattr(self.plant, "airframe", None)
        if isinstance(flown, Airframe) and flown != frame:
            named = [f.name for f in fields(frame) if getattr(frame, f.name) != getattr(flown, f.name)]
            planned, given = (", ".join(f"{name} {getattr(one, name)}" for name in named) for one in (frame, flown))
            raise InputError("plant.airframe", f"that of the planning model, {planned}", given)
        if self.substeps(float(dynamics.dt)) is None:
            raise InputError("scenario.dt", f"a multiple of the plant's {self.plant.dt} s", dynamics.dt)
        if self.sensor != "full" and find_compiler() is None:
            wanted = "full on a machine without a C compiler: sensors and their maps are computed in C (TORCHGCO_CC)"
            raise InputError("mission.sensor", wanted, self.sensor)

    def substeps(self, period: float) -> int | None:
        """Time steps of the plant in a control period, s; None where they don't fit."""
        count = round(period / self.plant.dt)
        return count if count >= 1 and math.isclose(count * self.plant.dt, period, rel_tol=1e-9) else None

    def exploration(self, problem: Problem, seed: int, ids: Tensor) -> Exploration | None:
        """The planner of missions with a sensor; None where all obstacles are known."""
        if self.sensor == "full":
            return None
        sensor = self.lidar if self.sensor == "lidar" else self.depth
        return Exploration(self.explorer, self.planner, sensor, self.unknown, problem, seed, ids)

    def fly(
        self, problem: Problem, seed: int = 0, ids: Tensor | None = None, report: Report | None = None
    ) -> MissionLog:
        """Fly B missions from rest at the starts of planning problems to their goals.

        Args:
            problem: the planning problems, float64, on the quadrotor's planning model.
            seed, ids: the key of all random draws; ids (B,) int64, by default 0..B-1.

        Raises:
            InputError: another model, no goal, another precision, obstacles of a kind that can't be judged, a control
                period that isn't a multiple of the plant's time step, or an argument of another kind.
        """
        check_value(report, Callable | None, "report")
        with computing_on(torch.device("cpu")):
            return self._flight(problem, seed, ids).run(report or (lambda step, flying: None))

    def first_plans(self, problem: Problem, seed: int = 0, ids: Tensor | None = None) -> tuple[Problem, Solution]:
        """The planning problems of the first control period, and the solutions that `fly` makes its first plans of.

        Raises:
            InputError: as `fly`, and for missions with a sensor, which plan on their maps.
        """
        if self.sensor != "full":
            raise InputError("mission.sensor", "full for first plans", self.sensor)
        with computing_on(torch.device("cpu")):
            flight = self._flight(problem, seed, ids)
            return flight.planner.first(problem, measured(flight.x, flight.noise[:, 0]), flight.seed, flight.ids)

    def _flight(self, problem: Problem, seed: int, ids: Tensor | None) -> _Flight:
        problem = current_problem(problem)
        seed = check_value(seed, Seed, "seed")
        if ids is not None:
            check_ids(ids, problem)
        return _Flight(self, problem, seed, torch.arange(problem.B) if ids is None else ids)


class _Flight:
    """One call of `Mission.fly`: the state of all vehicles that still fly."""

    def __init__(self, mission: Mission, problem: Problem, seed: int, ids: Tensor) -> None:
        self.mission, self.seed = mission, seed
        # The thrusts at a plan's start are not known one period ahead.
        self.planner = mission.planner if mission.latency == 0 else replace(mission.planner, first_step=False)
        if problem.goal is None:
            raise InputError("goal", "a Goal in the problem", None)
        if problem.horizon is not None:
            raise InputError("horizon", "None for a mission, which replans over N stages", "horizons of each problem")
        mission.check(problem.dynamics)
        self.airframe = airframe_of(problem.dynamics)
        if problem.x0.dtype != torch.float64:
            raise InputError("x0", "torch.float64 for a mission", problem.x0.dtype)
        self.period = float(problem.dynamics.dt)
        self.substeps = mission.substeps(self.period) or 1
        self.steps = math.ceil(mission.duration / self.period - 1e-9)
        self.contact = Contact.among(problem)
        self.measured_at, self.clearance = problem.x0[:, :3], torch.full_like(problem.x0[:, 0], -torch.inf)
        self.goal = problem.goal.position
        radius = mission.goal_radius
        self.radius = problem.goal.radius if radius is None else torch.full_like(problem.x0[:, 0], radius)
        x = hovering(self.airframe, problem.x0[:, :3])
        self.start = x[:, :3]
        self.problem, self.planned = problem, self.planner.problem(problem, x)
        self.force, self.noise = mission.disturbance.draw(seed, ids.tolist(), self.steps, self.period)
        self.plant, self.x, self.rows, self.ids = mission.plant, x, torch.arange(problem.B), ids
        self.exploration = mission.exploration(problem, seed, ids)
        knots = (problem.N if self.exploration is None else mission.explorer.stages) + 1
        self.log = MissionLog.blank(x, self.steps, self.substeps, self.period, knots)
        if self.exploration is not None:
            self.log.seen.extend(scout.log for scout in self.exploration.scouts)

    def run(self, report: Report) -> MissionLog:
        """Fly until all missions have ended."""
        plan: Plan | None = None
        tracking: Tracking | None = None
        self._leave(~self.problem.start_is_clear)
        for step in range(self.steps):
            if self.rows.numel() == 0:
                break
            seen, seconds = measured(self.x, self.noise[self.rows, step]), 0.0
            if self.exploration is not None:
                self.exploration.sense(step, self.x, seen)
            if plan is None or self.mission.latency == 0:
                plan, seconds = self._planned(step, seen, seen, plan)
            flown = plan
            if self.mission.latency == 1:
                plan, more = self._planned(step + 1, self.planner.predicted(seen, flown), seen, flown)
                seconds += more
            self.log.add_plan(self.rows, step, self.x, flown, seconds / self.rows.numel())
            if self.exploration is not None:
                self.log.add_parts(self.rows, step, self.exploration.parts())
            tracking, left = self._fly_period(step, flown, tracking)
            if bool(left.any()):
                stay = (~left).nonzero().flatten()
                plan, tracking = plan.take(stay), tracking.take(stay)
                self._leave(left)
            report(step, self.rows.numel())
        return self.log

    def _planned(self, step: int, x: Tensor, seen: Tensor, before: Plan | None) -> tuple[Plan, float]:
        """Plans from states x (B, 17) at a control step, when `seen` is measured; and the seconds they took."""
        if self.exploration is not None:
            return self.exploration.plan(step, x, before)
        seed = self.seed + SEED_STEP * step
        plan, self.planned, seconds = self.planner.plan(
            self.problem, self.planned, x, step, before, seed, self.ids, seen
        )
        return plan, seconds

    def _fly_period(self, step: int, plan: Plan, tracking: Tracking | None) -> tuple[Tracking, Tensor]:
        """One control period along a plan; and which vehicles have ended in it, (B,) bool."""
        reference = Reference(plan.X, self.period, self.airframe)
        ended = torch.zeros_like(self.rows, dtype=torch.bool)
        for j in range(self.substeps):
            seen = measured(self.x, self.noise[self.rows, step])
            began = time.perf_counter()
            tracking = self.mission.tracker.track(seen, reference, j * self.plant.dt, tracking)
            seconds = (time.perf_counter() - began) / self.rows.numel()
            flew, x = ~ended, self.plant.advance(self.x, tracking.commands, self.force[self.rows, step])
            self.x = torch.where(ended.unsqueeze(-1), self.x, x)
            ended |= self._ends((step * self.substeps + j + 1) * self.plant.dt)
            self.log.add_sample(self.rows, step, j, self.x, tracking, seconds, flew)
        assert tracking is not None
        return tracking, ended

    def _ends(self, t: float) -> Tensor:
        """Whether a vehicle is at its goal, in contact, or lost, (B,)."""
        p = self.x[:, :3]
        finite = torch.isfinite(self.x).all(-1) & ((p - self.start[self.rows]).norm(dim=-1) <= FARTHEST)
        there = (p - self.goal[self.rows]).norm(dim=-1) < self.radius[self.rows]
        return ~finite | there | self._touches(p, t)

    def _touches(self, p: Tensor, t: float) -> Tensor:
        """Whether vehicles at p (B, 3) are in contact: none is that has flown less than its last clearance at rest."""
        if self.contact.moving or not bool(((p - self.measured_at).norm(dim=-1) < self.clearance).all()):
            self.measured_at, self.clearance = p, self.contact.distance(p, t)
            return self.clearance < 0
        return torch.zeros_like(self.clearance, dtype=torch.bool)

    def _leave(self, left: Tensor) -> None:
        """Drop the vehicles where `left` (B,)."""
        stay = (~left).nonzero().flatten()
        if stay.numel() == left.numel():
            return
        self.problem, self.planned = self.problem.take(stay), self.planned.take(stay)
        self.plant, self.contact = self.plant.take(stay), self.contact.take(stay)
        self.x, self.rows, self.ids = take((self.x, self.rows, self.ids), stay)
        self.measured_at, self.clearance = self.measured_at[stay], self.clearance[stay]
        if self.exploration is not None:
            self.exploration.take(stay)
