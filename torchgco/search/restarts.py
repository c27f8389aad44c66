"""The default solver: AL-iLQR, and where it is caught between obstacles, the passes of a table that suit a problem."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

from torchgco.base.errors import InputError
from torchgco.base.options import check_options
from torchgco.base.shapes import repeated
from torchgco.guidance.gco import GCO, check_form, failure, suited_guide, warn_of_losses
from torchgco.kernels import expect_interior, kernels_of
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers, SolveEnd, linearise
from torchgco.obstacles.base import Obstacles
from torchgco.problem.problem import Problem
from torchgco.roadmap.geometry import has_maps, has_paths
from torchgco.search.arrivals import Arrivals
from torchgco.search.finish import ClearChords, Converge, Freed
from torchgco.search.nearby import among_nearby
from torchgco.search.proposals import PathProposals
from torchgco.search.reach import Horizon, horizon_of
from torchgco.search.rows import Tighten
from torchgco.search.search import Late, Search
from torchgco.search.solved_candidates import settle
from torchgco.search.starts import Starts
from torchgco.search.steps import FromProposal, FromSamples, IntoGoal, Solve
from torchgco.search.table import Passes, Row, passes_of
from torchgco.search.through_gates import solved_through_gates
from torchgco.search.timed import Timed
from torchgco.solution import Solution
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.contracts import Call, Guidance, Solver
from torchgco.solvers.interior import InteriorPoint, least_violated
from torchgco.solvers.session import Session
from torchgco.solvers.timing import Chooser


def suited_paths(passes: Sequence[Row], problem: Problem) -> tuple[Sequence[Row | None], str | None]:
    """The passes, with None for proposals along paths that can't serve; and a sentence on what is lost, or None.

    Obstacles that the roadmap doesn't know by design, such as moving ones, are no loss. Initial offsets for another
    number of controls are left out.
    """
    others = [None if one.seeks_paths else one for one in passes]
    if None not in others:
        return others, None
    position, bodies = problem.dynamics.position, bool(problem.obstacles)
    if position is None:
        return others, "the dynamics have no position"
    d = position.stop - position.start
    if d not in (2, 3) and bodies:
        return others, f"no path is sought around obstacles in {d}-D, as the roadmap knows only 2-D and 3-D"
    if problem.goal is None and bodies:
        return others, "no path is sought around obstacles without a goal: Problem(..., goal=Goal(position, radius))"
    if not has_paths(problem):
        return others, None
    why = None if kernels_of(problem).compiled else failure(_expand, problem, problem.x0.dtype)
    if why is not None:
        return others, f"no path can be followed ({why})"
    return [one.fitting(problem.m) for one in passes], None


def _expand(problem: Problem) -> None:
    """Evaluate the parts of an iLQR iteration, for one problem that stays at its start."""
    X = repeated(problem.x0, problem.N + 1)
    U = X.new_zeros(1, problem.N, problem.m)
    check_form("dynamics", problem.along.step(X[:, :-1], U), X[:, :-1])
    lagrangian = Lagrangian(problem, Multipliers.zero(problem, 1.0), None, True)
    check_form("cost", lagrangian.value(X, U)[1], X[:, 0, 0])
    linearise(problem, X, U)
    lagrangian.expand(X, U)


if TYPE_CHECKING:
    import pandas as pd

PASSES = Passes((Solve(), PathProposals(), FromProposal(), FromSamples("unproposed"), IntoGoal(), ClearChords()))

TABLE_COLUMNS = "name", "pass", "problems", "what it does"

TIME_PACES = 0.7, 1.0, 1.4  # of the times found, where the time is free: each is a search of its own


@dataclass(frozen=True)
class Restarts(Solver):
    """AL-iLQR, and where it is caught between obstacles, further passes; the best trajectory is returned.

    Args:
        local: makes every solve, without its `guidance`: that guides attempts from samples alone (`FromSamples`).
        passes: by name, or in a list; in their order: the first ones make a solve from the given guess.
        interior: the interior point that the passes solve by, to its own tight tolerance.

    Raises:
        InputError: a field out of its range, passes that don't begin with a solve, or one that would improve proposals
            where there are none.
    """

    local: AugmentedLagrangian = AugmentedLagrangian()
    passes: Passes = PASSES
    interior: InteriorPoint = InteriorPoint()

    def __post_init__(self) -> None:
        object.__setattr__(self, "passes", passes_of(self.passes))
        _check(self.passes)
        check_options(self, "solver")

    def table(self, problem: Problem | None = None) -> pd.DataFrame:
        """The passes, a row each: which problems they look at, and what they do with them.

        A trajectory is accepted where it is better than the best before: arrived before feasible before cheap.

        Args:
            problem: only the rows that may work on problems of this kind; None: all.
        """
        import pandas as pd

        from torchgco.search.shown import Sentences

        rows = [(name, type(row).__name__, row.problems, row.does) for name, row in self.passes.items()]
        table = pd.DataFrame(rows, pd.RangeIndex(1, len(rows) + 1, name="row"), TABLE_COLUMNS)
        kind = None if problem is None else kind_of(problem)
        return Sentences(table if kind is None else table[[kind in row.kinds for row in self.passes]])

    def in_closed_loop(self, rounds: int) -> tuple[Solver, Solver]:
        """The passes but the last solves, as the next plan continues this one; and the local solver, unguided."""
        passes = Passes(step for step in self.passes.steps if not step.last)
        local = replace(self.local, guidance=None, max_outer_iterations=rounds)
        return replace(self, passes=passes), local.in_closed_loop(rounds)[1]

    @cached_property
    def _finishes(self) -> bool:
        """Whether a pass is the interior point's: in closed loop there is none, and no time for a verdict."""
        return any(isinstance(one, Converge) for one in self.passes.steps)

    def announce(self, problem: Problem) -> None:
        """Where a pass is the interior point's."""
        if self._finishes and Converge.worth(problem):
            expect_interior(problem)

    def frees_start(self, problem: Problem) -> bool:
        """Where a pass is the interior point's."""
        return self._finishes

    def take_states(self, problem: Problem) -> bool:
        """Where the first solve is the interior point's: without obstacles."""
        first = any(isinstance(one, Converge) and one.among == "free" for one in self.passes.steps)
        return first and Converge.begins(problem)

    def choosing_time(self, problem: Problem) -> Chooser:
        """The interior point; among obstacles the passes where the time is held, and the interior point from there."""
        bodies = (part.absent.shape[1] > 0 if isinstance(part, Obstacles) else True for part in problem.geometric)
        if not any(bodies):
            starts = [one for one in self.passes.steps if isinstance(one, Starts)]
            count, every = max((one.count for one in starts), default=0), any(one.when == "all" for one in starts)
            chooser = self.interior.choosing_time(problem)
            return replace(chooser, starts=count, others=count if every else count // 2)
        limit = self.local.violation_tolerance
        through = partial(solved_through_gates, self.interior, limit)
        rounds = max((one.rounds for one in self.passes.steps if isinstance(one, ClearChords)), default=0)
        return Chooser(
            self._at_held_times(), Freed(self.interior, limit, rounds), limit, paces=TIME_PACES, through=through,
            arrivals=Arrivals.of(self.passes.steps, problem),
        )  # fmt: skip

    def _at_held_times(self) -> Restarts:
        """The same without further starts: a time that is too short has no trajectory, and the next one is tried."""
        rows = {name: row for name, row in self.passes.items() if not isinstance(row, Starts)}
        short = {name: replace(row, starts=0) for name, row in rows.items() if isinstance(row, Tighten)}
        return replace(self, passes=Passes(rows | short))

    def from_guesses(self, problem: Problem) -> Solver:
        """Without obstacles in a fixed time the same; else the interior point, without a compiler the local solver."""
        if problem.time is None and not problem.geometric:
            return self
        return self.interior if Converge.worth(problem) else replace(self.local, guidance=None)

    def horizon(self, problem: Problem) -> Horizon | None:
        """What `Solution.explain` asks of the horizon of a batch of one; see `reach.horizon_of`."""
        return horizon_of(problem)

    def recording(self) -> Restarts:
        """The same solver, which keeps the record of its search and of every iteration."""
        return replace(self, local=self.local.recording())

    def in_slots(self, slots: int) -> Restarts:
        """The same solver with at most `slots` problems at a time."""
        return replace(self, local=self.local.in_slots(slots))

    def run(self, call: Call) -> Solution:
        """Solve a checked call, with the obstacles nearby where these will do."""
        return among_nearby(call, self._solved)

    def _solved(self, call: Call) -> Solution:
        solver = self.local
        session = Session(call, solver.inner.as_printed, record=solver.record)
        passes, guidance = self._suited(session.call.problem)
        # Among what moves a goal is sought, required or not: where there is no way, there is none again.
        again = partial(self._ended, [None if isinstance(one, Timed) else one for one in passes], guidance)
        search = Search(session.call, solver, passes, guidance, self.interior, session.recorder, again)
        self._run(search, passes)
        end = search.best.end
        if self._finishes:
            end = least_violated(session.call, end, solver.violation_tolerance)
        solution = session.finished(end, solver.violation_tolerance, solver.slots)
        if search.record is None:
            return solution
        return replace(solution, search=search.finish_record(*session.scales))

    def _ended(self, passes: Sequence[Row | None], guidance: Guidance | None, call: Call) -> SolveEnd:
        """How another search of the same kind ends, which isn't recorded."""
        search = Search(call, self.local, passes, guidance, self.interior)
        self._run(search, passes)
        return search.best.end

    def _run(self, search: Search, passes: Sequence[Row | None]) -> None:
        """All passes, until the time is over; and in the last, what was sound before it is looked at again."""
        begun: tuple[int, str] | None = None
        watched = search.record is not None or search.call.callback is not None
        for number, (name, one) in enumerate(zip(self.passes.names, passes, strict=True), start=1):
            if search.begun and search.call.late:
                break
            if watched:
                if begun is not None:
                    search.end_pass(*begun)
                begun = number, name
                search.next_pass(*begun)
            with suppress(Late):
                if one is not None:
                    one.run(search)
        if self._finishes:
            settle(search, next((one for one in self.passes.steps if isinstance(one, ClearChords)), None))
        if begun is not None:
            search.end_pass(*begun)

    def _suited(self, problem: Problem) -> tuple[Sequence[Row | None], Guidance | None]:
        """The passes, None for those that can't serve these problems, and the guidance, None where it can't.

        A GuidanceWarning names what can't.
        """
        if not problem.geometric:
            return [None if one.seeks_paths else one for one in self.passes], None
        guidance, losses = self.local.guidance, list[str]()
        if isinstance(guidance, GCO):
            sampler, unsampled = suited_guide(guidance.sampler, problem)
            solves = (one for one in self.passes.steps if isinstance(one, Solve) and one.until == "caught")
            after = next((solve.single_contact_after for solve in solves), None)
            if sampler is not None and sampler is not guidance.sampler:
                guidance = replace(guidance, sampler=sampler)
            guidance = None if sampler is None else guidance.in_search(after)
            losses += [] if unsampled is None else [unsampled]
        elif guidance is not None:
            guidance = guidance.suited(problem)
        passes, unsought = suited_paths(self.passes, problem)
        losses += [] if unsought is None else [unsought]
        warn_of_losses(losses, guidance is None and not any(one.seeks_paths for one in passes if one is not None))
        return passes, guidance


def kind_of(problem: Problem) -> str:
    """The kind of problem: "free" of obstacles, "moving" where no path can be sought, "maps", or "bodies" without."""
    if not problem.geometric:
        return "free"
    return "moving" if not has_paths(problem) else "maps" if has_maps(problem) else "bodies"


def _check(passes: Passes) -> None:
    """InputError for no first solve, or for a pass that would improve no proposals."""
    begun = False
    for number, row in enumerate(passes):
        for step in row.steps:
            if isinstance(step, PathProposals) and step.continues and not begun:
                expected = f"path proposals before those that are {step.when}, and no FromProposal in between"
                raise InputError(f"solver.passes[{number}].when", expected, step.when)
            begun = isinstance(step, PathProposals) or (begun and not isinstance(step, FromProposal))
    some = [isinstance(one, Solve | Converge) and one.among in ("pathless", "free") for one in passes.steps]
    first = next((one for one, of_some in zip(passes.steps, some, strict=True) if not of_some), None)
    if not isinstance(first, Solve):
        got = "none" if first is None else type(first).__name__
        raise InputError("solver.passes", "a Solve first, not only for problems without paths", got)
