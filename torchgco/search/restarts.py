"""The default solver: AL-iLQR with restarts, from paths of several homotopy classes and from samples.

1. The solver works on every problem until its trajectory is caught between obstacles, or its solve ends. Where no path
   can be sought, as among moving obstacles, it first works to the end, and again on the problems that don't arrive.
2. Where it is caught, `paths` proposes a trajectory along the best of several paths, and the solver continues from it.
   Where that attempt ends close to the goal, another one attracts its end to the goal; where it ends farther away, the
   best of more and better candidates is proposed.
3. Without a path, or where that attempt doesn't arrive, further attempts start from the caught trajectory, guided by
   samples.
4. Where no attempt arrives but the best one ends close to the goal, it is attracted to the goal, too.
5. The best trajectory of all attempts is taken: one that arrives before one that is feasible, then the cheapest. Where
   it touches an obstacle between two knots, it is solved again with grown obstacles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from torchgco.base.draws import DrawKey
from torchgco.base.errors import InputError
from torchgco.base.options import Count, check_options
from torchgco.base.status import Status
from torchgco.base.tree import copied, put, take
from torchgco.guidance.detection import caught_knots
from torchgco.guidance.gco import GCO
from torchgco.guidance.suitability import suited_guide, warn_of_losses
from torchgco.lagrangian.penalties import GuideRegion
from torchgco.lagrangian.quality import goal_tolerance
from torchgco.native.dispatch import cost_unit
from torchgco.problem.problem import Problem
from torchgco.search.best import Best
from torchgco.search.chords import clear_chords
from torchgco.search.finish import finish
from torchgco.search.paths import PathProposals
from torchgco.search.suitability import has_paths, suited_paths
from torchgco.solution import Solution
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.contracts import Advice, Call, Progress, Solver
from torchgco.solvers.ending import finished
from torchgco.solvers.history import Recorder
from torchgco.solvers.state import STOPPED, Iterate, SolveEnd

CLOSE = 2.0  # times the goal tolerance: trajectories that end nearer are attracted to the goal
WITHIN = 0.95  # share of the goal tolerance to which they are attracted
STIFF = 1e3  # weight of that attraction, in units of cost per radius^4
SEED_STEP = 1_000_003  # between the seeds of two attempts


@dataclass(frozen=True)
class Restarts(Solver):
    """AL-iLQR, and where it is caught between obstacles, further attempts; the best trajectory is returned.

    Args:
        local: solves every attempt; its `guidance` is None.
        paths: proposals along paths between static obstacles, for the first attempt after a trajectory is caught; None:
            no such attempt.
        sampling: guidance of the other attempts; its `single_contact_after` also says when a trajectory counts as
            caught. None: no sampled attempts.
        attempts: number per problem, after its trajectory is caught.
        all_attempts: make all attempts even if one arrives, and return the cheapest result.
        finish: continues the best trajectories that no attempt has solved to the end, with more iterations; None: they
            are returned as they are.

    Raises:
        InputError: a field out of its range, or a `local` with guidance.
    """

    local: AugmentedLagrangian = AugmentedLagrangian()
    paths: PathProposals | None = PathProposals()
    sampling: GCO | None = GCO()
    attempts: Count = 4
    all_attempts: bool = False
    finish: AugmentedLagrangian | None = None

    def __post_init__(self) -> None:
        check_options(self, "solver")
        if self.local.guidance is not None:
            raise InputError("solver.local.guidance", "null: attempts are guided by `sampling`", self.local.guidance)

    def in_slots(self, slots: int) -> Restarts:
        """The same solver with at most `slots` problems at a time."""
        return replace(self, local=self.local.in_slots(slots))

    def run(self, call: Call) -> Solution:
        """Solve a checked call."""
        solver = self.local
        scaled, unit = solver.inner.in_units(call)
        recorder = Recorder() if solver.record else None
        paths, sampling = self._suited(scaled.problem)
        if paths is None and sampling is None:
            best = Best(scaled, solver.iterate(scaled, recorder=recorder, by_arrival=True), solver, recorder)
        else:
            best, caught = self._first(scaled, not has_paths(scaled.problem), recorder)
            self._restart(best, caught, paths, sampling)
        if self.finish is not None:
            finish(best, self.finish)
        if not call.late:
            clear_chords(best)
        phr = not solver.inner.as_printed
        return finished(call, scaled, unit, best.end, phr, solver.violation_tolerance, solver.slots, recorder)

    def _suited(self, problem: Problem) -> tuple[PathProposals | None, GCO | None]:
        """The parts that can serve these problems; a GuidanceWarning names the others."""
        if not problem.geometric:
            return None, None
        sampler, unsampled = suited_guide(None if self.sampling is None else self.sampling.sampler, problem)
        paths, unsought = suited_paths(self.paths, problem)
        sampling = None if sampler is None or self.sampling is None else replace(self.sampling, sampler=sampler)
        warn_of_losses([why for why in (unsampled, unsought) if why is not None], sampling is None and paths is None)
        return paths, sampling

    def _first(self, call: Call, to_the_end: bool, recorder: Recorder | None) -> tuple[Best, SolveEnd]:
        """The first solves: the best trajectories, and the solves that were stopped where they were caught.

        Waiting is enough among most moving obstacles: `to_the_end`, only problems that a solve to its end doesn't bring
        to the goal are solved again and stopped; nor are those solved again that converge, where the goal is assumed:
        it may lie beyond the horizon.
        """
        solver = self.local
        stop = StopWhenCaught(None if self.sampling is None else self.sampling.single_contact_after)
        if not to_the_end:
            caught = solver.iterate(call, stop, recorder=recorder, by_arrival=True)
            return Best(call, caught, solver, recorder), caught
        best = Best(call, solver.iterate(call, recorder=recorder, by_arrival=True), solver, recorder)
        caught = copied(best.end)
        goal, done = call.problem.goal, best.arrived()
        if goal is not None and goal.assumed:
            done = done | (caught.status == Status.CONVERGED)
        rows = (torch.ones_like(done) if self.all_attempts else ~done).nonzero().flatten()
        best.next_attempt()
        if rows.numel() > 0 and not call.late:
            again = best.attempt(call.take(rows), stop)
            best.keep(rows, again)
            put(caught, rows, again)
        return best, caught

    def _restart(self, best: Best, caught: SolveEnd, paths: PathProposals | None, sampling: GCO | None) -> None:
        """All attempts for the problems that were stopped."""
        stopped = caught.status == STOPPED
        for attempt in range(1, self.attempts + 1):
            if best.call.late:
                return
            best.next_attempt()
            wanted = (stopped if self.all_attempts else stopped & ~best.arrived()).nonzero().flatten()
            start = take(caught.last, wanted)
            if attempt == 1 and paths is not None:
                wanted, start = self._path_attempts(best, stopped, wanted, start, paths)
            if wanted.numel() > 0 and (sampling is not None or attempt == 1):
                self._from_samples(best, wanted, start, attempt, sampling, caught.outer)
        best.next_attempt()
        self._into_the_goal(best, stopped)

    def _path_attempts(
        self, best: Best, stopped: Tensor, rows: Tensor, start: Iterate, paths: PathProposals
    ) -> tuple[Tensor, Iterate]:
        """Attempts along paths at the problems in `rows`; returns those of them without a proposal, and their start."""
        left, last = self._along_paths(best, rows, start, paths)
        best.next_attempt()
        self._into_the_goal(best, stopped)
        best.next_attempt()
        if self.attempts == 1 or best.call.late:
            return left, last
        failed = ~best.arrived()[rows] & ~best.arrived(CLOSE)[rows]
        again = failed.nonzero().flatten()
        none, _ = self._along_paths(best, rows[again], take(start, again), paths.thorough())
        still = torch.isin(left, none).nonzero().flatten()
        return left[still], take(last, still)

    def _along_paths(self, best: Best, rows: Tensor, start: Iterate, paths: PathProposals) -> tuple[Tensor, Iterate]:
        """An attempt from the proposal of each problem in `rows`; returns the problems without one, and their start.

        The penalty of a rejected proposal is kept: it keeps the solver from returning to the caught trajectory.
        """
        if rows.numel() == 0:
            return rows, start
        try:
            proposal = paths.propose(best.call.problem.take(rows), partial(_watched, best, rows))
        except _Late:
            return rows[:0], take(start, rows[:0])
        best.end.iterations[rows] += proposal.iterations
        mu = torch.fmax(start.multipliers.mu, proposal.multipliers.mu)
        found, others = proposal.found.nonzero().flatten(), (~proposal.found).nonzero().flatten()
        best.end.guided[rows[found]] += 1
        warm = replace(take(proposal.multipliers, found), mu=mu[found])
        best.improve(rows[found], replace(best.call.take(rows[found]), U0=proposal.U[found], warm=warm))
        start = take(start, others)
        return rows[others], replace(start, multipliers=replace(start.multipliers, mu=mu[others]))

    def _from_samples(
        self, best: Best, rows: Tensor, start: Iterate, attempt: int, sampling: GCO | None, outer: Tensor
    ) -> None:
        """An attempt at the problems in `rows` from their caught trajectories, guided by samples from the start.

        Without `sampling` the solve that was stopped, after `outer` (B,) outer iterations, continues to its end.
        """
        call = replace(best.call.take(rows), U0=start.U, warm=start.multipliers)
        if attempt == 1:
            call = replace(call, outer=outer[rows])
        else:  # other random draws
            call = replace(call, seed=call.seed + SEED_STEP * (attempt - 1))
        best.improve(rows, call, guidance=sampling, guide_first=True)

    def _into_the_goal(self, best: Best, stopped: Tensor) -> None:
        """An attempt from the best trajectories that end close to the goal, their ends attracted to it."""
        rows = (stopped & ~best.arrived() & best.arrived(CLOSE)).nonzero().flatten()
        if rows.numel() > 0 and not best.call.late:
            start = take(best.end.best, rows)
            call = replace(best.call.take(rows), U0=start.U, warm=start.multipliers)
            best.improve(rows, call, penalty=_goal_region(call.problem))


class _Late(Exception):
    """The time limit has passed during the search for paths."""


def _watched(best: Best, rows: Tensor, done: int, total: int) -> None:
    """Report that `done` of `total` candidates for the problems `rows` are solved; raises _Late after the deadline."""
    call = best.call
    if call.late:
        raise _Late
    if call.callback is not None:
        best.finished = max(best.finished, call.problem.B - rows.numel())
        call.callback(Progress(0, call.rows[rows], best.finished, call.problem.B, candidates=(done, total)))


class StopWhenCaught:
    """Guidance that ends the solve of a problem whose trajectory is caught between obstacles."""

    def __init__(self, single_contact_after: int | None) -> None:
        self.single_contact_after = single_contact_after

    def suited(self, problem: Problem) -> StopWhenCaught:
        """This guidance, which serves any problem."""
        return self

    def start(self, problem: Problem, X: Tensor) -> None:
        """No penalty."""

    def update(self, problem: Problem, X: Tensor, U: Tensor, penalty: GuideRegion | None, key: DrawKey) -> Advice:
        """Stop where a knot is caught."""
        return Advice(None, stop=caught_knots(problem, X, U, key.outer, self.single_contact_after).any(-1))


def _goal_region(problem: Problem) -> GuideRegion:
    """A ball around the goal for the last knot, slightly smaller than the goal tolerance."""
    near = goal_tolerance(problem)
    assert near is not None and problem.goal is not None
    size = WITHIN * near
    radius = problem.x0.new_full((problem.B, problem.N + 1), torch.inf)
    radius[:, -1] = size
    center = problem.goal.position.unsqueeze(1).expand(-1, problem.N + 1, -1).contiguous()
    return GuideRegion(center, radius, STIFF * cost_unit(problem) / size.pow(4), problem.position)
