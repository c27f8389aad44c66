"""Trajectories drawn closely along paths at several paces, each solved by the interior point: nothing is relaxed.

A relaxed candidate gives way to its cost through whatever is thinner than its penalty can hold, such as the walls of a
map. A stiff and narrow tube keeps a candidate on its path, nearly clear of all obstacles; from there an interior point
with a small barrier stays on its side of each of them. What it finds has the homotopy class of its path and about the
pace that it was given: several of both are tried, and the cheapest counts.

A trajectory that iLQR draws to a moving point changes its direction wherever the point outruns the vehicle, and the
interior point keeps many of these cusps. One that is steered along the way has none (`steering`), and what it costs
says which of the trajectories will be the cheapest when solved.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from torchgco.base.options import Count
from torchgco.base.status import STOPPED
from torchgco.kernels import at_once, open_loop
from torchgco.maps.ways import length
from torchgco.problem.problem import Problem
from torchgco.roadmap.cheapest import HOPS
from torchgco.roadmap.clear import clear_path, clear_ways, evenly, smoothed
from torchgco.roadmap.geometry import Scene, around_body, has_maps
from torchgco.roadmap.lattice import Array
from torchgco.roadmap.mapped import even, in_each
from torchgco.roadmap.roadmap import Known, Roadmap
from torchgco.search.candidates import Candidates
from torchgco.search.following import Follow, Free, Paths
from torchgco.search.manoeuvres import MANOEUVRES_TEXT, manoeuvre
from torchgco.search.proposals import Part
from torchgco.search.reach import within_reach
from torchgco.search.search import Search
from torchgco.search.solved_candidates import solve_cheapest
from torchgco.search.steering import Steered, Tracks, driven, speed_limit, steered
from torchgco.search.table import Row

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


TRACKED_AT_ONCE = 256  # candidates of all problems that are tracked and solved together: bounds the memory
# Tracked candidates lie a small part of R inside an obstacle, from where the interior point leads out of it again; from
# deeper than `DEEP` it rarely does. A spring, or a wider tube, leaves most of them there.
FOLLOW = Follow(smoothing=0.02, tube=0.05, stiffness=(200.0, 2000.0), iterations=40)
SPUN_BY = 0.5  # share of a control's range by which a vehicle is turned on the spot over the first tenth of the horizon
TURN_WITHIN = 1e-9  # share of the distance to the goal by which it may move then
LATEST_FIRST = 0.55  # share of the horizon: the slowest that the first pace is
ROADMAP = Roadmap()
PACES = 4  # at which each path is tracked
TOP = 8  # candidates of a problem that are solved, those of least cost as tracked: the lanes of a vector in C


@dataclass(frozen=True)
class Tube(Row):
    """Tracks paths closely at several paces, solves the cheapest by the interior point, and keeps the best.

    A car with a `Body` is solved from manoeuvres of its whole pose first (`manoeuvre`).
    In maps, a vehicle that drives along its heading is steered along ways that keep clear of them first (`pursue`).
    One with a body that turns on the spot, too, is then solved from manoeuvres where that doesn't arrive.
    Where that doesn't arrive, and for all others, paths are tracked; among these is one that keeps clear of a map's
    obstacles, with its corners averaged, and among spheres and boxes one of the ball that holds a body, which has room
    along all of it. A vehicle that can turn on the spot follows each from rest and after either
    turn: else it reverses along much of a way behind it. The first pace is that of the trajectory without obstacles,
    the last takes the whole horizon; the others lie evenly between.
    Candidates count where they end feasible and at the goal.

    Args:
        among: "maps": in problems with a map among their obstacles; "bodies": in those without.
        num_paths: of the roadmap, before those of one homotopy class are merged.

    Raises:
        InputError: a field out of its range.
    """

    among: Literal["maps", "bodies"] = "bodies"
    num_paths: Count = 6

    label: ClassVar[str] = "tube"
    seeks_paths: ClassVar[bool] = True
    last: ClassVar[bool] = True

    @property
    def kinds(self) -> tuple[str, ...]:
        return (self.among,)

    @property
    def problems(self) -> str:
        return "in maps: not arrived" if self.among == "maps" else "among spheres and boxes: caught, not arrived"

    @property
    def does(self) -> str:
        more, first = "", ""
        if self.among == "maps":
            more, first = " and one that keeps clear", f"{PURSUIT_TEXT}; others, or without success: "
        tracked = f"{self.num_paths} paths{more}: {FOLLOW}, {PACES} paces"
        cars = f"bodies that drive along their heading: {MANOEUVRES_TEXT}; without success, and others: "
        return f"{cars}{first}{tracked}; not relaxed; interior point from the {TOP} cheapest"

    def run(self, search: Search) -> None:
        """Solve; see the class."""
        if not search.has_paths or has_maps(search.call.problem) != (self.among == "maps"):
            return
        if self.among == "maps":
            search.stalled |= _stalled(search)
        manoeuvre(search, on_the_spot=False)
        rows = search.rows("unarrived")
        if self.among == "maps":
            for some in rows.split(PURSUED_AT_ONCE) if rows.numel() > 0 else ():
                if not search.call.late:
                    pursue(search, some)
        if not search.call.late:
            manoeuvre(search, on_the_spot=True)
        rows = search.rows("unarrived")
        rows = rows[~search.steered[rows]]
        if rows.numel() == 0:
            return
        each = (1 + self.num_paths) * (1 + 2 * search.call.problem.m) * PACES
        for some in rows.split(max(1, at_once(TRACKED_AT_ONCE) // each)):
            if search.call.late:
                return
            self._some(search, some)

    def _some(self, search: Search, rows: Tensor) -> None:
        """As `run`, for the problems in `rows`."""
        part = search.part(rows)
        if part.scene is None:
            return
        search.best.worked[rows] = True
        every = torch.arange(part.problem.B, device=rows.device)
        paths = part.seek(every, (ROADMAP,), self.num_paths)
        if part.scene.gates is None:
            if part.scene.obstacles.maps:
                paths = paths.joined(*in_each(part.scene, 1, ROADMAP.max_overlap, clear_path))
            wide = around_body(part.problem, part.scene)
            if wide is not None:
                paths = paths.joined(*ROADMAP.paths(wide, 1, every, Known()))
        starts, usable = _starts(part.problem, part.rest)
        live = (paths.live.unsqueeze(-1) & usable.unsqueeze(1)).flatten(1).repeat_interleave(PACES, dim=1)
        starts = starts.repeat_interleave(PACES, dim=1).repeat(1, paths.corners.shape[1], 1, 1)
        candidates = Candidates.begin(part.problem, starts, paths.R, paths.unit, live)
        tracked = FOLLOW.along(candidates, paths, self._arrivals(paths, part.free(FOLLOW.iterations)), PACES)
        solve_cheapest(search, rows, part, paths, tracked, TOP)

    def _arrivals(self, paths: Paths, free: Free) -> Tensor:
        """Shares (B * K * paces,) of the horizon at which each candidate arrives."""
        own = (free.share * free.slower).unsqueeze(-1) * paths.stretch()
        first = own.nan_to_num(torch.inf).clamp(min=2.0 * torch.finfo(own.dtype).eps, max=LATEST_FIRST)
        later = torch.linspace(0.0, 1.0, PACES, dtype=first.dtype, device=first.device)
        return (first.unsqueeze(-1) + (1.0 - first.unsqueeze(-1)) * later).flatten()


def _stalled(search: Search) -> Tensor:
    """Which problems' first solve ended short of the goal, (B,) bool, though it was stated and is within reach.

    No obstacle has to stop it: a vehicle that can't move sideways may rest where no control lowers the cost.
    """
    problem, left = search.call.problem, ~search.best.arrived() & (search.caught.status != STOPPED)
    if problem.goal is None or problem.goal.assumed or problem.time is not None or not bool(left.any()):
        return torch.zeros_like(left)
    return left & within_reach(problem)


def _starts(problem: Problem, rest: Tensor) -> tuple[Tensor, Tensor]:
    """Controls (B, S, N, m) to begin with: rest, and turns on the spot; and which (B, S) of these each problem has.

    A turn is an offset of one control that changes the state, but moves the vehicle nowhere.
    """
    assert problem.goal is not None
    m, at = problem.m, problem.position
    axes = [tuple(SPUN_BY * sign if i == j else 0.0 for j in range(m)) for i in range(m) for sign in (1.0, -1.0)]
    starts = replace(FOLLOW, initial_offsets=tuple(axes)).starts(problem, rest)
    each = torch.arange(problem.B, device=rest.device).repeat_interleave(starts.shape[1])
    X = open_loop(problem.take(each), starts.flatten(0, 1)).unflatten(0, starts.shape[:2])
    away, size = (X - X[:, :1]).abs(), problem.goal.distance(problem.x0[:, at])
    stays = away[..., at].amax((-1, -2)) <= TURN_WITHIN * size.unsqueeze(-1)
    usable = stays & (away.amax((-1, -2)) > 0.0)
    usable[:, 0] = True
    some = usable.any(0).nonzero().flatten()
    return starts[:, some], usable[:, some]
