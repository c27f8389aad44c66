"""Ways that keep clear of a map, driven along by vehicles that drive along their heading.

A trajectory that iLQR draws to a moving point changes its direction wherever the point outruns the vehicle, and the
interior point keeps many of these cusps. One that is steered along the way has none (`steering`), and what it costs
says which of the trajectories will be the cheapest when solved.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from torchgco.kernels import open_loop
from torchgco.maps.ways import length
from torchgco.problem.problem import Problem
from torchgco.roadmap.cheapest import HOPS
from torchgco.roadmap.clear import clear_ways, evenly, smoothed
from torchgco.roadmap.geometry import Scene
from torchgco.roadmap.lattice import Array
from torchgco.roadmap.mapped import even
from torchgco.roadmap.roadmap import Roadmap
from torchgco.roadmap.scene import around_body
from torchgco.search.candidates import Candidates
from torchgco.search.following import Paths
from torchgco.search.proposals import Part
from torchgco.search.search import Search
from torchgco.search.solved_candidates import solve_cheapest
from torchgco.search.steering import Steered, Tracks, driven, speed_limit, steered

PURSUED_AT_ONCE = 16  # problems: bounds the memory
FREE_ITERATIONS = 40  # of the trajectory without constraints, at most
WAY_ROADMAP, PATHS = Roadmap(max_overlap=0.02), 6  # between bodies, before those of one homotopy class are merged
WAYS = 3  # of different homotopy classes
WAY_PACES = 6  # at which a way is driven
# The fastest pace takes half the time that the trajectory without constraints takes for as long a way, the slowest a
# share of the horizon; the others lie between, by equal ratios.
AT_BEST, LATEST_FREE, LATEST = 0.5, 0.55, 0.75
SHORTEST = 0.01  # share of the horizon that such a trajectory counts for, at least
SOLVED_WAYS = 4  # candidates that are solved, the cheapest as driven
FINE = 0.25  # R between the points of a way
ROUNDED = 2.0  # R: the standard deviation over which its corners are averaged
LOOK_AHEAD = 2.4  # R that the vehicle looks ahead
PURSUIT_TEXT = (
    f"what drives along its heading is steered along ways that keep clear, of {WAYS} to {2 * WAYS} classes, "
    f"{WAY_PACES} paces, forwards and backwards; interior point from the {SOLVED_WAYS} cheapest, "
    f"with a body in maps also from the {SOLVED_WAYS} cheapest along ways of the ball around it"
)
EACH = 2 * WAY_PACES  # candidates of a way: forwards and backwards at each pace


def pursue(search: Search, rows: Tensor) -> None:
    """Solve the problems in `rows` from trajectories that are driven along ways through their maps."""
    part = search.part(rows)
    if part.scene is None or part.scene.gates is not None:  # to which these ways don't lead
        return
    around = around_body(part.problem, part.scene) if part.scene.obstacles.maps else None
    found = [_driven(part, b, around) for b in range(rows.numel())]
    if not any(ways for ways, _, _ in found):
        return
    search.best.worked[rows] = True
    paths, candidates = _candidates(part, [(ways, controls) for ways, _, controls in found])
    wide = torch.zeros_like(candidates.live).view(rows.numel(), -1)
    for b, (ways, first, _) in enumerate(found):
        wide[b, EACH * first : EACH * len(ways)] = True
    solve_cheapest(search, rows, part, paths, candidates, SOLVED_WAYS, wide.flatten() if around is not None else None)
    for place, (ways, _, _) in enumerate(found):
        search.steered[rows[place]] |= bool(ways) and not part.scene.obstacles.maps


def _driven(part: Part, b: int, around: Scene | None) -> tuple[list[Array], int, Array]:
    """Ways of the problem at place b, and controls (W * EACH, N, m) along these; none for other vehicles.

    Args:
        around: the scene as the ball meets it that holds the body; the ways through it come last.

    Returns:
        The ways, the place of the first such one among them, and the controls.
    """
    assert part.scene is not None
    one = part.problem.take(torch.tensor([b], device=part.rest.device))
    R, unit = (float(scale[b]) for scale in part.scales)
    vehicle = steered(one) if np.isfinite(unit) and unit > 0 and bool(torch.isfinite(one.x0).all()) else None
    none = np.empty((0, one.N, one.m))
    if vehicle is None:
        return [], 0, none
    step = FINE * (radius_of(one) or 0.5 * R)
    near, far = _ways(part, b), [] if around is None else clear_ways(around, b, 1)
    near, far = ([smoothed(evenly(w, step), ROUNDED / FINE) for w in some if length(w) > 0.0] for some in (near, far))
    ways = [*near, *far]
    if not ways:
        return [], 0, none
    duration = float(one.stages[0]) * float(one.dynamics.dt)
    straight = float((part.scene.goal[b] - part.scene.start[b]).square().sum().sqrt())
    free = part.free(FREE_ITERATIONS)
    tracks = _tracks(vehicle, ways, duration, float((free.share * free.slower)[b]) / straight)
    return ways, len(near), driven(one, vehicle, tracks)


def _ways(part: Part, b: int) -> list[Array]:
    """Ways of the problem at place b: those that keep clear of a map, or paths between bodies, one of each class."""
    assert part.scene is not None
    if part.scene.obstacles.maps:
        return clear_ways(part.scene, b, WAYS)
    rows = torch.tensor([b], device=part.rest.device)
    paths = part.seek(rows, (WAY_ROADMAP,), PATHS)
    corners = paths.corners[0][paths.live[0]].double().cpu().numpy()
    return [way[np.append(True, np.any(way[1:] != way[:-1], axis=1))] for way in corners]


def radius_of(problem: Problem) -> float:
    """The largest radius of the vehicle in a batch of one, m; 0 where it is a point, and without obstacles."""
    return max((float(part.vehicle_radius.max()) for part in problem.obstacles), default=0.0)


def _tracks(vehicle: Steered, ways: list[Array], duration: float, free: float) -> Tracks:
    """Each way at each pace, forwards and backwards.

    Args:
        free: share of the duration, s, in which the trajectory without constraints makes a metre.
    """
    longest, lengths = max(map(len, ways)), np.array([length(way) for way in ways])
    points = np.stack([np.concatenate((way, np.repeat(way[-1:], longest - len(way), axis=0))) for way in ways])
    last, steps = np.array([len(way) - 1 for way in ways]), lengths / np.array([len(way) - 1 for way in ways])
    first = AT_BEST * np.clip(np.nan_to_num(free * lengths, nan=np.inf), SHORTEST, LATEST_FREE)[:, None]
    shares = first * (LATEST / first) ** np.linspace(0.0, 1.0, WAY_PACES)
    speed = (lengths[:, None] / (shares * duration)).repeat(2, axis=1).ravel()
    ahead = round(LOOK_AHEAD / FINE)
    limit = np.zeros(points.shape[:2])
    for own, way, step in zip(limit, ways, steps, strict=True):
        own[: len(way)] = speed_limit(vehicle, way, step, ahead)
    return Tracks(
        points.repeat(EACH, axis=0), last.repeat(EACH), steps.repeat(EACH), ahead, speed, limit.repeat(EACH, axis=0),
        np.tile([False, True], shares.size),
    )  # fmt: skip


def _candidates(part: Part, found: list[tuple[list[Array], Array]]) -> tuple[Paths, Candidates]:
    """The trajectories along the ways of each problem, with the ways as paths, those that there aren't not live."""
    assert part.scene is not None
    problem, rest, (R, unit) = part.problem, part.rest, part.scales
    K = max(len(ways) for ways, _ in found)
    live = torch.tensor([[k < len(ways) for k in range(K)] for ways, _ in found], device=rest.device)
    ends = torch.stack((part.scene.start, part.scene.goal), dim=1)
    corners = ends[:, [0, *[1] * HOPS]].unsqueeze(1).repeat(1, K, 1, 1)
    U = rest.unsqueeze(1).repeat(1, K * EACH, 1, 1)
    for b, (ways, controls) in enumerate(found):
        for k, way in enumerate(ways):
            corners[b, k] = corners.new_tensor(even(way, HOPS + 1))
        U[b, : len(controls)] = U.new_tensor(controls)
    unit = torch.where(torch.isfinite(unit) & (unit > 0), unit, 1.0)
    classes = torch.arange(K, device=rest.device).expand(problem.B, K)
    paths = Paths(corners, classes, live, R, unit, part.scene.obstacles)
    made = Candidates.begin(problem, U, R, unit, live.repeat_interleave(EACH, dim=1))
    rows = made.live.nonzero().flatten()
    X = made.X.clone()
    X[rows] = open_loop(made.of(rows), made.U[rows])
    return paths, replace(made, X=X)
