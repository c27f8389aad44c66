"""A plan along the shortest way between the obstacles: the geometric proposal of guidance.

The way says where to pass; iLQR finds the controls that follow it, drawn into a narrow tube that travels along it,
slowly enough for the vehicle to turn. What comes out is rarely cheap and need not be quite free of contact: it is where
the solver goes on from, with a penalty that keeps it on this side of every obstacle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchgco.constraints.obstacles import BoundSpheres, GuideRegion
from torchgco.guidance.roadmap import FAR, Roadmap, Scene, points_along
from torchgco.lagrangian import Multipliers
from torchgco.problem import Problem
from torchgco.shapes import InputError
from torchgco.solvers.ilqr import ILQR
from torchgco.solvers.line_search import LineSearch


class Proposal(NamedTuple):
    """Controls to go on from."""

    U: Tensor  # (B, N, m)
    found: Tensor  # (B,) bool: whether there is a way; where not, U means nothing
    penalty: Tensor  # (B,): mu that keeps the solver from falling back


@dataclass(frozen=True)
class Detour:
    """Follow the shortest way around static spheres.

    Penalties are given without units, against q0, the stage cost of resting at the start, L, the distance to the goal,
    and R, the mean r_obs + r_veh.

    Args:
        roadmap: finds the way.
        begin, end: the shares of the horizon at which the vehicle sets out and arrives.
        smoothing: the share of the horizon over which the way's corners are averaged.
        tube: radius of the tube, as a share of R.
        stiffness: one solve after the other, how strongly the tube draws, in q0 / L^2.
        obstacle_penalty: of the spheres meanwhile, in q0 / R^4.
        hold: penalty that the solver is to go on with, in q0 / R^4.
        iterations: of each solve, at most.

    Raises:
        InputError: a field out of its range.
    """

    roadmap: Roadmap = Roadmap()
    begin: float = 0.0
    end: float = 0.9
    smoothing: float = 0.08
    tube: float = 0.05
    stiffness: tuple[float, ...] = (20.0, 200.0)
    obstacle_penalty: float = 10.0
    hold: float = 80.0
    iterations: int = 20

    def __post_init__(self) -> None:
        if not isinstance(self.roadmap, Roadmap):
            raise InputError("detour.roadmap", "a Roadmap", self.roadmap)
        if not 0 <= self.begin < self.end <= 1:
            raise InputError("detour.begin", f"at least 0 and below end, {self.end}", self.begin)
        if not 0 <= self.smoothing < 1:
            raise InputError("detour.smoothing", "at least 0 and below 1", self.smoothing)
        for name in ("tube", "obstacle_penalty", "hold"):
            if not getattr(self, name) > 0:
                raise InputError(f"detour.{name}", "above 0", getattr(self, name))
        if not self.stiffness or not all(value > 0 for value in self.stiffness):
            raise InputError("detour.stiffness", "one or more numbers above 0", self.stiffness)
        if self.iterations < 1:
            raise InputError("detour.iterations", "at least 1", self.iterations)

    def propose(self, problem: Problem) -> Proposal:
        """A plan for every problem, from the vehicle at rest."""
        rest = problem.cost.rest_controls(problem.x0.new_zeros(problem.B, problem.N, problem.m))
        scene, goal = _scene(problem, rest), problem.cost.goal(problem.x0)
        if scene is None or goal is None:
            nowhere = torch.zeros(problem.B, dtype=torch.bool, device=rest.device)
            return Proposal(rest, nowhere, torch.full_like(rest[:, 0, 0], torch.nan))
        way, found = self.roadmap.ways(scene)
        q0 = _resting_cost(problem, rest, scene.start.unsqueeze(1))[:, 0]
        L2 = (scene.goal - scene.start).square().sum(-1)
        here = scene.distances > 0
        R = torch.where(here, scene.distances, 0.0).sum(-1) / here.sum(-1).clamp(min=1)
        U, radius, unit = rest, self.tube * R, q0 / R.pow(4)
        found = found & torch.isfinite(unit) & (q0 > 0)
        center, mu = self._travel(way, problem.N), torch.where(found, unit, 1.0)
        inner, duals = self._inner(), replace(Multipliers.zero(problem, 0.0), mu=self.obstacle_penalty * mu)
        for stiffness in self.stiffness:
            # Near its surface the tube is as stiff as a spring of 4 weight radius^2.
            weight = stiffness * q0 / L2.clamp(min=1e-12) / (4.0 * radius.square()).clamp(min=1e-12)
            guide = GuideRegion(center, radius.unsqueeze(-1).repeat(1, problem.N + 1), weight, _position(problem))
            U = inner.solve(problem, U, warm=duals, guide=guide).U
        return Proposal(U, found, self.hold * mu)

    def _inner(self) -> ILQR:
        return ILQR(
            tolerance=0.1, max_iterations=self.iterations, damping=1.0, line_search=LineSearch(accept_last=False)
        )

    def _travel(self, way: Tensor, N: int) -> Tensor:
        """Where the tube is at every knot, (B, N+1, d): speeding up and slowing down smoothly, corners rounded."""
        share = torch.arange(N + 1, dtype=way.dtype, device=way.device) / N
        share = ((share - self.begin) / (self.end - self.begin)).clamp(0.0, 1.0)
        share = share.square() * (3.0 - 2.0 * share)
        length = (way[:, 1:] - way[:, :-1]).square().sum(-1).sqrt().sum(-1, keepdim=True)
        center = points_along(way, share * length)
        reach = int(0.5 * self.smoothing * N)
        if reach == 0:
            return center
        padded = torch.cat((center[:, :1].expand(-1, reach, -1), center, center[:, -1:].expand(-1, reach, -1)), dim=1)
        return padded.unfold(1, 2 * reach + 1, 1).mean(-1)


def _position(problem: Problem) -> slice:
    position = problem.dynamics.position
    if position is None:
        raise InputError("guidance", "dynamics with a position", type(problem.dynamics).__name__)
    return position


def _scene(problem: Problem, rest: Tensor) -> Scene | None:
    """Start, goal and spheres; None where there are none, or others, or they move."""
    spheres = [c for c in problem.geometric if isinstance(c, BoundSpheres) and c.velocities is None]
    goal = problem.cost.goal(problem.x0)
    if not spheres or len(spheres) < len(problem.geometric) or goal is None:
        return None
    at = _position(problem)

    def toll(points: Tensor, rows: Tensor) -> Tensor:
        part = problem.take(rows)
        price, first = (_resting_cost(part, rest[rows], p) for p in (points, part.x0[:, None, at]))
        return price.clamp(min=0.0) / first.clamp(min=1e-12) + 0.1

    return Scene(
        problem.x0[:, at], goal[:, at],
        torch.cat([c.centers for c in spheres], dim=1),
        torch.cat([torch.where(c.absent, FAR, c.distances) for c in spheres], dim=1),
        toll,
    )  # fmt: skip


def _resting_cost(problem: Problem, rest: Tensor, points: Tensor) -> Tensor:
    """Stage cost (B, V) of resting at points (B, V, d)."""
    x = problem.x0.unsqueeze(1).repeat(1, points.shape[1], 1)
    x[..., _position(problem)] = points
    u = rest[:, :1].expand(-1, points.shape[1], -1)
    return problem.cost.stage(x, u, 0)
