"""The planner: in every control period a trajectory to the goal from the vehicle's measured state (section 5.2.2)."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from torchgco.constraints import ControlBounds, FirstStepRates
from torchgco.constraints.base import Constraint
from torchgco.constraints.bodies import CONTACT_FACTOR, Obstacles
from torchgco.dynamics.quadrotor import Airframe, QuadrotorPlanning
from torchgco.errors import InputError
from torchgco.evaluation import violation
from torchgco.lagrangian import Multipliers, shifted
from torchgco.native.dispatch import open_loop
from torchgco.problem import Problem
from torchgco.solvers.contracts import Solver
from torchgco.tree import Rows, put, take

FEASIBLE = 1e-2  # violation up to which a plan is flown without a look at the former one
PARTS = 4  # of the horizon, with a margin each, where margins grow
BLIND = 3  # knots whose positions the controls of a plan can't change, or hardly
EARLY = 10  # knots in which a vehicle may leave a margin that it has entered


@dataclass(frozen=True)
class Plan:
    """Trajectories from the states that were measured at the control step `step`, (B, ...)."""

    X: Tensor  # (B, N+1, 14)
    U: Tensor  # (B, N, 4)
    multipliers: Multipliers
    cost: Tensor
    violation: Tensor
    shifted: Tensor  # bool: the former plan one stage later, as the new one was infeasible
    guided: Tensor  # int64: outer iterations with guidance on
    step: int

    def take(self, index: Rows) -> Plan:
        """The plans in `index`."""
        tensors = take((self.X, self.U, self.multipliers, self.cost, self.violation, self.shifted, self.guided), index)
        return Plan(*tensors, self.step)


@dataclass(frozen=True)
class Planner:
    """Solves the planning problem from every measured state; where the result is infeasible, the former plan goes on.

    Args:
        solver: any solver of the library.
        airframe: as the planner knows it.
        multipliers: "shifted" starts from those of the former plan one stage later, "reset" from zero, as the paper.
        max_seconds: time limit of a solve, s; None: none. With a limit, results depend on the machine.
        margin: by which obstacles are grown, m; margin_growth: by how much more per second of the horizon, m/s, in
            four steps.
        first_step: the body rates of the second knot are the ones that the rotors lead to (`FirstStepRates`).

    Raises:
        InputError: a field out of its range.
    """

    solver: Solver
    airframe: Airframe = Airframe()
    multipliers: Literal["shifted", "reset"] = "shifted"
    max_seconds: float | None = None
    margin: float = 0.0
    margin_growth: float = 0.0
    first_step: bool = True

    def __post_init__(self) -> None:
        if self.multipliers not in ("shifted", "reset"):
            raise InputError("planner.multipliers", "shifted or reset", repr(self.multipliers))
        if self.max_seconds is not None and not self.max_seconds > 0:
            raise InputError("planner.max_seconds", "above 0 s, or null", self.max_seconds)
        for name in ("margin", "margin_growth"):
            if not getattr(self, name) >= 0:
                raise InputError(f"planner.{name}", "at least 0", getattr(self, name))

    def problem(self, problem: Problem, x: Tensor) -> Problem:
        """The planning problems of a mission at its start, from those of an open-loop study and plants x (B, 17).

        Raises:
            InputError: another model than the quadrotor's planning model.
        """
        if not isinstance(problem.dynamics, QuadrotorPlanning):
            raise InputError("model", "quadrotor: a mission flies its planning model", type(problem.dynamics).__name__)
        x0 = _planning_state(x, self.airframe)
        return replace(problem, x0=x0, constraints=self._constraints(problem, 0.0, x, x0, torch.zeros_like(x0[:, 0])))

    def plan(
        self, whole: Problem, now: Problem, x: Tensor, step: int, before: Plan | None, seed: int, ids: Tensor
    ) -> tuple[Plan, Problem, float]:
        """Plans from plants x (B, 17) at a control step, their problems, and the seconds that the planning took.

        Args:
            whole: the problems of the open-loop study; now: those of the plan before, at first of `problem`.
        """
        began = time.perf_counter()
        t, x0 = step * float(whole.dynamics.dt), _planning_state(x, self.airframe)
        U0, warm = now.cost.rest_controls(x0.new_zeros(now.B, now.N, now.m)), None
        if before is not None:
            U0 = shifted(before.U)
            warm = before.multipliers.shifted() if self.multipliers == "shifted" else None
        depth = self._unavoidable_depth(whole, t, x0, U0)
        now = now.started_at(x0, self._constraints(whole, t, x, x0, depth))
        solution = self.solver.solve(now, U0, seed=seed, ids=ids, warm=warm, max_seconds=self.max_seconds)
        none = torch.zeros_like(solution.cost, dtype=torch.bool)
        plan = Plan(
            solution.X, solution.U, solution.multipliers, solution.cost, solution.violation, none, solution.guided, step
        )
        if before is not None:
            self._keep_former(plan, now, U0, before)
        return plan, now, time.perf_counter() - began

    def _constraints(self, whole: Problem, t: float, x: Tensor, x0: Tensor, depth: Tensor) -> list[Constraint]:
        """The constraints of plans that start at time t from plants x (B, 17), depth (B,) m within the margin."""
        parts: list[Constraint] = []
        for constraint in whole.constraints:
            later = constraint.later(t)
            parts += self._with_margin(later, whole, depth) if isinstance(constraint, Obstacles) else [later]
        return [*parts, *self._first_step(whole, x, x0)]

    def _with_margin(self, obstacles: Obstacles, whole: Problem, depth: Tensor) -> list[Constraint]:
        """Obstacles with the planner's margin: less by `depth` at the early knots, more at late ones where it grows."""
        late = torch.arange(EARLY + 1, whole.N + 1).chunk(PARTS if self.margin_growth > 0 else 1)
        parts: list[Constraint] = [replace(obstacles.grown(self.margin - depth), knots=slice(1, EARLY + 1))]
        for knots in late:
            first, last = int(knots[0]), int(knots[-1]) + 1
            by = self.margin + self.margin_growth * 0.5 * (first + last - 1) * float(whole.dynamics.dt)
            parts.append(replace(obstacles.grown(torch.full_like(depth, by)), knots=slice(first, last)))
        return parts

    def _unavoidable_depth(self, whole: Problem, t: float, x0: Tensor, U: Tensor) -> Tensor:
        """How deep a vehicle gets into an obstacle's margin before any control has an effect, (B,), m.

        At most to where a quarter of the clearance from contact is left.
        """
        X, depth = whole.started_at(x0, whole.constraints), torch.zeros_like(x0[:, 0])
        p = open_loop(X, U)[:, : BLIND + 1, X.position]
        times = torch.arange(BLIND + 1, dtype=p.dtype) * float(whole.dynamics.dt)
        for part in whole.constraints:
            if isinstance(part, Obstacles):
                distance = part.later(t).signed_distance(p, times).amin(1) - self.margin  # (B, M)
                most = self.margin + 0.75 * (1.0 - CONTACT_FACTOR) * part.margins
                deep = torch.minimum(-distance, most).clamp(min=0.0)
                if deep.shape[1] > 0:
                    depth = torch.maximum(depth, deep.amax(-1))
        return depth

    def _keep_former(self, plan: Plan, problem: Problem, U: Tensor, before: Plan) -> None:
        """Put the former plan in the place of new ones that are infeasible and worse than it is."""
        rows = (~(plan.violation <= FEASIBLE)).nonzero().flatten()
        if rows.numel() == 0:
            return
        part = problem.take(rows)
        X = open_loop(part, U[rows])
        worst = violation(part, X, U[rows])
        better = worst < plan.violation[rows].nan_to_num(nan=torch.inf)
        chosen, place = better.nonzero().flatten(), rows[better]
        cost = part.cost.total(X, U[rows])
        former = Plan(
            X, U[rows], take(before.multipliers.shifted(), rows), cost, worst,
            torch.ones_like(better), torch.zeros_like(rows), plan.step,
        )  # fmt: skip
        for name in ("X", "U", "multipliers", "cost", "violation", "shifted", "guided"):
            put(getattr(plan, name), place, take(getattr(former, name), chosen))

    def _first_step(self, problem: Problem, x: Tensor, x0: Tensor) -> list[Constraint]:
        if not self.first_step:
            return []
        model = problem.dynamics
        assert isinstance(model, QuadrotorPlanning)
        bounds = [part for part in problem.constraints if isinstance(part, ControlBounds)]
        reachable = None
        if bounds:
            w = x0[:, 10:13]
            share = model.dt / torch.as_tensor(model.rate_time_constant, dtype=x.dtype).reshape(-1, 1)
            reachable = tuple(w + share * (bound[:, :3] - w) for bound in (bounds[0].lower, bounds[0].upper))
        return [FirstStepRates(x[:, 13:], model.dt, self.airframe, reachable)]  # type: ignore[arg-type]


def _planning_state(x: Tensor, airframe: Airframe) -> Tensor:
    """States (B, 14) of the planning model for plants x (B, 17): thrusts become their acceleration."""
    return torch.cat((x[:, :13], x[:, 13:].sum(-1, keepdim=True) / airframe.mass), dim=-1).contiguous()
