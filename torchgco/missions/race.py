"""Races: missions through gates in the least time, planned again from where the vehicle is in every control period.

The first plan leads through all gates to rest at the end. Later ones lead from the measured state through the next few
gates, and begin with the plan before. Plans are made with `QuadrotorThrusts`, whose 13 states and four thrusts become
the 14 states that a tracker follows: the joint thrust by the mass is the last of these.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from torchgco.base import clock
from torchgco.base.errors import InputError
from torchgco.base.options import Checked, Count, Meters, NonNegative, Within
from torchgco.constraints.base import Constraint
from torchgco.constraints.bounds import Bounds, bounds_of
from torchgco.constraints.gates import GateBalls, Gates, gates_of
from torchgco.dynamics.base import Dynamics, rk4
from torchgco.dynamics.quadrotor import QuadrotorThrusts, with_unit_quaternion
from torchgco.missions.contact import Passing
from torchgco.missions.log import SeenLog
from torchgco.missions.mission import Duration, Mission
from torchgco.missions.pilot import SEED_STEP, Pilot
from torchgco.missions.planner import MissionPlan
from torchgco.missions.planning_problem import airframe_of
from torchgco.obstacles.base import Obstacles
from torchgco.problem.free_time import FreeTime
from torchgco.problem.in_time import guessing_times
from torchgco.problem.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers.contracts import Solver
from torchgco.solvers.interior import InteriorPoint

LOGGED = 40  # control periods of a plan that are logged
FOLLOWED = 1e-3  # violation, m for lengths, up to which a plan is flown


@dataclass(frozen=True)
class RacePlanner(Checked, named="planner"):
    """Plans a race again from every measured state; where that finds none, the plan before is flown on.

    Args:
        solver: makes the first plan, and another where a gate was missed: any that chooses the time.
        local: continues a plan.
        ahead: through how many gates, the end among them, a plan that is continued leads.
        margin: by which a plan passes a gate inside its radius, m; of a small gate at most half its radius.
        reserve: share of the range of a rotor's thrust that plans leave to the tracker at each end.

    Raises:
        InputError: a field out of its range.
    """

    solver: Solver
    local: InteriorPoint = field(default_factory=lambda: InteriorPoint(initial_barrier=1e-3, max_iterations=200))
    ahead: Count = 5
    margin: NonNegative = 0.05
    reserve: Annotated[float, Within(0, 0.4)] = 0.05

    def posed(self, whole: Problem, passed: int, legs: int) -> Problem:
        """The problems that are left of whole races once some gates are passed, through so many legs at most."""
        gates, time_, knots = gates_of(whole), whole.time, legs_of(whole)
        assert isinstance(gates, GateBalls) and time_ is not None
        last = min(passed + legs, len(knots) - 1)
        first, stops = knots[passed], [knot - knots[passed] for knot in knots[passed + 1 : last + 1]]
        ends = last == len(knots) - 1
        open_ = slice(passed, last - 1 if ends else last)
        parts = [self._kept(bounds) for bounds in bounds_of(whole.constraints)]
        if open_.stop > open_.start:
            sizes = gates.sizes[:, open_]
            sizes = torch.maximum(sizes - self.margin, 0.5 * sizes)
            parts.append(Gates(gates.centers[:, open_], sizes, knots=stops[: open_.stop - open_.start]))
        least, most = time_.least[:, passed:last].clone(), time_.most[:, passed:last]
        least[:, 0] = least[:, 0].clamp(max=1.0 / stops[0])  # a control period may be left of it
        times = FreeTime(least, most, time_.weight, segments=stops[:-1] or None)
        goal = whole.goal if ends else None
        return Problem(whole.dynamics, whole.cost, parts, whole.x0, knots[last] - first, goal, time=times)

    def _kept(self, bounds: Bounds) -> Constraint:
        """Bounds for another number of stages; those on thrusts with the reserve."""
        room = self.reserve * (bounds.upper - bounds.lower) if bounds.of == "u" else 0.0
        return type(bounds)(bounds.lower + room, bounds.upper - room)


def legs_of(problem: Problem) -> list[int]:
    """The knots at which the legs of a race begin, and its last one."""
    assert problem.time is not None
    return [*problem.time.segments, problem.N]


@dataclass(frozen=True)
class RaceMission(Mission):
    """A closed loop through gates in the least time; see `Mission` for its other options.

    It flies problems of `QuadrotorThrusts` with a free time, a segment of it for each leg, with balls as gates and a
    goal that binds, but without obstacles. A vehicle has reached the goal once it has passed all gates in their order.

    Raises:
        InputError: as `Mission`, and a latency.
    """

    planner: RacePlanner  # type: ignore[assignment]
    duration: Duration = 40.0
    goal_radius: Meters | None = 0.1

    model: ClassVar[type[Dynamics]] = QuadrotorThrusts
    model_name: ClassVar[str] = "rotors"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.latency:
            raise InputError("mission.latency", "0 in a race", self.latency)

    def check_stated(self, problem: Problem) -> None:
        """See `Mission`."""
        gates, time_ = gates_of(problem), problem.time
        if not isinstance(gates, GateBalls):
            raise InputError("constraints", "Gates with a radius in a race", "none" if gates is None else "squares")
        assert gates.places is not None
        if time_ is None or not problem.goal or not problem.goal.required:
            raise InputError("time", "a FreeTime, and a goal that is required, in a race", "others")
        if gates.places.tolist() != [list(time_.segments[1:])] * problem.B:
            raise InputError("time.segments", "the knots of the gates", list(time_.segments[1:]))
        for i, constraint in enumerate(problem.constraints):
            fits = isinstance(constraint, Bounds | GateBalls) or constraint is problem.constraints[-1]
            if not fits and not (isinstance(constraint, Obstacles) and bool(constraint.absent.all())):
                expected = "bounds and gates alone in a race, whose plans know nothing else"
                raise InputError(f"constraints[{i}]", expected, type(constraint).__name__)

    def _first(self, problem: Problem, x: Tensor, seed: int, ids: Tensor) -> tuple[Problem, Solution]:
        """See `Mission`."""
        return Racer(self.planner, problem, self.plant.dt, seed, ids).first(x)

    def begin(self, problem: Problem, x: Tensor, seed: int, ids: Tensor) -> Pilot:
        """Who plans for vehicles at plants x (B, 17)."""
        return Racer(self.planner, problem, self.plant.dt, seed, ids)


class Racer:
    """The pilot of a race, which holds a plan for all of it on the knots of the whole problems; see `Pilot`.

    Args:
        spacing: of the states that a tracker follows, s.
    """

    knots, seen = LOGGED + 1, list[SeenLog]()

    def __init__(self, planner: RacePlanner, problem: Problem, spacing: float, seed: int, ids: Tensor) -> None:
        self.planner, self.problem, self.spacing, self.seed, self.ids = planner, problem, spacing, seed, ids
        self.legs, self.period = legs_of(problem), float(problem.dynamics.dt)
        passing, like = Passing.among(problem), problem.x0
        assert passing is not None
        self.passing, self.before = passing, like[:, :3]  # where the vehicles were seen last
        self.X, self.U = like.new_zeros(len(like), problem.N + 1, problem.n), like.new_zeros(len(like), problem.N, 4)
        self.t = like.new_full((len(like), problem.N + 1), -torch.inf)  # s from the start; before now: no plan
        self._posed = dict[tuple[int, int], Problem]()

    def sense(self, step: int, x: Tensor, measured: Tensor) -> None:
        """Which gates have been passed, as far as measured positions show it."""
        p = measured[:, :3]
        self.passing = replace(self.passing, passed=self.passing.after(self.before, p))
        self.before = p

    def plan(
        self, step: int, x: Tensor, before: MissionPlan | None, measured: Tensor | None = None
    ) -> tuple[MissionPlan, float]:
        """See `Pilot`."""
        began, now = clock.seconds(), step * self.period
        violation, kept = torch.zeros_like(x[:, 0]), torch.ones_like(x[:, 0], dtype=torch.bool)
        iterations = torch.zeros_like(kept, dtype=torch.int64)
        for passed in self.passing.passed.unique().tolist():
            rows = (self.passing.passed == passed).nonzero().flatten()
            left = self.t[rows, self.legs[passed + 1]] - now
            for fresh, group in ((True, rows[left <= 0]), (False, rows[left >= self.period])):
                if group.numel() == 0:
                    continue
                solution = self._solved(group, passed, x[group], now, step, fresh)
                flown = (solution.violation <= FOLLOWED) | (self.t[group, -1] == -torch.inf)  # there is no other plan
                self._keep(group[flown], passed, solution.take(flown.nonzero().flatten()), now)
                violation[group], iterations[group], kept[group] = solution.violation, solution.iterations, ~flown
        plan = MissionPlan.of_states(self._ahead(now), x, self.problem.dynamics, now, self.spacing)
        plan = replace(plan, cost=self.t[:, -1] - now, violation=violation, shifted=kept, iterations=iterations)
        return plan, clock.seconds() - began

    def first(self, x: Tensor) -> tuple[Problem, Solution]:
        """The whole problems as planned from plants x (B, 17), and their solutions."""
        rows = torch.arange(len(x))
        return self._from(rows, 0, len(self.legs), x), self._solved(rows, 0, x, 0.0, 0, True)

    def _solved(self, rows: Tensor, passed: int, x: Tensor, now: float, step: int, fresh: bool) -> Solution:
        """Plans of vehicles at plants x (b, 17) that have passed so many gates: fresh ones, or continued ones."""
        planner, seed, ids = self.planner, self.seed + SEED_STEP * step, self.ids[rows]
        problem = self._from(rows, passed, len(self.legs) if fresh else planner.ahead, x)
        if fresh:
            U0 = problem.cost.rest_controls(x.new_zeros(problem.B, problem.N, problem.m))
            return planner.solver.solve(problem, U0, seed=seed, ids=ids)
        first, next_ = self.legs[passed], self.legs[passed + 1]
        share = torch.arange(next_ - first, dtype=x.dtype) / (next_ - first)
        times = now + (self.t[rows, next_] - now).unsqueeze(-1) * share
        X, U = self._at(rows, times)
        later = slice(next_, first + problem.N)
        X = torch.cat((X, self.X[rows, later], self.X[rows, later.stop : later.stop + 1]), dim=1)
        t = torch.cat((times, self.t[rows, later], self.t[rows, later.stop : later.stop + 1]), dim=1)
        X[:, 0], U = problem.x0, torch.cat((U, self.U[rows, later]), dim=1)
        return planner.local.solve(guessing_times(problem, t - t[:, :1]), U, seed=seed, ids=ids, X0=X)

    def _from(self, rows: Tensor, passed: int, legs: int, x: Tensor) -> Problem:
        """The problems from plants x (b, 17), with rates within the bounds or as they are measured."""
        if (passed, legs) not in self._posed:
            self._posed[passed, legs] = self.planner.posed(self.problem, passed, legs)
        problem, x0 = self._posed[passed, legs].take(rows), x[:, : self.problem.n].contiguous()
        parts = [
            type(constraint)(torch.minimum(constraint.lower, x0), torch.maximum(constraint.upper, x0))
            if isinstance(constraint, Bounds) and constraint.of == "x"
            else constraint
            for constraint in problem.constraints
        ]
        return problem.started_at(x0, parts)

    def _keep(self, rows: Tensor, passed: int, solution: Solution, now: float) -> None:
        """Put plans into those of the whole race, whose later knots are passed as much later or earlier."""
        first = self.legs[passed]
        last = first + solution.U.shape[1]
        delay = now + solution.t[:, -1] - self.t[rows, last]
        self.t[rows, last:] += torch.where(torch.isfinite(delay), delay, 0.0).unsqueeze(-1)
        knots = slice(first, last + 1)
        self.X[rows, knots], self.U[rows, first:last], self.t[rows, knots] = solution.X, solution.U, now + solution.t

    def _at(self, rows: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        """States (b, K, 13) and controls (b, K, 4) of the plans at times (b, K), s; at the ends after their last knot.

        From the knot before by a step of that length.
        """
        t = self.t[rows].contiguous()
        k = (torch.searchsorted(t, times.contiguous(), right=True) - 1).clamp(0, self.problem.N - 1)
        X, U = (Z[rows].gather(1, k.unsqueeze(-1).expand(-1, -1, Z.shape[-1])) for Z in (self.X, self.U))
        length = torch.minimum(times, t.gather(1, k + 1)) - t.gather(1, k)
        rates = lambda x: length.clamp(min=0.0).unsqueeze(-1) * self.problem.dynamics.field(x, U)
        return with_unit_quaternion(rk4(rates, X, 1.0)), U

    def _ahead(self, now: float) -> Tensor:
        """The next states (B, K, 14) of the plans, `spacing` apart; after its end a vehicle hovers there."""
        count = round(LOGGED * self.period / self.spacing)
        times = (now + self.spacing * torch.arange(count + 1, dtype=self.t.dtype)).expand(len(self.t), -1)
        X, U = self._at(torch.arange(len(self.t)), times)
        airframe = airframe_of(self.problem.dynamics)
        over = times >= self.t[:, -1:]
        lift = torch.where(over, airframe.gravity, U.sum(-1) / airframe.mass)
        return torch.cat((X, lift.unsqueeze(-1)), dim=-1)

    def take(self, index: Tensor) -> None:
        """See `Pilot`."""
        self.problem, self.passing, self.ids = self.problem.take(index), self.passing.take(index), self.ids[index]
        self.X, self.U, self.t, self.before = self.X[index], self.U[index], self.t[index], self.before[index]
        self._posed = {key: problem.take(index) for key, problem in self._posed.items()}

    def parts(self) -> Mapping[str, Tensor]:
        """None: see `Pilot`."""
        return {}
