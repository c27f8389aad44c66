"""The quality of controls: a simulation from U alone, in float64, with the problem's own step, cost and rows.

No solver code is used: it rolls the planning model out, adds the cost up stage by stage, and measures distances from
obstacles by plain differences. docs/words.md defines the terms that it returns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.shapes import check_finite, check_shape, check_tensor, computing_on, tensor
from torchgco.constraints.base import ADMITTED, Constraint, Distance
from torchgco.constraints.gates import has_gates
from torchgco.judging.gates import passages
from torchgco.judging.steps import StepErrors, step_errors
from torchgco.judging.worst import path_rows, violation_between
from torchgco.problem.alone import row_by_row
from torchgco.problem.goal import Goal
from torchgco.problem.in_time import at_times
from torchgco.problem.problem import Problem, current_problem
from torchgco.problem.times import Paths, paths

SUCCESS_COST = 0.05  # by how much a success may exceed the best known cost, as a share of its amount
NUMBERS_AT_ONCE = 2**18  # numbers held at once where distances are measured: 2 MB


@dataclass(frozen=True)
class Verdict:
    """One value per problem, (B,)."""

    cost: Tensor  # J_var
    violation: Tensor  # largest violation of the planning problem, full radii; lengths in metres
    # Smallest distance, m, to contact at the knots: to a surface of 0.95 (r_obs + r_veh), of a box grown by
    # 0.95 (r + r_veh), where r rounds it; of a map to r_veh - 1e-3 m from its cells and points; of positions that keep
    # a distance from each other, above 0.95 of it; infinite without any. A constraint given as a function has no
    # distance: its rows count only as violations. NaN where the model has no position, and no positions keep distance.
    clearance_knots: Tensor
    clearance: Tensor  # the same between the knots, too, along the path that the model's integrator takes there
    goal_distance: Tensor  # m, last knot to goal, positions only; NaN without a goal
    # bool: what the statuses CONVERGED and FEASIBLE say: violation <= 1e-3, clearance >= 0, every gate passed
    feasible: Tensor
    # bool: feasible, and closer to the goal than the goal radius, of a required one 1e-3 m more; False without a goal
    reached: Tensor
    clear_95: Tensor  # bool, the paper's notion: clearance_knots >= 0, every other constraint within 1e-3
    gates_passed: Tensor  # int64: how many gates are passed in the order of `Gates`, at or between any knots
    step_error: Tensor  # whether dt is short enough: see `StepErrors`; NaN without a known field
    step_cost: Tensor
    # largest violation within stages of inequalities of the state, which hold at the knots: see `violation_between`
    violation_between: Tensor

    def success(self, best_cost: Tensor) -> Tensor:
        """Whether reached, and within 5 % of the best known cost (B,), (B,) bool.

        Raises:
            InputError: a best cost that isn't a number: without one, success is unknown.
        """
        best_cost = tensor(best_cost, "best_cost", self.cost)
        check_shape(best_cost, () if best_cost.dim() == 0 else tuple(self.cost.shape), "best_cost")
        if bool(best_cost.isnan().any()):
            raise InputError("best_cost", "the best known cost of every problem", "NaN")
        return self.reached & near_best(self.cost, best_cost)


def near_best(cost: Any, best: Any) -> Any:
    """Whether costs, tensors or columns of a table, exceed the best known ones by at most 5 % of their amounts."""
    return cost - best <= SUCCESS_COST * abs(best)


def judge(
    problem: Problem,
    U: Tensor,
    goal: Tensor | None = None,
    goal_radius: Tensor | float | None = None,
    start: Tensor | None = None,
    times: Tensor | None = None,
) -> Verdict:
    """Judge controls U (B, N, m) by their rollout; arguments, and errors, are those of `torchgco.judge`."""
    problem = current_problem(problem)
    single = problem.x0.dtype == torch.float32
    problem, U = row_by_row(in_double(problem)), doubled(U, "U", problem)
    problem.check_controls(U, "U")
    more = goal, goal_radius, start
    stated: list[Any] = [value.double() if single and isinstance(value, Tensor) else value for value in more]
    with computing_on(problem.x0.device):
        end = _goal(problem, *stated[:2])
        first = _start(problem, stated[2])
        X0 = first.unsqueeze(1).expand(-1, problem.N + 1, -1)
        times = None if times is None else doubled(times, "times", problem)
        user, controls = problem, U
        problem, X0, U = at_times(problem, X0, U, times)
        first = X0[:, 0]
        X, moved = [first], _moved(problem, first)
        cost = torch.zeros_like(problem.x0[:, 0])
        for k in range(problem.N):
            runs, x = k < problem.stages, X[-1]
            cost = cost + torch.where(runs, problem.cost.stage(x, U[:, k], k), 0.0)
            X.append(torch.where(runs.unsqueeze(-1), problem.dynamics.at(k).step(x, U[:, k]), x))
        cost = cost + problem.cost.terminal(X[-1])
        states = torch.stack(X, dim=1)
        errors = step_errors(user, states[..., : user.n], controls, times)
        return _verdict(problem, states, U, cost, end, moved, errors)


def in_double(problem: Problem) -> Problem:
    """The problems in float64."""
    return problem if problem.x0.dtype == torch.float64 else problem.cast(torch.float64)


def doubled(value: Any, field: str, problem: Problem) -> Tensor:
    """A tensor of float64 or float32 on the problems' device, in float64.

    Raises:
        InputError: anything else.
    """
    check_tensor(value, field)
    if value.device != problem.x0.device:
        raise InputError(field, f"device {problem.x0.device} as in x0", value.device)
    return value.double()


def _start(problem: Problem, start: Any) -> Tensor:
    """Where the rollout begins, (B, n)."""
    free = problem.free_start
    if start is None:
        if free is not None and bool(free.any()):
            raise InputError("start", "the starts found, such as solution.X[:, 0], as some are free", "None")
        return problem.x0
    start = tensor(start, "start", problem.x0)
    check_shape(start, (problem.B, problem.n), "start")
    return start


def _moved(problem: Problem, start: Tensor) -> Tensor:
    """The largest change (B,) of a component of the start that is given."""
    if start is problem.x0:
        return torch.zeros_like(start[:, 0])
    change = (start - problem.x0).abs()
    return (change if problem.free_start is None else change.masked_fill(problem.free_start, 0.0)).amax(-1)


def _goal(problem: Problem, center: Any, radius: Any) -> tuple[Tensor, Tensor] | None:
    """Position (B, d) or (d,) and radius, () or (B,), of the goal: those given, else the problem's; None where there is
    none.
    """
    if center is None and radius is None and problem.goal is None:
        return None
    if center is None:
        center = _own_goal(problem).position
    else:
        if problem.dynamics.position is None:
            raise InputError("goal", "a model with a position", type(problem.dynamics).__name__)
        center = tensor(center, "goal", problem.x0)
        d = problem.position.stop - problem.position.start
        check_shape(center, (d,) if center.dim() == 1 else (problem.B, d), "goal")
        check_finite(center, "goal")
    if radius is None:
        radius = _own_goal(problem).radius
    else:
        radius = tensor(radius, "goal_radius", problem.x0)
        check_shape(radius, () if radius.dim() == 0 else (problem.B,), "goal_radius")
        if not bool((radius > 0).all()):
            raise InputError("goal_radius", "above 0 m", float(radius.min()))
    return center, radius


def _own_goal(problem: Problem) -> Goal:
    if problem.goal is None:
        raise InputError("goal", "a Goal in the problem, or position and radius here", "neither")
    return problem.goal


def _verdict(
    problem: Problem,
    X: Tensor,
    U: Tensor,
    cost: Tensor,
    goal: tuple[Tensor, Tensor] | None,
    moved: Tensor,
    errors: StepErrors,
) -> Verdict:
    far, along = torch.full_like(cost, torch.inf), paths(problem, X, U)
    clearance_knots, clearance, violation, others = far, far, moved, torch.zeros_like(cost)
    for constraint in problem.constraints:
        worst = constraint.worst(X, U) if problem.horizon is None else _worst_within(problem, constraint, X, U)
        violation = torch.maximum(violation, worst)
        if isinstance(constraint, Distance):
            at_knots, between = _clearances(problem, constraint, X, along)
            clearance_knots = torch.minimum(clearance_knots, at_knots)
            clearance = torch.minimum(clearance, between)
        else:
            others = torch.maximum(others, worst)
    passed, gates = torch.zeros_like(problem.stages), 0
    for way in passages(problem, X, U, along).values():
        passed, gates = passed + way.passed.sum(-1), gates + way.passed.shape[-1]
    finite = torch.isfinite(X).flatten(1).all(-1) & (moved == 0)
    clear_95 = finite & (clearance_knots >= 0) & (others <= ADMITTED)
    feasible = finite & (violation <= ADMITTED) & (clearance >= 0) & (passed == gates)
    goal_distance, reached = torch.full_like(cost, torch.nan), torch.zeros_like(feasible)
    if goal is not None:
        goal_distance = (X[:, -1, problem.position] - goal[0]).square().sum(-1).sqrt()
        required = problem.goal is not None and problem.goal.required  # rows among the others are kept as far as these
        reached = feasible & (goal_distance < goal[1] + (ADMITTED if required else 0.0))
    if problem.dynamics.position is None and not any(isinstance(row, Distance) for row in problem.constraints):
        clearance_knots = clearance = torch.full_like(cost, torch.nan)
    of_goal, of_steps = (goal_distance, feasible, reached), (errors.step_error, errors.step_cost)
    between_knots = violation_between(problem, X, U)
    return Verdict(cost, violation, clearance_knots, clearance, *of_goal, clear_95, passed, *of_steps, between_knots)


def _worst_within(problem: Problem, constraint: Constraint, X: Tensor, U: Tensor) -> Tensor:
    """The largest violation (B,) of rows within each horizon; a row of knot N alone is one of the last knot."""
    rows, worst = constraint.violation(X, U), torch.zeros_like(X[:, 0, 0])
    if rows.shape[2] == 0:
        return worst
    knots = torch.arange(problem.N + 1, device=X.device)[constraint.knots].tolist()
    of = getattr(constraint, "of", "x" if constraint.holds_at(problem.N) else "xu")
    for b, last in enumerate(problem.stages.tolist()):
        within = [i for i, k in enumerate(knots) if k < last or (k == last and of == "x")]
        if problem.N in knots and last not in knots:
            within.append(knots.index(problem.N))
        if within:
            worst[b] = rows[b, within].max()
    return worst


def _clearances(problem: Problem, distance: Distance, X: Tensor, along: Sequence[Paths]) -> tuple[Tensor, Tensor]:
    """Smallest distances (B,) at the knots and between them; those of a horizon's own knots where horizons differ."""
    at_knots, between = (torch.empty_like(X[:, 0, 0]) for _ in range(2))
    for path in along:
        stages = problem.stages[path.rows]
        for last in [problem.N] if problem.horizon is None else stages.unique().tolist():
            index = (stages == last).nonzero().flatten()
            rows = path.rows[index]
            at_knots[rows], between[rows] = _measured(distance.take(rows), X[rows, : last + 1])
            if path.pieces > 1:
                fine = distance.take(rows).in_pieces(path.pieces)
                between[rows] = _measured(fine, path.X[index, : path.pieces * last + 1])[1]
    return at_knots, between


def _measured(distance: Distance, X: Tensor) -> tuple[Tensor, Tensor]:
    """The clearances (B,) of a part, of as many problems at a time as memory should hold distances of."""
    size = max(1, NUMBERS_AT_ONCE // (X.shape[1] * X.shape[2] * max(1, distance.contact_depths.shape[1])))
    starts = (slice(i, i + size) for i in range(0, len(X), size))
    at_knots, between = zip(*(distance.take(rows).clearances(X[rows]) for rows in starts), strict=True)
    return torch.cat(at_knots), torch.cat(between)


def frame_columns(verdict: Verdict) -> dict[str, Any]:
    """The verdict as arrays, by the names of a study's columns (`success` needs the best cost first)."""
    names = "feasible", "reached", "clear_95", "cost", "violation", "clearance", "clearance_knots", "goal_distance"
    return {name: getattr(verdict, name).cpu().numpy() for name in names}


def more_columns(problem: Problem, verdict: Verdict) -> dict[str, Any]:
    """`gates_passed` where there are gates, `violation_between` where rows may be violated within stages alone."""
    names = ["gates_passed"] if has_gates(problem) else []
    names += ["violation_between"] if path_rows(problem) else []
    return {name: getattr(verdict, name).cpu().numpy() for name in names}


def columns(problem: Problem, U: Tensor, start: Tensor | None = None, times: Tensor | None = None) -> dict[str, Any]:
    """What can be judged of controls U (B, N, m) without being given more than the problem, as columns of a table.

    Those of `judged_columns`; a problem of another precision is judged in float64; `start` and `times` as in `judge`.

    Raises:
        InputError: as `judge`.
    """
    problem = current_problem(problem)
    if not _names(problem) and not has_gates(problem) and not path_rows(problem):
        return {}
    return judged_columns(problem, judge(problem, U, start=start, times=times))


def judged_columns(problem: Problem, verdict: Verdict) -> dict[str, Any]:
    """`clearance` (m) where the problem has obstacles, `reached` where it has a goal, and `more_columns`."""
    values = {name: getattr(verdict, name).cpu().numpy() for name in _names(problem)}
    return values | more_columns(problem, verdict)


def _names(problem: Problem) -> list[str]:
    names = ["clearance"] if any(isinstance(c, Distance) for c in problem.constraints) else []
    names += ["reached"] if problem.goal is not None else []
    return names if problem.dynamics.position is not None else []
