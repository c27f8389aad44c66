"""The quality of controls: a simulation from U alone, in float64, with the problem's own step, cost and rows.

No solver code is used: it rolls the planning model out, adds the cost up stage by stage, and measures distances from
obstacles by plain differences. docs/words.md defines the terms that it returns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.shapes import check_finite, check_shape, check_tensor, computing_on, tensor
from torchgco.constraints.base import CONTACT_FACTOR, Constraint
from torchgco.constraints.gates import has_gates
from torchgco.constraints.separation import Separation
from torchgco.judging.distances import box_distance, box_segment_distance, oscillating_distances, segment_distance
from torchgco.judging.gates import passages
from torchgco.judging.maps import segment_distances
from torchgco.judging.steps import StepErrors, step_errors
from torchgco.maps.field import BoundField
from torchgco.obstacles.base import ADMITTED, Obstacles
from torchgco.obstacles.body import BoundBody
from torchgco.obstacles.boxes import BoundBoxes
from torchgco.obstacles.in_free_time import SpheresInFreeTime
from torchgco.obstacles.oscillating import BoundOscillatingBoxes
from torchgco.obstacles.spheres import BoundSpheres
from torchgco.problem.alone import row_by_row
from torchgco.problem.between import Paths, paths
from torchgco.problem.goal import Goal
from torchgco.problem.in_time import at_times
from torchgco.problem.problem import Problem, current_problem

SUCCESS_COST = 0.05  # by how much a success may exceed the best known cost, as a share of its amount
NUMBERS_AT_ONCE = 2**18  # numbers held at once where distances from spheres are measured: 2 MB


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
    """Judge controls U (B, N, m) by their rollout from the start: any controls of any model, in float64.

    Args:
        problem: the problems; of a model without a position cost, violation and feasibility are judged. Those in
            float32 are judged in float64, with their numbers as they are.
        U: controls, float64 or float32; NaN where a solver returned none: such a problem is neither feasible nor
            reached.
        goal: positions (B, d) or (d,), m. None: the problem's goal; where it has none, nothing is reached.
        goal_radius: number or (B,), m, above 0. None: that of the problem's goal.
        start: (B, n), the starts found, such as `solution.X[:, 0]`, where some are free. One that differs from x0 in a
            component that isn't free is not feasible. None: x0, where none is free.
        times: (B, N+1), s, of the knots where the time is free, such as `solution.t`; a duration out of its bounds is
            not feasible. None: the time isn't free.

    Raises:
        InputError: U, goal, radius or start don't fit the problem, a goal is given without a radius, or for dynamics
            without a position, starts are free and none are given, or obstacles are of a kind that can't be judged.
    """
    problem = current_problem(problem)
    single = problem.x0.dtype == torch.float32
    problem, U = row_by_row(in_double(problem)), doubled(U, "U", problem)
    problem.check_controls(U, "U")
    more = goal, goal_radius, start
    stated: list[Any] = [value.double() if single and isinstance(value, Tensor) else value for value in more]
    with computing_on(problem.x0.device):
        end = _goal(problem, *stated[:2])
        first = _start(problem, stated[2])
        held = first.unsqueeze(1).expand(-1, problem.N + 1, -1)
        times = None if times is None else doubled(times, "times", problem)
        given, controls = problem, U
        problem, held, U = at_times(problem, held, U, times)
        first = held[:, 0]
        X, moved = [first], _moved(problem, first)
        cost = torch.zeros_like(problem.x0[:, 0])
        for k in range(problem.N):
            runs, x = k < problem.stages, X[-1]
            cost = cost + torch.where(runs, problem.cost.stage(x, U[:, k], k), 0.0)
            X.append(torch.where(runs.unsqueeze(-1), problem.dynamics.at(k).step(x, U[:, k]), x))
        cost = cost + problem.cost.terminal(X[-1])
        states = torch.stack(X, dim=1)
        errors = step_errors(given, states[..., : given.n], controls, times)
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
        if isinstance(constraint, Obstacles | Separation):
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
    if problem.dynamics.position is None and not any(isinstance(part, Separation) for part in problem.constraints):
        clearance_knots = clearance = torch.full_like(cost, torch.nan)
    of_goal, of_steps = (goal_distance, feasible, reached), (errors.step_error, errors.step_cost)
    return Verdict(cost, violation, clearance_knots, clearance, *of_goal, clear_95, passed, *of_steps)


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


def _clearances(
    problem: Problem, obstacles: Constraint, X: Tensor, along: Sequence[Paths]
) -> tuple[Tensor, Tensor]:
    """Smallest distances (B,) at the knots and between them; those of a horizon's own knots where horizons differ."""
    at_knots, between = (torch.empty_like(X[:, 0, 0]) for _ in range(2))
    for path in along:
        stages = problem.stages[path.rows]
        for last in [problem.N] if problem.horizon is None else stages.unique().tolist():
            own = (stages == last).nonzero().flatten()
            rows = path.rows[own]
            part, measure = obstacles.take(rows), by_kind(CLEARANCES, obstacles)
            at_knots[rows], between[rows] = measure(part, X[rows, : last + 1])
            if path.pieces > 1:
                fine = part.in_pieces(path.pieces) if isinstance(part, Obstacles) else part
                between[rows] = measure(fine, path.X[own, : path.pieces * last + 1])[1]
    return at_knots, between


def sphere_clearance(spheres: BoundSpheres, X: Tensor) -> tuple[Tensor, Tensor]:
    """Smallest distance (B,) to a surface of 0.95 (r_obs + r_veh), at the knots and along the segments between, m.

    Infinite where there is no obstacle. All knots count, the given start too. With Euler steps vehicle and obstacle
    both move straight from knot to knot, so the distance is exact; for other integrators it is that of the chord.
    """
    if spheres.centers.shape[1] == 0:
        far = torch.full_like(X[:, 0, 0], torch.inf)
        return far, far
    rows = max(1, NUMBERS_AT_ONCE // (X.shape[1] * spheres.centers[0].numel()))
    starts = (slice(i, i + rows) for i in range(0, X.shape[0], rows))
    at_knots, between = zip(*(_sphere_clearance(spheres.take(some), X[some]) for some in starts), strict=True)
    return torch.cat(at_knots), torch.cat(between)


def _sphere_clearance(spheres: BoundSpheres, X: Tensor) -> tuple[Tensor, Tensor]:
    contact = torch.where(spheres.absent, -torch.inf, CONTACT_FACTOR * spheres.inflated_radii).unsqueeze(1)
    p = X[..., spheres.position].unsqueeze(2)
    relative, move = p - spheres.centers.unsqueeze(1), p.diff(dim=1)
    if spheres.velocities is not None:
        v = spheres.velocities.unsqueeze(1)
        t = spheres.dt * torch.arange(X.shape[1], dtype=X.dtype, device=X.device).view(1, -1, 1, 1)
        relative, move = relative - t * v, move - spheres.dt * v
    apart = relative.norm(dim=-1)
    at_knots = (apart - contact).flatten(1).amin(-1)
    # A segment's closest point lies within half its length of an end: so bounded, most can't be the closest.
    half = 0.5 * move.norm(dim=-1)
    least = (torch.minimum(apart[:, :-1], apart[:, 1:]).square() - half.square()).clamp(min=0.0).sqrt()
    i, k, j = (least - contact < at_knots.view(-1, 1, 1)).nonzero(as_tuple=True)
    near = segment_distance(relative[i, k, j], relative[i, k + 1, j]) - contact[i, 0, j]
    return at_knots, at_knots.scatter_reduce(0, i, near, "amin")


def box_clearance(boxes: BoundBoxes, X: Tensor) -> tuple[Tensor, Tensor]:
    """Smallest distance (B,) to a surface grown by 0.95 (r + r_veh), at the knots and along the segments between, m.

    As for spheres: all knots count, and it is infinite where there is no obstacle.
    """
    p = X[..., boxes.position]
    if boxes.centers.shape[1] == 0:
        far = torch.full_like(p[:, 0, 0], torch.inf)
        return far, far
    contact = torch.where(boxes.absent, -torch.inf, CONTACT_FACTOR * boxes.inflated_radii).unsqueeze(1)
    at_knots = (box_distance(boxes, p) - contact).flatten(1).amin(-1)
    between = (box_segment_distance(boxes, p, at_knots.view(-1, 1, 1) + contact) - contact).flatten(1).amin(-1)
    return at_knots, torch.minimum(between, at_knots)


def oscillating_clearance(swings: BoundOscillatingBoxes, X: Tensor) -> tuple[Tensor, Tensor]:
    """As `box_clearance`, of boxes that move; between the knots a lower bound, by dt^2 / 8 of their accelerations."""
    p, boxes = X[..., swings.position], swings.boxes
    if boxes.centers.shape[1] == 0:
        far = torch.full_like(p[:, 0, 0], torch.inf)
        return far, far
    contact = torch.where(boxes.absent, -torch.inf, CONTACT_FACTOR * boxes.inflated_radii).unsqueeze(1)
    ends, ways = oscillating_distances(swings, p)
    at_knots, between = ((part - contact).flatten(1).amin(-1) for part in (ends, ways))
    return at_knots, torch.minimum(between, at_knots)


def separation_clearance(separation: Separation, X: Tensor) -> tuple[Tensor, Tensor]:
    """Smallest distance (B,) of a pair, less 0.95 of that to keep, at the knots and along the segments between, m.

    Both positions move along their segments at the same time; all knots count.
    """
    at_knots = between = torch.full_like(X[:, 0, 0], torch.inf)
    for i, j in separation.pairs.tolist():
        away = X[..., separation.positions[i]] - X[..., separation.positions[j]]
        at_knots = torch.minimum(at_knots, away.norm(dim=-1).amin(-1))
        between = torch.minimum(between, segment_distance(away[:, :-1], away[:, 1:]).amin(-1))
    contact = CONTACT_FACTOR * separation.min_distance
    return at_knots - contact, torch.minimum(between, at_knots) - contact


def field_clearance(field: BoundField, X: Tensor) -> tuple[Tensor, Tensor]:
    """Smallest distance (B,) of the occupied cells, or points, less r_veh - 1e-3, at the knots and between them, m.

    Where nothing is nearer than `maps.EXACT_TO` a lower bound; infinite where the map is empty. At the start, and in
    the first stage, contact is where the start is, or at 0.95 r_veh if that is nearer.
    """
    p, radius = X[..., field.position], field.vehicle_radius.unsqueeze(-1)
    at_knots = segment_distances(field, torch.stack((p, p), dim=2).flatten(1, 2))[:, ::2] - radius
    along = segment_distances(field, p) - radius
    ways = (gaps + field.depths_along(at_knots[:, 0], gaps.shape[1]) for gaps in (at_knots, along))
    nearest, between = (gaps.amin(-1) for gaps in ways)
    return nearest, torch.minimum(between, nearest)


def body_clearance(body: BoundBody, X: Tensor) -> tuple[Tensor, Tensor]:
    """The same of all balls of a body, whose state changes evenly between the knots: there a lower bound.

    Between them the balls' centers are taken from states a part of a step apart, and what they leave the chords of
    these by where the vehicle turns evenly is subtracted.
    """
    fine, states = body.finer(X)
    bulge = fine.points.bulge(states).amax(1)  # (B, P)
    at_knots = between = torch.full_like(X[:, 0, 0], torch.inf)
    whole, parts = body.points.at(X), fine.points.at(states)
    for i, (ball, finer) in enumerate(zip(body.balls, fine.balls, strict=True)):
        measure = by_kind(CLEARANCES, ball)
        at_knots = torch.minimum(at_knots, measure(ball, whole[:, :, i])[0])
        between = torch.minimum(between, measure(finer, parts[:, :, i])[1] - bulge[:, i])
    return at_knots, torch.minimum(between, at_knots)


# By kind of obstacles: smallest distances (B,) from X (B, N+1, n) to where bodies touch, at the knots and between them.
CLEARANCES: dict[type[Constraint], Callable[[Any, Tensor], tuple[Tensor, Tensor]]] = {
    BoundSpheres: sphere_clearance,
    SpheresInFreeTime: lambda part, X: sphere_clearance(part.along(X), X),
    BoundBoxes: box_clearance,
    BoundOscillatingBoxes: oscillating_clearance,
    BoundField: field_clearance,
    BoundBody: body_clearance,
    Separation: separation_clearance,
}


def by_kind(measures: dict[type[Constraint], Any], obstacles: Constraint) -> Any:
    """The function that measures obstacles of this kind.

    Raises:
        InputError: no function measures this kind. Without the error these obstacles would count as absent.
    """
    for kind, measure in measures.items():
        if isinstance(obstacles, kind):
            return measure
    known = ", ".join(kind.__name__ for kind in measures)
    raise InputError("constraints", f"obstacles that can be judged ({known})", type(obstacles).__name__)


def frame_columns(verdict: Verdict) -> dict[str, Any]:
    """The verdict as arrays, by the names of a study's columns (`success` needs the best cost first)."""
    names = "feasible", "reached", "clear_95", "cost", "violation", "clearance", "clearance_knots", "goal_distance"
    return {name: getattr(verdict, name).cpu().numpy() for name in names}


def gates_passed(problem: Problem, verdict: Verdict) -> dict[str, Any]:
    """The column `gates_passed`; none where there are no gates."""
    return {"gates_passed": verdict.gates_passed.cpu().numpy()} if has_gates(problem) else {}


def columns(problem: Problem, U: Tensor, start: Tensor | None = None, times: Tensor | None = None) -> dict[str, Any]:
    """What can be judged of controls U (B, N, m) without being given more than the problem, as columns of a table.

    `clearance` (m) where the problem has obstacles, `reached` where it has a goal, `gates_passed` where it has gates; a
    problem of another precision is judged in float64; `start` and `times` as in `judge`.

    Raises:
        InputError: as `judge`.
    """
    problem = current_problem(problem)
    if problem.dynamics.position is None:
        return {}
    names = ["clearance"] if any(isinstance(c, tuple(CLEARANCES)) for c in problem.constraints) else []
    names += ["reached"] if problem.goal is not None else []
    if not names and not has_gates(problem):
        return {}
    verdict = judge(problem, U, start=start, times=times)
    found = {name: getattr(verdict, name).cpu().numpy() for name in names}
    return found | gates_passed(problem, verdict)
