"""The steps of a search that solve by AL-iLQR: from the guess, from proposals, into the goal, from samples.

A step says which problems it looks at and what it does with them. The best trajectory of all passes is kept: one that
arrives at the goal before one that is feasible, then the cheapest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import torch

from torchgco.base.options import Count, Natural
from torchgco.base.status import Status
from torchgco.base.tree import put, take
from torchgco.kernels import cost_scale
from torchgco.lagrangian.penalties import GuideRegion
from torchgco.lagrangian.quality import goal_tolerance
from torchgco.problem.problem import Problem
from torchgco.search.proposals import WHEN
from torchgco.search.search import Search
from torchgco.search.table import Row
from torchgco.solvers.caught import StopWhenCaught

ATTRACTED_TO = 0.95  # share of the goal tolerance to which trajectories are attracted
ATTRACTION = 1e3  # weight of that attraction, in units of cost per radius^4
ATTEMPT_SEED_STEP = 1_000_003  # between the seeds of two attempts


@dataclass(frozen=True)
class Solve(Row):
    """A solve from the given guess.

    Args:
        until: "caught": a solve is stopped where its trajectory is caught between obstacles; "end": it isn't.
        among: "pathless": problems in which no path can be sought, as among moving obstacles, where waiting is often
            enough; "all". Those that have arrived are not solved again, nor those that have converged where the goal is
            assumed: it may lie beyond the horizon.
        single_contact_after: from this outer iteration on, a knot inside one obstacle counts as caught, too; None: only
            knots inside two.

    Raises:
        InputError: a field out of its range.
    """

    until: Literal["caught", "end"] = "caught"
    among: Literal["pathless", "all"] = "all"
    single_contact_after: Count | None = None

    label: ClassVar[str] = "solve"

    @property
    def problems(self) -> str:
        return "where no path can be sought" if self.among == "pathless" else "all, or those that have not arrived"

    @property
    def does(self) -> str:
        if self.until == "end":
            return "AL-iLQR to the end"
        after = self.single_contact_after
        single = "" if after is None else f", or inside one after {after} outer iterations"
        return f"AL-iLQR until a knot lies inside two obstacles{single}"

    def run(self, search: Search) -> None:
        """Solve; see the class."""
        if self.among == "pathless" and search.has_paths:
            return
        stop = StopWhenCaught(self.single_contact_after) if self.until == "caught" and search.guided else None
        if not search.begun:
            search.begin(search.solver.outer_loop(search.call, stop, recorder=search.recorder, by_arrival=True))
        elif search.guided:
            self._again(search, stop)

    def _again(self, search: Search, stop: StopWhenCaught | None) -> None:
        best, caught = search.best, search.caught
        goal, done = search.call.problem.goal, best.arrived()
        if goal is not None and goal.assumed:
            done = done | (caught.status == Status.CONVERGED)
        rows = (~done).nonzero().flatten()
        if rows.numel() > 0:
            again = best.attempt(search.call.take(rows), guidance=stop)
            best.keep(rows, again)
            put(caught, rows, again)


@dataclass(frozen=True)
class FromProposal(Row):
    """An attempt from every proposal of the passes before.

    The penalty of a rejected proposal is kept: it keeps the solver from returning to the caught trajectory.
    """

    problems: ClassVar[str] = "with a proposal"
    does: ClassVar[str] = "AL-iLQR from there"

    def run(self, search: Search) -> None:
        """Solve; see the class."""
        if search.round is None:
            return
        (rows, begun), search.round, best = search.round, None, search.best
        proposal = begun.result()
        best.end.iterations[rows] += proposal.iterations
        mu = torch.fmax(search.caught.last.multipliers.mu[rows], proposal.multipliers.mu)
        found, others = proposal.found.nonzero().flatten(), (~proposal.found).nonzero().flatten()
        best.end.guided[rows[found]] += 1
        search.proposed[rows[found]] = True
        search.rejected[rows[others]] = torch.fmax(search.rejected[rows[others]], mu[others])
        warm = replace(take(proposal.multipliers, found), mu=mu[found])
        best.improve(rows[found], replace(search.call.take(rows[found]), U0=proposal.U[found], warm=warm))


@dataclass(frozen=True)
class IntoGoal(Row):
    """An attempt from the best trajectories that end close to the goal, their ends attracted to it.

    Args:
        among: as of `Solve`.

    Raises:
        InputError: a field out of its range.
    """

    among: Literal["pathless", "all"] = "all"

    @property
    def problems(self) -> str:
        where = ", where no path can be sought" if self.among == "pathless" else ""
        return f"caught, close to the goal, not arrived{where}"

    label: ClassVar[str] = "into_goal"
    does: ClassVar[str] = "AL-iLQR with the end attracted to the goal"

    def run(self, search: Search) -> None:
        """Solve; see the class."""
        if self.among == "pathless" and search.has_paths:
            return
        goal, best = search.call.problem.goal, search.best
        if goal is not None and goal.required:  # its rows attract all attempts
            return
        rows = search.rows("close")
        if rows.numel() > 0:
            start = take(best.end.best, rows)
            call = replace(search.call.take(rows), U0=start.U, warm=start.multipliers)
            best.improve(rows, call, penalty=_goal_region(call.problem))


@dataclass(frozen=True)
class FromSamples(Row):
    """Attempts from the caught trajectory, guided by samples from the start: the guidance of the local solver.

    Args:
        when: as of `PathProposals`; "unproposed": there was never a proposal.
        redraws: how many attempts start again, each with other random draws; 0: the solve that was stopped goes on,
            without guidance where none can serve.

    Raises:
        InputError: a field out of its range.
    """

    when: Literal["caught", "unarrived", "unproposed"] = "unarrived"
    redraws: Natural = 0

    label: ClassVar[str] = "samples"

    @property
    def problems(self) -> str:
        return WHEN[self.when]

    @property
    def does(self) -> str:
        draws = "goes on once" if self.redraws == 0 else f"{self.redraws} times, with other draws"
        return f"AL-iLQR from the caught iterate, guided by samples: {draws}"

    def run(self, search: Search) -> None:
        """Solve; see the class."""
        for draw in range(1, self.redraws + 1) if self.redraws > 0 else (0,):
            rows = search.rows(self.when)
            if draw > 1:
                search.best.next_attempt()
            if not search.call.late and rows.numel() > 0 and (search.guidance is not None or draw == 0):
                self._attempt(search, rows, draw)

    def _attempt(self, search: Search, rows: torch.Tensor, draw: int) -> None:
        start = take(search.caught.last, rows)
        call = replace(search.call.take(rows), U0=start.U, warm=start.multipliers)
        if draw == 0:
            warm = replace(start.multipliers, mu=torch.fmax(start.multipliers.mu, search.rejected[rows]))
            call = replace(call, warm=warm, outer=search.caught.outer[rows])
        else:
            call = replace(call, seed=call.seed + ATTEMPT_SEED_STEP * draw)
        search.best.improve(rows, call, guidance=search.guidance, guide_first=True)


def _goal_region(problem: Problem) -> GuideRegion:
    """A ball around the goal for the last knot, slightly smaller than the goal tolerance."""
    near = goal_tolerance(problem)
    assert near is not None and problem.goal is not None
    size = ATTRACTED_TO * near
    radius = problem.x0.new_full((problem.B, problem.N + 1), torch.inf)
    radius[:, -1] = size
    center = problem.goal.position.unsqueeze(1).expand(-1, problem.N + 1, -1).contiguous()
    return GuideRegion(center, radius, ATTRACTION * cost_scale(problem).unit / size.pow(4), problem.position)
