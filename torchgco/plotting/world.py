"""The obstacles of a problem in the form that maps show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from torchgco.maps.field import BoundField
from torchgco.obstacles.base import Obstacles
from torchgco.obstacles.body import BoundBody
from torchgco.obstacles.boxes import BoundBoxes
from torchgco.obstacles.oscillating import BoundOscillatingBoxes
from torchgco.obstacles.spheres import BoundSpheres
from torchgco.plotting.bodies import Ball, Box, Plane, Solid
from torchgco.plotting.scene import Scene
from torchgco.plotting.silhouettes import body_of
from torchgco.problem.problem import Problem

GRID_POINTS = 160  # points along x at which the distance from other kinds of obstacles is looked at


@dataclass(frozen=True, eq=False)
class World:
    """The scenes of one problem, one for each radius of the vehicle and each map, and its obstacles of other kinds.

    Args:
        scenes: at least one; all have the same start and goal.
        others: bound obstacles that are neither spheres nor boxes nor a map, of this problem alone.
        obstacles: all of them, of this problem alone.
        body: the vehicle's; None where it is a ball.
    """

    scenes: tuple[Scene, ...]
    others: tuple[Obstacles, ...]
    obstacles: tuple[Obstacles, ...]
    body: BoundBody | None = None

    @property
    def first(self) -> Scene:
        return self.scenes[0]


def world_of(problem: Problem, b: int) -> World:
    """The obstacles, the start and the goal of problem b.

    Raises:
        InputError: dynamics without a position.
    """
    one = problem.take(torch.tensor([b], device=problem.x0.device))
    by_radius: dict[float, list[Solid]] = {}
    others, maps = [], []
    for whole in one.obstacles:
        part = whole.inscribed
        vehicle = 0.0 if whole.body is not None else float(part.vehicle_radius[0])  # its balls are drawn instead
        if isinstance(part, BoundSpheres | BoundBoxes | BoundOscillatingBoxes):
            by_radius.setdefault(vehicle, []).extend(_bodies(part))
        elif isinstance(part, BoundField):
            maps.append((vehicle, part.field.single(int(part.which[0]))))
        else:
            others.append(part)
    start = one.x0[:, one.position].cpu().numpy()
    goal, radius = np.full_like(start, np.nan), np.nan
    if one.goal is not None:
        goal, radius = one.goal.position.cpu().numpy(), float(one.goal.radius[0])
    dt = float(getattr(one.dynamics, "dt", None) or 0.0)
    none: dict[float, list[Solid]] = {} if maps else {0.0: []}
    scenes = [
        Scene((tuple(held),), start, goal, vehicle, radius, dt, np.array([b]))
        for vehicle, held in (by_radius or none).items()
    ]
    scenes += [Scene(((),), start, goal, vehicle, radius, dt, np.array([b]), field) for vehicle, field in maps]
    return World(tuple(scenes), tuple(others), tuple(one.obstacles), body_of(one))


def _bodies(part: BoundSpheres | BoundBoxes | BoundOscillatingBoxes) -> list[Solid]:
    if isinstance(part, BoundOscillatingBoxes):
        swings = torch.stack((part.amplitudes[0], part.rates[0], part.phases[0]), dim=1).cpu().numpy()
        here = swings[~part.absent[0].cpu().numpy()]
        return [replace(box, swing=own) for box, own in zip(_bodies(part.boxes), here, strict=True)]  # type: ignore
    centers, radii = part.centers[0].cpu().numpy(), (part.inflated_radii[0] - part.vehicle_radius[0]).cpu().numpy()
    here = np.flatnonzero(~part.absent[0].cpu().numpy())
    if isinstance(part, BoundSpheres):
        moves = np.zeros_like(centers) if part.velocities is None else part.velocities[0].cpu().numpy()
        return [Ball(centers[i], float(radii[i]), moves[i]) for i in here]
    halves, axes = part.half_sizes[0].cpu().numpy(), part.axes[0].cpu().numpy()
    return [Box(centers[i], halves[i], axes[i], max(0.0, float(radii[i]))) for i in here]


def distances(part: Obstacles, low: np.ndarray, high: np.ndarray, plane: Plane, at: float) -> tuple[np.ndarray, ...]:
    """Grids (V, W) of two coordinates in a plane, m, and the least signed distance there from obstacles at t = 0.

    Args:
        low, high: corners (d,), m, of what is seen.
        at: the hidden coordinate, m.
    """
    first, second = plane
    like = part.vehicle_radius
    wide, high_ = (high - low)[[first, second]]
    x, y = np.meshgrid(
        np.linspace(low[first], high[first], GRID_POINTS),
        np.linspace(low[second], high[second], max(2, round(GRID_POINTS * float(high_ / wide)))),
    )
    points = np.full((x.size, len(low)), at)
    points[:, first], points[:, second] = x.ravel(), y.ravel()
    p = torch.as_tensor(points, dtype=like.dtype, device=like.device).unsqueeze(0)
    apart = part.signed_distance(p, p.new_zeros(p.shape[1]))[0]
    least = apart.amin(-1) if apart.shape[-1] else torch.full_like(p[0, :, 0], torch.inf)
    return x, y, least.cpu().numpy().reshape(x.shape)
