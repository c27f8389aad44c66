"""How candidates become trajectories: track a path, relax, refine."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchgco.lagrangian import Multipliers
from torchgco.penalties import GuidePath, GuideRegion, Penalty
from torchgco.problem import Problem
from torchgco.search import scene as seen
from torchgco.search.candidates import PENALTY, Candidates
from torchgco.search.geometry import points_along
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.ilqr import ILQR
from torchgco.solvers.line_search import LineSearch
from torchgco.tree import put, take

if TYPE_CHECKING:
    from torchgco.search.paths import PathProposals

TOLERANCE = 5e-5  # of tracking and relaxing, as a share of L_M; refining takes a tenth of it
SEARCH = LineSearch(back=2)
TRACK_PENALTY = 10.0  # of obstacles while a path is tracked, in q0 / R^4
CHORD_PENETRATION = 0.049  # share of an obstacle's margin, between two knots; the judge accepts 0.05


def track(options: PathProposals, candidates: Candidates, paths: Tensor) -> Candidates:
    """Each candidate along its path (B, num_paths, P, d), to arrive at its pace, from its start."""
    paces, K = len(options.paces), paths.shape[1]
    path = paths.flatten(0, 1).repeat_interleave(paces, dim=0)
    center = travel(options, path, path.new_tensor(options.paces).repeat(path.shape[0] // paces), candidates.problem.N)
    problem = torch.arange(candidates.problem.B, device=path.device).repeat_interleave(K * paces) * candidates.count
    number = torch.arange(candidates.live.numel(), device=path.device)
    place = number // (candidates.count // K) * paces + number % paces  # of each candidate's path and pace
    for stiffness in options.stiffness:
        weight = stiffness * candidates.unit[problem]
        penalty = attraction(options, candidates.problem, center, path, candidates.R[problem], weight)
        candidates = candidates.solved(_inner(options.track_iterations), TRACK_PENALTY, penalty, place)
    return candidates


def relax(options: PathProposals, candidates: Candidates) -> tuple[Candidates, Tensor]:
    """Candidates that nothing attracts, and whether they arrive without deep penetration (B * count,)."""
    if options.relax_iterations > 0:
        relaxed = candidates.solved(_inner(options.relax_iterations), PENALTY)
        # A candidate that falls back into the trap, where waiting is cheaper, is no longer one.
        keeps = (relaxed.arrive() | ~candidates.arrive()).view(-1, 1, 1)
        X, U = torch.where(keeps, relaxed.X, candidates.X), torch.where(keeps, relaxed.U, candidates.U)
        candidates = replace(relaxed, X=X, U=U)
    shallow = candidates.penetration() <= options.max_penetration * candidates.R
    return candidates, candidates.live & candidates.arrive() & shallow


def refine(options: PathProposals, candidates: Candidates, sound: Tensor) -> tuple[Candidates, Multipliers, Tensor]:
    """The sound candidates solved to convergence by AL-iLQR.

    Returns the candidates, the multipliers that each is to continue with, and the rows (B,) of the cheapest ones: the
    first of each problem where none converges, or none was asked for.
    """
    everyone = torch.arange(candidates.live.numel(), device=sound.device)
    multipliers = candidates.multipliers(everyone, PENALTY)
    rows = sound.nonzero().flatten()
    if options.refine_top == 1 or rows.numel() == 0:
        return candidates, multipliers, everyone[:: candidates.count]
    part = candidates.of(rows)
    inner = replace(_inner(options.track_iterations), tolerance=0.1 * TOLERANCE)
    solver = AugmentedLagrangian(inner, initial_penalty=1.0, max_outer_iterations=20)
    end = solver.solve(part, candidates.U[rows], warm=take(multipliers, rows))
    good = (end.violation <= solver.violation_tolerance) & seen.arrives(part, end.X)
    good &= seen.chord_penetration(part, end.X, CHORD_PENETRATION) <= 0
    won = rows[good]
    X, U, cost = candidates.X.clone(), candidates.U.clone(), torch.full_like(candidates.unit, torch.inf)
    X[won], U[won], cost[won] = end.X[good], end.U[good], end.cost[good]
    iterations = candidates.iterations.index_add(0, rows // candidates.count, end.iterations)
    put(multipliers, won, take(end.multipliers, good.nonzero().flatten()))
    best = cost.view(-1, candidates.count).argsort(dim=-1, stable=True)[:, :1]
    return replace(candidates, X=X, U=U, iterations=iterations), multipliers, candidates.rows(best)[:, 0]


def attraction(
    options: PathProposals, problem: Problem, center: Tensor, path: Tensor, R: Tensor, stiffness: Tensor
) -> Penalty:
    """The penalty that attracts knots to `center` (B, N+1, d) on a path; stiffness (B,) in q0 / (R^4 L^2)."""
    at = problem.position
    length2 = (path[:, -1] - path[:, 0]).square().sum(-1)
    spring = stiffness * R.pow(4) / length2.clamp(min=1e-12)
    if options.tube is None:
        return GuidePath(center, spring, at)
    radius = options.tube * R
    # Near its surface the tube is as stiff as a spring of 4 weight radius^2.
    weight = spring / (4.0 * radius.square()).clamp(min=1e-12)
    return GuideRegion(center, radius.unsqueeze(-1).repeat(1, problem.N + 1), weight, at)


def travel(options: PathProposals, path: Tensor, arrive: Tensor, N: int) -> Tensor:
    """Positions on paths (B, P, d) at every knot, (B, N+1, d): smooth start and stop, corners averaged."""
    share = torch.arange(N + 1, dtype=path.dtype, device=path.device) / N
    share = ((share - options.depart) / (arrive.unsqueeze(-1) - options.depart)).clamp(0.0, 1.0)
    share = share.square() * (3.0 - 2.0 * share)
    length = (path[:, 1:] - path[:, :-1]).square().sum(-1).sqrt().sum(-1, keepdim=True)
    center = points_along(path, share * length)
    reach = int(0.5 * options.smoothing * N)
    if reach == 0:
        return center
    padded = torch.cat((center[:, :1].expand(-1, reach, -1), center, center[:, -1:].expand(-1, reach, -1)), dim=1)
    return padded.unfold(1, 2 * reach + 1, 1).mean(-1)


def _inner(iterations: int) -> ILQR:
    return ILQR(tolerance=TOLERANCE, max_iterations=iterations, line_search=SEARCH)
