"""Further solves by the interior point: from the guess, from where the first was caught, and from random guesses.

A vehicle that drives along its heading is steered along the paths, too (`pursue`); where that arrives there is no
search, and where it doesn't, only samples are left: tracking the same paths by iLQR takes a hundred times as long.

A first solve is stopped where a knot lies millimetres inside one obstacle, and may be at the optimum there. Among few
obstacles in the plane an interior point from there, or from the guess, takes a hundredth of the iterations that a
search takes. Its results compete with the search's by cost, at the end; they spare it only where it could save little.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, Literal

import torch
from torch import Tensor

from torchgco.base.draws import DrawKey, smooth_normal
from torchgco.base.options import Count, Natural, NonNegative, Positive
from torchgco.base.status import STOPPED, UNMOVED, Status, is_over
from torchgco.base.tree import take
from torchgco.kernels import is_convex, measured, open_loop
from torchgco.lagrangian.lagrangian import Iterate, Multipliers, SolveEnd
from torchgco.lagrangian.quality import goal_tolerance, has_arrived, outside_goal, ranks_arrival
from torchgco.obstacles.base import ADMITTED, Obstacles
from torchgco.problem.problem import Problem
from torchgco.roadmap.geometry import has_maps
from torchgco.search.finish import Converge, clear_further, continued, keep_clear, keep_tight, solved_nearby
from torchgco.search.nearby import WITHOUT_OBSTACLES, without_obstacles
from torchgco.search.reach import beyond_reach
from torchgco.search.search import Search
from torchgco.search.table import Row
from torchgco.search.tube import pursue
from torchgco.solvers.contracts import Call
from torchgco.solvers.convexity import KNOTS, STREAM, controls_of, half_ranges
from torchgco.solvers.ending import STATIONARY

START_ROUNDS = 2  # one guess turns a car round between walls in 2 of 5 cases: all of 8 miss in 1.7 %, of 16 in 0.03 %


@dataclass(frozen=True)
class Starts(Row):
    """Solves by the interior point from random guesses; the best result is kept.

    A guess has states on the straight line from the start to the end of the best trajectory, bent by smooth noise, and
    the controls given, with smooth noise: swing-ups and manoeuvres have many local minima, and random controls alone
    lead chaotic systems far away. Every other guess is the trajectory of random controls over their whole range,
    shifted so that it ends where the line does: it breaks symmetries in which the best trajectory rests, and turns a
    vehicle that can't go straight to its goal. A stated goal that isn't reached is the end of both. Guesses are keyed
    by (seed, id, start). What they lead to is solved on among larger obstacles where it touches one between two knots.

    Args:
        count: of guesses, and of as many others where none of these leads to a feasible trajectory that arrives.
        when: "unsolved": where the first solve failed, the best trajectory is infeasible, between the knots too, or it
            ends outside a stated goal, and it was never caught; "all": of problems without obstacles.
        bend: standard deviation of the noise in the states half-way, as a share of the range of each along the best
            trajectory, or that of the random controls where this is wider.
        change: standard deviation of the noise in the controls, as a share of half their range.

    Raises:
        InputError: a field out of its range.
    """

    count: Count = 8
    when: Literal["unsolved", "all"] = "unsolved"
    bend: Positive = 0.2
    change: Positive = 0.1

    label: ClassVar[str] = "starts"
    last: ClassVar[bool] = True

    @property
    def problems(self) -> str:
        return "without obstacles, all" if self.when == "all" else "never caught, unsolved or not arrived"

    @property
    def does(self) -> str:
        return (
            f"interior point from {self.count} guesses: lines bent by {self.bend:g} with controls changed by "
            f"{self.change:g}, and trajectories of random controls"
        )

    def run(self, search: Search) -> None:
        """Solve; see the class."""
        problem, rows = search.call.problem, self._rows(search)
        if rows.numel() == 0:
            return
        slots, held = search.solver.slots or problem.B * self.count, search.best.end.best.X.clone()
        for number in range(START_ROUNDS if Converge.worth(problem) else 0):
            rows = rows[self._missed(search)[rows]] if number > 0 else rows
            # Of none, `split` would make one empty batch.
            for some in rows.split(max(1, slots // self.count)) if rows.numel() > 0 else ():
                if search.call.late:
                    return
                self._solve(search, some, number * self.count)
        best = search.best
        new = (held != best.end.best.X).flatten(1).any(-1) & ~is_over(best.end.status)
        if (some := new.nonzero().flatten()).numel() > 0:  # found, but not to the end
            call = replace(search.call.take(some), callback=None)
            keep_clear(search, some, continued(search.interior, call, best.of(some).best))

    def _rows(self, search: Search) -> Tensor:
        """The problems to solve again, (b,)."""
        problem, first = search.call.problem, search.caught.status
        if self.when == "all":
            return torch.arange(0 if problem.geometric else problem.B, device=search.call.ids.device)
        left = self._missed(search)
        if not problem.geometric:
            left |= ~is_over(first) & (first != Status.CONVERGED)
        return (left & (first != UNMOVED) & (first != Status.INVALID_START) & (first != STOPPED)).nonzero().flatten()

    @staticmethod
    def _missed(search: Search) -> Tensor:
        """Where the best trajectory is infeasible, between the knots too, or ends outside a stated goal, (B,) bool."""
        best = search.best.end.best
        missed = ~(best.violation <= search.solver.violation_tolerance) | outside_goal(search.call.problem, best.X)
        return missed | (search.best.clearance < 0)

    def _solve(self, search: Search, rows: Tensor, first: int) -> None:
        """All starts of the problems in `rows` as one batch, numbered from `first`."""
        each = rows.repeat_interleave(self.count)
        start = first + torch.arange(self.count, device=rows.device).repeat(rows.numel())
        call = replace(search.call.take(each), callback=None, warm=None)
        X, U = self._guess(call, take(search.best.end.best, each), start)
        end = solved_nearby(search.interior, replace(call, U0=U), X)
        clear_further(search, call, end)
        for number in range(self.count):
            keep_tight(search, rows, take(end, slice(number, None, self.count)))

    def _guess(self, call: Call, best: Iterate, start: Tensor) -> tuple[Tensor, Tensor]:
        """States (b, N+1, n) and controls (b, N, m) to begin with, for starts of the numbers (b,)."""
        problem, X = call.problem, best.X
        bends, changes = (DrawKey(call.seed, call.ids, STREAM + 2 * start + part) for part in (0, 1))
        noise, end = smooth_normal(changes, KNOTS, call.U0), _end(problem, X)
        driven, controls = _driven(problem, call.U0, noise)
        way = torch.linspace(0.0, 1.0, problem.N + 1, dtype=X.dtype, device=X.device).view(1, -1, 1)
        size = torch.maximum(X.amax(1) - X.amin(1), driven.amax(1) - driven.amin(1)).unsqueeze(1)
        line = X[:, :1] + way * (end - X[:, :1])
        bent = line + self.bend * 4.0 * way * (1.0 - way) * size * smooth_normal(bends, KNOTS, X)
        shift = torch.zeros_like(end)
        if problem.dynamics.position is not None:
            shift[..., problem.position] = (end - driven[:, -1:])[..., problem.position]
        odd = (start % 2 == 1).view(-1, 1, 1)
        changed = call.U0 + self.change * half_ranges(problem, call.U0) * noise
        return torch.where(odd, driven + way * shift, bent), torch.where(odd, controls, changed)


@dataclass(frozen=True)
class RequireGoal(Row):
    """Solves problems whose trajectory misses a stated goal with the goal required, by a search of its own.

    What arrives is one more candidate: the interior point goes on from it with the goal as it was stated, and where
    that leads away, or nowhere, it counts as it is.
    """

    label: ClassVar[str] = "require_goal"
    last: ClassVar[bool] = True
    problems: ClassVar[str] = "outside a goal that isn't required, within reach"
    does: ClassVar[str] = "the whole table with the goal required; interior point from what arrives"

    def run(self, search: Search) -> None:
        """Solve; see the class."""
        problem, best = search.call.problem, search.best
        if search.again is None or problem.goal is None or problem.goal.required or search.call.late:
            return
        open_ = (search.caught.status != UNMOVED) & (search.caught.status != Status.INVALID_START)
        rows = (open_ & outside_goal(problem, best.end.best.X)).nonzero().flatten()
        rows = rows[~beyond_reach(problem.take(rows))] if rows.numel() > 0 else rows
        if rows.numel() == 0:
            return
        call = replace(search.call.take(rows), callback=None, warm=None)
        near = goal_tolerance(call.problem)
        assert near is not None
        within = near - search.interior.admitted(problem)  # by as much a row may be violated
        end = search.again(replace(call, problem=call.problem.requiring_goal(within)))
        found = end.best
        multipliers = Multipliers(found.multipliers.lam[:-1], found.multipliers.mu)
        _propose(search, rows, call, replace(end, best=replace(found, multipliers=multipliers)))


@dataclass(frozen=True)
class ReleaseGoal(Row):
    """Solves problems whose required goal doesn't bind, or into which the terminal cost draws, without requiring it.

    Where it binds the cost mostly leads out of the goal, and a solve without it ends outside. Where it doesn't, the
    cost alone holds the end there, but what the row did on the way may have led past a cheaper trajectory; and so it
    may where it binds although the terminal cost is less at the centre. That is the first solve again; where this one
    had failed, of goals that don't bind the whole table, as in `RequireGoal`. Those that were caught have been led
    along ways to the goal. Nothing is solved of convex problems, nor where a state is required, an equality.
    """

    label: ClassVar[str] = "release_goal"
    last: ClassVar[bool] = True
    problems: ClassVar[str] = "never caught, a required goal doesn't bind or the terminal cost draws into it"
    does: ClassVar[str] = "interior point without the goal required; where the first solve failed, the whole table"

    def run(self, search: Search) -> None:
        """Solve; see the class."""
        problem, best, first = search.call.problem, search.best.end.best, search.caught.status
        goal = problem.goal
        if search.again is None or search.call.late or goal is None or not goal.required or goal.state is not None:
            return
        if is_convex(problem) or not Converge.worth(problem):
            return
        inside = goal.distance(best.X[:, -1, problem.position]) < goal.radius - ADMITTED
        served = (
            (best.violation <= search.solver.violation_tolerance) & (first != STOPPED) & (first != Status.INVALID_START)
        )
        failed, once = ~is_over(first), partial(search.interior.solved, escapes=True)
        drawn = inside | _draws_in(problem, best.X[:, -1])
        for rows, solves in ((drawn & ~failed, once), (inside & failed, search.again)):
            rows = rows & served
            if (some := rows.nonzero().flatten()).numel() > 0:
                call = replace(search.call.take(some), callback=None, warm=None)
                _propose(search, some, call, solves(replace(call, problem=call.problem.releasing_goal())))


def _draws_in(problem: Problem, x: Tensor) -> Tensor:
    """Whether the terminal cost of states x (B, n) is less with their position at the goal's centre, (B,) bool."""
    goal, centred = problem.goal, x.clone()
    assert goal is not None
    centred[:, problem.position] = goal.position
    return problem.cost.terminal(centred) < problem.cost.terminal(x)


def _propose(search: Search, rows: Tensor, call: Call, end: SolveEnd) -> None:
    """Solve on from what has ended, where it alone arrives in the problems of the call or is cheaper by more than a
    stationary trajectory may leave to save, and keep what is better.

    Its multipliers are of the rows of these problems, those in `rows`.
    """
    best, given, found = search.best, call.problem, end.best
    cost, violation = given.cost.total(found.X, found.U), measured(given, found.X, found.U)
    arrives = (violation <= search.solver.violation_tolerance) & has_arrived(given, found.X)
    old = best.end.best.cost[rows]
    arrives &= (cost < old - STATIONARY * old.abs()) | ~has_arrived(given, best.end.best.X[rows])
    best.end.iterations[rows] += end.iterations
    some = arrives.nonzero().flatten()
    if some.numel() == 0:
        return
    status = torch.full_like(rows[some], int(Status.MAX_ITERATIONS))
    none = torch.zeros_like(status)
    start = take(replace(found, cost=cost, violation=violation), some)
    best.keep(rows[some], SolveEnd(start, start, status, none, none, none))
    keep_clear(search, rows[some], continued(search.interior, call.take(some), start))


def _end(problem: Problem, X: Tensor) -> Tensor:
    """Where states (b, N+1, n) end, (b, 1, n): those that miss a stated goal, at its position."""
    end = X[:, -1:].clone()
    rows = outside_goal(problem, X)
    if bool(rows.any()):
        assert problem.goal is not None
        end[rows, :, problem.position] = problem.goal.position[rows].unsqueeze(1)
    return end


def _driven(problem: Problem, U: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """States (b, N+1, n) and controls (b, N, m) by noise of half the controls' range about its middle, within it.

    Where states don't stay finite, the start is held.
    """
    U = controls_of(problem, U, noise)
    X = open_loop(problem, U)
    held = torch.isfinite(X).flatten(1).all(-1).view(-1, 1, 1)
    return torch.where(held, X, problem.x0.unsqueeze(1)), U


FROM_CAUGHT = 1e-2  # barrier for iterates that lie inside of obstacles by little


@dataclass(frozen=True)
class Direct(Row):
    """Solves caught problems by the interior point too; the results are compared with the search's at its end.

    Where one arrives and costs little more than the trajectory without obstacles, which keeps all other constraints,
    there is no search: it could save no more than that. Nor is there where a vehicle that is steered along the paths
    arrives.

    Args:
        gap: how much more it may cost, as a share.
        most: obstacles at a knot, at most; and only in the plane.

    Raises:
        InputError: a field out of its range.
    """

    gap: NonNegative = 0.02
    most: Natural = 5

    label: ClassVar[str] = "direct"
    seeks_paths: ClassVar[bool] = True
    last: ClassVar[bool] = True

    @property
    def problems(self) -> str:
        return f"caught in the plane among at most {self.most} obstacles and no map"

    @property
    def does(self) -> str:
        return (
            f"interior point from the guess and from there; over {self.gap:.0%} more expensive than without obstacles, "
            "what drives along its heading is steered along the paths; search"
        )

    def run(self, search: Search) -> None:
        """Solve; see the class."""
        rows = search.rows("caught")
        if rows.numel() == 0 or not search.has_paths or not self.serves(search.call.problem):
            return
        call = replace(search.call.take(rows), callback=None, warm=None)
        bare = without_obstacles(call.problem)
        bound = torch.full_like(call.problem.x0[:, 0], -torch.inf)
        if bare is not None:
            free = WITHOUT_OBSTACLES.solved(replace(call, problem=bare))
            bound = free.best.cost
            search.best.end.iterations[rows] += free.iterations
        solver = search.interior  # what it solves counts as solved: `Tighten` leaves it as it is
        left = self._compared(search, rows, call, solver.solved(call), bound)
        if left.numel() > 0:
            start = take(search.caught.last, rows[left])
            call = replace(call.take(left), U0=start.U)
            solver = replace(solver, initial_barrier=FROM_CAUGHT)
            left = left[self._compared(search, rows[left], call, solver.solved(call, start.X), bound[left])]
        if left.numel() > 0:
            pursue(search, rows[left])

    def serves(self, problem: Problem) -> bool:
        """Whether the interior point is cheap for these problems: among few obstacles in the plane."""
        at = problem.position
        bodies = sum(part.absent.shape[1] for part in problem.geometric if isinstance(part, Obstacles))
        return at.stop - at.start == 2 and bodies <= self.most and not has_maps(problem)

    def _compared(self, search: Search, rows: Tensor, call: Call, end: SolveEnd, bound: Tensor) -> Tensor:
        """Keep results of `rows` that hardly exceed a bound (b,) on costs; places (b',) of the others, which wait."""
        serves = end.best.violation <= search.solver.violation_tolerance
        if ranks_arrival(call.problem):
            serves &= has_arrived(call.problem, end.best.X)
        quick = serves & (end.best.cost <= bound + self.gap * bound.abs())
        enough, left = quick.nonzero().flatten(), (~quick).nonzero().flatten()
        if enough.numel() > 0:
            search.best.keep(rows[enough], take(end, enough))
        search.best.end.iterations[rows[left]] += end.iterations[left]  # now, and not once more at the end
        search.best.worked[rows] = True
        if left.numel() > 0:
            waits = take(end, left)
            search.waiting.append((rows[left], replace(waits, iterations=torch.zeros_like(waits.iterations))))
        return left


@dataclass(frozen=True)
class Join(Row):
    """Lets the results of `Direct` that wait compete with the best trajectories."""

    seeks_paths: ClassVar[bool] = True
    last: ClassVar[bool] = True
    problems: ClassVar[str] = "with results that wait"
    does: ClassVar[str] = "the cheaper counts"

    def run(self, search: Search) -> None:
        """Compare; see the class."""
        for rows, end in search.waiting:
            search.best.keep(rows, end)
        search.waiting.clear()
