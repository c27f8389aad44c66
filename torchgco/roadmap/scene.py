"""A problem as the search sees it: start, goal, the obstacles between, and their scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import torch
from torch import Tensor

from torchgco.base.shapes import repeated
from torchgco.base.tree import LastTaken
from torchgco.constraints.gates import gates_of
from torchgco.costs.base import Cost
from torchgco.maps.field import BoundField
from torchgco.obstacles.base import Obstacles, Solids
from torchgco.obstacles.box_geometry import Cuboids
from torchgco.problem.problem import Problem
from torchgco.roadmap.geometry import Inflated, Scene

LEAST_STAGE_COST = 1e-6  # in units of cost: a smaller stage cost says nothing about the goal
S = TypeVar("S", bound=Solids)
FALLEN_BACK = 0.25  # share of the distance from start to goal; candidates that end farther from the goal are dropped


def scene_of(problem: Problem, rest: Tensor) -> Scene | None:
    """Start, goal and obstacles, and the cost of being at a point under the controls `rest` (B, N, m).

    A body counts as the ball about its position that it holds: what bars the way of that, bars the body's.
    Obstacles that don't hold at the last knot are left out: only those that stay bar a path. None without a goal or
    obstacles, with obstacles that the roadmap can't take, or if space is neither 2-D nor 3-D.
    """
    found, at = _barring(problem), problem.position
    if found is None:
        return None
    assert problem.goal is not None
    obstacles = _by_kind(problem.x0[:, at], *found)
    parts = problem.cost, problem.x0, rest[:, :1]
    first = _resting_cost(*parts, at, problem.x0[:, None, at]).clamp(min=1e-12)
    some = LastTaken((*parts, first))

    def traversal_cost(points: Tensor, rows: Tensor) -> Tensor:
        cost, x0, u, unit = some.take(rows)
        return _resting_cost(cost, x0, u, at, points).clamp(min=0.0) / unit + 0.1

    gates = gates_of(problem)
    centers = None if gates is None else gates.centers
    return Scene(problem.x0[:, at], problem.goal.position, obstacles, traversal_cost, centers)


def has_maps(problem: Problem) -> bool:
    """Whether there are maps among the obstacles."""
    return any(part.map is not None for part in problem.obstacles)


def around_body(problem: Problem, scene: Scene) -> Scene | None:
    """The same scene as the ball meets it that holds the body; None without a body."""
    bodies = [part.body for part in problem.obstacles if part.body is not None]
    if not bodies:
        return None
    more = torch.stack([part.overhang for part in bodies]).amax(0)
    spheres, boxes, maps = scene.obstacles
    grown = None if boxes is None else boxes.grown(more)
    return replace(scene, obstacles=Inflated(spheres.grown(more), grown, tuple(part.grown(more) for part in maps)))


def has_paths(problem: Problem) -> bool:
    """Whether there is a goal, and obstacles among which the roadmap can seek a path to it."""
    if problem.dynamics.position is None:
        return False
    if problem.known.paths is None:
        problem.known.paths = _barring(problem.take(slice(0, 1))) is not None
    return problem.known.paths


def _barring(problem: Problem) -> tuple[list[Solids], tuple[BoundField, ...]] | None:
    """The bodies and the maps among which the roadmap can seek a path; None where there are none, or it can't."""
    lasting = [c.inscribed if isinstance(c, Obstacles) else c for c in problem.geometric if c.holds_at(problem.N)]
    maps = tuple(c for c in lasting if isinstance(c, BoundField))
    parts = [c.inflated() if isinstance(c, Obstacles) else None for c in lasting if not isinstance(c, BoundField)]
    known, at = [part for part in parts if part is not None], problem.position
    if len(known) < len(parts) or problem.goal is None or at.stop - at.start not in (2, 3):
        return None
    bodies = [part for part in known if part.radii.shape[1] > 0]
    return (bodies, maps) if bodies or maps else None


def _by_kind(start: Tensor, parts: Sequence[Solids], maps: tuple[BoundField, ...]) -> Inflated:
    """The spheres and the boxes among obstacles of problems with starts (B, d)."""
    boxes = _joined([part for part in parts if isinstance(part, Cuboids)])
    spheres = _joined([part for part in parts if not isinstance(part, Cuboids)])
    if spheres is None:
        zero = torch.zeros_like(start[:, :1])
        spheres = Solids(start.unsqueeze(1), zero, torch.ones_like(zero, dtype=torch.bool))  # one that is absent
    return Inflated(spheres, boxes, maps)


def _joined(parts: Sequence[S]) -> S | None:
    """All obstacles of one kind; None where there are none."""
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return type(parts[0])(*(torch.cat(column, dim=1) for column in columns)) if parts else None


def scales(problem: Problem, scene: Scene, rest: Tensor) -> tuple[Tensor, Tensor]:
    """R and q0 / R^4 (B,), the units of lengths and penalties, for problems in units of cost.

    R is the mean size of the obstacles, m. q0 is the stage cost of resting at the start, or, where only the
    terminal cost depends on the goal, the mean cost per stage of staying there.
    """
    sizes = scene.obstacles.scales
    R = sizes.sum(-1) / (sizes > 0).sum(-1).clamp(min=1)
    resting = _resting_cost(problem.cost, problem.x0, rest[:, :1], problem.position, scene.start.unsqueeze(1))[:, 0]
    ends_matter = (resting.abs() < LEAST_STAGE_COST) & (scene.start != scene.goal).any(-1)
    return R, torch.where(ends_matter, 1.0, resting) / R.pow(4)


def arrives(problem: Problem, X: Tensor) -> Tensor:
    """Whether candidates X (B, ..., N+1, n) end near the goal, (B, ...): looser than the goal tolerance."""
    at = problem.position
    assert problem.goal is not None
    first = problem.goal.distance(problem.x0[:, at]).view(-1, *([1] * (X.dim() - 3)))
    return problem.goal.distance(X[..., -1, at]) <= FALLEN_BACK * first


def control_reach(problem: Problem, rest: Tensor, signs: Tensor) -> Tensor:
    """Range (B, P, m) of the controls from rest (B, N, m), stage 0, to the bound that a sign (P, m) points to.

    Where there is no bound, 1.
    """
    if problem.control_bounds is None:
        return torch.ones_like(signs).expand(rest.shape[0], *signs.shape)
    reach = problem.control_bounds.range_from(rest[:, :1], signs)
    return torch.where(torch.isfinite(reach), reach, 1.0)


def _resting_cost(cost: Cost, x0: Tensor, u: Tensor, at: slice, points: Tensor) -> Tensor:
    """Stage cost (B, V) of resting at points (B, V, d) under u (B, 1, m); the position is at `at` in x0 (B, n)."""
    x = repeated(x0, points.shape[1])
    x[..., at] = points
    return cost.stage(x, u.expand(-1, points.shape[1], -1), 0)
