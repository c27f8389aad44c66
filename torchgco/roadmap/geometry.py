"""The geometry that the search works on: obstacles by their kind, scenes of them, and points along polylines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import torch
from torch import Tensor

from torchgco.base.shapes import CPU, computing_on
from torchgco.base.tree import cast, moved, take
from torchgco.maps.field import BoundField
from torchgco.obstacles.base import TINY, Solids
from torchgco.obstacles.box_geometry import Cuboids

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
