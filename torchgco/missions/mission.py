"""The mission: planner, tracker and plant in closed loop, for a batch of vehicles in lockstep (section 5.2.2).

Every control period the planner solves from the measured state; every step of the plant the tracker commands the rotors
along the plan. A vehicle that reaches its goal, touches an obstacle or diverges leaves the batch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, ClassVar

import torch
from torch import Tensor

from torchgco.base import clock
from torchgco.base.errors import InputError
from torchgco.base.options import Above, AtMost, Meters, Seed, Within, check_options, check_value
from torchgco.base.shapes import CPU, check_shape, check_tensor, computing_on
from torchgco.base.tree import take
from torchgco.constraints.gates import has_gates
from torchgco.dynamics.base import Dynamics
from torchgco.dynamics.quadrotor import Airframe, QuadrotorPlanning
from torchgco.missions.contact import Contact, Passing
from torchgco.missions.disturbance import Disturbance, measured
from torchgco.missions.log import MissionLog
from torchgco.missions.outcome import FARTHEST
from torchgco.missions.pilot import KnownMap, Pilot
from torchgco.missions.planner import MissionPlan, Planner
from torchgco.missions.planning_problem import airframe_of
from torchgco.missions.plant import Plant, RotorPlant, flown, hovering
from torchgco.missions.tracker import Reference, Tracker, Tracking
from torchgco.problem.problem import Problem, current_problem
from torchgco.solution import Solution
from torchgco.solvers.contracts import check_ids

LONGEST = 3600.0  # s of a mission
OTHER_MODELS = "torchgco.MPC controls other models"
Duration = Annotated[float, Above(0, "s"), AtMost(LONGEST, "s")]
Begin = Callable[[Problem, Tensor, int, Tensor], Pilot]
Report = Callable[[int, int], None]  # of a control step and the number of vehicles that still fly


@dataclass(frozen=True)
class Mission:
    """The closed loop.

    Args:
        planner: makes a plan in every control period, which is a time step of the planning problems.
        tracker: its time step divides the control period, and is the plant's.
        plant: what is flown; parameters that differ between missions are (B,). Its airframe is that of the planning
            model, as those of planner, tracker and explorer are; its errors are deviations from that.
        disturbance: wind and noise.
        duration: s, after which a mission ends with TIMEOUT.
        goal_radius: m, within which the goal counts as reached; None: the problems' own.
        latency: control periods between a measurement and the first use of the plan made from it, 0 or 1. With 1, a
            plan starts where the previous plan leads within the period, and without `first_step`.

    Raises:
        InputError: a field out of its range, or periods that don't fit each other.
    """

    planner: Planner
    tracker: Tracker = field(default_factory=Tracker)
    plant: Plant = field(default_factory=RotorPlant)
    disturbance: Disturbance = field(default_factory=Disturbance)
    duration: Duration = 15.0
    goal_radius: Meters | None = 0.5
    latency: Annotated[int, Within(0, 1, "control periods")] = 0

    model: ClassVar[type[Dynamics]] = QuadrotorPlanning  # that plans are made with
    model_name: ClassVar[str] = "quadrotor"  # as commands name it

    def __post_init__(self) -> None:
        check_options(self, "mission")
        if self.plant.dt != self.tracker.dt:
            raise InputError("tracker.dt", f"the plant's {self.plant.dt} s", self.tracker.dt)

    @property
    def sees_all(self) -> bool:
        """Whether vehicles know all obstacles from the start, and don't learn of them by a sensor."""
        return True

    def check(self, dynamics: Dynamics) -> None:
        """Raise InputError unless these dynamics of a planning problem can be flown."""
        if not isinstance(dynamics, self.model):
            expected = f"{self.model_name}, which this mission flies ({OTHER_MODELS})"
            raise InputError("model", expected, type(dynamics).__name__)
        frame, other = airframe_of(dynamics), getattr(self.plant, "airframe", None)
        if isinstance(other, Airframe) and other != frame:
            named = [f.name for f in fields(frame) if getattr(frame, f.name) != getattr(other, f.name)]
            planned, flies = (", ".join(f"{name} {getattr(v, name)}" for name in named) for v in (frame, other))
            raise InputError("plant.airframe", f"that of the planning model, {planned}", flies)
        if self.substeps(float(dynamics.dt)) is None:
            raise InputError("scenario.dt", f"a multiple of the plant's {self.plant.dt} s", dynamics.dt)

    def check_stated(self, problem: Problem) -> None:
        """Raise InputError unless this mission flies problems that are stated like this one."""
        if problem.time is not None:
            raise InputError("time", "None for a mission, whose control periods are fixed", "a free time")
        if problem.goal is not None and problem.goal.required:
            raise InputError("goal.required", "False for a mission, whose plans may end before the goal", True)
        if has_gates(problem):
            raise InputError("constraints", "no Gates in a mission, whose plans begin again at their knot 0", "Gates")

    def substeps(self, period: float) -> int | None:
        """Time steps of the plant in a control period, s; None where they don't fit."""
        count = round(period / self.plant.dt)
        return count if count >= 1 and math.isclose(count * self.plant.dt, period, rel_tol=1e-9) else None

    def periods(self, period: float) -> int:
        """Control periods, s, of the mission."""
        return math.ceil(self.duration / period - 1e-9)

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
        return Flight(self, problem, seed, ids).run(report or (lambda step, flying: None))

    def first_plans(self, problem: Problem, seed: int = 0, ids: Tensor | None = None) -> tuple[Problem, Solution]:
        """The planning problems of the first control period, and the solutions that `fly` makes its first plans of.

        Raises:
            InputError: as `fly`, and for missions with a sensor, which plan on their maps.
        """
        if not self.sees_all:
            raise InputError("mission.sensor", "full for first plans", "a sensor")
        problem, seed, ids = check_flown(self, problem, seed, ids)
        with computing_on(CPU):
            x = hovering(airframe_of(problem.dynamics), problem.x0[:, :3])
            period = float(problem.dynamics.dt)
            _, noise = self.disturbance.draw(seed, ids.tolist(), self.periods(period), period)
            return self._first(problem, measured(x, noise[:, 0]), seed, ids)

    def _first(self, problem: Problem, x: Tensor, seed: int, ids: Tensor) -> tuple[Problem, Solution]:
        """The problems of the first plans from plants x (B, 17), and the solutions."""
        return self._planner.first(problem, x, seed, ids)

    def begin(self, problem: Problem, x: Tensor, seed: int, ids: Tensor) -> Pilot:
        """Who plans for vehicles at plants x (B, 17): the planner, which knows all obstacles."""
        return KnownMap(self._planner, problem, x, seed, ids)

    @property
    def _planner(self) -> Planner:
        """The planner: with a latency it doesn't know the thrusts at a plan's start, one period ahead."""
        return self.planner if self.latency == 0 else replace(self.planner, first_step=False)


def check_flown(mission: Mission, problem: Problem, seed: int, ids: Tensor | None) -> tuple[Problem, int, Tensor]:
    """The problems, the seed and the ids (B,) of a flight, where they can be flown; see `Mission.fly`."""
    problem = current_problem(problem)
    seed = check_value(seed, Seed, "seed")
    if ids is not None:
        check_ids(ids, problem)
    if problem.goal is None:
        raise InputError("goal", "a Goal in the problem", None)
    mission.check_stated(problem)
    if problem.horizon is not None:
        raise InputError("horizon", "None for a mission, which replans over N stages", "horizons of each problem")
    mission.check(problem.dynamics)
    if problem.x0.dtype != torch.float64:
        raise InputError("x0", "torch.float64 for a mission", problem.x0.dtype)
    return problem, seed, torch.arange(problem.B, device="cpu") if ids is None else ids


@dataclass(frozen=True)
class Frame:
    """A control period of a flight; b vehicles flew in it.

    Args:
        step: its number; t: its end, s.
        rows: the vehicles' places among all, (b,) int64.
        measured: their states at its start, (b, 17).
        plan: that they flew along.
        x: their states at its end, (b, 17).
        ended: which of them are at their goal, in contact or lost by then, (b,) bool.
        seconds: that the plans took.
    """

    step: int
    t: float
    rows: Tensor
    measured: Tensor
    plan: MissionPlan
    x: Tensor
    ended: Tensor
    seconds: float


class Flight:
    """Missions that are flown period by period: `Mission.fly` calls `step` until they are `done`.

        flight = Flight(mission, problem)
        while not flight.done:
            frame = flight.step()

    Args:
        mission, problem, seed, ids: as `Mission.fly` takes them.
        begin: makes the pilot; None: `mission.begin`.

    Attributes:
        x: states (b, 17) of the plants that still fly; rows: their places among all, (b,) int64.
        log: what has happened.

    Raises:
        InputError: as `Mission.fly`.
    """

    def __init__(
        self, mission: Mission, problem: Problem, seed: int = 0, ids: Tensor | None = None, begin: Begin | None = None
    ) -> None:
        self.mission = mission
        problem, self.seed, ids = check_flown(mission, problem, seed, ids)
        self.airframe = airframe_of(problem.dynamics)
        self.period = float(problem.dynamics.dt)
        self.substeps = mission.substeps(self.period) or 1
        self.steps, self._step = mission.periods(self.period), 0
        with computing_on(CPU):
            self._begin(problem, ids, begin or mission.begin)

    def _begin(self, problem: Problem, ids: Tensor, begin: Begin) -> None:
        mission, goal = self.mission, problem.goal
        assert goal is not None
        self.contact, self.passing, self.model = Contact.among(problem), Passing.among(problem), problem.dynamics
        radius = mission.goal_radius
        self.goal = goal.position
        self.radius = goal.radius if radius is None else torch.full_like(problem.x0[:, 0], radius)
        x = hovering(self.airframe, problem.x0[:, :3])
        self.start, self.ids = x[:, :3], ids
        self.measured_at, self.clearance = x, torch.full_like(x[:, 0], -torch.inf)
        self.force, self.noise = mission.disturbance.draw(self.seed, ids.tolist(), self.steps, self.period)
        self.plant, self.x, self.rows = flown(mission.plant, self.airframe), x, torch.arange(problem.B)
        self.pilot = begin(problem, x, self.seed, ids)
        self.log = MissionLog.blank(x, self.steps, self.substeps, self.period, self.pilot.knots)
        self.log.seen.extend(self.pilot.seen)
        self._plan: MissionPlan | None = None  # to continue, or with a latency to fly
        self._tracking: Tracking | None = None
        self._leave(~self.contact.clear(problem, x))

    @property
    def done(self) -> bool:
        """Whether all vehicles have ended, or the time is over."""
        return self.rows.numel() == 0 or self._step == self.steps

    def run(self, report: Report = lambda step, flying: None) -> MissionLog:
        """Fly until it is done."""
        while not self.done:
            frame = self.step()
            report(frame.step, self.rows.numel())
        return self.log

    def step(self, plan: MissionPlan | Tensor | None = None) -> Frame:
        """Fly one control period.

        Args:
            plan: to fly along, of the vehicles in `rows`: states (b, K, 14) of the planning model at knots a control
                period apart, K at least 2, of which the tracker follows body rates and acceleration. None: the
                pilot's. The pilot doesn't continue a plan that isn't its own.

        Raises:
            InputError: a flight that is done, a plan of another shape, or one that isn't finite.
        """
        if self.done:
            raise InputError("flight", "one that isn't done", "one that is")
        with computing_on(CPU):
            step, rows = self._step, self.rows
            seen = measured(self.x, self.noise[rows, step])
            flown, seconds = self._chosen(step, seen, plan)
            self.log.add_plan(rows, step, self.x, flown, seconds / rows.numel())
            self.log.add_parts(rows, step, self.pilot.parts())
            self._tracking, ended = self._fly_period(step, flown, self._tracking)
            frame = Frame(step, (step + 1) * self.period, rows, seen, flown, self.x, ended, seconds)
            if bool(ended.any()):
                stay = (~ended).nonzero().flatten()
                self._plan = None if self._plan is None else self._plan.take(stay)
                self._tracking = self._tracking.take(stay)
                self._leave(ended)
            self._step += 1
            return frame

    def _chosen(self, step: int, seen: Tensor, plan_given: MissionPlan | Tensor | None) -> tuple[MissionPlan, float]:
        """The plan of a control step, from measured states `seen` (b, 17), and the seconds that it took."""
        if plan_given is not None and not isinstance(plan_given, MissionPlan):
            plan_given = self._of_states(plan_given, seen, step)
        self.pilot.sense(step, self.x, seen)
        if plan_given is not None:
            self._plan = None
            return plan_given, 0.0
        plan, seconds, late = self._plan, 0.0, self.mission.latency == 1
        if plan is None or not late:
            plan, seconds = self.pilot.plan(step, seen, plan, seen)
        self._plan = plan
        if late:
            ahead = self.mission.planner.predicted(seen, plan)
            self._plan, more = self.pilot.plan(step + 1, ahead, plan, seen)
            seconds += more
        return plan, seconds

    def _of_states(self, X: Any, seen: Tensor, step: int) -> MissionPlan:
        b = len(seen)
        wanted = f"states ({b}, K, 14) of the vehicles that fly, K at least 2, or a MissionPlan"
        if not isinstance(X, Tensor) or X.dim() != 3 or (X.shape[0], X.shape[2]) != (b, 14) or X.shape[1] < 2:
            raise InputError("plan", wanted, tuple(X.shape) if isinstance(X, Tensor) else type(X).__name__)
        check_tensor(X, "plan", seen)
        if not bool(torch.isfinite(X).all()):
            raise InputError("plan", "finite states", "NaN or infinity")
        return MissionPlan.of_states(X, seen, self.model, step * self.period, self.period)

    def _fly_period(self, step: int, plan: MissionPlan, tracking: Tracking | None) -> tuple[Tracking, Tensor]:
        """One control period along a plan; and which vehicles have ended in it, (B,) bool."""
        reference = Reference(plan.X, plan.dt, self.airframe)
        ended = torch.zeros_like(self.rows, dtype=torch.bool)
        for j in range(self.substeps):
            seen = measured(self.x, self.noise[self.rows, step])
            began = clock.seconds()
            tracking = self.mission.tracker.track(seen, reference, j * self.plant.dt, tracking)
            seconds = (clock.seconds() - began) / self.rows.numel()
            flew, x = ~ended, self.plant.advance(self.x, tracking.commands, self.force[self.rows, step])
            check_shape(x, tuple(self.x.shape), "plant.advance")
            before, self.x = self.x, torch.where(ended.unsqueeze(-1), self.x, x)
            if self.passing is not None:
                passed = self.passing.after(before[:, :3], self.x[:, :3])
                self.passing = replace(self.passing, passed=passed)
            ended |= self._ends((step * self.substeps + j + 1) * self.plant.dt)
            self.log.add_sample(self.rows, step, j, self.x, tracking, seconds, flew)
        assert tracking is not None
        return tracking, ended

    def _ends(self, t: float) -> Tensor:
        """Whether a vehicle is at its goal, in contact, or lost, (B,)."""
        p = self.x[:, :3]
        finite = torch.isfinite(self.x).all(-1) & ((p - self.start[self.rows]).norm(dim=-1) <= FARTHEST)
        there = (p - self.goal[self.rows]).norm(dim=-1) < self.radius[self.rows]
        there = there if self.passing is None else there & self.passing.done
        return ~finite | there | self._touches(t)

    def _touches(self, t: float) -> Tensor:
        """Whether vehicles are in contact, (B,): none is that has moved less than its last clearance at rest."""
        if self.contact.moving or not bool((self.contact.moved(self.measured_at, self.x) < self.clearance).all()):
            self.measured_at, self.clearance = self.x, self.contact.distance(self.x, t)
            return self.clearance < 0
        return torch.zeros_like(self.clearance, dtype=torch.bool)

    def _leave(self, left: Tensor) -> None:
        """Drop the vehicles where `left` (B,)."""
        stay = (~left).nonzero().flatten()
        if stay.numel() == left.numel():
            return
        self.plant, self.contact = self.plant.take(stay), self.contact.take(stay)
        self.passing = None if self.passing is None else self.passing.take(stay)
        self.x, self.rows, self.ids = take((self.x, self.rows, self.ids), stay)
        self.measured_at, self.clearance = self.measured_at[stay], self.clearance[stay]
        self.pilot.take(stay)
