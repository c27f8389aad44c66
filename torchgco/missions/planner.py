"""The planner: in every control period a trajectory to the goal from the vehicle's measured state (section 5.2.2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import ClassVar, Literal

import torch
from torch import Tensor

from torchgco.base import clock
from torchgco.base.options import Checked, NonNegative, PositiveOrInfinite, Seconds, Share
from torchgco.base.tree import take
from torchgco.constraints.base import Constraint
from torchgco.dynamics.base import Dynamics
from torchgco.kernels import followed, measured, open_loop, value
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers, shifted
from torchgco.lagrangian.quality import has_arrived
from torchgco.missions.planning_problem import (
    Margin,
    acceleration,
    airframe_of,
    biased,
    continued,
    first_step,
    follows,
    planning_state,
    settled,
)
from torchgco.obstacles.base import Obstacles
from torchgco.problem.problem import Problem
from torchgco.receding.plan import Plan
from torchgco.solution import Solution
from torchgco.solvers.contracts import Solver


@dataclass(frozen=True, kw_only=True)
class MissionPlan(Plan):
    """Plans (B, ...) of a control step with what their solves say, for those that continue them.

    Args:
        multipliers: of the constraints at `problem`'s knots.
        penalty: mu (B,) from which plans that continue this one start.
        cost, violation: (B,).
        shifted: (B,) bool: the previous plan one stage later, as the new one was infeasible.
        guided: (B,) int64: outer iterations with guidance on.
        iterations: (B,) int64: of all solves for this plan.
        measured: (B, 17): the plants' states.
        bias: (B, 3): estimated acceleration that the model lacks, m/s^2.
        arrived: (B,) bool: whether this plan or one before it ends at the goal.
    """

    multipliers: Multipliers
    penalty: Tensor
    cost: Tensor
    violation: Tensor
    shifted: Tensor
    guided: Tensor
    iterations: Tensor
    measured: Tensor
    bias: Tensor
    arrived: Tensor

    beside: ClassVar[tuple[str, ...]] = ("guided", "iterations", "measured", "bias", "arrived")  # of each vehicle, too
    trajectory: ClassVar[tuple[str, ...]] = (
        *Plan.trajectory, "multipliers", "penalty", "cost", "violation", "shifted"
    )  # fmt: skip

    def continued(self, problem: Problem) -> Multipliers:
        """The multipliers one stage later; where a group of obstacles ends, a knot takes those of the next group.

        The penalty is reset in every period; over a mission it would otherwise grow without bound.
        """
        before, parts = self.multipliers.lam, problem.constraints
        lam = [shifted(group) for group in before]
        for i, (group, following) in enumerate(pairwise(parts)):
            if isinstance(group, Obstacles) and isinstance(following, Obstacles) and follows(group, following):
                lam[i] = torch.cat((before[i][:, 1:], before[i + 1][:, :1]), dim=1)
        return Multipliers(tuple(lam), self.penalty)

    @classmethod
    def of_solution(cls, solution: Solution, problem: Problem, t: float) -> MissionPlan:
        """What a solve at a time t, s, has found; `measured` and `bias` are still to be said."""
        none, x = torch.zeros_like(solution.cost, dtype=torch.bool), solution.X[:, 0]
        return cls(
            X=solution.X, U=solution.U, K=solution.K, start=torch.full_like(solution.cost, t),
            dt=float(problem.dynamics.dt), dynamics=problem.dynamics, multipliers=solution.multipliers,
            penalty=solution.multipliers.mu, cost=solution.cost, violation=solution.violation, shifted=none,
            guided=solution.guided, iterations=solution.iterations, measured=x, bias=x[:, :3], arrived=none,
        )  # fmt: skip

    @classmethod
    def of_states(cls, X: Tensor, measured: Tensor, model: Dynamics, start: float, spacing: float) -> MissionPlan:
        """A plan that somebody else has made, from plants measured at (B, 17).

        Args:
            X: states (B, K, 14), `spacing` apart, s.
            start: time of the first, s.
        """
        B, like, U = len(X), X[:, 0, 0], X.new_zeros(len(X), X.shape[1] - 1, 4)
        none, unknown = torch.zeros_like(like, dtype=torch.int64), torch.full_like(like, torch.nan)
        return cls(
            X=X, U=U, K=X.new_zeros(*U.shape, X.shape[-1]), start=torch.full_like(like, start), dt=spacing,
            dynamics=model, multipliers=Multipliers((), unknown), penalty=unknown, cost=unknown, violation=unknown,
            shifted=none.bool(), guided=none, iterations=none, measured=measured, bias=X.new_zeros(B, 3),
            arrived=none.bool(),
        )  # fmt: skip


AGAIN = 10  # control periods after which a plan that only waits, where one before it arrived, is sought again
CONTINUED = 4  # outer iterations at most that continue a previous plan
MIN_SECONDS = 1e-4  # s, of a time limit


@dataclass(frozen=True)
class Planner(Checked, named="planner"):
    """Solves the planning problem from every measured state.

    A first plan is the solver's. Later, where the solver makes attempts around a local solver (`gco`), the local solver
    continues from the previous plan for up to four outer iterations. Where the result is infeasible, the previous plan
    one stage later is flown if it is less violated; where that is infeasible, too, the whole solver searches again. So
    it does every ten periods where plans end short of the goal and an earlier one didn't: what a search returned that
    found no way waits, and is feasible.

    Args:
        solver: any solver of the library.
        feedback: a previous plan is continued by its controls and their feedback gains, which bring the measured state
            back to it. Without, by its controls alone, as in the paper: over a long horizon a small difference of the
            state then leads metres away.
        multipliers: "shifted" starts from those of the previous plan one stage later, "reset" from zero, as the paper.
        max_seconds: time limit of a plan, s; None: none. With a limit, results depend on the machine.
        tolerance: violation (m for lengths) up to which a plan is flown without a look at the previous one; what the
            margin has for the way between two knots comes on top. Infinity: a new plan always is, as in the paper,
            unless its violation is not a number.
        margin: by which obstacles are grown, m, and above 0 by as much more as a straight step between two knots of the
            previous plan may lead into them; margin_growth: by how much more per second of the horizon, m/s, in four
            steps.
        first_step: the body rates of the second knot are the ones that the rotors lead to (`FirstStepRates`).
        estimation: gain per control period of an estimated constant acceleration that the planning model lacks, for
            wind and errors of the mass, at most 1; 0: none, as the paper.

    Raises:
        InputError: a field out of its range.
    """

    solver: Solver
    feedback: bool = True
    multipliers: Literal["shifted", "reset"] = "shifted"
    max_seconds: Seconds | None = None
    tolerance: PositiveOrInfinite = 0.01
    margin: NonNegative = 0.01
    margin_growth: NonNegative = 0.0
    first_step: bool = True
    estimation: Share = 0.2

    @cached_property
    def solvers(self) -> tuple[Solver, Solver]:
        """What makes a new plan, and what continues one: see `Solver.in_closed_loop`."""
        return self.solver.in_closed_loop(CONTINUED)

    def problem(self, problem: Problem, x: Tensor) -> Problem:
        """The planning problems of a mission at its start, from those of an open-loop study and plants x (B, 17).

        Raises:
            InputError: another model than the quadrotor's planning model.
        """
        x0, none = planning_state(x, airframe_of(problem.dynamics)), torch.zeros_like(x[:, :3])
        constraints = self._constraints(problem, 0.0, x, self._margin(x, None), none[:, 0])
        dynamics = problem.dynamics if self.estimation == 0 else biased(problem.dynamics, none)
        return settled(replace(problem, dynamics=dynamics, x0=x0, constraints=constraints))

    def plan(
        self,
        whole: Problem,
        now: Problem,
        x: Tensor,
        step: int,
        before: MissionPlan | None,
        seed: int,
        ids: Tensor,
        measured: Tensor | None = None,
    ) -> tuple[MissionPlan, Problem, float]:
        """Plans from plants x (B, 17) at a control step, their problems, and the seconds that it took to solve them.

        Args:
            whole: the problems of the open-loop study; now: those of the plan before, at first of `problem`.
            measured: the states that were measured last, (B, 17), where x is predicted from them; None: x.
        """
        measured = x if measured is None else measured
        began = clock.seconds()
        t = step * float(whole.dynamics.dt)
        former = None if before is None else before.moved_to(t)
        now, margin, bias, U0 = self._posed(whole, now, x, t, before, former, measured)
        solve = _Solve(self, now, t, seed, ids, began, self.tolerance + margin.between(whole))
        if former is None or before is None:
            plan = solve.first(U0)
        else:
            former = replace(former, multipliers=before.continued(now))
            U0 = _brought_back(now, former) if self.feedback else U0
            plan = solve.next(U0, former, step % AGAIN == 0)
        return replace(plan, measured=measured, bias=bias), now, clock.seconds() - began

    def first(self, whole: Problem, x: Tensor, seed: int, ids: Tensor) -> tuple[Problem, Solution]:
        """The problems of the first plans from plants x (B, 17), and the solver's solutions, as `plan` makes them."""
        now, _, _, U0 = self._posed(whole, self.problem(whole, x), x, 0.0, None, None, x)
        return now, self.solvers[0].solve(now, U0, seed=seed, ids=ids, max_seconds=self.max_seconds)

    def _posed(
        self,
        whole: Problem,
        now: Problem,
        x: Tensor,
        t: float,
        before: MissionPlan | None,
        former: MissionPlan | None,
        measured: Tensor,
    ) -> tuple[Problem, Margin, Tensor, Tensor]:
        """The problems at a time t, s, their margin, the estimated acceleration (B, 3), controls to begin with.

        Args:
            former: the plans before, moved on to that time.
        """
        x0 = planning_state(x, airframe_of(whole.dynamics))
        U0 = now.cost.rest_controls(x0.new_zeros(now.B, now.N, now.m)) if former is None else former.U
        bias = self.estimated(measured, before, float(whole.dynamics.dt))
        dynamics = whole.dynamics if self.estimation == 0 else biased(whole.dynamics, bias)
        margin = self._margin(x, before)
        depth = margin.unavoidable_depth(continued(whole, x0), t, U0)
        constraints = self._constraints(whole, t, x, margin, depth)
        return continued(now, x0, constraints, dynamics), margin, bias, U0

    def predicted(self, x: Tensor, plan: MissionPlan) -> Tensor:
        """The plants (B, 17) one period later, from x (B, 17) at the plan's first knot: as the plan's model leads."""
        airframe = airframe_of(plan.dynamics)
        now = planning_state(x, airframe)
        later = plan.dynamics.at(0).step(now, plan.U[:, 0])
        q = later[:, 6:10] / later[:, 6:10].square().sum(-1, keepdim=True).sqrt()
        more = (later[:, 13:] - now[:, 13:]) * airframe.mass / 4.0
        F = (x[:, 13:] + more).clamp(airframe.thrust_min, airframe.thrust_max)
        return torch.cat((later[:, :6], q, later[:, 10:13], F), dim=-1)

    def _margin(self, x: Tensor, before: MissionPlan | None) -> Margin:
        """The margin of plans from plants x (B, 17); of a first plan the whole solver looks between the knots."""
        step = torch.zeros_like(x[:, 0])
        if before is not None:
            step = before.X[..., :3].diff(dim=1).square().sum(-1).amax(-1).sqrt()
        return Margin(self.margin, self.margin_growth, step, None if before is None else before.X)

    def _constraints(self, whole: Problem, t: float, x: Tensor, margin: Margin, depth: Tensor) -> list[Constraint]:
        """The constraints of plans that start at time t from plants x (B, 17), depth (B,) m within the margin."""
        parts, start = list[Constraint](), planning_state(x, airframe_of(whole.dynamics))
        for constraint in whole.constraints:
            later = constraint.later(t)
            if isinstance(later, Obstacles):
                parts += margin.around(later, whole.N, float(whole.dynamics.dt), depth, start)
            else:
                parts.append(later)
        return [*parts, *([first_step(whole, x)] if self.first_step else [])]

    def estimated(self, x: Tensor, before: MissionPlan | None, dt: float) -> Tensor:
        """The acceleration (B, 3) that the planning model lacks: a low-pass of what the last period has shown."""
        if before is None or self.estimation == 0:
            return torch.zeros_like(x[:, :3])
        shown = (x[:, 3:6] - before.measured[:, 3:6]) / dt
        airframe = airframe_of(before.dynamics)
        expected = 0.5 * (acceleration(x, airframe) + acceleration(before.measured, airframe))
        return before.bias + self.estimation * (shown - expected - before.bias)


def _brought_back(problem: Problem, former: MissionPlan) -> Tensor:
    """The controls (B, N, 4) of previous plans moved on, with feedback where that has the better Lagrangian.

    Gains along a plan that is far from stationary may lead away.
    """
    lagrangian = Lagrangian(problem, former.multipliers, None, True)
    rollouts = followed(problem, former.X, former.U, former.K), (open_loop(problem, former.U), former.U)
    fed, plain = (value(lagrangian, *rollout)[1].nan_to_num(torch.inf) for rollout in rollouts)
    return torch.where((fed <= plain).view(-1, 1, 1), rollouts[0][1].nan_to_num(), former.U)


class _Solve:
    """The solves of one control step."""

    def __init__(
        self, planner: Planner, problem: Problem, t: float, seed: int, ids: Tensor, began: float, allowed: Tensor
    ) -> None:
        self.planner, self.problem, self.t, self.seed, self.ids, self.began = planner, problem, t, seed, ids, began
        self.allowed = allowed  # violation (B,)
        self.solver, self.local = planner.solvers

    def first(self, U0: Tensor) -> MissionPlan:
        """The solver's plans, from controls U0 (B, N, 4)."""
        plan = self._plan(self._solved(self.solver, self.problem, U0, None, self.ids), self.allowed)
        return replace(plan, arrived=self._arrives(plan))

    def next(self, U0: Tensor, former: MissionPlan, again: bool) -> MissionPlan:
        """Plans that continue previous ones, which are moved on and flown by U0 (B, N, 4).

        Args:
            again: seek others where plans wait, see `_from_waiting`.
        """
        warm = former.multipliers if self.planner.multipliers == "shifted" else None
        plan = self._plan(self._solved(self.local, self.problem, U0, warm, self.ids), self.allowed)
        plan.penalty.copy_(former.penalty)
        self._keep_former(plan, former, U0)
        rows = (~(plan.violation <= self.allowed)).nonzero().flatten()
        left = self._time_left()
        if self.local is not self.solver and rows.numel() > 0 and (left is None or left > MIN_SECONDS):
            searched = self._solved(self.solver, self.problem.take(rows), U0[rows], None, self.ids[rows])
            other = self._plan(searched, self.allowed[rows])
            self._replace(plan, rows, other)
            _count(plan, rows, other)
        if again:
            self._from_waiting(plan, former)
        return replace(
            plan,
            arrived=former.arrived | self._arrives(plan),
            penalty=torch.where(plan.violation <= self.allowed, plan.penalty, former.penalty),
        )

    def _from_waiting(self, plan: MissionPlan, former: MissionPlan) -> None:
        """Search for plans that arrive where these don't, but one before did: they wait where a search found no way.

        Each is feasible, and nothing else would look for another one.
        """
        rows = (former.arrived & ~self._arrives(plan)).nonzero().flatten()
        left = self._time_left()
        if self.local is self.solver or rows.numel() == 0 or (left is not None and left <= MIN_SECONDS):
            return
        waiting = self.problem.take(rows)
        rest = waiting.cost.rest_controls(waiting.x0.new_zeros(waiting.B, waiting.N, waiting.m))
        other = self._plan(self._solved(self.solver, waiting, rest, None, self.ids[rows]), self.allowed[rows])
        arrives = ((other.violation <= self.allowed[rows]) & has_arrived(waiting, other.X)).nonzero().flatten()
        plan.put(rows[arrives], other.take(arrives))
        _count(plan, rows, other)

    def _arrives(self, plan: MissionPlan) -> Tensor:
        return has_arrived(self.problem, plan.X)

    def _solved(self, solver: Solver, problem: Problem, U0: Tensor, warm: Multipliers | None, ids: Tensor) -> Solution:
        return solver.solve(problem, U0, seed=self.seed, ids=ids, warm=warm, max_seconds=self._time_left())

    def _time_left(self) -> float | None:
        """Seconds that are left of the limit, at least `MIN_SECONDS`; None without a limit."""
        limit = self.planner.max_seconds
        return None if limit is None else max(MIN_SECONDS, limit - (clock.seconds() - self.began))

    def _keep_former(self, plan: MissionPlan, former: MissionPlan, U: Tensor) -> None:
        """Put previous plans, moved on and flown by U, in the place of new ones that are infeasible and worse."""
        rows = (~(plan.violation <= self.allowed)).nonzero().flatten()
        if rows.numel() == 0:
            return
        violated = self.problem.take(rows)
        X = open_loop(violated, U[rows])
        moved = replace(
            plan.take(rows), X=X, U=U[rows], K=former.K[rows], multipliers=take(former.multipliers, rows),
            cost=violated.cost.total(X, U[rows]), violation=measured(violated, X, U[rows]),
            shifted=torch.ones_like(rows, dtype=torch.bool),
        )  # fmt: skip
        self._replace(plan, rows, moved)

    @staticmethod
    def _replace(plan: MissionPlan, rows: Tensor, other: MissionPlan) -> None:
        """The less violated of two plans for `rows`, in place; NaN is worst."""
        better = (other.violation < plan.violation[rows].nan_to_num(nan=torch.inf)).nonzero().flatten()
        plan.put(rows[better], other.take(better))

    def _plan(self, solution: Solution, allowed: Tensor) -> MissionPlan:
        plan = MissionPlan.of_solution(solution, self.problem, self.t)
        return replace(plan, penalty=_penalty(solution.multipliers, allowed))


def _count(plan: MissionPlan, rows: Tensor, other: MissionPlan) -> None:
    """Add the iterations of another solve for some vehicles (b,), in place."""
    for name in ("guided", "iterations"):
        getattr(plan, name)[rows] += getattr(other, name)


def _penalty(multipliers: Multipliers, allowed: Tensor) -> Tensor:
    """The penalty mu (B,) at which a multiplier error of 100 % causes the allowed violation (B,).

    The final penalty of a solve isn't used: AL-iLQR raises it until solves are stiff, and the interior point has none.
    """
    largest = torch.zeros_like(multipliers.mu)
    for lam in multipliers.lam:
        if lam.numel() > 0:
            largest = torch.maximum(largest, lam.abs().flatten(1).amax(-1))
    return torch.where((largest > 0) & torch.isfinite(allowed), largest / allowed, multipliers.mu)
