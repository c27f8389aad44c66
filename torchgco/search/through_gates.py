"""Trajectories through gates in a free time: straight by the interior point, from paths that lead leg by leg.

Gates say at which knot the vehicle is where, so that states on a path from gate to gate are as good a guess as any
trajectory, and no time needs to be held to find one. Which side of each obstacle a leg takes is mostly settled by its
path, and legs depend little on those two gates away. So trajectories along several paths are combined leg by leg, and
the best is led past the other side of each obstacle that it touches, until nothing is gained.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from torchgco.base.tree import put, take
from torchgco.constraints.gates import gates_of
from torchgco.kernels import path_clearance
from torchgco.lagrangian.lagrangian import SolveEnd
from torchgco.lagrangian.quality import has_arrived, ranks_arrival
from torchgco.obstacles.base import Solids
from torchgco.problem.in_time import factor_controls, factor_state
from torchgco.roadmap.geometry import scene_of
from torchgco.roadmap.roadmap import Known, Roadmap, paths_through, timed
from torchgco.search.nearby import among_nearby
from torchgco.solution import Solution
from torchgco.solvers.contracts import Call
from torchgco.solvers.interior import InteriorPoint

LEG_PATHS = 7  # of each leg: the first ones follow each other, the second ones, and so on
ALONG_PATHS = InteriorPoint(tolerance=1e-4, max_iterations=150)
# With this barrier the best trajectory, begun from once more, leaves optima that a small step from it leaves.
COMBINED = InteriorPoint(tolerance=1e-4, max_iterations=100, initial_barrier=1e-2)
COMBINATIONS = 4  # rounds, at most
GAINED = 1e-4  # share of the cost: a round that saves less is the last
SWITCHES = 0.0, 0.01, 0.03, 0.1, 0.3  # what going on with another trajectory costs, in mean legs: a combination each
ALIKE_LEGS = 1e-3  # difference of their costs, as a share of a mean one, by which trajectories are told apart
GROWN_BY = 1.5  # of obstacles that are touched between two knots, in the clearance that lacks there
TOUCHED = 0.02  # share of an obstacle's size: nearer ones are passed on their other side, too


@dataclass
class Tried:
    """The trajectories of one problem that are feasible, and what has been begun from."""

    X: Tensor  # (c, N+1, n)
    U: Tensor  # (c, N, m)
    legs: Tensor  # (c, G+1): cost of each leg
    clearance: Tensor  # (c,): between knots, too, m
    grown: Tensor  # (c,): by which obstacles were larger, m
    begun: set[Any] = field(default_factory=set)

    @property
    def cost(self) -> Tensor:
        """(c,); infinite of those that touch an obstacle between two knots."""
        return torch.where(self.clearance < 0.0, torch.inf, self.legs.sum(-1))

    @property
    def best(self) -> int:
        """The cheapest."""
        return int(self.cost.argmin())

    def joined(self, new: Tried) -> Tried:
        """These and further ones."""
        names = "X", "U", "legs", "clearance", "grown"
        return replace(self, **{name: torch.cat((getattr(self, name), getattr(new, name))) for name in names})

    def is_new(self, key: Any) -> bool:
        """Whether nothing with this key was begun from; now it is."""
        new = key not in self.begun
        self.begun.add(key)
        return new

    def key(self, legs: Tensor) -> tuple[float, ...]:
        """What trajectories whose legs cost as much have in common."""
        return tuple((legs / (ALIKE_LEGS * self.legs[0].mean().abs().clamp(min=1e-300))).round().tolist())


class ThroughGates:
    """One search for the best trajectories of B problems with gates.

    Args:
        call: of a problem in free time, with states X0 to begin with.
        limit: violation up to which a trajectory is feasible.
    """

    def __init__(self, call: Call, limit: float) -> None:
        problem, gates = call.problem, gates_of(call.problem)
        assert gates is not None and gates.places is not None
        self.problem, self.call, self.limit = problem, replace(call, warm=None, callback=None), limit
        ends = gates.places.new_tensor([0, problem.N]).expand(problem.B, 2)
        self.places = gates.places
        self.knots = torch.cat((ends[:, :1], gates.places, ends[:, 1:]), dim=1)  # (B, G+2)
        self.scene = scene_of(problem, problem.cost.rest_controls(call.U0))
        empty = call.U0.new_zeros(0, self.knots.shape[1] - 1)
        assert call.X0 is not None
        self.tried = [Tried(call.X0[:0], call.U0[:0], empty, empty[:, 0], empty[:, 0]) for _ in range(problem.B)]
        self.best = SolveEnd.blank(problem, call.U0)
        self.best.best.X[:] = call.X0  # where nothing is found
        self.rank = [(True, True, True, torch.inf)] * problem.B
        self.grown = torch.zeros_like(call.U0[:, 0, 0])  # of the best
        self.iterations = torch.zeros_like(call.ids)

    def run(self) -> SolveEnd:
        """The best trajectories, to a loose tolerance."""
        every = torch.arange(self.problem.B, device=self.call.ids.device)
        rows, X, U = self._along_paths()
        self._solve(ALONG_PATHS, rows, X, U, torch.zeros_like(X[:, 0, 0]))
        left = every.tolist()
        for _ in range(COMBINATIONS):
            begun = [(b, *one) for b in left for one in self._others(b)]
            if not begun or self.call.late:
                break
            before = list(self.rank)
            rows, *starts = zip(*begun, strict=True)
            self._solve(COMBINED, every[list(rows)], *map(torch.stack, starts))
            left = [b for b in left if self.rank[b][2] or self._gained(before[b], self.rank[b])]
        return self.best

    @staticmethod
    def _gained(before: Any, now: Any) -> bool:
        return now[:-1] < before[:-1] or now[-1] < before[-1] - GAINED * abs(before[-1])

    def _along_paths(self) -> tuple[Tensor, Tensor, Tensor]:
        """Problems (R,), states (R, N+1, n) and controls to begin with: those of the call, and on the paths."""
        call, every = self.call, torch.arange(self.problem.B, device=self.call.ids.device)
        assert call.X0 is not None
        if self.scene is None:
            return every, call.X0, call.U0
        corners, found = paths_through(Roadmap(), self.scene, LEG_PATHS, every, Known())
        each = every[found].repeat_interleave(LEG_PATHS)
        X = call.X0[each]
        stages = torch.full_like(X[:, 0, 0], float(self.problem.N))
        X[..., self.problem.position] = timed(corners[found].flatten(0, 1), self.places[each], stages, self.problem.N)
        return torch.cat((every, each)), torch.cat((call.X0, X)), torch.cat((call.U0, call.U0[each]))

    def _solve(self, solver: InteriorPoint, rows: Tensor, X: Tensor, U: Tensor, grown: Tensor) -> None:
        """Solve problems `rows` (R,), which may occur again, from states and controls, among obstacles grown by (R,) m.

        What is feasible is kept.
        """
        call = replace(self.call.take(rows), U0=U, X0=X)
        larger = replace(call, problem=call.problem.grown(grown)) if bool(grown.any()) else call
        end = solver.solved(larger)
        self.iterations.index_add_(0, rows, end.iterations)
        problem, found = call.problem, end.best
        fits = (found.violation <= self.limit) & torch.isfinite(found.cost)
        clearance, some = torch.full_like(grown, -torch.inf), fits.nonzero().flatten()
        if some.numel() > 0:
            clearance[some] = path_clearance(problem.take(some), found.X[some], found.U[some])
        arrived = has_arrived(problem, found.X) | (not ranks_arrival(problem))
        ranks = zip(*map(Tensor.tolist, (~fits, ~arrived, clearance < 0.0, found.cost)), strict=True)
        for place, (b, rank) in enumerate(zip(rows.tolist(), ranks, strict=True)):
            if rank < self.rank[b]:
                self.rank[b], self.grown[b] = rank, grown[place]
                put(self.best, rows[place : place + 1], take(end, slice(place, place + 1)))
        stages = problem.cost.stage(found.X[:, :-1], found.U, torch.arange(problem.N, device=U.device))
        legs = torch.nn.functional.pad(stages.cumsum(-1), (1, 0)).gather(1, self.knots[rows]).diff(dim=1)
        legs[:, -1] += problem.cost.terminal(found.X[:, -1])
        for b in rows.unique().tolist():
            own, old = (fits & (rows == b)).nonzero().flatten(), self.tried[b]
            new = Tried(found.X[own], found.U[own], legs[own], clearance[own], grown[own])
            self.tried[b] = old.joined(new)

    def _others(self, b: int) -> list[tuple[Tensor, Tensor, Tensor]]:
        """States, controls and growth of obstacles of further solves of problem b."""
        tried = self.tried[b]
        if len(tried.X) == 0:
            return []
        least = tried.cost.amin()
        touching = (tried.clearance < 0.0) & (tried.legs.sum(-1) < least)
        larger = tried.grown - GROWN_BY * tried.clearance
        new = (c for c in touching.nonzero().flatten().tolist() if tried.is_new(c))
        found = [(tried.X[c], tried.U[c], larger[c]) for c in {tried.key(tried.legs[c]): c for c in new}.values()]
        if not bool(torch.isfinite(least)):
            return found
        tried.begun.update(map(tried.key, tried.legs))
        each = torch.arange(tried.legs.shape[1], device=tried.legs.device)
        for chosen in (_cheapest(tried, share) for share in SWITCHES):
            if tried.is_new(tried.key(tried.legs[chosen, each])):
                found.append((*self._joined(b, chosen), tried.grown[chosen].amax()))
        best, grown = tried.best, tried.grown[tried.best]
        again = [tried.X[best]] if tried.is_new(("again", tried.key(tried.legs[best]))) else []
        return found + [(X, tried.U[best], grown) for X in again + self._past_the_other_side(b)]

    def _joined(self, b: int, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """States and controls whose legs are those of trajectories `chosen` (G+1,)."""
        tried, tau, factor = self.tried[b], factor_state(self.problem), factor_controls(self.problem)
        X, U = tried.X[tried.best].clone(), tried.U[tried.best].clone()
        for c, (first, last) in zip(chosen.tolist(), pairwise(self.knots[b].tolist()), strict=True):
            X[first + 1 : last + 1], U[first:last] = tried.X[c, first + 1 : last + 1], tried.U[c, first:last]
            X[first, tau] = tried.X[c, first, tau]  # of the stages that begin here
            if first > 0:
                U[first - 1, factor] = tried.U[c, first - 1, factor]
        return X, U

    def _past_the_other_side(self, b: int) -> list[Tensor]:
        """States of problem b: the best trajectory, bent past the other side of each obstacle that it touches."""
        if self.scene is None:
            return []
        tried, at, found = self.tried[b], self.problem.position, []
        X = tried.X[tried.best]
        for number, kind in enumerate(self.scene.obstacles.kinds):
            for j, k, away in _touched(kind, b, X[:, at]):
                place = int(torch.searchsorted(self.knots[b], k))
                first, last = self.knots[b, place - 1 : place + 1].tolist()
                if first < k < last and tried.is_new((number, j, *away.sign().tolist())):
                    bent, knot = X.clone(), torch.arange(len(X), dtype=X.dtype, device=X.device)
                    share = torch.minimum((knot - first) / (k - first), (last - knot) / (last - k)).clamp(0.0, 1.0)
                    bent[:, at] -= (share.square() * (3.0 - 2.0 * share)).unsqueeze(-1) * away
                    found.append(bent)
        return found


def _cheapest(tried: Tried, share: float) -> Tensor:
    """Which trajectory each leg (G+1,) is taken from, so that the sum of costs and of those of switches is least."""
    legs = torch.where(torch.isfinite(tried.cost).unsqueeze(-1), tried.legs, torch.inf)
    switch = share * tried.legs.mean()
    every, cost, froms = torch.arange(len(legs), device=legs.device), legs[:, 0], []
    for leg in legs.T[1:]:
        least, at = cost.min(0)
        froms.append(torch.where(cost <= least + switch, every, at))
        cost = torch.minimum(cost, least + switch) + leg
    chosen = [cost.argmin()]
    for before in reversed(froms):
        chosen.append(before[chosen[-1]])
    return torch.stack(chosen[::-1])


def _touched(kind: Solids, b: int, p: Tensor) -> list[tuple[int, int, Tensor]]:
    """Which obstacles of a kind problem b touches on its way p (N+1, d), at which knot, and twice the way (d,) to
    their middle from there."""
    extent, off = kind.extent[b], p.unsqueeze(1) - kind.centers[b]
    off = off - torch.minimum(torch.maximum(off, -extent), extent)
    size = off.norm(dim=-1)
    least, at = torch.where(kind.absent[b], torch.inf, size - kind.radii[b]).min(0)
    found = []
    for j in (least < TOUCHED * kind.sizes[b]).nonzero().flatten().tolist():
        k = int(at[j])
        normal = off[k, j] / size[k, j].clamp(min=1e-12)
        found.append((j, k, 2.0 * (size[k, j] + (normal.abs() * extent[j]).sum()) * normal))
    return found


def solved_through_gates(interior: InteriorPoint, limit: float, call: Call) -> Solution:
    """The solution of a call of problems with gates in free time, with states to begin with; see the module.

    Args:
        interior: brings the best trajectories to its own tolerance.
        limit: violation up to which a trajectory is feasible.
    """

    def solved(call: Call) -> Solution:
        search = ThroughGates(call, limit)
        start = search.run().best
        larger = call.problem.grown(search.grown) if bool(search.grown.any()) else call.problem
        tight = interior.run(replace(call, problem=larger, X0=start.X, U0=start.U, warm=start.multipliers))
        return replace(tight, iterations=tight.iterations + search.iterations)

    return among_nearby(call, solved)
