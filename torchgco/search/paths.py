"""Proposals along paths: for each problem, the best of several trajectories that follow short paths past obstacles.

1. The roadmap gives short paths; one per homotopy class is kept.
2. Candidates track each path, from rest and from each initial offset of the controls, at each pace.
3. The candidates are relaxed: solved further without a guide; a penalty keeps them out of the obstacles.
4. The best by penalised cost are refined: the augmented Lagrangian solves them to convergence.
5. Where no candidate arrives, the paths are followed again, closer; where the best costs far more than the trajectory
   without constraints, more paths are compared, each followed in both ways.
6. The cheapest is proposed, with the multipliers to continue with.

A proposal may touch obstacles slightly: the solver removes that. Candidates that penetrate deeper are rejected, since
removing it would use up a whole attempt, or must first be refined (`PathSettings.roughly`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchgco.base.shapes import check_shape, tensor
from torchgco.base.tree import put, take
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.native.dispatch import cost_unit, open_loop, value
from torchgco.problem.problem import Problem
from torchgco.roadmap import scene as seen
from torchgco.roadmap.geometry import Scene
from torchgco.roadmap.homotopy import one_per_class
from torchgco.search.candidates import PENALTY, ROUGH, TO_THE_END, Candidates, Refining, Watch, unwatched
from torchgco.search.settings import MORE, PathSettings
from torchgco.search.tracking import attraction, followed
from torchgco.search.ways import Ways, joined, plain, unconstrained
from torchgco.solvers.ilqr import ILQR
from torchgco.solvers.line_search import LineSearch

MOST = 1536  # paths of all problems that are compared and tracked together: bounds the memory
OFFSET_LASTS = 0.1  # share of the horizon that an initial offset lasts
ALIKE = 2e-3  # relaxed candidates whose penalised costs differ by less, as a share, count as the same

TOLERANCE = 5e-5  # of tracking and relaxing, as a share of L_M; refining takes a tenth of it
SEARCH = LineSearch(back=2)
TRACK_PENALTY = 10.0  # of obstacles while a path is tracked, in q0 / R^4
LEAST = 0.05  # share of the horizon between departure and arrival


class Proposal(NamedTuple):
    """Trajectories to continue from."""

    U: Tensor  # (B, N, m)
    found: Tensor  # (B,) bool: whether there is a proposal; elsewhere U is not to be used
    multipliers: Multipliers  # to continue with; mu keeps the solver from leaving the path, NaN where there is none
    iterations: Tensor  # (B,) int64: of all solves of all candidates, also where none is found
    cost: Tensor  # (B,): as refined; infinite where no candidate was refined with success


@dataclass(frozen=True)
class PathProposals(PathSettings):
    """Follow short paths between static obstacles, and propose the candidate that is cheapest to fly.

    The arguments and the errors are those of `PathSettings`.
    """

    def propose(self, problem: Problem, watch: Watch = unwatched) -> Proposal:
        """A proposal for every problem, from the vehicle at rest.

        `watch` is called with how many candidates of the current step are solved, and of how many; an exception that
        it raises ends the search.

        Raises:
            InputError: initial offsets that don't fit the controls.
        """
        rest = problem.cost.rest_controls(problem.x0.new_zeros(problem.B, problem.N, problem.m))
        none = torch.zeros(problem.B, dtype=torch.int64, device=problem.x0.device)
        unit, scaled = cost_unit(problem), problem.in_cost_units()
        least = torch.full_like(unit, torch.inf)
        whole = Proposal(rest, none.bool(), Multipliers.zero(problem, torch.nan), none, least)
        for rows in torch.arange(problem.B, device=none.device).split(max(1, MOST // self.num_paths)):
            part = self._propose(scaled.take(rows), rest[rows], watch)
            if part is not None:
                put(whole, rows, part)
        return whole._replace(multipliers=whole.multipliers.scaled(unit), cost=whole.cost * unit)

    def _propose(self, problem: Problem, rest: Tensor, watch: Watch) -> Proposal | None:
        scene = seen.scene_of(problem, rest)
        if scene is None:
            return None
        ways = self._ways(problem, rest, scene)
        proposal = self._along(problem, rest, ways, watch, TO_THE_END)
        if ways.free is not None:
            proposal.iterations.add_(ways.free.iterations)
        more = self._costly(problem, ways, proposal)
        self._closer(problem, rest, ways, proposal, watch)
        both = 2 * MORE * self.num_paths  # paths of two searches
        for rows in more.split(max(1, MOST // both)):
            self._wider(problem, rest, rows, proposal, watch)
        return proposal

    def _ways(self, problem: Problem, rest: Tensor, scene: Scene) -> Ways:
        paths, found = self.roadmap.paths(scene, self.num_paths)
        R, unit = seen.scales(problem, scene, rest)
        found = found & torch.isfinite(unit) & (unit > 0)
        live = one_per_class(paths, scene.obstacles) & found.unsqueeze(-1)
        compared = self.pace is not None or self.max_gap is not None
        free = unconstrained(problem, rest, _inner(self.track_iterations)) if compared else None
        return Ways(paths, live, R, torch.where(found, unit, 1.0), scene.obstacles, free)

    def _closer(self, problem: Problem, rest: Tensor, ways: Ways, proposal: Proposal, watch: Watch) -> None:
        """Where there are paths but no proposal along them, follow them again, closer."""
        rows = (ways.live.any(-1) & ~proposal.found).nonzero().flatten()
        if rows.numel() > 0:
            proposals, refining = self.closer(), TO_THE_END
            if self.max_gap is not None:  # a costly problem: the repair of deep candidates is worth its time
                proposals, refining = replace(proposals.roughly(), relax_top=None), ROUGH
            more = proposals._along(problem.take(rows), rest[rows], take(ways, rows), watch, refining)
            put(proposal, rows, more._replace(iterations=more.iterations + proposal.iterations[rows]))

    def _costly(self, problem: Problem, ways: Ways, proposal: Proposal) -> Tensor:
        """The problems (b,) whose proposal costs far more than the trajectory without constraints."""
        if self.max_gap is None or ways.free is None:
            return proposal.found.new_empty(0, dtype=torch.int64)
        cost, _ = value(plain(problem), open_loop(problem, proposal.U), proposal.U)
        costly = cost > ways.free.cost + self.max_gap * ways.free.cost.abs()
        return (proposal.found & costly).nonzero().flatten()

    def _wider(self, problem: Problem, rest: Tensor, rows: Tensor, proposal: Proposal, watch: Watch) -> None:
        """Better proposals for the problems in `rows`, from a comparison of more paths, each followed in two ways."""
        if rows.numel() == 0:
            return
        part, rest = problem.take(rows), rest[rows]
        scene = seen.scene_of(part, rest)
        assert scene is not None
        wide = self.wider()
        ways = joined(wide._ways(part, rest, scene), wide.among_more_points()._ways(part, rest, scene))
        assert ways.free is not None
        proposal.iterations[rows] += ways.free.iterations
        for proposals in (wide, wide.closer()):
            more = proposals._along(part, rest, ways, watch, ROUGH)
            iterations = proposal.iterations[rows] + more.iterations
            better = (more.found & (more.cost < proposal.cost[rows])).nonzero().flatten()
            put(proposal, rows[better], take(more, better))
            proposal.iterations[rows] = iterations

    def _along(self, problem: Problem, rest: Tensor, ways: Ways, watch: Watch, refining: Refining) -> Proposal:
        """Proposals along paths that are known."""
        paths = ways.paths
        starts = self.starts(problem, rest).repeat_interleave(len(self.paces), dim=1)
        live = ways.live.repeat_interleave(starts.shape[1], dim=1)
        candidates = Candidates.begin(problem, starts.repeat(1, paths.shape[1], 1, 1), ways.R, ways.unit, live, watch)
        candidates = self.track(candidates, ways)
        candidates = candidates.pick(candidates.order(candidates.arrive())[:, : self.relax_top])
        candidates, sound = self.relax(candidates)
        order = candidates.order(sound, ALIKE)[:, : self.refine_top]
        sound = sound[candidates.rows(order).flatten()]
        inner = replace(_inner(self.track_iterations), tolerance=0.1 * TOLERANCE) if self.refine_top > 1 else None
        candidates, multipliers, best, cost = candidates.pick(order).refined(inner, sound, refining)
        multipliers, found = take(multipliers, best), ways.live.any(-1)
        multipliers = replace(multipliers, mu=torch.where(found, multipliers.mu, torch.nan))
        found &= cost.isfinite() if refining.needed else sound[best]
        return Proposal(candidates.U[best], found, multipliers, candidates.iterations, cost)

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
