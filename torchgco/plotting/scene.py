"""Layouts and problems in the form that a map shows, and what a map asks of flights through them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from torchgco.judging import contact
from torchgco.judging.contact import deepest, map_depth, pieces
from torchgco.maps.distance import DistanceField
from torchgco.obstacles.base import CONTACT_FACTOR, Obstacles
from torchgco.plotting.bodies import Plane, Solid, bodies, solids
from torchgco.plotting.vehicle_body import VehicleBody
from torchgco.problem.problem import Problem
from torchgco.scenarios.layouts import map_of

Arrays = Mapping[str, np.ndarray]
SLACK = 0.12  # share of the scene's size by which obstacles and flights that miss the goal may widen a map
FREE_EDGE = 0.03  # share of the scene's size left free around it
STRAY = 1.0  # share of the scene's size by which a path may widen a map on each side; one that goes farther is cut


@dataclass(frozen=True, eq=False)
class Scene:
    """L layouts, lengths in metres.

    Args:
        bodies: the obstacles present in each layout.
        start, goal: (L, d), nan where unknown.
        margin: the vehicle's radius, 0 where unknown.
        goal_radius: nan where unknown.
        ids: (L,) index of each layout in its file or generator.
        map: of all layouts, or one of each, or None.
        body: the vehicle's, in the place of the margin; None: it is a ball.
        position: its place in the states of flights; None: they begin with it.
        gates: (L, G, d+1) centres and radii of balls to be passed in this order, nan where absent; or None.
        sized: the vehicle's size is known, and with it what is in contact.
        obstacles: those of each layout's problem, a batch of one each, which say what is in contact; None: its bodies
            and its map do.
    """

    bodies: tuple[tuple[Solid, ...], ...]
    start: np.ndarray
    goal: np.ndarray
    margin: float
    goal_radius: float
    ids: np.ndarray
    map: DistanceField | None = None
    gates: np.ndarray | None = None
    body: VehicleBody | None = None
    position: slice | None = None
    sized: bool = True
    obstacles: tuple[tuple[Obstacles, ...], ...] | None = None

    @property
    def dimension(self) -> int:
        return self.start.shape[1]

    def map_of(self, i: int) -> DistanceField | None:
        """The map of layout i; None where there is none."""
        return None if self.map is None else self.map.single(i)

    def others(self, i: int) -> list[Obstacles]:
        """The obstacles of layout i that are neither bodies nor a map."""
        cores = [whole.inscribed for whole in (self.obstacles or {i: ()})[i]]
        return [core for core in cores if core.map is None and core.shapes(0) is None]


class Pass(NamedTuple):
    """Where a flight passes an obstacle."""

    place: np.ndarray  # (d,) of the vehicle, m
    t: float  # s
    distance: float  # m, the least between the surfaces at full radii


def scene_of(
    layouts: Arrays,
    body: VehicleBody | None = None,
    position: slice | None = None,
    obstacles: Sequence[Sequence[Obstacles]] | None = None,
) -> Scene:
    """The scene of all layouts in the arrays of a layout file, for a vehicle that is a ball or has a body.

    Args:
        position: its place in the states of flights, and of starts and goals that aren't positions; None: the first.
        obstacles: those of the problems that are made of the layouts, a batch of one each; None: the layouts' own.
    """
    count, d = len(layouts["radii"]), np.shape(layouts["centers"])[2]

    def point(name: str) -> np.ndarray:
        states = np.asarray(layouts.get(name, np.full(d, np.nan)), dtype=float)
        columns = slice(d) if position is None or states.shape[-1] == d else position
        return np.broadcast_to(states[..., columns], (count, d))

    return Scene(
        bodies=tuple(bodies(layouts, i) if obstacles is None else _solids(obstacles[i]) for i in range(count)),
        start=point("start"),
        goal=point("goal"),
        margin=float(layouts.get("vehicle_radius", 0.0)) if body is None else 0.0,
        goal_radius=float(layouts.get("goal_radius", np.nan)),
        ids=np.asarray(layouts.get("layout", np.arange(count))),
        map=map_of(layouts),
        gates=gates_in(layouts),
        body=body,
        position=position,
        sized=body is not None or "vehicle_radius" in layouts,
        obstacles=None if obstacles is None else tuple(map(tuple, obstacles)),
    )


def _solids(obstacles: Sequence[Obstacles]) -> tuple[Solid, ...]:
    """Those of the obstacles of one problem that are balls and boxes."""
    cores = (whole.inscribed for whole in obstacles)
    shapes = (core.shapes(0) for core in cores if core.map is None)
    return tuple(solid for shape in shapes if shape is not None for solid in solids(shape))


def gates_in(layouts: Arrays) -> np.ndarray | None:
    """Centres and radii (L, G, d+1) of gates; None where there are none."""
    if layouts.get("gate_centers") is None:
        return None
    return np.concatenate((layouts["gate_centers"], np.asarray(layouts["gate_radii"])[..., None]), axis=-1)


def flown(path: np.ndarray) -> np.ndarray:
    """The knots (K, d) of a path (N+1, d) before the first one that isn't finite."""
    finite = np.isfinite(path).all(axis=1)
    return path if finite.all() else path[: int(finite.argmin())]


def passes(scene: Scene, i: int, path: np.ndarray, t: np.ndarray) -> list[Pass]:
    """Where a path (T, d) with times (T,), s, passes each obstacle of layout i; without one, each where it starts.

    An obstacle at rest is passed where the path has its x (where it has it several times, at the closest of these
    places), a moving one where it comes closest.
    """
    path, closest = flown(path), []
    step = np.abs(np.diff(path[:, 0])).max(initial=0.0)
    for body in scene.bodies[i]:
        if len(path) == 0:
            closest.append(Pass(body.at(0.0), 0.0, 0.0))
            continue
        apart = body.distance(path, t[: len(path)])
        k = int(apart.argmin())
        least = float(apart[k] - body.radius - scene.margin)
        if not body.moving:
            along = np.abs(path[:, 0] - body.center[0])
            k = int(np.where(along <= along.min() + 0.5 * step, apart, np.inf).argmin())
        closest.append(Pass(path[k], float(t[k]), least))
    return closest


def contacts(scene: Scene, i: int, path: np.ndarray, t: np.ndarray, states: np.ndarray | None = None) -> np.ndarray:
    """Places (C, d) where a path (T, d) touches obstacles or the map of layout i: the deepest of each contact.

    Bodies touch, and distances are measured, as by the judge; between even times (T,), s, the
    path is straight, and the states (T, n) change evenly, by which a vehicle's body turns.
    """
    dt = float(t[1]) if len(t) > 1 else 0.0
    if scene.obstacles is not None:
        kept = None if states is None else states[: len(flown(path))]
        return contact.contacts(scene.obstacles[i], flown(path), dt, kept)
    places, knots = pieces(flown(path))
    depth = np.full(max(len(places) - 1, 0), -np.inf)
    if len(places) == 0:
        return deepest(places, depth)
    balls = [(places, scene.margin)]
    if scene.body is not None and states is not None:
        centers = scene.body.balls(pieces(states[: len(flown(path))])[0]).swapaxes(0, 1)
        balls = list(zip(centers, scene.body.radii.tolist(), strict=True))
    for ball, margin in balls:
        for body in scene.bodies[i]:
            reach = CONTACT_FACTOR * (body.radius + margin)
            depth = np.maximum(depth, reach - body.along(ball, dt * knots, reach))
        if (field := scene.map_of(i)) is not None:
            depth = np.maximum(depth, map_depth(field, ball, margin))
    return deepest(places, depth)


def view(scene: Scene, shown: Iterable[int], whole: list[np.ndarray], others: list[np.ndarray]) -> np.ndarray:
    """Lower and upper corner (2, d), m, of a map of the layouts `shown`.

    Starts, goals, gates and the paths of `whole`, (N+1, d) each, are inside, and of `others` those that stay near these
    or on the map of cells or points. Obstacles and paths that go farther widen the picture only by a share of its size,
    as a long wall or a diverged path would shrink all the rest to a dot.
    """
    shown = list(shown)
    ring = np.nan_to_num(scene.goal_radius)
    ends = [scene.start[shown], scene.goal[shown] - ring, scene.goal[shown] + ring]
    if scene.gates is not None:
        balls = scene.gates[shown].reshape(-1, scene.dimension + 1)
        ends += [balls[:, :-1] - balls[:, -1:], balls[:, :-1] + balls[:, -1:]]
    edges = [_extent(body, scene.margin) for i in shown for body in scene.bodies[i] if not body.moving]
    if scene.map is not None:
        edges += [np.stack([low, high]) for low, high in zip(scene.map.origin, scene.map.upper, strict=True)]
    corners = _corners([*whole, *ends])
    if corners is None:
        corners = _corners(edges)
    if corners is None:
        corners = _corners(others)
    if corners is None:
        return np.stack([np.zeros(scene.dimension), np.ones(scene.dimension)])
    size = float(max(corners[1] - corners[0])) or 1.0
    widest = corners + STRAY * size * np.array([[-1.0], [1.0]])
    if scene.map is not None:
        low, high = scene.map.origin.min(0), scene.map.upper.max(0)
        widest = np.stack([np.minimum(widest[0], low), np.maximum(widest[1], high)])
    near = [path for path in others if bool(((path >= widest[0]) & (path <= widest[1])).all())]
    corners = _corners([*near, corners])
    assert corners is not None
    size = float(max(corners[1] - corners[0])) or 1.0
    reach = _corners([*edges, *others, corners])
    assert reach is not None
    box = np.clip(reach, corners[0] - SLACK * size, corners[1] + SLACK * size)
    return box + FREE_EDGE * size * np.array([[-1.0], [1.0]])


def leaving(box: np.ndarray, path: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Where a path (K, 2) leaves a picture with corners `box` (2, 2) for good, (2,), and its angle there, rad.

    None where it ends inside, or never was.
    """
    inside: np.ndarray = np.all((path >= box[0]) & (path <= box[1]), axis=1)
    if len(path) == 0 or inside[-1] or not inside.any():
        return None
    k = int(np.flatnonzero(inside)[-1])
    step = path[k + 1] - path[k]
    room = np.where(step > 0, box[1], box[0]) - path[k]
    share = float(np.divide(room, step, out=np.full(2, np.inf), where=step != 0).min())
    return path[k] + share * step, float(np.arctan2(step[1], step[0]))


def _extent(body: Solid, margin: float) -> np.ndarray:
    """Lower and upper corner (2, d) of a body at t = 0."""
    reach = body.radius + margin
    return np.stack([body.corners.min(axis=0) - reach, body.corners.max(axis=0) + reach])


def _corners(points: list[np.ndarray]) -> np.ndarray | None:
    """Lower and upper corner of the finite ones among (., d) points; None if there are none."""
    finite = [array[np.isfinite(array).all(axis=1)] for array in points]
    stacked = np.concatenate([np.empty((0, points[0].shape[1])), *finite]) if points else np.empty((0, 0))
    return np.stack([stacked.min(axis=0), stacked.max(axis=0)]) if len(stacked) else None


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
    body: VehicleBody | None = None

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
    none: dict[float, list[Solid]] = {} if maps else {0.0: []}
    scenes = [
        Scene((tuple(bodies),), start, goal, vehicle, radius, np.array([b]))
        for vehicle, bodies in (by_radius or none).items()
    ]
    scenes += [Scene(((),), start, goal, vehicle, radius, np.array([b]), field) for vehicle, field in maps]
    return World(tuple(scenes), tuple(others), tuple(single.obstacles), VehicleBody.of(single))


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
