"""Cars with a body, solved from manoeuvres: paths of the whole pose through what is hardly wider than the body.

The roadmap's paths are of the ball that the body holds. They lead from aside into openings where the body can't turn,
and no candidate along them backs up. A path of poses does, and the interior point starts close to it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchgco.kernels import chord_clearance
from torchgco.obstacles.body import BoundBody
from torchgco.problem.problem import Problem
from torchgco.roadmap.lattice import Array
from torchgco.roadmap.scene import scales, scene_of
from torchgco.search.candidates import Candidates
from torchgco.search.chords import EXTRA
from torchgco.search.poses import ARC_LENGTH, Poses, clear_at
from torchgco.search.search import Search
from torchgco.search.solved_candidates import solved
from torchgco.search.steering import SAME_MODEL, alike, heading_and_speed, sampled

GROWTH_ROUNDS = 3  # of solves, at most, each among larger obstacles than the one before
PATH_PACES = 0.6, 0.8, 1.0  # shares of the horizon in which a path is driven: each is a start of the interior point
MANOEUVRES_TEXT = f"a path of poses, forwards and backwards, at {len(PATH_PACES)} paces; interior point from each"


@dataclass(frozen=True)
class Car:
    """A vehicle that drives along its heading, and turns by a curvature.

    Args:
        heading, speed: places in the state.
        curvature: the largest that it can steer either way, 1/m.
        radius: of the body's largest ball, m.
    """

    heading: int
    speed: int
    curvature: float
    radius: float


def car(problem: Problem) -> Car | None:
    """The car with a body of a batch of one, by its equations; None of another vehicle."""
    bodies = [part for part in problem.obstacles if isinstance(part, BoundBody)]
    if not bodies or not bool(torch.isfinite(problem.x0).all()):
        return None
    seen = sampled(problem)
    if seen is None:
        return None
    z, n, at = seen.z, problem.n, problem.position
    places = heading_and_speed(z[0, :, :n], seen.rates[:, at], seen.slopes[:, at])
    if places is None or any(part.points.attitude.of != places[0] for part in bodies):
        return None
    heading, speed = places
    if not alike(seen.rates[:, heading], z[0, :, speed] * seen.slopes[:, heading, speed]):
        return None  # it turns at rest, too
    on = (seen.slopes[:, heading].abs() > SAME_MODEL).any(0)
    on[speed] = False
    corners = z.repeat(1, 2, 1)
    low, high = seen.box
    ends = torch.where(z[0] > 0.5 * (low + high), high, low)
    corners[0, z.shape[1] :] = torch.where(on, ends, z[0])
    corners[..., speed] = 1.0
    turns = problem.dynamics.field(corners[..., :n], corners[..., n:])[0, :, heading]
    curvature = min(float(turns.max()), -float(turns.min()))
    radius = max(float(part.vehicle_radius.max()) for part in bodies)
    return Car(heading, speed, curvature, radius) if curvature > 0.0 and radius > 0.0 else None


def manoeuvre(search: Search) -> None:
    """Solve the problems of cars with a body that haven't arrived, or touch between knots, from manoeuvres.

    Where every trajectory from these touches between knots, too, they are solved again among obstacles that have grown.
    """
    if not any(isinstance(part, BoundBody) for part in search.call.problem.obstacles):
        return
    best, limit = search.best.end.best, search.solver.violation_tolerance
    left = (best.violation <= limit) & (chord_clearance(search.call.problem, best.X) < 0.0)
    left[search.rows("unarrived")] = True
    rows = left.nonzero().flatten()
    if rows.numel() == 0:
        return
    made = _made(search, rows)
    if made is None:
        return
    rows, made = made
    grown = torch.zeros_like(made.R[:: made.count])
    for number in range(GROWTH_ROUNDS):
        ends = solved(search, rows, made, grown if number > 0 else None)
        good = ends.cost.isfinite()
        clearance = torch.full_like(ends.cost, torch.inf)
        some = good.nonzero().flatten()
        clearance[some] = chord_clearance(made.of(some), ends.candidates.X[some])
        lacks = torch.where(good, clearance, -torch.inf).view(-1, made.count).amax(1)
        again = ((lacks < 0.0) & torch.isfinite(lacks)).nonzero().flatten()
        if again.numel() == 0 or search.call.late:
            return
        grown = grown[again] - EXTRA * lacks[again]
        rows, made = rows[again], made.of_problems(again)


def _made(search: Search, rows: Tensor) -> tuple[Tensor, Candidates] | None:
    """Those of the problems in `rows` that have manoeuvres, and these as candidates; None without any."""
    problem = search.call.problem.take(rows)
    rest = problem.cost.rest_controls(problem.x0.new_zeros(problem.B, problem.N, problem.m))
    scene = scene_of(problem, rest)
    if scene is None or scene.gates is not None:
        return None
    found = [_driven(problem.take(torch.tensor([b], device=rows.device))) for b in range(problem.B)]
    some = [b for b, one in enumerate(found) if one is not None]
    if not some:
        return None
    at = torch.tensor(some, device=rows.device)
    search.best.worked[rows[at]] = True
    R, unit = scales(problem, scene, rest)
    U, live = rest[at].unsqueeze(1).repeat(1, len(PATH_PACES), 1, 1), torch.ones_like(R[at].bool())
    made = Candidates.begin(problem.take(at), U, R[at], unit[at], live.unsqueeze(1).expand(-1, len(PATH_PACES)))
    return rows[at], replace(made, X=torch.cat([one for one in found if one is not None]))


def _driven(problem: Problem) -> Tensor | None:
    """States (len(PATH_PACES), N+1, n) of a batch of one along a manoeuvre to the goal; None where none is found."""
    vehicle = car(problem)
    if vehicle is None:
        return None
    goal, at, heading = problem.goal, problem.position, vehicle.heading
    assert goal is not None
    start = torch.cat((problem.x0[0, at], problem.x0[0, heading : heading + 1])).double().cpu().numpy()
    end = np.append(goal.position[0].double().cpu().numpy(), np.nan)
    if goal.state is not None:
        end[2] = float(goal.state[0, heading])
    space = Poses(clear_at(problem, heading), vehicle.curvature, ARC_LENGTH * vehicle.radius)
    # Where the pose at the end is known, it is the one with less room, and the search begins there.
    known = not np.isnan(end[2])
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


def driven_in_time(path: Array, K: int, share: float, duration: float) -> tuple[Array, Array]:
    """Poses (K + 1, 3) and speeds (K + 1,) at the knots of a drive along poses (P, 3) in a share of the duration, s.

    From one change of direction to the next the vehicle drives from rest to rest, in a time that grows with the root of
    the length: so the integral of the squared acceleration is least.
    """
    steps = np.diff(path, axis=0)
    mean = 0.5 * (path[1:, 2] + path[:-1, 2])
    sign = np.where(steps[:, 0] * np.cos(mean) + steps[:, 1] * np.sin(mean) < 0.0, -1.0, 1.0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
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
