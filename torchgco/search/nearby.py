"""Drops obstacles that no reasonable detour can touch from a search, and checks them again at its end.

Time, memory and the answer then depend on the obstacles between start and goal, not on those of the whole world. Where
a trajectory is only refined, those far from it are left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchgco.base.tree import put
from torchgco.constraints.base import Constraint
from torchgco.constraints.gates import gates_of
from torchgco.kernels import chord_clearance, cost_scale, measured
from torchgco.lagrangian.lagrangian import Iterate
from torchgco.obstacles.base import Obstacles, Solids, places_of
from torchgco.problem.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers.contracts import Call
from torchgco.solvers.interior import InteriorPoint

T = TypeVar("T", Solution, Iterate)

DETOUR = math.sqrt(2.0)  # ways this many times as long as the straight one stay within half of its length from it
WITHOUT_OBSTACLES = InteriorPoint(tolerance=1e-4, max_iterations=100)  # of trajectories without obstacles
FAR_ONES = 0.5  # share of a problem's obstacles that must be far from a trajectory, for leaving any out of its refining


class Nearby:
    """A call without the obstacles that no way up to `DETOUR` times as long as the straight one touches.

    Args:
        given: the call with all of them.
        places: of each constraint, which obstacles (B, M') are kept, -1 where there are fewer; None where all are.
    """

    def __init__(self, given: Call, places: list[Tensor | None]) -> None:
        parts = [
            (c, None if at is None else _filled(c, at)) for c, at in zip(given.problem.constraints, places, strict=True)
        ]
        self.given, self.places = given, [None if at is None else _rows(part, at) for part, at in parts]
        constraints = tuple(c if at is None or not isinstance(c, Obstacles) else c.chosen(at) for c, at in parts)
        problem = _among(given.problem, constraints)
        warm = given.warm
        if warm is not None:
            warm = replace(warm, lam=tuple(map(_gathered, warm.lam, self.places)))
        self.call = replace(given, problem=problem, warm=warm)

    @classmethod
    def of(cls, call: Call) -> Nearby | None:
        """None where no obstacle of any problem can be dropped.

        A single far one counts: points all over the scene, and with them paths, would spread to it.
        """
        return cls._where(call, lambda part, solids: _on_the_way(call.problem, solids), 0.0)

    @classmethod
    def along(cls, call: Call, X: Tensor) -> Nearby | None:
        """A call without the obstacles farther from X (B, N+1, n) than a mean one is thick; None where few are."""
        return cls._where(call, lambda part, solids: _beside(X, part, solids), FAR_ONES)

    @classmethod
    def _where(
        cls, call: Call, near: Callable[[Obstacles, Solids | None], Tensor | None], share: float
    ) -> Nearby | None:
        """Without those that aren't near, of problems in which they are more than a share of all."""
        problem = call.problem
        kept = [_kept(part, near) if isinstance(part, Obstacles) else None for part in problem.constraints]
        known = [part for part in kept if part is not None]
        if not known or problem.B == 0:
            return None
        present = [~part.inscribed.absent for part in problem.constraints if isinstance(part, Obstacles)]
        few = torch.stack([part.sum(-1) for part in known]).sum(0)
        every = torch.stack([part.sum(-1) for part in present]).sum(0)
        worth = (few < every) & (few <= (1.0 - share) * every)
        if not bool(worth.any()):
            return None
        return cls(call, [None if part is None else places_of(part | ~worth.unsqueeze(-1)) for part in kept])

    def whole(self, found: T) -> T:
        """What was found with multipliers, all zero, of the obstacles that were left out, too."""
        lam = tuple(map(_scattered, found.multipliers.lam, self.places, self.given.problem.row_shapes))
        return replace(found, multipliers=replace(found.multipliers, lam=lam))

    def wrong(self, found: Solution | Iterate) -> Tensor:
        """The problems (b,) whose trajectories are worse with the obstacles that were left out."""
        whole, part = self.given.problem, self.call.problem
        deeper = measured(whole, found.X, found.U, obstacles=True) > measured(part, found.X, found.U, obstacles=True)
        cut = chord_clearance(whole, found.X) < chord_clearance(part, found.X).clamp(max=0.0)
        return (deeper | cut).nonzero().flatten()


def among_nearby(call: Call, solve: Callable[[Call], Solution]) -> Solution:
    """Solve a call: with the obstacles nearby where many are far, then with all where that won't do."""
    near = Nearby.of(call)
    if near is None:
        return solve(call)
    found = near.whole(solve(near.call))
    rows = near.wrong(found)
    return found if rows.numel() == 0 else merged(found, rows, solve(call.take(rows)))


def without_obstacles(problem: Problem) -> Problem | None:
    """The problems with one absent obstacle of each kind, in the same native form; None for kinds that can't say."""
    return problem.derive("without obstacles", lambda: _without_obstacles(problem))


def _without_obstacles(problem: Problem) -> Problem | None:
    if any(type(part.inscribed).chosen is Obstacles.chosen for part in problem.obstacles):
        return None
    none = torch.full((problem.B, 1), -1, dtype=torch.int64, device=problem.x0.device)
    bare = (c.chosen(_filled(c, none)) if isinstance(c, Obstacles) else c for c in problem.constraints)
    return _among(problem, tuple(bare))


def _filled(part: Constraint, at: Tensor) -> Tensor:
    """Places (B, M') with as many columns as there are obstacles where C traces rows: their number is in its code."""
    if part.kernel != "function" or not isinstance(part, Obstacles):
        return at
    return pad(at, (0, part.inscribed.absent.shape[1] - at.shape[1]), value=-1)


def _among(problem: Problem, constraints: tuple[Constraint, ...]) -> Problem:
    """The problems with fewer obstacles, which share kernels and the scale of the cost: neither depends on these."""
    derived: dict[str, Any] = {"cost_scale": cost_scale(problem)}
    clear = problem.derived.get("start_is_clear")
    if clear is not None and bool(clear.all()):  # then it is clear of fewer, too
        derived["start_is_clear"] = clear
    known = replace(problem.known, row_shapes=None, interior=None)
    return problem._with({"constraints": constraints}, known, derived)


def merged(first: Solution, rows: Tensor, again: Solution) -> Solution:
    """The first solution with the problems in `rows` solved again; iterations of both count, and both are recorded."""
    iterations = first.iterations[rows] + again.iterations
    whole = replace(first, trace=None, search=None)
    put(whole, rows, replace(again, trace=None, search=None, iterations=iterations))
    trace, search = first.trace, first.search
    if trace is not None and again.trace is not None:
        import pandas as pd

        trace = pd.concat((trace[~trace["element"].isin(again.trace["element"])], again.trace))
        trace = trace.sort_values(["element", "attempt", "iteration"], ignore_index=True)
    if search is not None and again.search is not None:
        search = search.followed_by(again.search)
    return replace(whole, trace=trace, search=search)


def _kept(part: Obstacles, near: Callable[[Obstacles, Solids | None], Tensor | None]) -> Tensor | None:
    """Which obstacles (B, M) are near; None for a kind that can't say. A body counts as the ball that holds it."""
    solids = part.inflated()
    if type(part.inscribed).chosen is Obstacles.chosen or part.absent.shape[1] == 0:
        return None
    if part.body is not None and solids is not None:
        solids = solids.grown(part.body.overhang)
    return near(part, solids)


def _rows(part: Constraint, at: Tensor) -> Tensor:
    """The rows of obstacles at places (B, M'), of each ball in turn where they are those of a body; -1 stays."""
    if not isinstance(part, Obstacles) or part.body is None:
        return at
    M = part.inscribed.absent.shape[1]
    return torch.cat([torch.where(at < 0, at, at + i * M) for i in range(len(part.body.balls))], dim=1)


def _on_the_way(problem: Problem, solids: Solids | None) -> Tensor | None:
    """Which obstacles (B, M) a sensible way may touch; None without a goal, and where they move."""
    if problem.goal is None or solids is None:
        return None
    start, goal = problem.x0[:, problem.position], problem.goal.position
    gates = gates_of(problem)
    stops = [start, *([] if gates is None else gates.centers.unbind(1)), goal]
    reach, near = solids.extent.square().sum(-1).sqrt() + solids.radii, torch.zeros_like(solids.absent)
    for leg in pairwise(stops):
        straight = (leg[1] - leg[0]).square().sum(-1).sqrt().unsqueeze(-1)
        way = sum((solids.centers - end.unsqueeze(1)).square().sum(-1).sqrt() - reach for end in leg)
        near |= way <= DETOUR * straight
    return ~solids.absent & near


def _beside(X: Tensor, part: Obstacles, solids: Solids | None) -> Tensor | None:
    """Which obstacles (B, M) are nearer to states X (B, N+1, n) than the mean obstacle's least half length, by axis; of
    those that move, at the times of the knots, by distance. None where C traces rows: absent ones take as long."""
    if solids is None:
        if not part.moving or part.body is not None or part.kernel == "function":
            return None
        present = (~part.absent).to(X.dtype)
        margin = (part.margins * present).sum(-1) / present.sum(-1).clamp(min=1.0)
        return ~part.absent & ~(part.distances(X).amin(1) > margin.unsqueeze(-1))  # NaN counts as near
    p = X[:, :, part.position]
    reach = solids.extent + solids.radii.unsqueeze(-1)
    present = (~solids.absent).to(p.dtype)
    margin = (reach.amin(-1) * present).sum(-1) / present.sum(-1).clamp(min=1.0)
    limit, far = reach + margin.view(-1, 1, 1), solids.absent.unsqueeze(1)
    for a in range(p.shape[-1]):
        away = (p[:, :, None, a] - solids.centers[:, None, :, a]).abs()
        far = far | (away > limit[:, None, :, a])  # NaN counts as near
    return ~far.all(1)


def _gathered(lam: Tensor, at: Tensor | None) -> Tensor:
    """The rows of lam (B, K, M) at places (B, M'); 0 where there is none."""
    if at is None:
        return lam
    index = at.clamp(min=0).unsqueeze(1).expand(-1, lam.shape[1], -1)
    return lam.gather(2, index).masked_fill((at < 0).unsqueeze(1), 0.0)


def _scattered(lam: Tensor, at: Tensor | None, shape: tuple[int, ...]) -> Tensor:
    """The rows of lam (B, K, M') put at places (B, M') of zeros (B, K, M)."""
    if at is None:
        return lam
    whole = lam.new_zeros(lam.shape[0], *shape)
    index = at.clamp(min=0).unsqueeze(1).expand(-1, lam.shape[1], -1)
    return whole.scatter_add(2, index, lam.masked_fill((at < 0).unsqueeze(1), 0.0))
