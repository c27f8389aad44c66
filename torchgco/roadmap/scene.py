"""A problem as the search sees it: start, goal, the obstacles between, and their scales."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.constraints.bounds import ControlBounds
from torchgco.obstacles.base import Obstacles, least
from torchgco.obstacles.box_geometry import join
from torchgco.problem.problem import Problem
from torchgco.roadmap.geometry import FAR, Scene

OPEN = 1e10  # a range of controls at least this wide counts as unbounded
LITTLE = 1e-6  # in units of cost: a smaller stage cost says nothing about the goal
FALLEN_BACK = 0.25  # share of the distance from start to goal; candidates that end farther from the goal are dropped


def scene_of(problem: Problem, rest: Tensor) -> Scene | None:
    """Start, goal and obstacles, and the cost of being at a point under the controls `rest` (B, N, m).

    Obstacles that don't hold at the last knot are left out: only those that stay bar a path. None without a goal or
    obstacles, with obstacles that the roadmap can't take, or if space is neither 2-D nor 3-D.
    """
    forms = [c.inflated() if isinstance(c, Obstacles) else None for c in problem.geometric if c.holds_at(problem.N)]
    spheres = [form for form in forms if form is not None]
    boxes = join([form.boxes for form in spheres if form.boxes is not None and form.boxes.radius.shape[1] > 0])
    count = sum(c.inflated_radii.shape[1] for c in spheres)
    if (count == 0 and boxes is None) or len(spheres) < len(forms) or problem.goal is None:
        return None
    at = problem.position
    if at.stop - at.start not in (2, 3):
        return None

    first = _resting_cost(problem, rest, problem.x0[:, None, at]).clamp(min=1e-12)

    def traversal_cost(points: Tensor, rows: Tensor) -> Tensor:
        price = _resting_cost(problem, rest, points, rows)
        return price.clamp(min=0.0) / first[rows] + 0.1

    centers = torch.cat([c.centers for c in spheres], dim=1)
    inflated_radii = torch.cat([c.inflated_radii for c in spheres], dim=1)
    if count == 0:  # one absent sphere stands for none: maxima over spheres then exist
        centers = problem.x0[:, None, at]
        inflated_radii = torch.full_like(centers[..., 0], FAR)
    return Scene(problem.x0[:, at], problem.goal.position, centers, inflated_radii, traversal_cost, boxes)


def scales(problem: Problem, scene: Scene, rest: Tensor) -> tuple[Tensor, Tensor]:
    """R and q0 / R^4 (B,), the units of lengths and penalties, for problems in units of cost.

    R is the mean size of the obstacles, m. q0 is the stage cost of resting at the start, or, where only the
    terminal cost depends on the goal, the mean cost per stage of staying there.
    """
    here = scene.sizes > 0
    R = torch.where(here, scene.sizes, 0.0).sum(-1) / here.sum(-1).clamp(min=1)
    resting = _resting_cost(problem, rest, scene.start.unsqueeze(1))[:, 0]
    ends_matter = (resting.abs() < LITTLE) & (scene.start != scene.goal).any(-1)
    return R, torch.where(ends_matter, 1.0, resting) / R.pow(4)


def arrives(problem: Problem, X: Tensor) -> Tensor:
    """Whether candidates X (B, ..., N+1, n) end near the goal, (B, ...): looser than the goal tolerance."""
    at = problem.position
    assert problem.goal is not None
    first = problem.goal.distance(problem.x0[:, at]).view(-1, *([1] * (X.dim() - 3)))
    return problem.goal.distance(X[..., -1, at]) <= FALLEN_BACK * first


def penetration(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """The deepest penetration of a trajectory into an obstacle at the knots, (B,), m."""
    rows = [c.worst(X, U) for c in problem.geometric]
    return torch.stack(rows).amax(0)


def chord_penetration(problem: Problem, X: Tensor, share: float = 0.0) -> Tensor:
    """The deepest penetration of the segments between the knots of X (B, N+1, n) into obstacles, (B,), m.

    Counted from a `share` of an obstacle's margin beneath its surface; at most 0 where no segment lies deeper.
    """
    p = X[..., problem.position]
    obstacles = [c for c in problem.geometric if isinstance(c, Obstacles)]
    gaps = [c.segment_clearance(p[:, :-1], p[:, 1:]) + share * c.margins.unsqueeze(1) for c in obstacles]
    return -torch.stack([least(gap) for gap in gaps]).amin(0)


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


def _resting_cost(problem: Problem, rest: Tensor, points: Tensor, rows: Tensor | slice = slice(None)) -> Tensor:
    """Stage cost (B', V) of resting at points (B', V, d) of some problems."""
    x = problem.x0[rows].unsqueeze(1).repeat(1, points.shape[1], 1)
    x[..., problem.position] = points
    u = rest[rows, :1].expand(-1, points.shape[1], -1)
    return problem.cost.take(rows).stage(x, u, 0)
