"""The planner: in every control period a trajectory to the goal from the vehicle's measured state (section 5.2.2)."""

from __future__ import annotations

import time
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from torchgco.constraints import ControlBounds, FirstStepRates
from torchgco.constraints.base import Constraint
from torchgco.constraints.bodies import CONTACT_FACTOR, Obstacles
from torchgco.dynamics.base import Dynamics
from torchgco.dynamics.quadrotor import GRAVITY, Airframe, QuadrotorPlanning, pose_rates
from torchgco.errors import InputError
from torchgco.evaluation import violation
from torchgco.lagrangian import Multipliers, shifted
from torchgco.native.dispatch import open_loop
from torchgco.problem import Problem
from torchgco.solvers.contracts import Solver
from torchgco.tree import Rows, put, take

PARTS = 4  # of the horizon, with a margin each, where margins grow
BLIND = 3  # knots whose positions the controls of a plan can't change, or hardly
EARLY = 10  # knots in which a vehicle may leave a margin that it has entered


@dataclass(frozen=True)
class BiasedPlanning(QuadrotorPlanning):
    """The planning model with an acceleration that is added to v'."""

    bias: Tensor = torch.zeros(1, 3)  # (B, 3), m/s^2

    batched: ClassVar[tuple[str, ...]] = ("bias",)
    reads_fields_alone: ClassVar[bool] = True

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        rates, bias = super().field(x, u), self.bias.view(-1, *([1] * (x.dim() - 2)), 3)
        return torch.cat((rates[..., :3], rates[..., 3:6] + bias.to(x.dtype), rates[..., 6:]), dim=-1)


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
    iterations: Tensor  # int64: of the solve
    measured: Tensor  # (B, 17): the plants' states
    bias: Tensor  # (B, 3): estimated acceleration that the model lacks, m/s^2
    step: int

    def take(self, index: Rows) -> Plan:
        """The plans in `index`."""
        return Plan(*take(tuple(getattr(self, name) for name in TENSORS), index), self.step)


TENSORS = ("X", "U", "multipliers", "cost", "violation", "shifted", "guided", "iterations", "measured", "bias")


@dataclass(frozen=True)
class Planner:
    """Solves the planning problem from every measured state; where the result is infeasible, the former plan goes on.

    Args:
        solver: any solver of the library.
        airframe: as the planner knows it.
        multipliers: "shifted" starts from those of the former plan one stage later, "reset" from zero, as the paper.
        max_seconds: time limit of a solve, s; None: none. With a limit, results depend on the machine.
        tolerance: violation (m for lengths) up to which a plan counts as feasible; replaces the solver's own.
        margin: by which obstacles are grown, m; margin_growth: by how much more per second of the horizon, m/s, in
            four steps.
        first_step: the body rates of the second knot are the ones that the rotors lead to (`FirstStepRates`).
        estimation: gain per control period of an estimated constant acceleration that the planning model lacks, for
            wind and errors of the mass, at most 1; 0: none, as the paper.

    Raises:
        InputError: a field out of its range.
    """

    solver: Solver
    airframe: Airframe = Airframe()
    multipliers: Literal["shifted", "reset"] = "shifted"
    max_seconds: float | None = None
    tolerance: float = 0.01
    margin: float = 0.0
    margin_growth: float = 0.0
    first_step: bool = True
    estimation: float = 0.2

    def __post_init__(self) -> None:
        if self.multipliers not in ("shifted", "reset"):
            raise InputError("planner.multipliers", "shifted or reset", repr(self.multipliers))
        if self.max_seconds is not None and not self.max_seconds > 0:
            raise InputError("planner.max_seconds", "above 0 s, or null", self.max_seconds)
        if not self.tolerance > 0:
            raise InputError("planner.tolerance", "above 0", self.tolerance)
        for name in ("margin", "margin_growth"):
            if not getattr(self, name) >= 0:
                raise InputError(f"planner.{name}", "at least 0", getattr(self, name))
        if not 0 <= self.estimation <= 1:
            raise InputError("planner.estimation", "between 0 and 1", self.estimation)

    def problem(self, problem: Problem, x: Tensor) -> Problem:
        """The planning problems of a mission at its start, from those of an open-loop study and plants x (B, 17).

        Raises:
            InputError: another model than the quadrotor's planning model.
        """
        check_model(problem.dynamics)
        x0, model = _planning_state(x, self.airframe), self._model(problem, torch.zeros_like(x[:, :3]))
        constraints = self._constraints(problem, 0.0, x, x0, torch.zeros_like(x0[:, 0]))
        return replace(problem, dynamics=model, x0=x0, constraints=constraints)

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
        bias = self._estimated(x, before, float(whole.dynamics.dt))
        depth = self._unavoidable_depth(whole, t, x0, U0)
        now = now.started_at(x0, self._constraints(whole, t, x, x0, depth), dynamics=self._model(whole, bias))
        solver = tolerant(self.solver, self.tolerance)
        solution = solver.solve(now, U0, seed=seed, ids=ids, warm=warm, max_seconds=self.max_seconds)
        none = torch.zeros_like(solution.cost, dtype=torch.bool)
        plan = Plan(
            solution.X, solution.U, solution.multipliers, solution.cost, solution.violation, none, solution.guided,
            solution.iterations, x, bias, step,
        )  # fmt: skip
        if before is not None:
            self._keep_former(plan, now, U0, before)
        return plan, now, time.perf_counter() - began

    def _model(self, whole: Problem, bias: Tensor) -> QuadrotorPlanning:
        """The planning model with the estimated bias (B, 3)."""
        assert isinstance(whole.dynamics, QuadrotorPlanning)
        if self.estimation == 0:
            return whole.dynamics
        given = {f.name: getattr(whole.dynamics, f.name) for f in fields(whole.dynamics)}
        return BiasedPlanning(**given, bias=bias)

    def _estimated(self, x: Tensor, before: Plan | None, dt: float) -> Tensor:
        """The acceleration (B, 3) that the planning model lacks: a low-pass of what the last period has shown."""
        if before is None or self.estimation == 0:
            return torch.zeros_like(x[:, :3])
        shown = (x[:, 3:6] - before.measured[:, 3:6]) / dt
        expected = 0.5 * (_acceleration(x, self.airframe) + _acceleration(before.measured, self.airframe))
        return before.bias + self.estimation * (shown - expected - before.bias)

    def _constraints(self, whole: Problem, t: float, x: Tensor, x0: Tensor, depth: Tensor) -> list[Constraint]:
        """The constraints of plans that start at time t from plants x (B, 17), depth (B,) m within the margin."""
        parts: list[Constraint] = []
        for constraint in whole.constraints:
            later = constraint.later(t)
            parts += self._with_margin(later, whole, depth) if isinstance(constraint, Obstacles) else [later]
        return [*parts, *self._first_step(whole, x, x0)]

    def _with_margin(self, obstacles: Obstacles, whole: Problem, depth: Tensor) -> list[Constraint]:
        """Obstacles with the planner's margin: less by `depth` at the early knots, more at late ones where it grows."""
        early = min(EARLY, whole.N)
        parts: list[Constraint] = [replace(obstacles.grown(self.margin - depth), knots=slice(1, early + 1))]
        if early == whole.N:
            return parts
        late = torch.arange(early + 1, whole.N + 1).chunk(PARTS if self.margin_growth > 0 else 1)
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
        times = torch.arange(p.shape[1], dtype=p.dtype) * float(whole.dynamics.dt)
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
        rows = (~(plan.violation <= self.tolerance)).nonzero().flatten()
        if rows.numel() == 0:
            return
        part = problem.take(rows)
        X = open_loop(part, U[rows])
        worst = violation(part, X, U[rows])
        better = worst < plan.violation[rows].nan_to_num(nan=torch.inf)
        chosen, place = better.nonzero().flatten(), rows[better]
        cost = part.cost.total(X, U[rows])
        former = {
            "X": X, "U": U[rows], "multipliers": take(before.multipliers.shifted(), rows), "cost": cost,
            "violation": worst, "shifted": torch.ones_like(better), "guided": torch.zeros_like(rows),
        }  # fmt: skip
        for name, values in former.items():
            put(getattr(plan, name), place, take(values, chosen))

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


def check_model(dynamics: Dynamics) -> None:
    """Raise InputError unless a mission can fly on these dynamics."""
    if not isinstance(dynamics, QuadrotorPlanning):
        raise InputError("model", "quadrotor: a mission flies its planning model", type(dynamics).__name__)


def tolerant(solver: Solver, tolerance: float) -> Solver:
    """The solver with another violation tolerance, where it has one."""
    local: Any = getattr(solver, "local", None)
    options: Any = solver
    if local is not None:
        return replace(options, local=replace(local, violation_tolerance=tolerance))
    return replace(options, violation_tolerance=tolerance) if hasattr(solver, "violation_tolerance") else solver


def _acceleration(x: Tensor, airframe: Airframe) -> Tensor:
    """v' (B, 3) of the planning model for plants x (B, 17), m/s^2."""
    _, v, q, w, F = (part.unbind(-1) for part in x.split((3, 3, 4, 3, 4), dim=-1))
    return torch.stack(pose_rates(v, q, w, sum(F) / airframe.mass, GRAVITY)[3:6], dim=-1)


def _planning_state(x: Tensor, airframe: Airframe) -> Tensor:
    """States (B, 14) of the planning model for plants x (B, 17): thrusts become their acceleration."""
    return torch.cat((x[:, :13], x[:, 13:].sum(-1, keepdim=True) / airframe.mass), dim=-1).contiguous()
