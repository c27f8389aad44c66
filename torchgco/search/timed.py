"""Problems among obstacles that move, solved from guesses along ways through a lattice in space and time.

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

from torchgco.base.options import Count
from torchgco.base.status import Status
from torchgco.base.tree import take
from torchgco.kernels import measured, path_clearance
from torchgco.lagrangian.lagrangian import SolveEnd
from torchgco.lagrangian.quality import has_arrived, ranks_arrival
from torchgco.problem.in_time import states_in_time
from torchgco.problem.problem import Problem
from torchgco.roadmap.lattice import Array
from torchgco.roadmap.timed import TimedWays, library_for, timed_ways
from torchgco.search.finish import EXTRA, solved_nearby
from torchgco.search.nearby import WITHOUT_OBSTACLES, without_obstacles
from torchgco.search.reach import limit_of, push_of
from torchgco.search.search import Search
from torchgco.search.solved_candidates import SOLVER
from torchgco.search.table import Row
from torchgco.search.timed_scenes import Velocity, can_search, scene_in_time
from torchgco.solvers.contracts import Call

SMALL = 1e-4  # change of a control by which its effect is looked at


def guesses_along(problem: Problem, each: Tensor, found: list[TimedWays]) -> tuple[Tensor, Tensor]:
    """States (C, N+1, n) and controls (C, N, m) along the ways of all problems in turn; `each` says whose way it is."""
    t = float(problem.dynamics.dt) * np.arange(problem.N + 1.0)
    X = _states(problem, found, [t for ways in found for _ in ways.points])
    many = problem.take(each)
    return X, _controls(many, X, many.at_rest[1])


def guesses_in_time(
    problem: Problem, whole: Problem, each: Tensor, found: list[TimedWays]
) -> tuple[Tensor, Tensor, Tensor]:
    """Factors of time (C, 1), and states and controls as of the problem `in_time`, from start to end of each way.

    Args:
        whole: the problem `in_time`; others as of `guesses_along`.
    """
    duration = np.array([ways.tau * (len(points) - 1) for ways in found for points in ways.points])
    X = _states(problem, found, [np.linspace(0.0, last, problem.N + 1) for last in duration])
    many, time = problem.take(each), problem.time
    assert time is not None
    factors = X.new_tensor(duration / (problem.N * float(problem.dynamics.dt))).unsqueeze(-1)
    factors = factors.clamp(time.least[each], time.most[each])
    X, U = states_in_time(many, X, many.at_rest[1], factors)
    return factors, X, _controls(whole.take(each), X, U)


def _states(problem: Problem, found: list[TimedWays], times: list[Array]) -> Tensor:
    """States (C, N+1, n) along the ways of all problems in turn, each at times of its own (N+1,), s."""
    states, t = [problem.x0.new_zeros(0, problem.N + 1, problem.n)], iter(times)
    for b, ways in enumerate(found):
        if len(ways.points) == 0:
            continue
        velocity = Velocity.of(problem.take(torch.tensor([b], device=problem.x0.device)))
        for points in ways.points:
            p, v = smooth(points, ways.tau, next(t), velocity.start)
            x = velocity.states(v, problem.x0.new_tensor(p))
            x[0] = problem.x0[b]
            states.append(x.unsqueeze(0))
    return torch.cat(states)


def _controls(many: Problem, X: Tensor, U: Tensor) -> Tensor:
    """Controls (C, N, m) that lead from state to state of X (C, N+1, n) as far as those about U can, within bounds."""
    x, model = X[:, :-1], many.along
    then = model.step(x, U)
    fu = torch.stack([model.step(x, U + SMALL * row) - then for row in torch.eye(many.m).to(U)], dim=-1) / SMALL
    U = (U + (torch.linalg.pinv(fu) @ (X[:, 1:] - then).unsqueeze(-1)).squeeze(-1)).nan_to_num(0.0, 0.0, 0.0)
    if many.control_bounds is None:
        return U
    lower, upper = many.control_bounds.over(many.N)
    return torch.minimum(torch.maximum(U, lower), upper)


def smooth(points: Array, tau: float, t: Array, first: Array) -> tuple[Array, Array]:
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


PROBLEMS_AT_ONCE = 16  # searched together: bounds the memory
FINER = 1.0, 0.5  # shares of the usual spacing: where no way is found, the lattice is made finer, and larger, once
GAP = 0.02  # share by which what has arrived may cost more than without obstacles, and is left as it is
DEARER = 0.5  # share by which ways that are solved may cost more than the cheapest, on the lattice
FIRST = 3  # ways of a problem that are solved in any case: costs on the lattice order them roughly
ALIKE = 1e-4  # share by which the costs of two candidates may differ that count as the same
ROUNDS = 5  # of solves, at most, each among larger obstacles: what is clear at knots may touch between them


@dataclass(frozen=True)
class Timed(Row):
    """Searches a lattice in space and time where obstacles move, and solves by the interior point along its ways.

    A lattice's cells are as wide as the vehicle's radius, and its layers as far apart as the acceleration of the model
    lets moves differ by a cell. Its costs are the problem's own, as far as they can be read from its states. The
    cheapest way of each class is solved, among larger obstacles where it touches one between the knots; the cheapest
    result that is clear there, too, competes with the best so far.

    Args:
        ways: classes of ways that are solved, at most.

    Raises:
        InputError: a field out of its range.
    """

    ways: Count = 8

    label: ClassVar[str] = "timed"
    kinds: ClassVar[tuple[str, ...]] = ("moving",)
    last: ClassVar[bool] = True

    @property
    def problems(self) -> str:
        return f"among obstacles that move, not arrived or over {GAP:.0%} more expensive than without obstacles"

    @property
    def does(self) -> str:
        return (
            f"up to {self.ways} ways through space and time, each of a class of its own; interior point from each, "
            "also among larger obstacles where the cheapest touch between knots"
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
        good = (best.violation <= limit) & (best.cost <= bound + GAP * bound.abs())
        if ranks_arrival(search.call.problem):
            good &= search.best.arrived()[rows]
        present = torch.stack([~part.absent.all(-1) for part in search.call.problem.obstacles]).any(0)[rows]
        left = (present & ~good).nonzero().flatten()
        if left.numel() == 0:
            return
        rows, X = rows[left], X[left]
        search.best.worked[rows] = True
        for finer in FINER:
            found = ways_in_time(search.call.problem.take(rows), X, self.ways, finer)
            arrived = _solve_along(search, rows, found)
            rows, X = rows[~arrived], X[~arrived]
            if rows.numel() == 0 or search.call.late:
                return


def ways_in_time(problem: Problem, X: Tensor, most: int, finer: float = 1.0) -> list[TimedWays]:
    """Up to `most` ways of every problem through a lattice in space and time; see `scene_in_time`.

    Args:
        X: trajectories without obstacles (B, N+1, n).
    """
    each = [problem.take(torch.tensor([b], device=X.device)) for b in range(problem.B)]
    scenes = [scene_in_time(one, X[b], finer) for b, one in enumerate(each)]
    return timed_ways(scenes, most, DEARER)


def _free(search: Search, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Trajectories (b, N+1, n) without obstacles and their costs (b,): minus infinity where there is none."""
    call = replace(search.call.take(rows), callback=None, warm=None)
    bare = without_obstacles(call.problem)
    none = torch.full_like(call.problem.x0[:, 0], -torch.inf)
    if bare is None:
        return _hurried(call.problem), none
    end = WITHOUT_OBSTACLES.solved(replace(call, problem=bare, U0=call.problem.at_rest[1]))
    search.best.end.iterations[rows] += end.iterations
    good = (end.best.violation <= search.solver.violation_tolerance) & torch.isfinite(end.best.cost)
    X = torch.where(good.view(-1, 1, 1), end.best.X, call.problem.at_rest[0])
    return X, torch.where(good, end.best.cost, none)


def _hurried(problem: Problem) -> Tensor:
    """States (B, N+1, n) straight to the goal, from rest to rest as fast as limits let it; at rest without a goal.

    They say how fast ways may be where no trajectory without obstacles is known, as beside a map.
    """
    X, at, dt = problem.at_rest[0].clone(), problem.position, float(problem.dynamics.dt)
    if problem.goal is None:
        return X
    far, push, whole = problem.goal.distance(problem.x0[:, at]), push_of(problem), dt * problem.stages
    time = torch.where(torch.isfinite(push) & (push > 0.0), 2.0 * (far / push).sqrt(), whole)
    limit = limit_of(problem)
    if limit is not None:
        time = torch.maximum(time, 2.0 * dt * far / limit.step)
    time = torch.minimum(time.clamp(min=2.0 * dt), whole.to(far))
    share = (dt * torch.arange(problem.N + 1).to(far) / time.unsqueeze(-1)).clamp(max=1.0).unsqueeze(-1)
    done = torch.where(share < 0.5, 2.0 * share.square(), 1.0 - 2.0 * (1.0 - share).square())
    X[..., at] += done * (problem.goal.position - problem.x0[:, at]).unsqueeze(1)
    return X


def _solve_along(search: Search, rows: Tensor, found: list[TimedWays]) -> Tensor:
    """Solve along the ways of the problems in `rows`; whether each has a trajectory that arrives now, (b,).

    First along a few of each; they show by how much a solve undercuts its lattice's costs, and others follow that may
    undercut the best by as much.
    """
    each = torch.tensor([b for b, ways in enumerate(found) for _ in ways.points], dtype=torch.int64, device=rows.device)
    done = torch.zeros_like(rows, dtype=torch.bool)
    if each.numel() == 0:
        return done
    number = torch.cat([torch.arange(len(ways.points)) for ways in found]).to(rows.device)
    X, U = guesses_along(search.call.problem.take(rows), each, found)
    along = torch.cat([X.new_tensor(ways.costs) for ways in found])
    call = replace(search.call.take(rows[each]), U0=U, warm=None, callback=None)
    least = torch.full_like(search.best.end.best.cost[rows], torch.inf)
    below = torch.full_like(least, torch.inf)
    for wave in range(2):
        # Those of a kind together: the last ones of a batch are solved without company.
        chosen = (number < FIRST if wave == 0 else number >= FIRST).nonzero().flatten()
        if wave == 1:
            b = each[chosen]
            chosen = chosen[~(along[chosen] + below[b] >= least[b])]
        if chosen.numel() == 0 or search.call.late:
            break
        chosen = chosen[number[chosen].argsort(stable=True)]
        ends = _Ends(search, rows, each[chosen], along[chosen], least, below)
        done |= ends.solve(call.take(chosen), X[chosen])
    return done


@dataclass
class _Ends:
    """What solves of some candidates come to.

    Args:
        rows: the problems (b,).
        each: the place (C,) among `rows` that each candidate belongs to.
        along: what its way costs on the lattice, (C,).
        least: the least cost of each problem so far, (b,), in place.
        below: the least that a solve has come to beyond its way's cost, (b,), in place.
    """

    search: Search
    rows: Tensor
    each: Tensor
    along: Tensor
    least: Tensor
    below: Tensor

    def solve(self, call: Call, X: Tensor) -> Tensor:
        """Solve from states X (C, N+1, n), and keep the best; whether a problem has one that arrives, (b,) bool.

        Where the cheapest of a problem touch an obstacle between two knots, they are solved again among larger ones.
        """
        search, each = self.search, self.each
        done = torch.zeros_like(self.rows, dtype=torch.bool)
        grown, left = torch.zeros_like(self.along), torch.arange(len(each), device=each.device)
        for _ in range(ROUNDS):
            part = call.take(left)
            end = _solved(part, X[left], grown[left])
            good, clearance = _rated(search, part.problem, end)
            clear = good & (clearance >= 0.0)
            merit = torch.where(clear, end.best.cost, torch.inf)
            done |= _keep(search, self.rows, each[left], merit, end)
            self.least.scatter_reduce_(0, each[left], merit, "amin")
            undercut = torch.where(good, end.best.cost - self.along[left], torch.inf)
            self.below.scatter_reduce_(0, each[left], undercut, "amin")
            again = good & ~clear & (end.best.cost < self.least[each[left]])
            again &= ~_repeated(each[left], end.best.cost)
            more = torch.maximum(grown[left] - EXTRA * clearance, 2.0 * grown[left])
            left = left[again]
            grown[left] = more[again]
            if left.numel() == 0 or search.call.late:
                break
        return done


def _solved(call: Call, X: Tensor, grown: Tensor) -> SolveEnd:
    """Solves of a call from X (C, N+1, n) among obstacles that have grown (C,), m, rated among those as they are."""
    if not bool(grown.any()):
        return solved_nearby(SOLVER, call, X)
    end = solved_nearby(SOLVER, replace(call, problem=call.problem.grown(grown)), X)
    return replace(end, best=replace(end.best, violation=measured(call.problem, end.best.X, end.best.U)))


def _rated(search: Search, problem: Problem, end: SolveEnd) -> tuple[Tensor, Tensor]:
    """Whether solved candidates are feasible and arrive where that is wanted, (C,), and their clearances (C,), m."""
    best = end.best
    good = (best.violation <= search.solver.violation_tolerance) & torch.isfinite(best.cost)
    if ranks_arrival(problem):
        good &= has_arrived(problem, best.X)
    clearance, some = torch.full_like(best.cost, -torch.inf), good.nonzero().flatten()
    if some.numel() > 0:  # others may end anywhere
        clearance[some] = path_clearance(problem.take(some), best.X[some], best.U[some])
    return good, clearance


def _repeated(each: Tensor, cost: Tensor) -> Tensor:
    """Which candidates (C,) cost as much as one before them of the same problem, `each` (C,): ways to one optimum."""
    pairs = (each.unsqueeze(1) == each) & ((cost.unsqueeze(1) - cost).abs() <= ALIKE * cost.abs())
    return pairs.tril(-1).any(1)


def _keep(search: Search, rows: Tensor, each: Tensor, merit: Tensor, end: SolveEnd) -> Tensor:
    """Keep the candidate of least merit (C,) of each problem in `rows` where it is finite; whether it is, (b,) bool.

    Args:
        each: the place (C,) among `rows` that each candidate belongs to.
    """
    made = torch.zeros_like(rows).index_add(0, each, end.iterations)
    least = torch.full_like(search.best.end.best.cost[rows], torch.inf).scatter_reduce(0, each, merit, "amin")
    done = torch.isfinite(least)
    order = torch.where(merit == least[each], torch.arange(len(each), device=each.device), len(each))
    first = torch.full_like(rows, len(each)).scatter_reduce(0, each, order, "amin")
    kept = take(end, first[done])
    kept.status[:] = int(Status.MAX_ITERATIONS)  # the last row brings it to its own tolerance
    kept.iterations[:] = made[done]
    search.best.end.iterations[rows[~done]] += made[~done]
    if bool(done.any()):
        search.best.keep(rows[done], kept)
    return done


def _dimension(problem: Problem) -> int:
    return problem.position.stop - problem.position.start
