"""The geometry that the search works on: a problem as a scene of obstacles of each kind, and points along lines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self, TypeVar

import torch
from torch import Tensor

from torchgco.base.shapes import CPU, computing_on, repeated
from torchgco.base.tree import LastTaken, cast, moved, take
from torchgco.constraints.gates import gates_of
from torchgco.costs.base import Cost
from torchgco.maps.field import BoundField
from torchgco.obstacles.base import TINY, Obstacles, Solids
from torchgco.obstacles.box_geometry import Cuboids
from torchgco.problem.problem import Problem

DISTANCES_AT_ONCE = 2**18  # distances between points and obstacles that are held at once
AROUND = 1.5  # times as large as they are, obstacles lie within the region in which points are spread


class Inflated(NamedTuple):
    """Obstacles at rest of B problems, grown by the vehicle's radius: at least one sphere, which may be absent."""

    spheres: Solids
    boxes: Cuboids | None = None
    maps: tuple[BoundField, ...] = ()

    @property
    def kinds(self) -> tuple[Solids, ...]:
        """The kinds of spheres and boxes of which there are any."""
        return (self.spheres,) if self.boxes is None else (self.spheres, self.boxes)

    @property
    def sizes(self) -> Tensor:
        """The depth of each obstacle's deepest point beneath its surface, boxes last, (B, M'), m; 0 where absent."""
        return torch.cat([part.sizes for part in self.kinds], dim=1)

    @property
    def scales(self) -> Tensor:
        """The same, of maps too: a map counts as its cells."""
        maps = [torch.where(part.absent, 0.0, part.sizes) for part in self.maps]
        return torch.cat((self.sizes, *maps), dim=1)

    @property
    def largest(self) -> Tensor:
        """The largest size, (B, 1), m."""
        return self.scales.amax(-1, keepdim=True)

    def reduced(self, share: float) -> Self:
        """The same obstacles with radii reduced by this share."""
        spheres = replace(self.spheres, radii=(1.0 - share) * self.spheres.radii)
        boxes = None if self.boxes is None else replace(self.boxes, radii=(1.0 - share) * self.boxes.radii)
        return self._replace(
            spheres=spheres, boxes=boxes, maps=tuple(part.grown(-share * part.vehicle_radius) for part in self.maps)
        )

    def region(self, start: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """The lower and upper corner (B, d) around start, goal, and the obstacles, each `AROUND` times as large."""
        low, high = torch.minimum(start, goal), torch.maximum(start, goal)
        for part in self.kinds:
            wide, absent = AROUND * (part.extent + part.radii.unsqueeze(-1)), part.absent.unsqueeze(-1)
            low = torch.minimum(low, (part.centers - wide).masked_fill(absent, torch.inf).amin(1))
            high = torch.maximum(high, (part.centers + wide).masked_fill(absent, -torch.inf).amax(1))
        return low, high

    def deeper(self, points: Tensor, than: Tensor) -> Tensor:
        """Whether points (B, V, d) lie deeper than lengths (B,) >= 0, m, beneath the surface of an obstacle, (B, V)."""
        B, V = points.shape[:2]
        at_once = max(1, DISTANCES_AT_ONCE // max(1, V * self.scales.shape[1]))
        if at_once >= B:
            return self._deeper(points, than)
        parts = torch.arange(B, device=points.device).split(at_once)
        return torch.cat([take(self, rows)._deeper(points[rows], than[rows]) for rows in parts])

    def _deeper(self, points: Tensor, than: Tensor) -> Tensor:
        found = [part.deeper(points, than) for part in self.kinds]
        level = -than.view(-1, 1, 1)
        found += [(part.signed_distance(points, points.new_zeros(1)) < level).any(-1) for part in self.maps]
        return torch.stack(found).any(0)


@dataclass(frozen=True)
class Scene:
    """Start, goal and obstacles of B problems; lengths in m."""

    start: Tensor  # (B, d)
    goal: Tensor  # (B, d)
    obstacles: Inflated
    traversal_cost: Callable[[Tensor, Tensor], Tensor]  # per metre at points (B', V, d) of some problems, (B', V)
    gates: Tensor | None = None  # (B, G, d): which paths pass, in this order

    def on_cpu(self) -> Scene:
        """The same in double precision on the CPU, where C searches; what a metre costs is asked where problems lie."""
        here = self.start
        if here.dtype == torch.float64 and here.device.type == CPU.type:
            return self
        start, goal, obstacles, gates = moved(
            cast((self.start, self.goal, self.obstacles, self.gates), torch.float64), CPU
        )

        def cost(points: Tensor, rows: Tensor) -> Tensor:
            with computing_on(here.device):
                return self.traversal_cost(points.to(here), rows.to(here.device)).double().cpu()

        return Scene(start, goal, obstacles, cost, gates)

    def straight(self, edges: int, count: int) -> Tensor:
        """The straight line as `count` paths of each problem, (B, count, edges+1, d): the goal is repeated."""
        return torch.stack((self.start, self.goal), dim=1)[:, [0, *[1] * edges]].unsqueeze(1).repeat(1, count, 1, 1)

    def take(self, rows: Tensor) -> Scene:
        """The same of some problems."""
        cost, (obstacles, gates) = self.traversal_cost, take((self.obstacles, self.gates), rows)
        return Scene(self.start[rows], self.goal[rows], obstacles, lambda points, some: cost(points, rows[some]), gates)


def length(path: Tensor) -> Tensor:
    """Lengths (B,) of paths (B, P, d)."""
    return path.diff(dim=1).square().sum(-1).sqrt().sum(-1)


def points_along(path: Tensor, length: Tensor) -> Tensor:
    """Points (B, K, d) at arc lengths (B, K), m, on polylines (B, P, d)."""
    steps = (path[:, 1:] - path[:, :-1]).square().sum(-1).sqrt()
    reached = torch.cat((torch.zeros_like(steps[:, :1]), steps.cumsum(-1)), dim=1)
    right = torch.searchsorted(reached, length.contiguous(), right=True).clamp(1, path.shape[1] - 1)
    share = (length - reached.gather(1, right - 1)) / steps.gather(1, right - 1).clamp(min=TINY)

    def corner(index: Tensor) -> Tensor:
        return path.gather(1, index.unsqueeze(-1).expand(-1, -1, path.shape[-1]))

    return torch.lerp(corner(right - 1), corner(right), share.clamp(0.0, 1.0).unsqueeze(-1))


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
