"""Proposals along paths: for each problem, the best of several trajectories that follow short paths past obstacles.

1. The roadmap gives short paths; one per homotopy class is kept.
2. Candidates track each path, from rest and from each initial offset of the controls, at each pace.
3. The candidates are relaxed: solved further without a guide; a penalty keeps them out of the obstacles.
4. The best by penalised cost are refined: the augmented Lagrangian solves them to convergence.
5. Where no candidate arrives, the paths are followed again, closer; where the best costs far more than the trajectory
   without obstacles, more paths are compared.
6. The cheapest is proposed, with the multipliers to continue with.

A proposal may touch obstacles slightly: the solver removes that. Candidates that penetrate deeper are rejected, since
removing it would use up a whole attempt.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from torchgco.errors import InputError
from torchgco.lagrangian import Multipliers
from torchgco.native.dispatch import cost_unit, open_loop, value
from torchgco.options import AtLeast, Below, Count, Natural, Positive, check_options
from torchgco.problem import Problem
from torchgco.search import scene as seen
from torchgco.search.candidates import PENALTY, Candidates, Watch, unwatched
from torchgco.search.geometry import Scene
from torchgco.search.homotopy import one_per_class
from torchgco.search.roadmap import Roadmap
from torchgco.search.tracking import attraction, followed
from torchgco.search.ways import Ways, plain, unconstrained
from torchgco.shapes import check_shape, tensor
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.ilqr import ILQR
from torchgco.solvers.line_search import LineSearch
from torchgco.tree import put, take

MOST = 1536  # paths of all problems that are tracked together: bounds the memory
OFFSET_LASTS = 0.1  # share of the horizon that an initial offset lasts
ALIKE = 2e-3  # relaxed candidates whose penalised costs differ by less, as a share, count as the same

TOLERANCE = 5e-5  # of tracking and relaxing, as a share of L_M; refining takes a tenth of it
SEARCH = LineSearch(back=2)
TRACK_PENALTY = 10.0  # of obstacles while a path is tracked, in q0 / R^4
# Where no candidate arrives, the paths are followed again, with corners averaged over a share of the horizon that is
# smaller by a factor. A spring gives way to the cost, so it gets stiffer; in a tube more iterations help.
SHARPER, STIFFER, LONGER = 4.0, 10.0, 2
# Where the best candidate is costly, this many times as many paths are followed and relaxed. The best few are refined
# for some outer iterations, which show the costs to a few percent, and compared if they violate less than 1 cm.
MORE, COMPARED, ROUNDS, NEARLY = 2, 3, 4, 1e-2
THOROUGH = 3  # times as many iterations of tracking, where an attempt along the best path has failed
LEAST = 0.05  # share of the horizon between departure and arrival
VIOLATION = 1e-3  # m for lengths: the most of other refined candidates


class Proposal(NamedTuple):
    """Trajectories to continue from."""

    U: Tensor  # (B, N, m)
    found: Tensor  # (B,) bool: whether there is a proposal; elsewhere U is not to be used
    multipliers: Multipliers  # to continue with; mu keeps the solver from leaving the path, NaN where there is none
    iterations: Tensor  # (B,) int64: of all solves of all candidates, also where none is found


@dataclass(frozen=True)
class PathProposals:
    """Follow short paths between static obstacles, and propose the candidate that is cheapest to fly.

    Args:
        roadmap: finds the paths.
        num_paths: paths per problem, before those of one homotopy class are merged.
        initial_offsets: offsets (m,) of the controls over the first tenth of the horizon, as shares of the range from
            rest to the control bounds; every path is tracked from rest and once from each offset. An initial turn lets
            a vehicle that turns slowly find reversing and three-point turns. `Restarts` leaves them out where they
            don't fit the number of controls.
        depart, arrive: shares of the horizon at which the vehicle leaves the start and reaches the goal. Several
            values of `arrive`: every path is tracked at each pace.
        pace: times the time that the vehicle takes without constraints, per length of the way: no path is followed more
            slowly than this, whatever `arrive` says. None: no such limit.
        smoothing: share of the horizon over which the corners of a path are averaged, at most (`tracking.followed`).
        tube: radius of the tube that a candidate is kept in, as a share of the mean inflated radius; None: a spring to
            the path instead. A spring takes half the iterations; a vehicle that can't move sideways ends closer to the
            path in a tube.
        stiffness: of tube or spring, one tracking solve per value, in units of the cost of resting at the start per
            squared distance to the goal.
        track_iterations, relax_iterations: iLQR iterations of each of these solves, at most; relax_iterations=0
            compares the candidates as tracked.
        relax_top: candidates per problem that are relaxed, the cheapest as tracked; None: all.
        refine_top: candidates per problem that AL-iLQR solves to convergence, of the relaxed ones that differ; 1: the
            best relaxed candidate is proposed as it is.
        max_penetration: largest accepted penetration of a relaxed candidate into an obstacle, as a share of the mean
            inflated radius.
        max_gap: how much more than without constraints the best candidate may cost, as a share; where it costs more,
            twice as many paths are compared, and the three best candidates refined. None: it may cost anything.

    Raises:
        InputError: a field out of its range.
    """

    roadmap: Roadmap = Roadmap()
    num_paths: Count = 1
    initial_offsets: tuple[tuple[float, ...], ...] = ()
    depart: float = 0.0
    arrive: float | tuple[float, ...] = 0.9
    pace: Positive | None = None
    smoothing: Annotated[float, AtLeast(0), Below(1)] = 0.08
    tube: Positive | None = 0.05
    stiffness: tuple[Positive, ...] = (20.0, 200.0)
    track_iterations: Count = 20
    relax_iterations: Natural = 20
    relax_top: Count | None = None
    refine_top: Count = 1
    max_penetration: Positive = 0.1
    max_gap: Positive | None = None

    def __post_init__(self) -> None:
        check_options(self, "paths")
        for name in ("arrive", "stiffness", "initial_offsets"):  # lists of a configuration file equal tuples
            if isinstance(value := getattr(self, name), Sequence):
                rows = (tuple(row) if isinstance(row, list) else row for row in value)
                object.__setattr__(self, name, tuple(rows))
        if not self.paces or not all(0 <= self.depart < arrive <= 1 for arrive in self.paces):
            raise InputError("paths.depart", f"at least 0 and below arrive, {self.arrive}", self.depart)
        if not self.stiffness:
            raise InputError("paths.stiffness", "one or more numbers above 0", self.stiffness)

    @property
    def paces(self) -> tuple[float, ...]:
        """The values of `arrive`, as a tuple."""
        return tuple(self.arrive) if isinstance(self.arrive, Sequence) else (self.arrive,)

    @property
    def thorough(self) -> PathProposals:
        """Proposals for problems that these don't bring to the goal: more paths, followed closer, and all refined."""
        return replace(
            self, num_paths=MORE * self.num_paths, track_iterations=THOROUGH * self.track_iterations, relax_top=None,
            refine_top=max(MORE * self.num_paths, self.refine_top), pace=None, max_gap=None,
        )  # fmt: skip

    def propose(self, problem: Problem, watch: Watch = unwatched) -> Proposal:
        """A proposal for every problem, from the vehicle at rest.

        `watch` is called with how many candidates of the current step are solved, and of how many; an exception that
        it raises ends the search.

        Raises:
            InputError: initial offsets that don't fit the controls.
        """
        rest = problem.cost.rest_controls(problem.x0.new_zeros(problem.B, problem.N, problem.m))
        none = torch.zeros(problem.B, dtype=torch.int64, device=problem.x0.device)
        whole = Proposal(rest, none.bool(), Multipliers.zero(problem, torch.nan), none)
        unit, scaled = cost_unit(problem), problem.in_cost_units()
        for rows in torch.arange(problem.B, device=none.device).split(max(1, MOST // self.num_paths)):
            part = self._propose(scaled.take(rows), rest[rows], watch)
            if part is not None:
                put(whole, rows, part)
        return whole._replace(multipliers=whole.multipliers.scaled(unit))

    def _propose(self, problem: Problem, rest: Tensor, watch: Watch) -> Proposal | None:
        scene = seen.scene_of(problem, rest)
        if scene is None:
            return None
        ways = self._ways(problem, rest, scene)
        proposal = self._along(problem, rest, ways, watch)
        if ways.free is not None:
            proposal.iterations.add_(ways.free.iterations)
        more = self._costly(problem, ways, proposal)
        self._closer(problem, rest, ways, proposal, watch)
        self._wider(problem, rest, more, proposal, watch)
        return proposal

    def _ways(self, problem: Problem, rest: Tensor, scene: Scene) -> Ways:
        paths, found = self.roadmap.paths(scene, self.num_paths)
        R, unit = seen.scales(problem, scene, rest)
        found = found & torch.isfinite(unit) & (unit > 0)
        live = one_per_class(paths, scene) & found.unsqueeze(-1)
        compared = self.pace is not None or self.max_gap is not None
        free = unconstrained(problem, rest, _inner(self.track_iterations)) if compared else None
        return Ways(paths, live, R, torch.where(found, unit, 1.0), scene.obstacles, free)

    def _closer(self, problem: Problem, rest: Tensor, ways: Ways, proposal: Proposal, watch: Watch) -> None:
        """Where there are paths but no proposal along them, follow them again, closer."""
        rows = (ways.live.any(-1) & ~proposal.found).nonzero().flatten()
        if rows.numel() > 0:
            closer = replace(self, smoothing=self.smoothing / SHARPER)
            if self.tube is None:
                closer = replace(closer, stiffness=(STIFFER * self.stiffness[-1],))
            else:
                closer = replace(closer, track_iterations=LONGER * self.track_iterations)
            more = closer._along(problem.take(rows), rest[rows], take(ways, rows), watch)
            put(proposal, rows, more._replace(iterations=more.iterations + proposal.iterations[rows]))

    def _costly(self, problem: Problem, ways: Ways, proposal: Proposal) -> Tensor:
        """The problems (b,) whose proposal costs far more than the trajectory without constraints."""
        if self.max_gap is None or ways.free is None:
            return proposal.found.new_empty(0, dtype=torch.int64)
        cost, _ = value(plain(problem), open_loop(problem, proposal.U), proposal.U)
        costly = cost > ways.free.cost + self.max_gap * ways.free.cost.abs()
        return (proposal.found & costly).nonzero().flatten()

    def _wider(self, problem: Problem, rest: Tensor, rows: Tensor, proposal: Proposal, watch: Watch) -> None:
        """Better proposals for the problems in `rows`, from a comparison of more paths."""
        if rows.numel() == 0:
            return
        part, rest = problem.take(rows), rest[rows]
        relax_top = None if self.relax_top is None else MORE * self.relax_top
        wider = replace(self, num_paths=MORE * self.num_paths, relax_top=relax_top, refine_top=COMPARED)
        scene = seen.scene_of(part, rest)
        assert scene is not None
        ways = wider._ways(part, rest, scene)
        more = wider._along(part, rest, ways, watch, ROUNDS, NEARLY)
        assert ways.free is not None
        proposal.iterations[rows] += more.iterations + ways.free.iterations
        better = more.found.nonzero().flatten()
        more = more._replace(iterations=proposal.iterations[rows])
        put(proposal, rows[better], take(more, better))

    def _along(
        self,
        problem: Problem,
        rest: Tensor,
        ways: Ways,
        watch: Watch,
        rounds: int = 20,
        violation: float = VIOLATION,
    ) -> Proposal:
        """Proposals along paths that are known; refined for `rounds` outer iterations, to a `violation`."""
        paths = ways.paths
        starts = self.starts(problem, rest).repeat_interleave(len(self.paces), dim=1)
        live = ways.live.repeat_interleave(starts.shape[1], dim=1)
        candidates = Candidates.begin(problem, starts.repeat(1, paths.shape[1], 1, 1), ways.R, ways.unit, live, watch)
        candidates = self.track(candidates, ways)
        candidates = candidates.pick(candidates.order(candidates.arrive())[:, : self.relax_top])
        candidates, sound = self.relax(candidates)
        order = candidates.order(sound, ALIKE)[:, : self.refine_top]
        sound = sound[candidates.rows(order).flatten()]
        candidates, solver = candidates.pick(order), None
        if self.refine_top > 1:
            inner = replace(_inner(self.track_iterations), tolerance=0.1 * TOLERANCE)
            solver = AugmentedLagrangian(inner, initial_penalty=1.0, max_outer_iterations=rounds)
        candidates, multipliers, best = candidates.refined(solver, sound, violation)
        multipliers, found = take(multipliers, best), ways.live.any(-1)
        multipliers = replace(multipliers, mu=torch.where(found, multipliers.mu, torch.nan))
        return Proposal(candidates.U[best], found & sound[best], multipliers, candidates.iterations)

    def starts(self, problem: Problem, rest: Tensor) -> Tensor:
        """Initial controls of the candidates of each path, (B, 1 + offsets, N, m): rest, and rest after each offset."""
        _, N, m = rest.shape
        starts = rest.unsqueeze(1).repeat(1, 1 + len(self.initial_offsets), 1, 1)
        if self.initial_offsets:
            offsets = tensor(self.initial_offsets, "paths.initial_offsets", rest)
            check_shape(offsets, (len(self.initial_offsets), m), "paths.initial_offsets")
            reach = seen.control_reach(problem, rest, offsets)
            starts[:, 1:, : math.ceil(OFFSET_LASTS * N)] += (reach * offsets).unsqueeze(2)
        return starts

    def track(self, candidates: Candidates, ways: Ways) -> Candidates:
        """The candidates, tracked along their paths from their initial controls at their paces."""
        paces, K = len(self.paces), ways.paths.shape[1]
        path = ways.paths.flatten(0, 1).repeat_interleave(paces, dim=0)
        arrive = path.new_tensor(self.paces).repeat(path.shape[0] // paces)
        if self.pace is not None:
            latest = self.pace * ways.shares().flatten().repeat_interleave(paces)
            arrive = torch.minimum(arrive, latest.clamp(min=self.depart + LEAST))
        center = followed(path, self.depart, arrive, self.smoothing, candidates.problem.N, ways.obstacles, ways.R)
        problem = torch.arange(candidates.problem.B, device=path.device).repeat_interleave(K * paces) * candidates.count
        number = torch.arange(candidates.live.numel(), device=path.device)
        place = number // (candidates.count // K) * paces + number % paces  # of each candidate's path and pace
        at = candidates.problem.position
        for stiffness in self.stiffness:
            weight = stiffness * candidates.unit[problem]
            penalty = attraction(center, path, at, candidates.R[problem], weight, self.tube)
            candidates = candidates.solved(_inner(self.track_iterations), TRACK_PENALTY, penalty, place)
        return candidates

    def relax(self, candidates: Candidates) -> tuple[Candidates, Tensor]:
        """The candidates, solved further without a guide, and whether they are sound, (B * count,)."""
        if self.relax_iterations > 0:
            relaxed = candidates.solved(_inner(self.relax_iterations), PENALTY)
            # A candidate that falls back into the trap, where waiting is cheaper, stays as tracked.
            keeps = (relaxed.arrive() | ~candidates.arrive()).view(-1, 1, 1)
            X, U = torch.where(keeps, relaxed.X, candidates.X), torch.where(keeps, relaxed.U, candidates.U)
            candidates = replace(relaxed, X=X, U=U)
        shallow = candidates.penetration() <= self.max_penetration * candidates.R
        return candidates, candidates.live & candidates.arrive() & shallow


def _inner(iterations: int) -> ILQR:
    return ILQR(tolerance=TOLERANCE, max_iterations=iterations, line_search=SEARCH)
