"""Previous plans in unknown space, flown one stage later, and what stands in for them where there is none."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.dynamics.quadrotor import Airframe
from torchgco.exploration.explorer import Explorer, within_bounds
from torchgco.exploration.safety import AT_REST
from torchgco.lagrangian.lagrangian import Multipliers, shifted
from torchgco.missions.planner import Plan
from torchgco.missions.planning_problem import airframe_of
from torchgco.problem.problem import Problem


def former_plans(problem: Problem, before: Plan | None) -> Plan:
    """The previous plans one stage later, brought back to by feedback; of a first plan, rest."""
    if before is None:
        x0, B, N = problem.x0, problem.B, problem.N
        U = problem.cost.rest_controls(x0.new_zeros(B, N, 4))
        X, K = x0.unsqueeze(1).repeat(1, N + 1, 1), x0.new_zeros(B, N, 4, 14)
        penalty = torch.full_like(x0[:, 0], 1.0)
    else:
        C = problem.B // before.X.shape[0]
        X, U, K = (shifted(part).repeat(C, *[1] * (part.dim() - 1)) for part in (before.X, before.U, before.K))
        X[:, -1] = resting(X[:, -1], airframe_of(problem.dynamics))
        U[:, -1] = problem.cost.rest_controls(U[:, -1:])[:, 0]
        X, U = within_bounds(problem, X, U, K)
        penalty = before.penalty.repeat(C)
    none = torch.zeros(problem.B, dtype=torch.int64)
    return Plan(
        X, U.nan_to_num(), K, Multipliers.zero(problem, 1.0), penalty, problem.cost.total(X, U),
        problem.x0.new_zeros(problem.B), torch.ones(problem.B, dtype=torch.bool), none, none.clone(),
        problem.x0, problem.x0[:, :3], problem.dynamics, 0, none.bool(),
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
