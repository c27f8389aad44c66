"""What a map says of a problem that wasn't solved: no way to the goal, or a start among unknown cells."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from torchgco.base.status import Status
from torchgco.constraints.base import CONTACT_FACTOR
from torchgco.maps.field import BoundField, distance_within
from torchgco.maps.grid import OccupancyGrid
from torchgco.maps.passage import widest_passage
from torchgco.obstacles.base import ADMITTED, Obstacles
from torchgco.problem.covered import covered_goals
from torchgco.problem.problem import Problem


def goal_facts(problem: Problem, X: Tensor, U: Tensor) -> dict[str, Any]:
    """Those of `Facts` on a required goal that X (1, N+1, n), U (1, N, m) misses; none where it doesn't."""
    row = next((constraint for constraint in problem.constraints if constraint.is_goal), None)
    if row is None:
        return {}
    last = int(problem.stages[0])  # of a problem with its own horizon, whose rows stand at knot N
    missed = float(row.worst(X[:, [last] * X.shape[1]], U))
    if not missed > ADMITTED:
        return {}
    unit = " m" if row.in_metres else ""
    return {"missed": f"{missed:.4g}{unit}", "covered": bool(covered_goals(problem))}


def map_facts(problem: Problem, status: Status, arrived: bool) -> dict[str, Any]:
    """Those of `Facts` that maps know, for a batch of one; none where the vehicle arrived without contact."""
    fields = [field for field in problem.obstacles if field.map is not None]
    if status is Status.INVALID_START:
        return {"in_unknown": any(_is_unknown(problem, field.map) for field in fields if field.body is None)}
    if arrived or problem.goal is None or not bool(problem.x0[:, problem.position].isfinite().all()):
        return {}
    facts = [fact for field in fields if field.holds_at(problem.N) and (fact := _barred(problem, field)) is not None]
    return min(facts, key=lambda fact: fact["passage"], default={})


def _barred(problem: Problem, obstacle: Obstacles) -> dict[str, Any] | None:
    """The vehicle's radius and the largest that gets to the goal, where this one touches the map on every way."""
    field = obstacle.inscribed  # of a body, as the ball meets it that the body holds
    assert problem.goal is not None and isinstance(field, BoundField)
    start = problem.x0[0, problem.position].detach().cpu().double().numpy()
    goal = problem.goal.position[0].detach().cpu().double().numpy()
    radius, goal_radius = float(field.vehicle_radius[0]), float(problem.goal.radius[0])
    b, near = int(field.which[0]), radius - ADMITTED
    if distance_within(field.field.source, field.field.unknown, b, start, radius) < near:
        near = CONTACT_FACTOR * radius  # from so near a start it may leave
    passage = widest_passage(field.field, b, start, goal, goal_radius, near)
    if passage is None:
        return None
    ends = {"start": start, "goal": goal}
    off = [name for name, point in ends.items() if passage == 0.0 and _shuts_out(field, point)]
    return {"radius": radius, "passage": passage, "body": obstacle is not field, "off_map": off[0] if off else None}


def _shuts_out(field: BoundField, point: np.ndarray) -> bool:
    """Whether a place lies outside of a grid whose outermost cells are all occupied."""
    source = field.field.single(int(field.which[0])).source
    if not isinstance(source, OccupancyGrid) or source.holds(point):
        return False
    (cells,) = source.held(field.field.unknown)
    return all(bool(cells.take((0, -1), axis).all()) for axis in range(source.d))


def _is_unknown(problem: Problem, field: BoundField) -> bool:
    """Whether the vehicle touches unknown cells at the start, and no others of this map."""
    source = field.field.source
    if not isinstance(source, OccupancyGrid) or bool(field.start_is_clear(problem.x0)[0]):
        return False
    p = problem.x0[0, problem.position].detach().cpu().double().numpy()
    least = CONTACT_FACTOR * float(field.vehicle_radius[0])
    known = distance_within(source, "free", int(field.which[0]), p, least + source.resolution)
    return known >= least and known > 0
