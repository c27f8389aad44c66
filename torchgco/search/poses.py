"""Manoeuvres of a body with a heading: paths of its whole pose, forwards and backwards, that keep every ball clear.

A path of the ball that a body holds says nothing of the heading: before an opening hardly wider than the body it leads
in from aside, where the body can't turn. This search is over positions and heading: from one pose to the next the
vehicle drives a short arc of a curvature that it can steer, or turns on the spot where it can. Dolgov, Thrun,
Montemerlo, Diebel, Path planning for autonomous vehicles in unknown semi-structured environments, IJRR 29 (2010): the
cells of their hybrid A*.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchgco.obstacles.base import Obstacles
from torchgco.problem.problem import Problem
from torchgco.roadmap.lattice import Array

CURVATURES = -1.0, -0.5, 0.0, 0.5, 1.0  # of the arcs, as shares of the tightest
TIGHTEST = 0.9  # share of the vehicle's largest curvature: steering from side to side takes a part of the way, too
ARC_LENGTH = 0.5  # length of an arc in radii of the largest ball
CELL = 0.6  # side of a cell as a share of an arc: each arc leaves its cell; with 0.7 two of 12 slots had no path
CUSP = 2.0  # arcs that a change between forwards and backwards costs: the vehicle stops and steers again
GREED = 1.3  # times the rest of the way through rooms counts: a tenth of the poses, for a way hardly longer
END_POSE_ARCS = 0.5  # arcs within which a pose counts as that at the end of the path
POSES_AT_ONCE = 2048  # poses that are measured together: bounds the memory
MOST_POSES = 1_000_000  # poses that are kept, at most: bounds the time, to about six seconds


@dataclass(frozen=True, eq=False)
class Poses:
    """What a search for manoeuvres needs.

    Args:
        clear: whether the body keeps clear at poses (K, 3): x and y, m, and heading, rad.
        curvature: the largest, 1/m.
        step: length of an arc, m.
        on_the_spot: whether the vehicle turns where it stands, too, by as much as over an arc of that curvature.
        rest: ways (K,), m, from poses (K, 3) to the target, at least; infinite where none leads there. None: straight.
    """

    clear: Callable[[Array], NDArray[np.bool_]]
    curvature: float
    step: float
    on_the_spot: bool = False
    rest: Callable[[Array], Array] | None = None

    def path(self, root: Array, target: Array) -> Array | None:
        """Poses (P, 3) from a root to a target, (3,), whose heading may be NaN: free; None where none is found."""
        search = _Wave(self, root, target)
        while search.open:
            reached = search.expand()
            if reached is not None:
                return search.back(reached)
        return None


class _Wave:
    """Poses in the order of the way to them and the straight rest of it, all of about the same together."""

    def __init__(self, space: Poses, root: Array, target: Array) -> None:
        self.space, self.target = space, target
        self.poses, self.parents = [root[None]], [np.array([-1])]
        self.count = 1
        self.open: dict[int, list[tuple[Array, Array, Array, NDArray[np.int64]]]] = {}
        zero = np.zeros(1)
        self.seen = set(self._cell(root[None], zero).tolist())
        self._push(root[None], zero, zero, np.zeros(1, np.int64))

    def expand(self) -> int | None:
        """Drive all arcs from the nearest open poses; the place of one at the target, if it is among them."""
        pose, way, ahead, place = (np.concatenate(part) for part in zip(*self.open.pop(min(self.open)), strict=True))
        near = self._near(pose)
        if near.any():
            return int(place[near][way[near].argmin()])
        if self.count > MOST_POSES:
            self.open.clear()
            return None
        s, k = self.space.step, TIGHTEST * self.space.curvature
        arcs = [(sign * s, sign * s * (c * k)) for sign in (1.0, -1.0) for c in CURVATURES]
        arcs += [(0.0, s * k), (0.0, -s * k)] if self.space.on_the_spot else []
        ds, by = (np.tile(part, len(pose)) for part in np.array(arcs).T)
        old, parent, from_, was = (np.repeat(part, len(arcs), axis=0) for part in (pose, place, way, ahead))
        turned = old[:, 2] + by
        mean = 0.5 * (old[:, 2] + turned)
        new = np.stack((old[:, 0] + ds * np.cos(mean), old[:, 1] + ds * np.sin(mean), turned), axis=1)
        far = from_ + 1.0 + CUSP * (was * ds < 0)
        cells = self._cell(new, ds)
        order = np.argsort(far, kind="stable")
        cells, first = np.unique(cells[order], return_index=True)
        names = cells.tolist()
        some = order[first[[cell not in self.seen for cell in names]]]
        if len(some) == 0:
            return None
        good = self.space.clear(new[some])
        self.seen.update(names)
        some = some[good]
        if len(some) > 0:
            at = self.count + np.arange(len(some))
            self.poses.append(new[some])
            self.parents.append(parent[some])
            self.count += len(some)
            self._push(new[some], far[some], np.sign(ds[some]), at)
        return None

    def back(self, place: int) -> Array:
        """The poses (P, 3) from the root to one."""
        poses, parents, found = np.concatenate(self.poses), np.concatenate(self.parents), []
        while place >= 0:
            found.append(place)
            place = int(parents[place])
        return poses[found[::-1]]

    def _push(self, pose: Array, way: Array, ahead: Array, place: NDArray[np.int64]) -> None:
        straight = np.hypot(*(pose[:, :2] - self.target[:2]).T)
        left = (straight if self.space.rest is None else GREED * self.space.rest(pose)) / self.space.step
        if not math.isnan(self.target[2]):
            turn = np.abs(pose[:, 2] - self.target[2]) / (TIGHTEST * self.space.curvature * self.space.step)
            left = np.maximum(left, turn)
        some = np.isfinite(left)
        pose, way, ahead, place, left = pose[some], way[some], ahead[some], place[some], left[some]
        bucket = np.floor(way + left).astype(np.int64)
        for one in np.unique(bucket):
            some = bucket == one
            self.open.setdefault(int(one), []).append((pose[some], way[some], ahead[some], place[some]))

    def _near(self, pose: Array) -> NDArray[np.bool_]:
        near = np.hypot(*(pose[:, :2] - self.target[:2]).T) <= END_POSE_ARCS * self.space.step
        if math.isnan(self.target[2]):
            return near
        return near & (np.abs(pose[:, 2] - self.target[2]) <= END_POSE_ARCS * self.space.curvature * self.space.step)

    def _cell(self, pose: Array, ahead: Array) -> NDArray[np.int64]:
        """A number for the cell of each pose, and the way it is driven to."""
        side = CELL * self.space.step
        x, y = (np.floor(pose[:, a] / side).astype(np.int64) + 2**19 for a in (0, 1))
        heading = pose[:, 2]
        if self.space.on_the_spot and math.isnan(self.target[2]):
            heading = heading % (2.0 * math.pi)  # it needn't turn back
        turn = np.floor(heading / (CELL * self.space.curvature * self.space.step)).astype(np.int64) + 2**15
        return ((x << 20 | y) << 17 | turn << 1) | (ahead < 0)


def clear_at(problem: Problem, heading: int) -> Callable[[Array], NDArray[np.bool_]]:
    """Whether the vehicle of a batch of one keeps clear of all obstacles at poses (K, 3)."""
    at, x0 = problem.position, problem.x0

    def clear(poses: Array) -> NDArray[np.bool_]:
        states = x0.unsqueeze(1).repeat(1, len(poses), 1)
        states[0, :, at], states[0, :, heading] = x0.new_tensor(poses[:, :2]), x0.new_tensor(poses[:, 2])
        good = torch.ones(len(poses), dtype=torch.bool, device=x0.device)
        for part in problem.obstacles:
            for some in good.nonzero().flatten().split(POSES_AT_ONCE):
                good[some] = _clear(part, states[:, some])
        return good.cpu().numpy()

    return clear


def _clear(part: Obstacles, states: Tensor) -> Tensor:
    """Whether the vehicle in states (1, K, n) touches none of some obstacles, (K,)."""
    if part.margins.shape[-1] == 0:
        return torch.ones_like(states[0, :, 0], dtype=torch.bool)
    inner = _room(part.inscribed, states[..., part.position])
    good, body = inner >= 0.0, part.body
    if body is None:
        return good
    near = (good & (inner < body.overhang[0])).nonzero().flatten()  # others are clear anyhow
    if near.numel() == 0:
        return good
    centers = body.places(states[:, near])
    for size in body.radii[0].unique():
        own = (body.radii[0] == size).nonzero().flatten()
        ball, p = body.balls[int(own[0])], centers[:, :, own]
        good[near] &= (_room(ball, p.flatten(1, 2)) >= 0.0).view(p.shape[1:3]).all(-1)
    return good


def _room(balls: Obstacles, p: Tensor) -> Tensor:
    """How far (K,), m, a ball at points (1, K, d) is from touching obstacles."""
    away = balls.signed_distance(p, p.new_zeros(p.shape[1]))[0]
    return (away + balls.contact_depths).amin(-1)
