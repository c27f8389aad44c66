"""A problem as the search sees it: start, goal, the spheres between, and their scales."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.constraints.bounds import ControlBounds
from torchgco.constraints.obstacles import BoundSpheres
from torchgco.problem import Problem
from torchgco.search.geometry import FAR, Scene, segment_gaps

OPEN = 1e10  # a range of controls that is no range
FALLEN_BACK = 0.25  # share of the distance from start to goal; a candidate that ends farther away isn't one


def scene_of(problem: Problem, rest: Tensor) -> Scene | None:
    """Start, goal and spheres, with what it costs to be at a point under the controls `rest` (B, N, m).

    None where there are no spheres, or other obstacles too, or they move, or space is neither 2-D nor 3-D.
    """
    spheres = [c for c in problem.geometric if isinstance(c, BoundSpheres) and c.velocities is None]
    goal = problem.cost.goal(problem.x0)
    if sum(c.distances.shape[1] for c in spheres) == 0 or len(spheres) < len(problem.geometric) or goal is None:
        return None
    at = problem.position
    if at.stop - at.start not in (2, 3):
        return None

    first = _resting_cost(problem, rest, problem.x0[:, None, at]).clamp(min=1e-12)

    def traversal_cost(points: Tensor, rows: slice) -> Tensor:
        price = _resting_cost(problem, rest, points, rows)
        return price.clamp(min=0.0) / first[rows] + 0.1

    return Scene(
        problem.x0[:, at], goal[:, at],
        torch.cat([c.centers for c in spheres], dim=1),
        torch.cat([torch.where(c.absent, FAR, c.distances) for c in spheres], dim=1),
        traversal_cost,
    )  # fmt: skip


def scales(problem: Problem, scene: Scene, rest: Tensor) -> tuple[Tensor, Tensor]:
    """R and q0 / R^4 (B,), the units of lengths and penalties."""
    here = scene.inflated_radii > 0
    R = torch.where(here, scene.inflated_radii, 0.0).sum(-1) / here.sum(-1).clamp(min=1)
    return R, _resting_cost(problem, rest, scene.start.unsqueeze(1))[:, 0] / R.pow(4)


def arrives(problem: Problem, X: Tensor) -> Tensor:
    """Whether candidates X (B, ..., N+1, n) end near the goal, (B, ...): in a looser sense than that of a solution."""
    goal, at = problem.cost.goal(problem.x0), problem.position
    assert goal is not None
    first = (problem.x0 - goal)[:, at].square().sum(-1)
    shape = (-1, *([1] * (X.dim() - 3)))
    last = (X[..., -1, at] - goal[:, at].view(*shape, at.stop - at.start)).square().sum(-1)
    return last <= FALLEN_BACK**2 * first.view(shape)


def penetration(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """The deepest penetration of a trajectory into an obstacle at the knots, (B,), m."""
    rows = [c.worst(X, U) for c in problem.geometric]
    return torch.stack(rows).amax(0)


def chord_penetration(problem: Problem, X: Tensor) -> Tensor:
    """The deepest penetration of the segments between the knots of X (B, N+1, n) into a sphere, (B,), m."""
    p = X[..., problem.position]
    spheres = [c for c in problem.geometric if isinstance(c, BoundSpheres) and c.distances.shape[1] > 0]
    gaps = [
        segment_gaps(p[:, :-1], p[:, 1:], c.centers, torch.where(c.absent, FAR, c.distances)).amin(-1) for c in spheres
    ]
    return -torch.stack(gaps).amin(0)


def control_reach(problem: Problem, rest: Tensor, signs: Tensor) -> Tensor:
    """Range (B, P, m) of the controls from rest (B, N, m), stage 0, to the bound that a sign (P, m) points to.

    Where there is no bound, 1.
    """
    first = rest[:, :1]
    for constraint in problem.constraints:
        if isinstance(constraint, ControlBounds):
            reach = torch.where(signs > 0, constraint.upper.unsqueeze(1) - first, first - constraint.lower.unsqueeze(1))
            return torch.where(reach < OPEN, reach.clamp(min=0.0), 1.0)
    return torch.ones_like(signs).expand(first.shape[0], *signs.shape)


def _resting_cost(problem: Problem, rest: Tensor, points: Tensor, rows: slice = slice(None)) -> Tensor:
    """Stage cost (B', V) of resting at points (B', V, d) of some problems."""
    x = problem.x0[rows].unsqueeze(1).repeat(1, points.shape[1], 1)
    x[..., problem.position] = points
    u = rest[rows, :1].expand(-1, points.shape[1], -1)
    return problem.cost.take(rows).stage(x, u, 0)
