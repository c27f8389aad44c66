"""Proposals along paths: for each problem the best of several trajectories past obstacles, and the record of it.

A pass finds paths, one per homotopy class, or takes those that are known, and has candidates follow them. The
candidates are relaxed: solved further without a guide, while a penalty keeps them out of the obstacles. The best are
refined by AL-iLQR, and the cheapest is proposed, with the multipliers to continue with.

A proposal may touch obstacles slightly: the solver removes that. Candidates that penetrate deeper are rejected, since
removing it would use up a whole attempt, or must first be refined.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import zip_longest
from typing import Any, ClassVar, Literal, NamedTuple, Self

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.options import Count, Natural, Positive
from torchgco.base.shapes import computing_on
from torchgco.base.tree import put, take
from torchgco.kernels import cost_scale, current_device, open_loop, value
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.obstacles.base import ADMITTED
from torchgco.problem.problem import Problem
from torchgco.roadmap import geometry as seen
from torchgco.roadmap.geometry import Scene
from torchgco.roadmap.homotopy import classes
from torchgco.roadmap.roadmap import Known, Roadmap, paths_through
from torchgco.search.candidates import CANDIDATE_PENALTY, Candidates, Refine, Refined, Watch, inner_solver, unwatched
from torchgco.search.following import Follow, Free, Paths, limits_states, plain, unconstrained
from torchgco.search.nearby import WITHOUT_OBSTACLES, without_obstacles
from torchgco.search.table import Row
from torchgco.solution import Comparison, Fate, SearchRecord
from torchgco.solvers.contracts import Call


def comparison(
    number: int,
    rows: Tensor,
    paths: Paths,
    refine: Refine,
    tracked: Candidates,
    relaxed: Candidates,
    sound: Tensor,
    refined: Refined,
    found: Tensor,
) -> Comparison:
    """The record of one comparison, from the candidates after each step.

    Args:
        number: of the pass in the solver's table.
        rows: (b,) places of the problems in the batch.
        sound: which of the relaxed candidates are, (b * count,) bool.
        found: (b,) bool: whether there is a proposal.
    """
    B, C = tracked.problem.B, tracked.count
    last = refined.candidates
    fate = torch.where(tracked.live, int(Fate.TRACKED), int(Fate.ABSENT)).view(B, C)
    _write(fate, relaxed, torch.where(sound, int(Fate.RELAXED), int(Fate.UNSOUND)), relaxed.live)
    known = _written(fate, relaxed, sound.to(torch.int64), relaxed.live, 0) == 1
    solved = known.gather(1, last.number.view(B, -1)).flatten() & (refine.top > 1)
    good = refined.cost.isfinite()
    _write(fate, last, torch.where(good, int(Fate.REFINED), int(Fate.FAILED)), solved)
    chosen = torch.zeros_like(last.live)
    chosen[refined.best[found]] = True
    _write(fate, last, torch.full_like(last.number, int(Fate.PROPOSED)), chosen)
    each = torch.arange(C, device=rows.device) // (C // paths.corners.shape[1])
    empty = tracked.X.new_full((B, C, *tracked.X.shape[1:]), torch.nan)
    cost = _written(empty[..., 0, 0], last, refined.cost, solved, torch.nan)
    return Comparison(
        number, rows, paths.corners, paths.classes, each.expand(B, C), fate, tracked.X.view_as(empty).clone(),
        _written(empty, relaxed, relaxed.X, relaxed.live, torch.nan), _written(empty, last, last.X, solved, torch.nan),
        cost,
    )  # fmt: skip


def _write(table: Tensor, candidates: Candidates, values: Tensor, where: Tensor) -> None:
    """Write the values (b * count, ...) of some candidates into a table (b, C, ...), in place."""
    chosen = where.nonzero().flatten()
    table[chosen // candidates.count, candidates.number[chosen]] = values[chosen]


def _written(like: Tensor, candidates: Candidates, values: Tensor, where: Tensor, empty: float) -> Tensor:
    table = torch.full_like(like, empty)
    _write(table, candidates, values, where)
    return table


WHEN = {
    "caught": "caught",
    "unarrived": "caught, not arrived",
    "far": "caught, not even close to the goal",
    "unproposed": "caught, without a proposal",
}
PATHS_AT_ONCE = 1536  # paths of all problems that are compared and tracked together: bounds the memory
SAME_COST = 2e-3  # relaxed candidates whose penalised costs differ by less, as a share, count as the same


class Proposal(NamedTuple):
    """Trajectories to continue from."""

    U: Tensor  # (B, N, m)
    found: Tensor  # (B,) bool: whether there is a proposal; elsewhere U is not to be used
    multipliers: Multipliers  # to continue with; mu keeps the solver from leaving the path, NaN where there is none
    iterations: Tensor  # (B,) int64: of all solves of all candidates, also where none is found
    cost: Tensor  # (B,): as refined; infinite where no candidate was refined with success

    @classmethod
    def none(cls, problem: Problem, rest: Tensor) -> Proposal:
        """No proposal for any problem; controls like rest (B, N, m)."""
        count = torch.zeros(problem.B, dtype=torch.int64, device=rest.device)
        cost = torch.full_like(problem.x0[:, 0], torch.inf)
        return cls(rest.clone(), count.bool(), Multipliers.zero(problem, torch.nan), count, cost)


@dataclass(frozen=True)
class PathProposals(Row):
    """A step that follows short paths between static obstacles, and proposes the candidate that is cheapest to fly.

    Args:
        when: the problems that it looks at. Among those that were caught: all ("caught"), those that have not arrived
            since ("unarrived"), and those that don't end close to the goal either ("far"). Among those that the pass
            before has looked at: those with a path but no proposal ("unproposed"), and those with a proposal that costs
            far more than the trajectory without constraints ("costly").
        roadmaps: find the paths, one search each; none: the paths that the pass before has found.
        num_paths: paths of each search, before those of one homotopy class are merged.
        follow: how each path is followed; candidates of several ways to do it are compared one after the other.
        relax_iterations: iLQR iterations of relaxing, at most; 0 compares the candidates as tracked.
        relax_top: candidates per problem that are relaxed, the cheapest as tracked; None: all.
        refine: how the best are refined.
        max_penetration: largest accepted penetration of a relaxed candidate into an obstacle, as a share of the mean
            inflated radius.
        max_gap: for "costly": how much more than without constraints a proposal may cost, as a share; None: anything.

    Raises:
        InputError: a field out of its range.
    """

    when: Literal["caught", "unarrived", "far", "unproposed", "costly"] = "unarrived"
    roadmaps: tuple[Roadmap, ...] = (Roadmap(),)
    num_paths: Count = 1
    follow: tuple[Follow, ...] = (Follow(),)
    relax_iterations: Natural = 20
    relax_top: Count | None = None
    refine: Refine = Refine()
    max_penetration: Positive = 0.1
    max_gap: Positive | None = None

    label: ClassVar[str] = "proposals"
    seeks_paths: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("roadmaps", "follow"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if not self.follow:
            raise InputError("proposals.follow", "one or more ways to follow a path", self.follow)
        if not self.roadmaps and not self.continues:
            raise InputError("proposals.roadmaps", f"one or more, for the problems that are {self.when}", ())

    @property
    def continues(self) -> bool:
        """Whether this pass improves the proposals of the one before."""
        return self.when in ("unproposed", "costly")

    @property
    def problems(self) -> str:
        if self.when == "costly":
            return f"with a proposal over {self.max_gap or 0.0:.0%} more expensive than without obstacles"
        return WHEN[self.when]

    @property
    def does(self) -> str:
        points = " and ".join(str(roadmap.num_halton) for roadmap in self.roadmaps)
        paths = f"{self.num_paths} paths over {points} points" if self.roadmaps else "the same paths"
        relax = "all" if self.relax_top is None else f"the best {self.relax_top}"
        relaxed = f"{relax} relaxed, {self.relax_iterations} iterations" if self.relax_iterations else "not relaxed"
        refined = f"; the best {self.refine.top} refined, {self.refine.rounds} rounds" if self.refine.top > 1 else ""
        least = ", as refined" if self.refine.needed else ""
        ways = "; then ".join(str(follow) for follow in self.follow)
        return f"{paths}: {ways}; {relaxed}{refined}; accepted up to {self.max_penetration:g} R deep{least}"

    def run(self, search: Any) -> None:
        """Propose; see the class."""
        if not self.continues:
            search.begin_round(self.when, self.at_once)
        if search.round is not None:
            rows, begun = search.round
            search.best.worked[rows[begun.improve(self)]] = True

    def fitting(self, m: int) -> Self:
        """Without initial offsets that have another number of controls than m."""
        return replace(self, follow=tuple(follow.fitting(m) for follow in self.follow))

    @property
    def at_once(self) -> int:
        """How many problems are looked at together."""
        return max(1, PATHS_AT_ONCE // (self.num_paths * max(1, len(self.roadmaps))))

    def improve(self, part: Part, watch: Watch) -> Tensor:
        """Better proposals for the problems of `part` that this pass looks at, in place; returns these, (b,)."""
        rows = self._rows(part)
        for some in rows.split(self.at_once if self.roadmaps else max(1, rows.numel())):
            self._improve(part, some, watch)
        return rows

    def _rows(self, part: Part) -> Tensor:
        """The problems (b,) of `part` that this pass looks at."""
        if part.scene is None or part.problem.B == 0:
            return part.proposal.found.new_empty(0, dtype=torch.int64)
        if self.when == "unproposed":
            assert part.paths is not None
            return (part.paths.live.any(-1) & ~part.proposal.found).nonzero().flatten()
        if self.when != "costly":
            return torch.arange(part.problem.B, device=part.rest.device)
        if self.max_gap is None:
            return part.proposal.found.new_empty(0, dtype=torch.int64)
        free, U = part.free(self.follow[0].iterations).cost, part.proposal.U
        cost, _ = value(plain(part.problem), open_loop(part.problem, U), U)
        rows = (part.proposal.found & (cost > free + self.max_gap * free.abs())).nonzero().flatten()
        least = torch.maximum(free[rows], part.limited(rows))
        return rows[cost[rows] > least + self.max_gap * least.abs()]

    def _improve(self, whole: Part, rows: Tensor, watch: Watch) -> None:
        """As `improve`, for the problems in `rows`."""
        if rows.numel() == 0:
            return
        problem = whole.problem.take(rows)
        paths = whole.seek(rows, self.roadmaps, self.num_paths) if self.roadmaps else take(whole.paths, rows)
        if not self.continues:
            whole.paths = paths
        for follow in self.follow:
            new, old = self._along(whole, rows, problem, paths, follow, watch), take(whole.proposal, rows)
            better = (~old.found | (new.found & (new.cost < old.cost))).nonzero().flatten()
            put(whole.proposal, rows[better], take(new, better))
            whole.proposal.iterations[rows] = old.iterations + new.iterations

    def _along(
        self, whole: Part, rows: Tensor, problem: Problem, paths: Paths, follow: Follow, watch: Watch
    ) -> Proposal:
        """Proposals for `problem`, some rows of the whole, along paths that are known, followed in one way."""
        paced = follow.pace is not None or limits_states(problem)
        free, K = take(whole.free(follow.iterations), rows) if paced else None, paths.corners.shape[1]
        starts = follow.starts(problem, whole.rest[rows]).repeat_interleave(len(follow.paces), dim=1)
        live = paths.live.repeat_interleave(starts.shape[1], dim=1)
        candidates = Candidates.begin(problem, starts.repeat(1, K, 1, 1), paths.R, paths.unit, live, watch)
        tracked = follow.track(candidates, paths, free)
        relaxed, sound = self.relax(tracked.pick(tracked.order(tracked.arrive)[:, : self.relax_top]))
        order = relaxed.order(sound, SAME_COST)[:, : self.refine.top]
        picked = sound[relaxed.rows(order).flatten()]
        refined = relaxed.pick(order).refined(picked, self.refine, follow.iterations)
        best, some = refined.best, paths.live.any(-1)
        multipliers, cost = take(refined.multipliers, best), refined.cost[best]
        multipliers = replace(multipliers, mu=torch.where(some, multipliers.mu, torch.nan))
        needed = self.refine.needed or follow.obstacles == 0.0
        found = some & (cost.isfinite() if needed else picked[best])
        if whole.record is not None:
            whole.note(rows, paths, self.refine, tracked, relaxed, sound, refined, found)
        return Proposal(refined.candidates.U[best], found, multipliers, refined.candidates.iterations, cost)

    def relax(self, candidates: Candidates) -> tuple[Candidates, Tensor]:
        """The candidates, solved further without a guide, and whether they are sound, (B * count,)."""
        if self.relax_iterations > 0:
            relaxed = candidates.solved(inner_solver(self.relax_iterations), CANDIDATE_PENALTY)
            # A candidate that falls back into the trap, where waiting is cheaper, stays as tracked.
            keeps = (relaxed.arrive | ~candidates.arrive).view(-1, 1, 1)
            X, U = torch.where(keeps, relaxed.X, candidates.X), torch.where(keeps, relaxed.U, candidates.U)
            candidates = replace(relaxed, X=X, U=U)
        shallow = candidates.penetration() <= self.max_penetration * candidates.R
        return candidates, candidates.live & candidates.arrive & shallow


class Part:
    """Some problems of a round, in units of cost: their paths, and the proposals so far.

    Args:
        rest: controls (B, N, m) at rest.
        places: (B,) in the batch, for the record.
    """

    def __init__(self, problem: Problem, rest: Tensor, places: Tensor, record: SearchRecord | None) -> None:
        self.problem, self.rest, self.places, self.record = problem, rest, places, record
        self.scene: Scene | None = seen.scene_of(problem, rest)
        self.known = Known()  # of the searches in the scene
        self.paths: Paths | None = None
        self.proposal = Proposal.none(problem, rest)
        self._free: Free | None = None
        self._ahead: Future[Paths] | None = None  # of all problems, from another thread

    @cached_property
    def scales(self) -> tuple[Tensor, Tensor]:
        """R and q0 / R^4 (B,); see `geometry.scales`."""
        assert self.scene is not None
        return seen.scales(self.problem, self.scene, self.rest)

    def seek_ahead(self, helper: Executor, roadmaps: Sequence[Roadmap], count: int) -> None:
        """Begin to seek, in a helper's thread, what `seek` will be asked for, of all problems."""
        if self.scene is not None and self.scene.gates is None:
            every = torch.arange(self.problem.B, device=self.rest.device)
            self._ahead = helper.submit(copy_context().run, self._sought, every, roadmaps, count)

    def seek(self, rows: Tensor, roadmaps: Sequence[Roadmap], count: int) -> Paths:
        """The paths of some searches, `count` each and one per homotopy class, of the problems in `rows`."""
        ahead, self._ahead = self._ahead, None
        return self._sought(rows, roadmaps, count) if ahead is None else ahead.result()

    def _sought(self, rows: Tensor, roadmaps: Sequence[Roadmap], count: int) -> Paths:
        """`seek`."""
        scene, known = self.scene, list[tuple[Tensor, Tensor]]()
        assert scene is not None
        with computing_on(self.rest.device):
            R, unit = (scale[rows] for scale in self.scales)
            usable, found = torch.isfinite(unit) & (unit > 0), torch.zeros_like(rows, dtype=torch.bool)
            for number, roadmap in enumerate(roadmaps):
                if any(roadmap.repeats(other, scene) for other in roadmaps[:number]):
                    continue
                corners, arrives = paths_through(roadmap, scene, count, rows, self.known)
                known.append((corners, (arrives & usable).unsqueeze(-1).expand(-1, count)))
                found = found | (arrives & usable)
            corners, live = (torch.cat(parts, dim=1) for parts in zip(*known, strict=True))
            obstacles = scene.obstacles if rows.numel() == self.problem.B else take(scene.obstacles, rows)
            label = classes(corners, obstacles)
            first = label == torch.arange(label.shape[1], device=label.device)
            return Paths(corners, label, first & live, R, torch.where(found, unit, 1.0), obstacles)

    def note(self, rows: Tensor, paths: Paths, refine: Refine, *steps: Any) -> None:
        """Record a comparison for the problems in `rows`; see `comparison`."""
        assert self.record is not None
        number = self.record.passes[-1][0]
        self.record.comparisons.append(comparison(number, self.places[rows], paths, refine, *steps))

    def free(self, iterations: int) -> Free:
        """The trajectories without constraints, solved at the first call; their iterations count as the proposals'."""
        if self._free is None:
            _, unit = self.scales
            self._free = unconstrained(self.problem, self.rest, iterations, unit.nan_to_num(1.0, 1.0, 1.0))
            self.proposal.iterations.add_(self._free.iterations)
        return self._free

    def limited(self, rows: Tensor) -> Tensor:
        """Costs (b,) of the trajectories of some problems without obstacles, but within all other limits.

        Minus infinity where none is found, or where there are no such limits.
        """
        least = torch.full_like(self.rest[rows, 0, 0], -torch.inf)
        bare = without_obstacles(self.problem.take(rows)) if rows.numel() > 0 else None
        if bare is None or len(bare.constraints) == len(bare.obstacles):
            return least
        end = WITHOUT_OBSTACLES.solved(Call.within(bare, self.rest[rows]))
        self.proposal.iterations[rows] += end.iterations
        return torch.where(end.best.violation <= ADMITTED, end.best.cost, least)


class Round:
    """Proposals for some problems, which one pass after another improves."""

    def __init__(
        self,
        problem: Problem,
        at_once: int,
        watch: Watch = unwatched,
        places: Tensor | None = None,
        record: SearchRecord | None = None,
    ) -> None:
        self.watch, self.unit = watch, cost_scale(problem).unit
        self.problem, scaled = problem, problem.in_cost_units()
        self.rest = problem.cost.rest_controls(problem.x0.new_zeros(problem.B, problem.N, problem.m))
        everyone = torch.arange(problem.B, device=problem.x0.device)
        places = everyone if places is None else places
        self.rows = everyone.split(at_once)
        self.parts = [Part(scaled.take(rows), self.rest[rows], places[rows], record) for rows in self.rows]

    def improve(self, proposals: PathProposals) -> Tensor:
        """One more pass; returns the problems (b,) that it looked at.

        Where a device solves candidates, a thread of the CPU seeks the next part's paths meanwhile.
        """
        together = not proposals.continues and proposals.at_once >= len(self.rows[0])  # all of a part
        seeks, worked = bool(proposals.roadmaps) and together and current_device() is not None, []
        with ThreadPoolExecutor(1) as helper:
            for rows, part, after in zip_longest(self.rows, self.parts, self.parts[1:]):
                if seeks and after is not None:
                    after.seek_ahead(helper, proposals.roadmaps, proposals.num_paths)
                worked.append(rows[proposals.improve(part, self.watch)])
        return torch.cat(worked)

    def result(self) -> Proposal:
        """The proposals so far, in the problem's own units."""
        whole = Proposal.none(self.problem, self.rest)
        for rows, part in zip(self.rows, self.parts, strict=True):
            put(whole, rows, part.proposal)
        return whole._replace(multipliers=whole.multipliers.scaled(self.unit), cost=whole.cost * self.unit)


def propose(passes: Sequence[PathProposals], problem: Problem) -> Proposal:
    """Proposals for every problem, from the vehicle at rest, by some passes.

    Raises:
        InputError: initial offsets that don't fit the controls.
    """
    found = Round(problem, passes[0].at_once)
    for proposals in passes:
        found.improve(proposals)
    return found.result()
