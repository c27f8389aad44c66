"""Problems among obstacles that move, solved from ways through a lattice in space and time.

A solve from the guess alone mostly waits before what passes: waiting is a minimum there. Each way waits, or hurries, in
a manner of its own, and the interior point starts close to it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import scipy
import torch
from torch import Tensor

from torchgco.base.options import Count, NonNegative
from torchgco.base.status import Status
from torchgco.base.tree import take
from torchgco.kernels import measured, path_clearance
from torchgco.lagrangian.quality import has_arrived, ranks_arrival
from torchgco.lagrangian.state import SolveEnd
from torchgco.problem.problem import Problem
from torchgco.roadmap.lattice import Array
from torchgco.roadmap.timed import TimedWays, library_for, timed_ways
from torchgco.search.converge import solved_nearby
from torchgco.search.nearby import WITHOUT_OBSTACLES, without_obstacles
from torchgco.search.search import Search
from torchgco.search.solved_candidates import SOLVER
from torchgco.search.table import Row
from torchgco.search.timed_scenes import can_search, scene_in_time
from torchgco.search.velocity import Velocity

PROBLEMS_AT_ONCE = 16  # searched together: bounds the memory
FINER = 1.0, 0.5  # shares of the usual spacing: where no way is found, the lattice is made finer once
GROWTHS = 0.0, 0.01, 0.03  # m by which obstacles grow for the solves: what is clear at knots may touch between them


@dataclass(frozen=True)
class Timed(Row):
    """Searches a lattice in space and time where obstacles move, and solves by the interior point along its ways.

    A lattice's cells are as wide as the vehicle's radius, and its layers as far apart as the acceleration of the model
    lets moves differ by a cell. Its costs are the problem's own, as far as they can be read from its states. The
    cheapest way of each class is solved among obstacles as they are, and among larger ones; the cheapest result that is
    clear between the knots, too, competes with the best so far.

    Args:
        ways: classes of ways that are solved, at most.
        gap: trajectories that have arrived and cost at most this share more than without obstacles are left as they are.
        dearer: share by which ways may cost more than the cheapest.

    Raises:
        InputError: a field out of its range.
    """

    ways: Count = 8
    gap: NonNegative = 0.02
    dearer: NonNegative = 0.5

    label: ClassVar[str] = "timed"
    kinds: ClassVar[tuple[str, ...]] = ("moving",)

    @property
    def problems(self) -> str:
        return f"among obstacles that move, not arrived or over {self.gap:.0%} more expensive than without obstacles"

    @property
    def does(self) -> str:
        return (
            f"up to {self.ways} ways through space and time, each of a class of its own; interior point from each, among "
            f"obstacles grown by {', '.join(f'{by:g}' for by in GROWTHS)} m"
        )

    def run(self, search: Search) -> None:
        """Search and solve; see the class."""
        problem = search.call.problem
        if search.has_paths or not can_search(problem) or library_for(_dimension(problem)) is None:
            return
        open_ = torch.isfinite(problem.x0).all(-1) & (search.best.end.status != Status.INVALID_START)
        for rows in open_.nonzero().flatten().split(PROBLEMS_AT_ONCE):
            if search.call.late:
                return
            self._solve(search, rows)

    def _solve(self, search: Search, rows: Tensor) -> None:
        """The same for the problems in `rows`."""
        X, bound = _free(search, rows)
        best = search.best.of(rows).best
        limit = search.solver.violation_tolerance
        good = (best.violation <= limit) & (best.cost <= bound + self.gap * bound.abs())
        if ranks_arrival(search.call.problem):
            good &= search.best.arrived()[rows]
        left = (~good).nonzero().flatten()
        if left.numel() == 0:
            return
        rows, X = rows[left], X[left]
        search.best.worked[rows] = True
        for finer in FINER:
            found = self._ways(search.call.problem.take(rows), X, finer)
            arrived = _solve_along(search, rows, found)
            rows, X = rows[~arrived], X[~arrived]
            if rows.numel() == 0 or search.call.late:
                return

    def _ways(self, problem: Problem, X: Tensor, finer: float) -> list[TimedWays | None]:
        """The ways of every problem."""
        each = [problem.take(torch.tensor([b], device=X.device)) for b in range(problem.B)]
        scenes = [scene_in_time(one, X[b], finer) for b, one in enumerate(each)]
        return timed_ways(scenes, self.ways, self.dearer) or [None] * len(scenes)


def _free(search: Search, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Trajectories (b, N+1, n) without obstacles and their costs (b,): minus infinity where there is none."""
    call = replace(search.call.take(rows), callback=None, warm=None)
    bare = without_obstacles(call.problem)
    none = torch.full_like(call.problem.x0[:, 0], -torch.inf)
    if bare is None:
        return call.problem.at_rest[0], none
    end = WITHOUT_OBSTACLES.solved(replace(call, problem=bare, U0=call.problem.at_rest[1]))
    search.best.end.iterations[rows] += end.iterations
    good = (end.best.violation <= search.solver.violation_tolerance) & torch.isfinite(end.best.cost)
    X = torch.where(good.view(-1, 1, 1), end.best.X, call.problem.at_rest[0])
    return X, torch.where(good, end.best.cost, none)


def _solve_along(search: Search, rows: Tensor, found: list[TimedWays | None]) -> Tensor:
    """Solve along the ways of the problems in `rows`; whether each has a trajectory that arrives now, (b,)."""
    problem = search.call.problem.take(rows)
    places, X, U = [], [], []
    for b, ways in enumerate(found):
        one = problem.take(torch.tensor([b], device=rows.device))
        velocity = Velocity.of(one)
        for points in () if ways is None else ways.points:
            x, u = _guess(velocity, points, ways.tau)
            places.append(b)
            X.append(x)
            U.append(u)
    done = torch.zeros_like(rows, dtype=torch.bool)
    if not places:
        return done
    each = torch.tensor(places, device=rows.device).repeat(len(GROWTHS))
    grown = X[0].new_tensor(GROWTHS).repeat_interleave(len(places))
    call = replace(search.call.take(rows[each]), U0=torch.stack(U).repeat(len(GROWTHS), 1, 1), warm=None, callback=None)
    larger = replace(call, problem=call.problem.grown(grown))
    end = solved_nearby(SOLVER, larger, torch.stack(X).repeat(len(GROWTHS), 1, 1))
    end = replace(end, best=replace(end.best, violation=measured(call.problem, end.best.X, end.best.U)))
    return _keep(search, rows, each, call.problem, end)


def _keep(search: Search, rows: Tensor, each: Tensor, problem: Problem, end: SolveEnd) -> Tensor:
    """Keep the cheapest of the solved candidates of each problem that is clear, between knots too; where there is any.

    Args:
        each: the place among `rows` that each candidate belongs to.
    """
    best, limit = end.best, search.solver.violation_tolerance
    good = (best.violation <= limit) & torch.isfinite(best.cost)
    if ranks_arrival(problem):
        good &= has_arrived(problem, best.X)
    some = good.nonzero().flatten()
    if some.numel() > 0:
        good[some] = path_clearance(problem.take(some), best.X[some], best.U[some]) >= 0.0
    made = torch.zeros_like(rows).index_add(0, each, end.iterations)
    merit = torch.where(good, best.cost, torch.inf)
    done, chosen = torch.zeros_like(rows, dtype=torch.bool), []
    for b in range(rows.numel()):
        own = (each == b).nonzero().flatten()
        least = own[merit[own].argmin()] if own.numel() > 0 else None
        done[b] = least is not None and bool(torch.isfinite(merit[least]))
        chosen += [int(least)] if done[b] else []
    kept = take(end, torch.tensor(chosen, dtype=torch.int64, device=rows.device))
    kept.status[:] = int(Status.MAX_ITERATIONS)  # the last row brings it to its own tolerance
    kept.iterations[:] = made[done]
    search.best.end.iterations[rows[~done]] += made[~done]
    if chosen:
        search.best.keep(rows[done], kept)
    return done


def _guess(velocity: Velocity, points: Array, tau: float) -> tuple[Tensor, Tensor]:
    """States (N+1, n) and controls (N, m) of a batch of one along places (layers + 1, d) at times tau apart."""
    problem = velocity.problem
    p, v = _smooth(points, tau, float(problem.dynamics.dt) * np.arange(problem.N + 1), velocity.start)
    x = velocity.states(v, problem.x0.new_tensor(p))
    x[0] = problem.x0[0]
    u = problem.at_rest[1]
    here, then = x[:-1].unsqueeze(0), x[1:].unsqueeze(0)
    error = then - problem.along.step(here, u)
    _, fu = problem.along.jacobians(here, u)
    u = u + (torch.linalg.pinv(fu) @ error.unsqueeze(-1)).squeeze(-1)
    if problem.control_bounds is not None:
        lower, upper = problem.control_bounds.over(problem.N)
        u = torch.minimum(torch.maximum(u, lower), upper)
    return x, u[0].nan_to_num(0.0, 0.0, 0.0)


def _smooth(points: Array, tau: float, t: Array, first: Array) -> tuple[Array, Array]:
    """Places and velocities (K, d) at times (K,) of the cubic spline through points (P, d) at times tau apart; at rest
    after the last one.

    Args:
        first: the velocity (d,) at the beginning.
    """
    ends = (1, first), (2, np.zeros_like(first))
    spline = scipy.interpolate.CubicSpline(tau * np.arange(len(points)), points, bc_type=ends)
    last = tau * (len(points) - 1)
    late = t > last + 1e-9
    v = spline(np.minimum(t, last), 1)
    v[late] = 0.0
    return spline(np.minimum(t, last)), v


def _dimension(problem: Problem) -> int:
    return problem.position.stop - problem.position.start
