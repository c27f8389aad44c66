"""Paths to follow, and the trajectory without constraints to compare with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers
from torchgco.problem.problem import Problem
from torchgco.roadmap.geometry import Inflated, length
from torchgco.roadmap.homotopy import one_per_class
from torchgco.solvers.ilqr import ILQR, descend

NEAR = 0.1  # of the distance to the goal: the last part is approached slowly


class Free(NamedTuple):
    """The trajectories without constraints of B problems."""

    cost: Tensor  # (B,)
    share: Tensor  # (B,): of the horizon, until a tenth of the distance to the goal is left; infinite where never
    iterations: Tensor  # (B,) int64


@dataclass(frozen=True)
class Ways:
    """Paths of B problems, K each, and the units to follow them in."""

    paths: Tensor  # (B, K, P, d), m
    live: Tensor  # (B, K) bool: one per homotopy class
    R: Tensor  # (B,): mean inflated radius, m
    unit: Tensor  # (B,): q0 / R^4
    obstacles: Inflated
    free: Free | None = None

    def shares(self) -> Tensor:
        """Shares (B, K) of the horizon that each path would take at the speed without constraints."""
        assert self.free is not None
        ends = self.paths[:, :, 0] - self.paths[:, :, -1]
        lengths = length(self.paths.flatten(0, 1)).view(self.paths.shape[:2])
        stretch = lengths / ends.square().sum(-1).sqrt().clamp(min=1e-12)
        return (self.free.share.unsqueeze(-1) * stretch).nan_to_num(torch.inf)


def joined(few: Ways, more: Ways) -> Ways:
    """The paths of both searches, one per homotopy class."""
    paths = torch.cat((few.paths, more.paths), dim=1)
    found = torch.cat([ways.live.any(-1, keepdim=True).expand_as(ways.live) for ways in (few, more)], dim=1)
    live = one_per_class(paths, few.obstacles) & found
    return replace(few, paths=paths, live=live)


def unconstrained(problem: Problem, rest: Tensor, inner: ILQR) -> Free:
    """The trajectories without constraints, from the controls `rest` (B, N, m)."""
    end, _ = descend(inner, plain(problem), rest)
    assert problem.goal is not None
    left = problem.goal.distance(end.X[..., problem.position])
    near = left <= NEAR * left[:, :1]
    share = near.to(torch.int8).argmax(-1).to(left) / problem.N
    return Free(end.cost, torch.where(near.any(-1), share, torch.inf), end.iterations)


def plain(problem: Problem) -> Lagrangian:
    """The cost alone: the constraints with multipliers and penalties of zero."""
    return Lagrangian(problem, Multipliers.zero(problem, 0.0), None, True)
