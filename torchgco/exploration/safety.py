"""The judge of safe plans: from the log alone, whether each period held a plan that comes to rest in known free space.

It shares no code with the planner: cells are rebuilt from the changes that were logged, and distances are those of
points along the plan from all cubes near it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from torchgco.dynamics.quadrotor import Airframe
from torchgco.exploration.explorer import Explorer, within_bounds
from torchgco.exploration.sensing.grid import FREE
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.missions.log import MissionLog, SeenLog
from torchgco.missions.planner import MissionPlan
from torchgco.missions.planning_problem import airframe_of
from torchgco.obstacles.base import CONTACT_FACTOR
from torchgco.problem.problem import Problem

AT_REST = 0.1  # m/s at most, where a plan has come to rest
SPACING = 0.05  # m between the points of a plan that are tested


def safe_arrays(log: MissionLog, problem: Problem) -> dict[str, np.ndarray]:
    """`safe` (B, K) of missions: 1 where safe, 0 where not, NaN after their ends; no array without a sensor."""
    if not log.seen:
        return {}
    safe = np.full(tuple(log.cost.shape), np.nan)
    for b, seen in enumerate(log.seen):
        radius = max((float(obstacles.vehicle_radius[b]) for obstacles in problem.obstacles), default=0.0)
        periods = safe_periods(seen, CONTACT_FACTOR * radius, log.period)
        safe[b, : len(periods)] = periods
    return {"safe": safe}


def safe_periods(log: SeenLog, radius: float, dt: float) -> np.ndarray:
    """Whether the plan of each period (K,) keeps `radius`, m, from all that isn't known to be free, and comes to rest.

    Args:
        dt: between two positions of a plan, s.
    """
    state, safe = np.zeros(log.shape, np.uint8), []
    for (cells, new), plan in zip(log.changes, log.safe, strict=True):
        state.reshape(-1)[cells] = new
        rests = np.linalg.norm(plan[-1] - plan[-2]) <= AT_REST * dt
        safe.append(bool(rests and least_gap(log, state, plan, radius) >= radius))
    return np.array(safe, bool)


def least_gap(log: SeenLog, state: np.ndarray, plan: Sequence[np.ndarray] | np.ndarray, reach: float) -> float:
    """The smallest distance, m, of a polyline (K, 3) from cells that aren't free, at most `reach`.

    A lower bound: between the tested points it may be smaller by half their distance at most, which is taken off.
    """
    plan = np.asarray(plan)
    parts = [
        a + np.linspace(0, 1, 1 + int(np.ceil(np.linalg.norm(b - a) / SPACING)), endpoint=False)[:, None] * (b - a)
        for a, b in pairwise(plan)
    ]
    points = np.concatenate([*parts, plan[-1:]])
    slack = 0.5 * np.linalg.norm(np.diff(points, axis=0), axis=1).max(initial=0.0)
    wide = int(np.ceil((reach + slack) / log.resolution))
    near = np.stack(np.meshgrid(*[np.arange(-wide, wide + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    cells = np.floor((points - log.corner) / log.resolution).astype(int)[:, None] + near
    outside = ((cells < 0) | (cells >= log.shape)).any(axis=-1)
    index = np.clip(cells, 0, np.array(log.shape) - 1)
    blocked = outside | (state[index[..., 0], index[..., 1], index[..., 2]] != FREE)
    centers = log.corner + (cells + 0.5) * log.resolution
    away = np.maximum(np.abs(points[:, None] - centers) - 0.5 * log.resolution, 0.0)
    gap = np.where(blocked, np.linalg.norm(away, axis=-1), np.inf).min()
    # Along a straight piece the distance from a convex cube is convex: its least value between two points that are
    # `d` apart lies below theirs by less than d / 2.
    return float(min(gap - slack, reach))


def former_plans(problem: Problem, former: MissionPlan | None, t: float) -> MissionPlan:
    """The previous plans moved on to a time t, s, brought back to by feedback; of a first plan, rest.

    Args:
        problem: seed by seed, the same number of times for each vehicle.
    """
    x0, C = problem.x0, 1 if former is None else problem.B // former.X.shape[0]
    if former is None:
        U = problem.cost.rest_controls(x0.new_zeros(problem.B, problem.N, 4))
        X, K = x0.unsqueeze(1).repeat(1, problem.N + 1, 1), x0.new_zeros(*U.shape, 14)
        penalty = torch.ones_like(x0[:, 0])
    else:
        X, U, K = (tensor.repeat(C, *[1] * (tensor.dim() - 1)) for tensor in (former.X, former.U, former.K))
        X[:, -1] = resting(X[:, -1], airframe_of(problem.dynamics))
        U[:, -1] = problem.cost.rest_controls(U[:, -1:])[:, 0]
        X, U = within_bounds(problem, X, U, K)
        penalty = former.penalty.repeat(C)
    plan = MissionPlan.of_states(X, x0, problem.dynamics, t, float(problem.dynamics.dt))
    return replace(
        plan, U=U.nan_to_num(), K=K, multipliers=Multipliers.zero(problem, 1.0), penalty=penalty,
        cost=problem.cost.total(X, U), violation=torch.zeros_like(penalty), shifted=~plan.shifted,
    )  # fmt: skip


def braking(x: Tensor, explorer: Explorer, dt: float) -> Tensor:
    """Positions (B, N, 3) of vehicles measured at x (B, 17) that brake straight ahead."""
    speed = x[:, 3:6].norm(dim=-1, keepdim=True).clamp(min=1e-6)
    t = dt * torch.arange(1, explorer.stages + 1, dtype=x.dtype)
    t = torch.minimum(t, speed / explorer.deceleration)
    way = speed * t - 0.5 * explorer.deceleration * t.square()
    return x[:, None, :3] + way.unsqueeze(-1) * (x[:, 3:6] / speed).unsqueeze(1)


def ends_at_rest(X: Tensor) -> Tensor:
    """Whether plans (B, N+1, 14) come to rest, (B,)."""
    return X[:, -1, 3:6].abs().amax(-1) <= 3.0 * AT_REST


def resting(x: Tensor, airframe: Airframe) -> Tensor:
    """States (B, 14) at rest and upright in the same positions, with the same yaw."""
    rest = torch.zeros_like(x)
    rest[:, :3], rest[:, 13] = x[:, :3], airframe.gravity
    yaw = torch.hypot(x[:, 6], x[:, 9]).clamp(min=1e-9)
    rest[:, 6], rest[:, 9] = x[:, 6] / yaw, x[:, 9] / yaw
    return rest
