"""Several candidate trajectories for every problem of a batch: solved together, counted, and ordered."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchgco.base.options import Count, Positive, check_options
from torchgco.base.tree import LastTaken, put, take
from torchgco.ilqr.line_search import LineSearch
from torchgco.kernels import at_once, chord_clearance, measured, value
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers
from torchgco.lagrangian.penalties import Penalty
from torchgco.obstacles.base import ADMITTED
from torchgco.problem.horizons import at_rest_after
from torchgco.problem.problem import Problem
from torchgco.roadmap import geometry as seen
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.contracts import Call
from torchgco.solvers.ilqr import ILQR, descend

CANDIDATES_AT_ONCE = 256  # candidates solved at once: bounds the memory of any batch
CANDIDATE_PENALTY = 80.0  # of obstacles for candidates without a guide, in q0 / R^4
CANDIDATE_TOLERANCE = 5e-5  # of tracking and relaxing, as a share of L_M; refining takes a tenth of it
LINE_SEARCH = LineSearch(back=2)
Watch = Callable[[int, int], None]  # is called with the candidates solved so far, and of how many


@dataclass(frozen=True)
class Refine:
    """How the best candidates are solved by AL-iLQR before the cheapest is chosen.

    Args:
        top: candidates per problem, of the relaxed ones that differ; 1: the best is proposed as it is.
        rounds: outer iterations, at most.
        violation: the most at which a refined candidate counts, m for lengths.
        cut: the deepest that it may lie in an obstacle between two knots, as a share of the obstacle's margin; the
            judge accepts 0.05.
        needed: whether candidates count only as refined; otherwise the best relaxed one is proposed where no refined
            one counts.

    Raises:
        InputError: a field out of its range.
    """

    top: Count = 1
    rounds: Count = 20
    violation: Positive = ADMITTED
    cut: Positive = 0.049
    needed: bool = False

    def __post_init__(self) -> None:
        check_options(self, "refine")


def inner_solver(iterations: int, share: float = 1.0) -> ILQR:
    """The inner solver of candidates, with a share of their tolerance."""
    return _inner(share * CANDIDATE_TOLERANCE, iterations)


# Each search asks for the same few: checking their options again takes longer than finding them.
@lru_cache(maxsize=64)
def _inner(tolerance: float, iterations: int) -> ILQR:
    return ILQR(tolerance=tolerance, max_iterations=iterations, line_search=LINE_SEARCH)


def unwatched(done: int, total: int) -> None:
    """Ignores the progress of candidates."""


@dataclass(frozen=True)
class Candidates:
    """Some candidates for each of B problems, those of one problem next to each other.

    Every tensor but `iterations` has a row for each candidate.
    """

    problem: Problem  # of the B problems
    X: Tensor  # (B * count, N+1, n)
    U: Tensor  # (B * count, N, m)
    R: Tensor  # (B * count,): mean inflated radius, m
    unit: Tensor  # (B * count,): q0 / R^4
    live: Tensor  # bool: the others are never solved, and come last
    number: Tensor  # (B * count,) int64: place among the candidates of its problem at the beginning
    count: int  # candidates of each problem
    iterations: Tensor  # (B,) int64: of all solves so far, those of dropped candidates included
    watch: Watch
    selected: LastTaken  # the problems of the candidates that a step looked at last

    @classmethod
    def begin(
        cls, problem: Problem, U: Tensor, R: Tensor, unit: Tensor, live: Tensor, watch: Watch = unwatched
    ) -> Candidates:
        """Candidates with controls U (B, count, N, m) where `live` (B, count); R and unit (B,)."""
        count = U.shape[1]
        R, unit = (t.repeat_interleave(count) for t in (R, unit))
        X = U.new_zeros(U.shape[0] * count, problem.N + 1, problem.n)
        none = torch.zeros(problem.B, dtype=torch.int64, device=U.device)
        number = torch.arange(count, device=U.device).repeat(problem.B)
        return cls(problem, X, U.flatten(0, 1), R, unit, live.flatten(), number, count, none, watch, LastTaken(problem))

    def pick(self, order: Tensor) -> Candidates:
        """The candidates at the places `order` (B, c) among those of their problem."""
        return self._at(self.rows(order).flatten(), count=order.shape[1])

    def of_problems(self, places: Tensor) -> Candidates:
        """All candidates of the problems at `places` (b,), without the iterations so far."""
        rows = (places.unsqueeze(1) * self.count + torch.arange(self.count, device=places.device)).flatten()
        problem = self.problem.take(places)
        none = torch.zeros_like(self.iterations[places])
        return self._at(rows, problem=problem, iterations=none, selected=LastTaken(problem))

    def _at(self, rows: Tensor, **changes: Any) -> Candidates:
        each = {name: getattr(self, name)[rows] for name in ("X", "U", "R", "unit", "live", "number")}
        return replace(self, **each, **changes)

    def rows(self, order: Tensor) -> Tensor:
        """Rows (B, c) of the candidates at the places `order` (B, c)."""
        return torch.arange(order.shape[0], device=order.device).unsqueeze(-1) * self.count + order

    def of(self, rows: Tensor) -> Problem:
        """The problems of the candidates in `rows` (b,)."""
        return self.selected.take(rows // self.count)

    def lagrangian(self, rows: Tensor, penalty: float, attraction: Penalty | None = None) -> Lagrangian:
        """The cost of the candidates in `rows` (b,), with a penalty of obstacles in q0 / R^4 and no multipliers."""
        problem = self.of(rows)
        return Lagrangian(problem, Multipliers.none(problem, penalty * self.unit[rows]), attraction, True)

    def parts(self) -> Iterator[Tensor]:
        """Rows of the live candidates, `CANDIDATES_AT_ONCE` at a time on the CPU."""
        rows, most = self.live.nonzero().flatten(), at_once(CANDIDATES_AT_ONCE)
        if rows.numel() <= most:
            return iter((rows,) if rows.numel() > 0 else ())
        return iter(rows.split(most))

    @cached_property
    def arrive(self) -> Tensor:
        """Whether each candidate ends near the goal, (B * count,)."""
        return seen.arrives(self.problem, self.X.view(self.problem.B, self.count, *self.X.shape[1:])).flatten()

    def penetration(self) -> Tensor:
        """The deepest penetration of each live candidate into an obstacle, (B * count,), m."""
        depth = torch.zeros_like(self.R)
        for rows in self.parts():
            depth[rows] = measured(self.of(rows), self.X[rows], self.U[rows], obstacles=True)
        return depth

    def solved(
        self, inner: ILQR, penalty: float, attraction: Penalty | None = None, place: Tensor | None = None
    ) -> Candidates:
        """The candidates after one inner solve of every live one, with a penalty of obstacles in q0 / R^4.

        `place` says which row of `attraction` belongs to each candidate.
        """
        X, U, iterations = self.X.clone(), self.U.clone(), self.iterations
        done, total = 0, int(self.live.sum())
        for rows in self.parts():
            part = take(attraction, rows if place is None else place[rows])
            end, _ = descend(inner, self.lagrangian(rows, penalty, part), U[rows])
            X[rows], U[rows] = end.X, end.U
            iterations = iterations.index_add(0, rows // self.count, end.iterations)
            done += rows.numel()
            self.watch(done, total)
        return replace(self, X=X, U=U, iterations=iterations)

    def refined(self, sound: Tensor, refine: Refine, iterations: int) -> Refined:
        """The candidates with those in `sound` solved by AL-iLQR, or as they are where only one is wanted.

        A solve counts where it ends near the goal and violates no more than `refine` says, at knots and between them.

        Args:
            sound: (B * count,) bool.
            iterations: of an inner solve, at most.
        """
        everyone = torch.arange(self.live.numel(), device=sound.device)
        lam = tuple(self.U.new_zeros(everyone.numel(), *shape) for shape in self.problem.row_shapes)
        multipliers, rows = Multipliers(lam, CANDIDATE_PENALTY * self.unit), sound.nonzero().flatten()
        if refine.top == 1 or rows.numel() == 0:
            return Refined(self, multipliers, everyone[:: self.count], torch.full_like(self.unit, torch.inf))
        part, inner = self.of(rows), inner_solver(iterations, 0.1)
        solver = AugmentedLagrangian(inner, initial_penalty=1.0, max_outer_iterations=refine.rounds)
        watched = None if self.watch is unwatched else lambda now: self.watch(now.finished, now.total)
        call = Call.within(part, at_rest_after(part, self.U[rows]), take(multipliers, rows), watched)
        end, made = solver.improved(call)
        good = (end.violation <= refine.violation) & seen.arrives(part, end.X)
        good &= chord_clearance(part, end.X, refine.cut) >= 0.0
        won = rows[good]
        X, U, cost = self.X.clone(), self.U.clone(), torch.full_like(self.unit, torch.inf)
        X[won], U[won], cost[won] = end.X[good], end.U[good], end.cost[good]
        total = self.iterations.index_add(0, rows // self.count, made)
        put(multipliers, won, take(end.multipliers, good.nonzero().flatten()))
        best = self.rows(cost.view(-1, self.count).argsort(dim=-1, stable=True)[:, :1])[:, 0]
        return Refined(replace(self, X=X, U=U, iterations=total), multipliers, best, cost)

    def order(self, first: Tensor, alike: float | None = None) -> Tensor:
        """Places (B, count) of each problem's candidates, the best first.

        Candidates in `first` come before the others; then the penalised cost decides. Of those in `first` whose costs
        differ by at most `alike`, as a share, all but the cheapest come after the others.
        """
        merit, first = torch.full_like(self.unit, torch.inf), first & self.live
        for rows in self.parts():
            merit[rows] = value(self.lagrangian(rows, CANDIDATE_PENALTY), self.X[rows], self.U[rows])[1]
        merit, order = merit.nan_to_num(torch.inf).view(-1, self.count).sort(dim=-1, stable=True)
        later = (~first).view(-1, self.count).gather(1, order).to(torch.int8)
        later, again = later.sort(dim=-1, stable=True)
        merit, order = merit.gather(1, again), order.gather(1, again)
        if alike is not None:
            same = merit[:, 1:] - merit[:, :-1] <= alike * merit[:, :-1].abs()
            later[:, 1:] += same & (later[:, 1:] == 0)
            order = order.gather(1, later.argsort(dim=-1, stable=True))
        return order


class Refined(NamedTuple):
    """Candidates after refining."""

    candidates: Candidates
    multipliers: Multipliers  # of each candidate, to continue with
    best: Tensor  # (B,): row of each problem's cheapest; the first where no solve counts
    cost: Tensor  # (B * count,): infinite where no solve was made or counts
