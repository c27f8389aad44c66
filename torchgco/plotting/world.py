"""The obstacles of a problem in the form that maps show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from torchgco.obstacles.base import Obstacles
from torchgco.obstacles.body import BoundBody
from torchgco.plotting.bodies import Plane, Solid, solids
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
    single = problem.take(torch.tensor([b], device=problem.x0.device))
    by_radius: dict[float, list[Solid]] = {}
    others, maps = [], []
    for whole in single.obstacles:
        core = whole.inscribed
        vehicle = 0.0 if whole.body is not None else float(core.vehicle_radius[0])  # its balls are drawn instead
        if core.map is not None:
            maps.append((vehicle, core.map.field.single(int(core.map.which[0]))))
        elif (shapes := core.shapes(0)) is not None:
            by_radius.setdefault(vehicle, []).extend(solids(shapes))
        else:
            others.append(core)
    start = single.x0[:, single.position].cpu().numpy()
    goal, radius = np.full_like(start, np.nan), np.nan
    if single.goal is not None:
        goal, radius = single.goal.position.cpu().numpy(), float(single.goal.radius[0])
    dt = float(getattr(single.dynamics, "dt", None) or 0.0)
    none: dict[float, list[Solid]] = {} if maps else {0.0: []}
    scenes = [
        Scene((tuple(bodies),), start, goal, vehicle, radius, dt, np.array([b]))
        for vehicle, bodies in (by_radius or none).items()
    ]
    scenes += [Scene(((),), start, goal, vehicle, radius, dt, np.array([b]), field) for vehicle, field in maps]
    return World(tuple(scenes), tuple(others), tuple(single.obstacles), body_of(single))


def distances(part: Obstacles, box: np.ndarray, plane: Plane, z: float, t: float = 0.0) -> tuple[np.ndarray, ...]:
    """Grids (V, W) of two coordinates in a plane, m, and the least signed distance there from obstacles at t, s.

    Args:
        box: corners (2, 2), m, of what is seen of the plane.
        z: the hidden coordinate, m.
    """
    like = part.vehicle_radius
    low, high = box
    rows = max(2, round(GRID_POINTS * float((high - low)[1] / (high - low)[0])))
    x, y = np.meshgrid(np.linspace(low[0], high[0], GRID_POINTS), np.linspace(low[1], high[1], rows))
    points = np.full((x.size, part.position.stop - part.position.start), z)
    points[:, plane[0]], points[:, plane[1]] = x.ravel(), y.ravel()
    p = torch.as_tensor(points, dtype=like.dtype, device=like.device).unsqueeze(0)
    apart = part.signed_distance(p, p.new_full((p.shape[1],), t))[0]
    least = apart.amin(-1) if apart.shape[-1] else torch.full_like(p[0, :, 0], torch.inf)
    return x, y, least.cpu().numpy().reshape(x.shape)
