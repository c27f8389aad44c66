"""Bodies with a heading, solved from manoeuvres: paths of the whole pose through what is hardly wider than the body.

The roadmap's paths are of the ball that the body holds. They lead from aside into openings where the body can't turn,
and no candidate along them backs up. A path of poses does, and the interior point starts close to it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
import torch
from torch import Tensor

from torchgco.kernels import chord_clearance
from torchgco.problem.problem import Problem
from torchgco.roadmap.geometry import Scene, scales, scene_of
from torchgco.roadmap.lattice import Array, Lattice
from torchgco.roadmap.mapped import Price, Ways, in_one, ways_of
from torchgco.search.candidates import Candidates
from torchgco.search.finish import EXTRA
from torchgco.search.poses import ARC_LENGTH, TIGHTEST, Poses, clear_at
from torchgco.search.search import Search
from torchgco.search.solved_candidates import solved
from torchgco.search.steering import SAME_MODEL, alike, sampled

GROWTH_ROUNDS = 3  # of solves, at most, each among larger obstacles than the one before
SPOT_TURN = 0.125  # rad that a vehicle turns on the spot from one pose to the next
PATH_PACES = 0.6, 0.8, 1.0  # shares of the horizon in which a path is driven: each is a start of the interior point
MANOEUVRES_TEXT = f"a path of poses, forwards and backwards, at {len(PATH_PACES)} paces; interior point from each"


@dataclass(frozen=True)
class Car:
    """A vehicle that drives along its heading, and turns by a curvature or on the spot.

    Args:
        heading, speed: places in the state.
        curvature: the largest that it can steer either way, 1/m; of one that turns on the spot, by which it turns
            over an arc as far as it is looked at there.
        radius: of the body's largest ball, m.
        on_the_spot: whether it turns at rest, too.
    """

    heading: int
    speed: int
    curvature: float
    radius: float
    on_the_spot: bool = False


def car(problem: Problem) -> Car | None:
    """The vehicle with a body of a batch of one that drives along its heading, by its equations; None of another."""
    bodies = [part.body for part in problem.obstacles if part.body is not None]
    if not bodies or not bool(torch.isfinite(problem.x0).all()):
        return None
    seen = sampled(problem)
    if seen is None:
        return None
    z, n, (heading, speed) = seen.z, problem.n, seen.places
    if any(part.points.attitude.of != heading or part.points.frames for part in bodies):  # a pose doesn't place parts
        return None
    radius = max(float(part.vehicle_radius.max()) for part in bodies)
    if not alike(seen.rates[:, heading], z[0, :, speed] * seen.slopes[:, heading, speed]):
        arc = TIGHTEST * ARC_LENGTH * radius
        return Car(heading, speed, SPOT_TURN / arc, radius, True) if radius > 0.0 else None
    on = (seen.slopes[:, heading].abs() > SAME_MODEL).any(0)
    on[speed] = False
    corners = z.repeat(1, 2, 1)
    low, high = seen.box
    ends = torch.where(z[0] > 0.5 * (low + high), high, low)
    corners[0, z.shape[1] :] = torch.where(on, ends, z[0])
    corners[..., speed] = 1.0
    turns = problem.dynamics.field(corners[..., :n], corners[..., n:])[0, :, heading]
    curvature = min(float(turns.max()), -float(turns.min()))
    return Car(heading, speed, curvature, radius) if curvature > 0.0 and radius > 0.0 else None


def manoeuvre(search: Search, on_the_spot: bool) -> None:
    """Solve the problems of bodies that haven't arrived from manoeuvres.

    Of vehicles that turn on the spot, or of others, of these also the ones that touch between knots. Where every
    trajectory from these touches between knots, too, they are solved again among obstacles that have grown.
    """
    if all(part.body is None for part in search.call.problem.obstacles):
        return
    best, limit = search.best.end.best, search.solver.violation_tolerance
    left = torch.zeros_like(best.violation, dtype=torch.bool)
    if not on_the_spot:
        left = (best.violation <= limit) & (chord_clearance(search.call.problem, best.X) < 0.0)
    left[search.rows("unarrived")] = True
    rows = left.nonzero().flatten()
    if rows.numel() == 0:
        return
    made = _made(search, rows, on_the_spot)
    if made is None:
        return
    rows, made = made
    grown = torch.zeros_like(made.R[:: made.count])
    for number in range(GROWTH_ROUNDS):
        ends = solved(search, rows, made, grown if number > 0 else None)
        good = ends.cost.isfinite()
        clearance = torch.full_like(ends.cost, torch.inf)
        some = good.nonzero().flatten()
        if some.numel() > 0:  # a map has no distances from nowhere
            clearance[some] = chord_clearance(made.of(some), ends.candidates.X[some])
        lacks = torch.where(good, clearance, -torch.inf).view(-1, made.count).amax(1)
        again = ((lacks < 0.0) & torch.isfinite(lacks)).nonzero().flatten()
        if again.numel() == 0 or search.call.late:
            return
        grown = grown[again] - EXTRA * lacks[again]
        rows, made = rows[again], made.of_problems(again)


def _made(search: Search, rows: Tensor, on_the_spot: bool) -> tuple[Tensor, Candidates] | None:
    """Those of the problems in `rows` that have manoeuvres, and these as candidates; None without any."""
    problem = search.call.problem.take(rows)
    rest = problem.cost.rest_controls(problem.x0.new_zeros(problem.B, problem.N, problem.m))
    scene = scene_of(problem, rest)
    if scene is None or scene.gates is not None:
        return None
    found = [
        _driven(problem.take(torch.tensor([b], device=rows.device)), scene, b, on_the_spot) for b in range(problem.B)
    ]
    some = [b for b, one in enumerate(found) if one is not None]
    if not some:
        return None
    at = torch.tensor(some, device=rows.device)
    search.best.worked[rows[at]] = True
    R, unit = scales(problem, scene, rest)
    U, live = rest[at].unsqueeze(1).repeat(1, len(PATH_PACES), 1, 1), torch.ones_like(R[at].bool())
    made = Candidates.begin(problem.take(at), U, R[at], unit[at], live.unsqueeze(1).expand(-1, len(PATH_PACES)))
    return rows[at], replace(made, X=torch.cat([one for one in found if one is not None]))


def _driven(problem: Problem, scene: Scene, b: int, on_the_spot: bool) -> Tensor | None:
    """States (len(PATH_PACES), N+1, n) of a batch of one along a manoeuvre to the goal; None where none is found.

    Args:
        scene, b: the problem as the search sees it, at a place among others.
    """
    vehicle = car(problem)
    if vehicle is None or vehicle.on_the_spot != on_the_spot:
        return None
    goal, at, heading = problem.goal, problem.position, vehicle.heading
    assert goal is not None
    start = torch.cat((problem.x0[0, at], problem.x0[0, heading : heading + 1])).double().cpu().numpy()
    end = np.append(goal.position[0].double().cpu().numpy(), np.nan)
    if goal.state is not None:
        end[2] = float(goal.state[0, heading])
    known = not np.isnan(end[2])
    rest = None
    if on_the_spot or scene.obstacles.maps:  # through rooms, or around all sides: the straight way says little
        rest = Rest.of(scene, b, int(not known))
        if rest is None:
            return None
    space = Poses(clear_at(problem, heading), vehicle.curvature, ARC_LENGTH * vehicle.radius, on_the_spot, rest)
    # Where the pose at the end is known, it is the one with less room, and the search begins there.
    path = space.path(end, start) if known else space.path(start, end)
    if path is None or len(path) < 2:
        return None
    if known:
        path = path[::-1]
    K = int(problem.stages[0])
    X = problem.x0.repeat(len(PATH_PACES), problem.N + 1, 1)
    for x, share in zip(X, PATH_PACES, strict=True):
        poses, speeds = driven_in_time(path, K, share, K * float(problem.dynamics.dt))
        x[: K + 1, at], x[: K + 1, heading] = x.new_tensor(poses[:, :2]), x.new_tensor(poses[:, 2])
        x[1 : K + 1, vehicle.speed] = x.new_tensor(speeds[1:])
        x[K + 1 :] = x[K]
    return X


@dataclass(frozen=True, eq=False)
class Rest:
    """The ways of the ball that a body holds from anywhere to start or goal, over the blocks of the roadmap.

    Args:
        lattice: of the roadmap.
        side: of a cell, in spacings of the nodes.
        ways: from each cell (X, Y), m; infinite where there is none. Next to one that has a way, a cell has its way.
    """

    lattice: Lattice
    side: int
    ways: Array

    @classmethod
    def of(cls, scene: Scene, b: int, end: int) -> Rest | None:
        """Those to the start (0) or goal (1) of the problem at place b of a scene; None where no way joins them."""
        found = list[Ways]()

        def search(lattice: Lattice, ends: Array, price: Price, radius: float, unit: float) -> list[Array]:
            ways = ways_of(lattice, ends, lambda points: np.ones(len(points)), radius, 0.0)
            found.extend([] if ways is None else [ways])
            return []

        in_one(scene, b, 0.0, search)
        if not found:
            return None
        blocks = found[0].blocks
        ways = np.append(found[0].costs[end], np.inf)[blocks.block].reshape(blocks.counts)[..., 0]
        ways = np.where(np.isfinite(ways), ways, scipy.ndimage.minimum_filter(ways, 3, mode="nearest"))
        return cls(blocks.lattice, blocks.side, ways)

    def __call__(self, poses: Array) -> Array:
        """From poses (K, 3), (K,), m."""
        return self.ways[tuple((self.lattice.node(poses[:, :2]) // self.side).T)]


def driven_in_time(path: Array, K: int, share: float, duration: float) -> tuple[Array, Array]:
    """Poses (K + 1, 3) and speeds (K + 1,) at the knots of a drive along poses (P, 3) in a share of the duration, s.

    From one change of direction to the next the vehicle drives from rest to rest, in a time that grows with the root of
    the length: so the integral of the squared acceleration is least. A turn on the spot counts as long as a step.
    """
    steps = np.diff(path, axis=0)
    mean = 0.5 * (path[1:, 2] + path[:-1, 2])
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    sign = np.where(steps[:, 0] * np.cos(mean) + steps[:, 1] * np.sin(mean) < 0.0, -1.0, 1.0)
    still = lengths == 0.0
    sign[still], lengths[still] = 0.0, lengths.max(initial=0.0) or 1.0
    along = np.append(0.0, np.cumsum(lengths))
    turns = np.flatnonzero(np.diff(sign)) + 1
    first, last = np.append(0, turns), np.append(turns, len(steps))
    ways = along[last] - along[first]
    times = np.sqrt(ways) / np.sqrt(ways).sum() * share * duration
    ends = np.append(0.0, np.cumsum(times))
    t = np.linspace(0.0, duration, K + 1)
    piece = np.clip(np.searchsorted(ends, t, side="right") - 1, 0, len(ways) - 1)
    tau = np.clip((t - ends[piece]) / times[piece], 0.0, 1.0)
    s = along[first][piece] + ways[piece] * tau**2 * (3.0 - 2.0 * tau)
    speed = sign[first][piece] * 6.0 * tau * (1.0 - tau) * ways[piece] / times[piece]
    return np.stack([np.interp(s, along, path[:, a]) for a in range(3)], axis=1), speed
