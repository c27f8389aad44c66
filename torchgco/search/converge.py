"""Solves by the interior point: the first of problems without obstacles, and the last of all that are not yet tight."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import torch
from torch import Tensor

from torchgco.base.status import SOLVED, Status, is_over
from torchgco.base.tree import put
from torchgco.kernels import is_convex, path_clearance
from torchgco.lagrangian.quality import is_preferred, leaves_goal
from torchgco.lagrangian.state import Iterate, SolveEnd
from torchgco.native.compiler import find_compiler
from torchgco.problem.problem import Problem
from torchgco.search.nearby import Nearby
from torchgco.search.search import Search
from torchgco.search.table import Row
from torchgco.solvers.contracts import Call
from torchgco.solvers.ending import STATIONARY
from torchgco.solvers.interior import InteriorPoint, guessed

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
            guess = guessed(search.call)
            found = search.interior.solved(search.call, guess=guess, escapes=True)
            search.begin(search.interior.no_worse(search.call, guess, found))
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
        X, U = call.problem.at_rest
        held = call.problem.cost.total(X, U)
        rows = (open_ & torch.isfinite(held) & ~(best.cost <= held)).nonzero().flatten()
        if rows.numel() > 0:
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
            keep_clear(search, rows, continued(search.interior, whole.take(rows), best.of(rows).best))
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


def continued(solver: InteriorPoint, call: Call, start: Iterate) -> SolveEnd:
    """Solves of a call from trajectories, with their multipliers, among the obstacles near these."""
    return solved_nearby(solver, replace(call, U0=start.U, warm=start.multipliers), start.X)


def solved_nearby(solver: InteriorPoint, call: Call, X: Tensor) -> SolveEnd:
    """Solves of a call from states X (B, N+1, n), among the obstacles near these."""
    near = Nearby.along(call, X)
    if near is None:
        return solver.solved(call, X)
    found = solver.solved(near.call, X)
    wrong, end = near.wrong(found.best), replace(found, best=near.whole(found.best), last=near.whole(found.last))
    if wrong.numel() > 0:
        again = solver.solved(call.take(wrong), X[wrong])
        put(end, wrong, replace(again, iterations=end.iterations[wrong] + again.iterations))
    return end
