"""A plan along a short way between the obstacles: the geometric proposal of guidance.

A way says where to pass; iLQR finds the controls that follow it, drawn to a point, or into a narrow tube, that travels
along it slowly enough for the vehicle to turn. Then nothing draws any more, and the path settles beside the obstacles
that it has come around. The shortest way is often not the cheapest to fly: several are followed, and the one that
settles best is handed over. It need not be quite free of contact: it is where the solver goes on from, with a penalty
that keeps it on this side of every obstacle. One that lies deep within obstacles is handed over to nobody: the solver
would spend a whole attempt on squeezing it out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchgco.constraints.guides import Guide, GuidePath, GuideRegion
from torchgco.constraints.obstacles import BoundSpheres
from torchgco.guidance.roadmap import FAR, Roadmap, Scene, points_along
from torchgco.lagrangian import Lagrangian, Multipliers
from torchgco.problem import Problem
from torchgco.rollout import open_loop
from torchgco.shapes import InputError
from torchgco.solvers.ilqr import ILQR
from torchgco.solvers.line_search import LineSearch

SURE = LineSearch(accept_last=False)
AT_ONCE = 1536  # ways followed at once: memory stays bounded, however large the batch
THERE = 0.25  # share of the distance from start to goal; a path that ends farther from it has fallen back


class Proposal(NamedTuple):
    """Controls to go on from."""

    U: Tensor  # (B, N, m)
    found: Tensor  # (B,) bool: whether there is a way; where not, U means nothing
    penalty: Tensor  # (B,): mu that keeps the solver from falling back


@dataclass(frozen=True)
class Detour:
    """Follow the shortest ways around static spheres, and keep the one that is cheapest to fly.

    Penalties are given without units, against q0, the stage cost of resting at the start, L, the distance to the goal,
    and R, the mean r_obs + r_veh.

    Args:
        roadmap: finds the ways.
        ways: how many are followed.
        keep: how many of these are settled, the cheapest as followed; None: all.
        begin, end: the shares of the horizon at which the vehicle sets out and arrives.
        smoothing: the share of the horizon over which the way's corners are averaged.
        tube: radius of the tube, as a share of R; None: no tube, but a spring to the point that travels. A spring is
            followed in half the iterations; for vehicles that can't move sideways the tube ends closer to the way.
        stiffness: one solve after the other, how strongly tube or spring draws, in q0 / L^2.
        obstacle_penalty: of the spheres meanwhile, in q0 / R^4.
        hold: penalty that the solver is to go on with, in q0 / R^4.
        tolerance: a solve ends where the penalised cost changes by less.
        iterations: of each solve, at most.
        settle: iterations that nothing draws, at most, after which the ways are compared; 0 compares them as followed.
        depth: how far into an obstacle a settled path may reach, as a share of R; one that lies deeper is refused.

    Raises:
        InputError: a field out of its range.
    """

    roadmap: Roadmap = Roadmap()
    ways: int = 1
    keep: int | None = None
    begin: float = 0.0
    end: float = 0.9
    smoothing: float = 0.08
    tube: float | None = 0.05
    stiffness: tuple[float, ...] = (20.0, 200.0)
    obstacle_penalty: float = 10.0
    hold: float = 80.0
    tolerance: float = 0.1
    iterations: int = 20
    settle: int = 20
    depth: float = 0.1

    def __post_init__(self) -> None:
        if not isinstance(self.roadmap, Roadmap):
            raise InputError("detour.roadmap", "a Roadmap", self.roadmap)
        if not 0 <= self.begin < self.end <= 1:
            raise InputError("detour.begin", f"at least 0 and below end, {self.end}", self.begin)
        if not 0 <= self.smoothing < 1:
            raise InputError("detour.smoothing", "at least 0 and below 1", self.smoothing)
        if self.tube is not None and not self.tube > 0:
            raise InputError("detour.tube", "above 0, or null", self.tube)
        for name in ("obstacle_penalty", "hold", "tolerance", "depth"):
            if not getattr(self, name) > 0:
                raise InputError(f"detour.{name}", "above 0", getattr(self, name))
        if not self.stiffness or not all(value > 0 for value in self.stiffness):
            raise InputError("detour.stiffness", "one or more numbers above 0", self.stiffness)
        for name, least in (("ways", 1), ("keep", 1), ("iterations", 1), ("settle", 0)):
            if getattr(self, name) is not None and getattr(self, name) < least:
                raise InputError(f"detour.{name}", f"at least {least}", getattr(self, name))

    def propose(self, problem: Problem, rank: Tensor | None = None) -> Proposal:
        """A plan for every problem, from the vehicle at rest, along the best of the ways or that of a rank (B,)."""
        rank = torch.zeros(problem.B, dtype=torch.int64, device=problem.x0.device) if rank is None else rank
        chunks = torch.arange(problem.B, device=rank.device).split(max(1, AT_ONCE // self.ways))
        if len(chunks) == 1:
            return self._propose(problem, rank)
        parts = [self._propose(problem.take(rows), rank[rows]) for rows in chunks]
        return Proposal(*(torch.cat(t) for t in zip(*parts, strict=True)))

    def _propose(self, problem: Problem, rank: Tensor) -> Proposal:
        rest = problem.cost.rest_controls(problem.x0.new_zeros(problem.B, problem.N, problem.m))
        scene = _scene(problem, rest)
        if scene is None:
            nowhere = torch.zeros(problem.B, dtype=torch.bool, device=rest.device)
            return Proposal(rest, nowhere, torch.full_like(rest[:, 0, 0], torch.nan))
        ways, found = self.roadmap.ways(scene, self.ways)
        R, unit = _scales(problem, scene, rest)
        found = found & torch.isfinite(unit) & (unit > 0)
        unit = torch.where(found, unit, 1.0)
        rows = torch.arange(problem.B, device=rest.device)
        each = rows.repeat_interleave(self.ways)
        part = problem.take(each)
        U = self._follow(part, rest[each], ways.flatten(0, 1), R[each], unit[each])
        best = self._order(part, U, unit[each], _arrives(part, U), self.ways)[:, : self._kept]
        U = U[(rows.unsqueeze(-1) * self.ways + best).flatten()]
        each = rows.repeat_interleave(self._kept)
        part = problem.take(each)
        U, sound = self._settle(part, U, R[each], unit[each])
        order = self._order(part, U, unit[each], sound, self._kept)
        chosen = rows * self._kept + order[rows, rank.clamp(max=self._kept - 1)]
        return Proposal(U[chosen], found & (rank < self._kept) & sound[chosen], self.hold * unit)

    @property
    def _kept(self) -> int:
        return self.ways if self.keep is None else min(self.keep, self.ways)

    def _follow(self, problem: Problem, U: Tensor, way: Tensor, R: Tensor, unit: Tensor) -> Tensor:
        """Controls that follow a way each, from U."""
        inner, none = self._inner(self.iterations), Multipliers.zero(problem, 0.0)
        for stiffness in self.stiffness:
            guide = self._guide(problem, way, R, stiffness * unit)
            U = inner.solve(problem, U, warm=replace(none, mu=self.obstacle_penalty * unit), guide=guide).U
        return U

    def _settle(self, problem: Problem, U: Tensor, R: Tensor, unit: Tensor) -> tuple[Tensor, Tensor]:
        """Controls that nothing draws any more, and whether their paths arrive and lie not too deep in obstacles."""
        if self.settle > 0:
            held = replace(Multipliers.zero(problem, 0.0), mu=self.hold * unit)
            settled = self._inner(self.settle).solve(problem, U, warm=held).U
            # A path that falls back into the trap, where waiting is cheaper, is none.
            keeps = _arrives(problem, settled) | ~_arrives(problem, U)
            U = torch.where(keeps.view(-1, 1, 1), settled, U)
        X = open_loop(problem.dynamics, problem.x0, U)
        return U, _arrives(problem, U) & (_depth(problem, X, U) <= self.depth * R)

    def _inner(self, iterations: int) -> ILQR:
        return ILQR(tolerance=self.tolerance, max_iterations=iterations, damping=1.0, line_search=SURE)

    def _order(self, problem: Problem, U: Tensor, unit: Tensor, first: Tensor, count: int) -> Tensor:
        """Each problem's `count` controls (rows beside each other) as places in their order, (B, count).

        Those in `first` come before the others; then the penalised cost decides.
        """
        held = replace(Multipliers.zero(problem, 0.0), mu=self.hold * unit)
        X = open_loop(problem.dynamics, problem.x0, U)
        merit = Lagrangian(problem, held, None, True).value(X, U)[1]
        order = merit.nan_to_num(torch.inf).view(-1, count).argsort(dim=-1, stable=True)
        later = (~first).view(-1, count).gather(1, order)
        return order.gather(1, later.to(torch.int8).argsort(dim=-1, stable=True))

    def _guide(self, problem: Problem, way: Tensor, R: Tensor, stiffness: Tensor) -> Guide:
        """What draws along the way; stiffness (B,) in units of q0 / (R^4 L^2)."""
        center, at = self._travel(way, problem.N), _position(problem)
        length2 = (way[:, -1] - way[:, 0]).square().sum(-1)
        spring = stiffness * R.pow(4) / length2.clamp(min=1e-12)
        if self.tube is None:
            return GuidePath(center, spring, at)
        radius = self.tube * R
        # Near its surface the tube is as stiff as a spring of 4 weight radius^2.
        weight = spring / (4.0 * radius.square()).clamp(min=1e-12)
        return GuideRegion(center, radius.unsqueeze(-1).repeat(1, problem.N + 1), weight, at)

    def _travel(self, way: Tensor, N: int) -> Tensor:
        """What is followed, at every knot, (B, N+1, d): speeding up and slowing down smoothly, corners rounded."""
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


def _arrives(problem: Problem, U: Tensor) -> Tensor:
    """Whether controls end close to the goal, (B,)."""
    goal = problem.cost.goal(problem.x0)
    assert goal is not None
    X = open_loop(problem.dynamics, problem.x0, U)
    last, first = ((x - goal)[:, _position(problem)].square().sum(-1) for x in (X[:, -1], problem.x0))
    return last <= THERE**2 * first


def _depth(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """How deep a path reaches into an obstacle, (B,), m."""
    rows = [c.violation(X, U).flatten(1).amax(-1) for c in problem.geometric]
    return torch.stack(rows).amax(0)


def _scales(problem: Problem, scene: Scene, rest: Tensor) -> tuple[Tensor, Tensor]:
    """R and q0 / R^4 (B,), the units of lengths and penalties."""
    here = scene.distances > 0
    R = torch.where(here, scene.distances, 0.0).sum(-1) / here.sum(-1).clamp(min=1)
    return R, _resting_cost(problem, rest, scene.start.unsqueeze(1))[:, 0] / R.pow(4)


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
