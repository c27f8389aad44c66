"""Paths tracked closely at several paces, and each trajectory solved by the interior point: nothing is relaxed.

A relaxed candidate gives way to its cost through whatever is thinner than its penalty can hold, such as the walls of a
map. A stiff and narrow tube keeps a candidate on its path, nearly clear of all obstacles; from there an interior point
with a small barrier stays on its side of each of them. What it finds has the homotopy class of its path and about the
pace that it was given: several of both are tried, and the cheapest counts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import torch
from torch import Tensor

from torchgco.base.options import Count
from torchgco.base.status import STOPPED
from torchgco.kernels import open_loop
from torchgco.problem.problem import Problem
from torchgco.roadmap.clear import clear_path
from torchgco.roadmap.known import Known
from torchgco.roadmap.mapped import in_each
from torchgco.roadmap.roadmap import Roadmap
from torchgco.roadmap.scene import around_body, has_maps
from torchgco.search.candidates import Candidates
from torchgco.search.following import Follow, Free, Paths
from torchgco.search.manoeuvres import MANOEUVRES_TEXT, manoeuvre
from torchgco.search.pursue import PURSUED_AT_ONCE, PURSUIT_TEXT, pursue
from torchgco.search.reach import within_reach
from torchgco.search.search import Search
from torchgco.search.solved_candidates import solve_cheapest
from torchgco.search.table import Row

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
        for some in rows.split(max(1, TRACKED_AT_ONCE // each)):
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
