"""The last solves of a search: tight to the tolerance, and clear of what a trajectory cuts between two knots.

Constraints hold at the knots. Where the vehicle turns around the corner of a box or a small sphere within one time
step, the straight line between two knots may come closer than both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import torch
from torch import Tensor

from torchgco.base.options import Count
from torchgco.base.status import SOLVED, Status, is_over
from torchgco.base.tree import put, take
from torchgco.kernels import is_convex, measured, path_clearance
from torchgco.lagrangian.lagrangian import Iterate, SolveEnd
from torchgco.lagrangian.quality import is_preferred, leaves_goal
from torchgco.native.compiler import find_compiler
from torchgco.problem.problem import Problem
from torchgco.roadmap.geometry import has_maps
from torchgco.search.nearby import Nearby
from torchgco.search.search import Search, is_sound
from torchgco.search.table import Row
from torchgco.solution import Solution
from torchgco.solvers.contracts import Call
from torchgco.solvers.ending import DOUBTED, STATIONARY
from torchgco.solvers.interior import InteriorPoint

WORTH = 0.01  # share of the cost that a trajectory without violation may cost more than one with some


@dataclass(frozen=True)
class Converge(Row):
    """Solves by the interior point of the table, to its own tight tolerance.

    Args:
        among: "free": problems without obstacles, from the given guess, once more from the start held where holding it
            would cost less than what is found, and by AL-iLQR where the interior point fails. "all": those that are not
            yet solved as tightly, from the best trajectory; where that leads to none that is feasible, from the guess.

    Raises:
        InputError: a field out of its range.
    """

    among: Literal["free", "all"] = "all"

    label: ClassVar[str] = "converge"
    last: ClassVar[bool] = True

    def run(self, search: Search) -> None:
        """Solve; see the class."""
        problem = search.call.problem
        if self.among == "all":
            if find_compiler() is not None:
                self._tighten(search)
        elif self.begins(problem) and not search.begun:
            found = search.interior.solved(search.call, guess=search.guess, escapes=True)
            search.begin(search.interior.no_worse(search.call, search.guess, found))
            self._from_rest(search)
            if (rows := _unsolved(search)).numel() > 0:
                search.best.improve(rows, search.call.take(rows))

    @property
    def problems(self) -> str:
        return "without obstacles" if self.among == "free" else "not solved as tightly yet"

    @property
    def does(self) -> str:
        start = "the guess, or the start held" if self.among == "free" else "the best trajectory"
        return f"interior point from {start}"

    @staticmethod
    def _from_rest(search: Search) -> None:
        """Solve again from the start held, where that costs less, though no step may hold it, than what was found.

        The rollout of a guess may fall far away from an upright pendulum, and the solve stay there. What was found of a
        convex problem is the least.
        """
        call, best, status = search.call, search.best.end.best, search.best.end.status
        if call.warm is not None or call.X0 is not None:  # a guess that was chosen
            return
        open_ = status != Status.INVALID_START
        if is_convex(call.problem):
            open_ &= ~is_over(status)
        if not bool(open_.any()):
            return
        held = call.problem.cost_at_rest
        rows = (open_ & torch.isfinite(held) & ~(best.cost <= held)).nonzero().flatten()
        if rows.numel() > 0:
            X, U = call.problem.at_rest
            call = replace(call.take(rows), U0=U[rows], callback=None)
            keep_tight(search, rows, search.interior.solved(call, X[rows]))

    @staticmethod
    def worth(problem: Problem) -> bool:
        """Whether an interior point is there, which needs a compiler, and there is more to do than AL-iLQR does."""
        return bool(problem.constraints or problem.free_start is not None) and find_compiler() is not None

    @classmethod
    def begins(cls, problem: Problem) -> bool:
        """Whether the first solve of these problems is one by the interior point: they have no obstacles, too."""
        return not problem.geometric and cls.worth(problem)

    def _tighten(self, search: Search) -> None:
        best, rows, whole = search.best, _unsolved(search), replace(search.call, callback=None)  # not worth a report
        if rows.numel() > 0:
            keep_clear(search, rows, continued(search.interior, whole.take(rows), best.of(rows).best, escapes=True))
        lost = best.end.best.violation[rows] > search.solver.violation_tolerance
        lost = rows[lost & ~is_over(best.end.status[rows])]
        if lost.numel() > 0:
            keep_clear(search, lost, search.interior.solved(whole.take(lost)))


def keep_clear(search: Search, rows: Tensor, end: SolveEnd) -> None:
    """Keep solved trajectories, unless the old ones are better by more than a small violation is worth.

    Better are those that arrive, that are clear between knots or touch less there, or that cost less.
    """
    problem, limit = search.call.problem.take(rows), search.solver.violation_tolerance
    old, new = search.best.of(rows).best, end.best
    arrives = ~leaves_goal(problem, new.X, old.X)
    near = new.cost <= old.cost + WORTH * old.cost.abs()
    serves = is_preferred(problem, new, old, limit) | (is_over(end.status) & arrives & near)
    now, before = path_clearance(problem, new.X, new.U), search.best.clearance[rows]
    clear = ~(now < before.clamp(max=0.0))
    clear |= old.violation > limit
    search.best.replace(rows, serves & clear & torch.isfinite(new.cost), new, end)


def keep_tight(search: Search, rows: Tensor, end: SolveEnd) -> None:
    """Keep results of the interior point that are better than the best by more than rounding, and as feasible.

    A result is better that is feasible where the best isn't, arrives at a stated goal where the best doesn't, or is
    cheaper by more than a stationary trajectory may leave to save. Where the best touches an obstacle between two knots
    one is better that touches less; where it doesn't, none is that does.
    """
    old, new = search.best.of(rows).best, end.best
    admitted = search.interior.admitted(search.call.problem)
    # A solve that failed counts as lost where it violates by more than those that succeed.
    solved = is_over(search.best.end.status[rows])
    limit = torch.where(solved, search.solver.violation_tolerance, admitted)
    lost = ~(old.violation <= limit)
    cheaper = new.cost < old.cost - STATIONARY * old.cost.abs()
    tight = (end.status == SOLVED) & (new.violation <= old.violation.clamp(min=admitted))
    problem = search.call.problem.take(rows)
    arrives = leaves_goal(problem, old.X, new.X)
    better = is_preferred(problem, new, old, limit) & (lost | arrives | (cheaper & tight))
    now, before = path_clearance(problem, new.X, new.U).clamp(max=0.0), search.best.clearance[rows].clamp(max=0.0)
    clearer = (now > before) & (new.violation <= limit) & ~leaves_goal(problem, new.X, old.X)
    search.best.replace(rows, torch.where(lost | (now == before), better, clearer), new, end)


def _unsolved(search: Search) -> Tensor:
    status = search.best.end.status
    return (~is_over(status) & (status != Status.INVALID_START)).nonzero().flatten()


def continued(solver: InteriorPoint, call: Call, start: Iterate, escapes: bool = False) -> SolveEnd:
    """Solves of a call from trajectories, with their multipliers, among the obstacles near these.

    Args:
        escapes: as of `InteriorPoint.solved`.
    """
    return solved_nearby(solver, replace(call, U0=start.U, warm=start.multipliers), start.X, escapes)


def solved_nearby(solver: InteriorPoint, call: Call, X: Tensor, escapes: bool = False) -> SolveEnd:
    """Solves of a call from states X (B, N+1, n), among the obstacles near these; `escapes` as of `continued`."""
    near = Nearby.along(call, X)
    if near is None:
        return solver.solved(call, X, escapes=escapes)
    found = solver.solved(near.call, X, escapes=escapes)
    wrong, end = near.wrong(found.best), replace(found, best=near.whole(found.best), last=near.whole(found.last))
    if wrong.numel() > 0:
        again = solver.solved(call.take(wrong), X[wrong], escapes=escapes)
        put(end, wrong, replace(again, iterations=end.iterations[wrong] + again.iterations))
    return end


EXTRA = 1.1  # times the missing clearance: by how much obstacles grow in a round
IN_MAPS = 2  # times as many rounds, which are short there
GROWN_BARRIER = 1e-4  # of warm solves among grown obstacles, which lie deeper than rounding
MIN_GROWTH = 0.1  # and at least this share of the allowed violation: solves differ by as much


@dataclass(frozen=True)
class ClearChords(Row):
    """Replaces feasible trajectories that touch an obstacle between two knots by ones that keep clear of it.

    Obstacles grow by 1.1 times the clearance that the last solve missed, or a little more, and the solve continues from
    the best trajectory: by AL-iLQR, and where that finds nothing by the interior point alone. A trajectory is replaced
    where the new one is feasible for the obstacles as they are, has arrived if the old one had, and keeps clearer of
    them between the knots. Openings may leave no room for it: there a more expensive trajectory of the passes before
    that is clear is taken back, or one along another way of a map, where it can be brought clear.

    Args:
        rounds: solves at most, each with larger obstacles than the one before; in maps, by the interior point alone,
            twice as many.

    Raises:
        InputError: a field out of its range.
    """

    rounds: Count = 4

    label: ClassVar[str] = "chords"
    kinds: ClassVar[tuple[str, ...]] = ("moving", "maps", "bodies")
    problems: ClassVar[str] = "touching an obstacle between two knots"

    @property
    def does(self) -> str:
        return f"AL-iLQR and interior point among larger obstacles, {self.rounds} rounds; accepted with more clearance"

    def run(self, search: Search) -> None:
        """Solve; see the class."""
        best = search.best

        def once(rows: Tensor, call: Call, old: Iterate, least: Tensor) -> tuple[Tensor, Tensor]:
            best.next_attempt()
            if has_maps(call.problem):  # along whose one row per knot AL-iLQR takes many short steps
                return self._continued(search, rows, call, old, least)
            serves, now = self._relaxed(search, rows, call, least)
            left = (~serves).nonzero().flatten()  # a relaxed solve may leave through a wall that is thin
            if left.numel() > 0:
                part = rows[left], call.take(left), take(old, left), least[left]
                serves[left], now[left] = self._continued(search, *part)
            return serves, now

        limit = search.solver.violation_tolerance
        rounds = self.rounds * (IN_MAPS if has_maps(search.call.problem) else 1)
        best.restore(*cleared(search.call, best.end.best, rounds, limit, once, best.clearance))
        _along_other_ways(search)

    def _continued(
        self, search: Search, rows: Tensor, call: Call, old: Iterate, least: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The interior point goes on from the best; as `_kept`."""
        grown = replace(search.interior, warm_barrier=GROWN_BARRIER)
        return self._kept(search, rows, continued(grown, replace(call, callback=None), old), least)

    def _relaxed(self, search: Search, rows: Tensor, call: Call, least: Tensor) -> tuple[Tensor, Tensor]:
        """AL-iLQR, and from where it serves the interior point; as `_kept`."""
        new = search.best.attempt(call)
        serves, now = self._kept(search, rows, new, least)
        some = serves.nonzero().flatten()
        if some.numel() > 0:
            tight = continued(search.interior, replace(call.take(some), callback=None), take(new.best, some))
            wanted = torch.where(is_over(tight.status), now[some].clamp(max=0.0), torch.inf)
            too, clear = self._kept(search, rows[some], tight, wanted)
            now[some] = torch.where(too, clear, now[some])
        return serves, now

    def _kept(self, search: Search, rows: Tensor, new: SolveEnd, least: Tensor) -> tuple[Tensor, Tensor]:
        """Where new trajectories of `rows` serve, with more clearance than `least`, they replace the best.

        Returns where they did, and their clearances.
        """
        best, problem = search.best, search.call.problem.take(rows)
        old, limit = best.of(rows).best, search.solver.violation_tolerance
        serves, found, clearance = serving(problem, new.best, old, least, limit)
        best.replace(rows, serves, found, new)
        return serves, clearance


Once = Callable[[Tensor, Call, Iterate, Tensor], tuple[Tensor, Tensor]]


def cleared(
    call: Call, best: Iterate, rounds: int, limit: float, once: Once, clearance: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Solve the feasible problems of a call that touch an obstacle between two knots again, among larger obstacles.

    Args:
        best: the trajectories so far, of all problems; `once` puts better ones into it.
        limit: violation up to which they are feasible.
        once: solves problems `rows` (b,), by a call with obstacles that have grown for them, from their trajectories,
            where more clearance than `least` (b,) is wanted. Returns where it has put new ones, and the clearances
            (b,) that it has found.
        clearance: `path_clearance` (B,) of `best`, where it is known.

    Returns:
        The problems that touched, and whether they still do.
    """
    clearance = path_clearance(call.problem, best.X, best.U) if clearance is None else clearance.clone()
    by, now = torch.zeros_like(clearance), clearance.clone()
    rows = touching = ((best.violation <= limit) & (clearance < 0)).nonzero().flatten()
    for _ in range(rounds):
        if rows.numel() == 0 or call.late:
            break
        by[rows] += (-EXTRA * now[rows]).clamp(min=MIN_GROWTH * limit)
        old, part = take(best, rows), call.take(rows)
        part = replace(part, problem=part.problem.grown(by[rows]), U0=old.U, warm=old.multipliers)
        serves, now[rows] = once(rows, part, old, clearance[rows])
        clearance[rows] = torch.where(serves, now[rows], clearance[rows])
        rows = rows[clearance[rows] < 0]
    return touching, clearance[touching] < 0


def clear_further(search: Search, call: Call, end: SolveEnd) -> None:
    """The interior point goes on among larger obstacles where solves of a call have ended in contact between knots.

    Args:
        end: how they have ended; the trajectories that are clearer take their places in it.
    """
    solver, limit = replace(search.interior, warm_barrier=GROWN_BARRIER), search.solver.violation_tolerance

    def once(rows: Tensor, larger: Call, old: Iterate, least: Tensor) -> tuple[Tensor, Tensor]:
        new = continued(solver, larger, old)
        serves, found, clearance = serving(call.problem.take(rows), new.best, old, least, limit)
        chosen = serves.nonzero().flatten()
        put(end.best, rows[chosen], take(found, chosen))
        end.status[rows[chosen]] = new.status[chosen]
        end.iterations[rows] += new.iterations
        return serves, clearance

    cleared(call, end.best, ClearChords().rounds, limit, once)


def _along_other_ways(search: Search) -> None:
    """Where the best can't be brought clear between the knots, the cheapest candidate of another way that can be."""
    best, limit = search.best, search.solver.violation_tolerance
    for row, others in sorted(best.others.items()):
        at = search.call.ids.new_tensor([row])
        call = replace(search.call.take(at), callback=None)
        for other in others:
            if search.call.late or bool(is_sound(call.problem, best.of(at).best, limit)):
                break
            clear_further(search, call, other)
            serves = is_sound(call.problem, other.best, limit)
            best.replace(at, serves & ~leaves_goal(call.problem, other.best.X, best.of(at).best.X), other.best, other)


def serving(
    problem: Problem, new: Iterate, old: Iterate, least: Tensor, limit: float
) -> tuple[Tensor, Iterate, Tensor]:
    """Where new trajectories may replace old ones, as they are among the problems' own obstacles, and their clearances.

    They do where they are feasible, arrive if the old ones do, and keep more clearance than `least`, (B,), m.
    """
    found = replace(new, violation=measured(problem, new.X, new.U))
    clearance = path_clearance(problem, found.X, found.U)
    serves = (found.violation <= limit) & (clearance > least)
    return serves & ~leaves_goal(problem, found.X, old.X), found, clearance


@dataclass(frozen=True)
class Freed:
    """The interior point, which goes on among larger obstacles where its trajectory touches one between two knots.

    Args:
        interior: the solver.
        limit: violation up to which a trajectory is feasible.
        rounds: solves at most, each with larger obstacles than the one before.
    """

    interior: InteriorPoint
    limit: float
    rounds: int

    def take_states(self, problem: Problem) -> bool:
        """See `Solver`."""
        return self.interior.take_states(problem)

    def run(self, call: Call) -> Solution:
        """Solve a checked call, as `Solver.run` does."""
        found, solver = self.interior.run(call), replace(self.interior, warm_barrier=GROWN_BARRIER)
        best = Iterate(found.X, found.U, found.multipliers, found.cost, found.violation)
        dear = found.cost + DOUBTED * found.cost.abs()

        def once(rows: Tensor, larger: Call, old: Iterate, least: Tensor) -> tuple[Tensor, Tensor]:
            new = solver.run(replace(larger, X0=old.X))
            one = Iterate(new.X, new.U, new.multipliers, new.cost, new.violation)
            serves, one, clearance = serving(call.problem.take(rows), one, old, least, self.limit)
            found.iterations[rows] += new.iterations
            chosen = serves.nonzero().flatten()
            put(best, rows[chosen], take(one, chosen))
            near = (new.status != Status.CONVERGED) | (new.cost <= dear[rows])
            status = torch.where(near, new.status, int(Status.FEASIBLE))
            for own, other in ((found.K, new.K), (found.d, new.d), (found.status, status)):
                own[rows[chosen]] = other[chosen]
            return serves, clearance

        cleared(call, best, self.rounds, self.limit, once)
        return found
