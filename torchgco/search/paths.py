"""A plan along a short way between the obstacles: the geometric proposal of guidance.

A way says where to pass; iLQR finds the controls that follow it, drawn to a point, or into a narrow tube, that travels
along it slowly enough for the vehicle to turn, from rest and from some spins. Then nothing draws any more, and the path
settles beside the obstacles that it has come around. The shortest way is often not the cheapest to fly: several are
followed, and the one that settles best is handed over, or the one of the best few that is cheapest when it is solved to
its end. It need not be quite free of contact: it is where the solver goes on from, with a penalty that keeps it on this
side of every obstacle. One that lies deep within obstacles is handed over to nobody: the solver would spend a whole
attempt on squeezing it out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchgco.constraints.guides import Guide, GuidePath, GuideRegion
from torchgco.errors import InputError
from torchgco.guidance import scene as seen
from torchgco.guidance.classes import distinct
from torchgco.guidance.plans import Plans
from torchgco.guidance.roadmap import Roadmap, points_along
from torchgco.lagrangian import Multipliers
from torchgco.native.dispatch import cost_unit
from torchgco.problem import Problem
from torchgco.shapes import check_shape, tensor
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.ilqr import ILQR
from torchgco.solvers.line_search import LineSearch
from torchgco.tree import put, take

SURE = LineSearch(accept_last=False, back=2)
MOST = 1536  # ways of all problems that are sought and followed together: memory stays bounded
BETWEEN = 0.049  # of r_obs + r_veh: how deep a finalist may cut into an obstacle between knots; the judge bears 0.05
DAMPING = 0.02  # of all solves, in units of `Problem.cost_unit`
PUSHED = 0.1  # share of the horizon that a push lasts
ALIKE = 2e-3  # settled paths whose penalised costs differ by less, as a share, are taken for one


class Proposal(NamedTuple):
    """Controls to go on from."""

    U: Tensor  # (B, N, m)
    found: Tensor  # (B,) bool: whether there is a way; where not, U means nothing
    # To go on with: a penalty that keeps the solver from falling back, also with another plan where this one is
    # refused; NaN where there is no way at all.
    duals: Multipliers
    iterations: Tensor  # (B,) int64: of all solves of all plans, also where none is found


@dataclass(frozen=True)
class Detour:
    """Follow the shortest ways around static spheres, and keep the one that is cheapest to fly.

    Penalties are given without units, against q0, the stage cost of resting at the start, L, the distance to the goal,
    and R, the mean r_obs + r_veh.

    Args:
        roadmap: finds the ways.
        ways: how many are followed.
        pushes: offsets (m,) of the controls over the first tenth of the horizon, as shares of the range from rest to
            the control bounds; every way is followed from rest, and once from each offset. An initial turn lets a
            vehicle that turns slowly find reversing and three-point turns.
        keep: how many of these are settled, the cheapest as followed; None: all.
        begin, end: the shares of the horizon at which the vehicle sets out and arrives. Several ends: every way is
            followed to arrive at each.
        smoothing: the share of the horizon over which the way's corners are averaged.
        tube: radius of the tube, as a share of R; None: no tube, but a spring to the point that travels. A spring is
            followed in half the iterations; for vehicles that can't move sideways the tube ends closer to the way.
        stiffness: one solve after the other, how strongly tube or spring draws, in q0 / L^2.
        obstacle_penalty: of the spheres meanwhile, in q0 / R^4.
        hold: penalty that the solver is to go on with, in q0 / R^4.
        tolerance: of each solve, as a share of the penalised cost; a finalist is solved to a tenth of it.
        iterations: of each solve, at most.
        settle: iterations that nothing draws, at most, after which the ways are compared; 0 compares them as followed.
        depth: how far into an obstacle a settled path may reach, as a share of R; one that lies deeper is refused.
        finalists: how many of those that settled best, and differ, are solved to their end before one is handed over,
            by what they cost there; 1: none is, and the best settled is handed over.

    Raises:
        InputError: a field out of its range; on `check` and `propose`, pushes that don't fit the controls.
    """

    roadmap: Roadmap = Roadmap()
    ways: int = 1
    pushes: tuple[tuple[float, ...], ...] = ()
    keep: int | None = None
    begin: float = 0.0
    end: float | tuple[float, ...] = 0.9
    smoothing: float = 0.08
    tube: float | None = 0.05
    stiffness: tuple[float, ...] = (20.0, 200.0)
    obstacle_penalty: float = 10.0
    hold: float = 80.0
    tolerance: float = 5e-5
    iterations: int = 20
    settle: int = 20
    depth: float = 0.1
    finalists: int = 1

    def __post_init__(self) -> None:
        for name in ("end", "stiffness", "pushes"):  # lists of a configuration file equal tuples
            if isinstance(value := getattr(self, name), Sequence) and not isinstance(value, str):
                rows = (tuple(row) if isinstance(row, list) else row for row in value)
                object.__setattr__(self, name, tuple(rows))
        if not isinstance(self.roadmap, Roadmap):
            raise InputError("detour.roadmap", "a Roadmap", self.roadmap)
        if not self.ends or not all(0 <= self.begin < end <= 1 for end in self.ends):
            raise InputError("detour.begin", f"at least 0 and below end, {self.end}", self.begin)
        if not isinstance(self.pushes, Sequence):
            raise InputError("detour.pushes", "a list of offsets of the controls", self.pushes)
        if not 0 <= self.smoothing < 1:
            raise InputError("detour.smoothing", "at least 0 and below 1", self.smoothing)
        if self.tube is not None and not self.tube > 0:
            raise InputError("detour.tube", "above 0, or null", self.tube)
        for name in ("obstacle_penalty", "hold", "tolerance", "depth"):
            if not getattr(self, name) > 0:
                raise InputError(f"detour.{name}", "above 0", getattr(self, name))
        if not self.stiffness or not all(value > 0 for value in self.stiffness):
            raise InputError("detour.stiffness", "one or more numbers above 0", self.stiffness)
        for name, least in (("ways", 1), ("keep", 1), ("iterations", 1), ("settle", 0), ("finalists", 1)):
            if getattr(self, name) is not None and getattr(self, name) < least:
                raise InputError(f"detour.{name}", f"at least {least}", getattr(self, name))

    @property
    def ends(self) -> tuple[float, ...]:
        """All of `end`."""
        return tuple(self.end) if isinstance(self.end, Sequence) else (self.end,)

    def check(self, problem: Problem) -> None:
        """Raise InputError where the pushes don't fit the controls."""
        self._begun(problem, problem.x0.new_zeros(problem.B, problem.N, problem.m))

    def propose(self, problem: Problem, rank: Tensor | None = None) -> Proposal:
        """A plan for every problem, from the vehicle at rest, along the best of the ways or that of a rank (B,)."""
        rank = torch.zeros(problem.B, dtype=torch.int64, device=problem.x0.device) if rank is None else rank
        U = problem.cost.rest_controls(problem.x0.new_zeros(problem.B, problem.N, problem.m))
        found, duals = torch.zeros_like(rank, dtype=torch.bool), Multipliers.zero(problem, torch.nan)
        unit = cost_unit(problem)
        whole, scaled = Proposal(U, found, duals, torch.zeros_like(rank)), problem.in_cost_units()
        for rows in torch.arange(problem.B, device=rank.device).split(max(1, MOST // self.ways)):
            part = self._propose(scaled.take(rows), U[rows], rank[rows])
            if part is not None:
                put(whole, rows, part)
        return whole._replace(duals=whole.duals.scaled(unit))

    def _propose(self, problem: Problem, rest: Tensor, rank: Tensor) -> Proposal | None:
        scene = seen.scene_of(problem, rest)
        if scene is None:
            return None
        ways, found = self.roadmap.ways(scene, self.ways)
        R, unit = seen.scales(problem, scene, rest)
        found = found & torch.isfinite(unit) & (unit > 0)
        begun = self._begun(problem, rest).repeat_interleave(len(self.ends), dim=1)
        live = (distinct(ways, scene) & found.unsqueeze(-1)).repeat_interleave(begun.shape[1], dim=1)
        plans = Plans.begin(problem, begun.repeat(1, self.ways, 1, 1), R, torch.where(found, unit, 1.0), live)
        plans = self._follow(plans, ways)
        plans = plans.pick(plans.order(self.hold, plans.arrive())[:, : self.keep])
        plans, sound = self._settle(plans)
        order, wanted = plans.order(self.hold, sound, ALIKE), max(self.finalists, int(rank.max()) + 1)
        order = order[:, :wanted]
        sound = sound[plans.rows(order).flatten()]
        plans, duals, order = self._refine(plans.pick(order), sound)
        chosen = plans.rows(order.gather(1, rank.clamp(max=plans.count - 1).unsqueeze(-1)))[:, 0]
        duals = take(duals, chosen)
        duals = replace(duals, mu=torch.where(found, duals.mu, torch.nan))
        return Proposal(plans.U[chosen], found & (rank < plans.count) & sound[chosen], duals, plans.iterations)

    def _begun(self, problem: Problem, rest: Tensor) -> Tensor:
        """What a way is followed from, (B, 1 + pushes, N, m): rest, and rest after each push."""
        _, N, m = rest.shape
        starts = rest.unsqueeze(1).repeat(1, 1 + len(self.pushes), 1, 1)
        if self.pushes:
            pushes = tensor(self.pushes, "detour.pushes", rest)
            check_shape(pushes, (len(self.pushes), m), "detour.pushes")
            reach = seen.control_reach(problem, rest, pushes)
            starts[:, 1:, : math.ceil(PUSHED * N)] += (reach * pushes).unsqueeze(2)
        return starts

    def _follow(self, plans: Plans, ways: Tensor) -> Plans:
        """Each plan along its way (B, ways, P, d), from its start, to arrive at its share of the horizon."""
        E, K = len(self.ends), ways.shape[1]
        path = ways.flatten(0, 1).repeat_interleave(E, dim=0)
        center = self._travel(path, path.new_tensor(self.ends).repeat(path.shape[0] // E), plans.problem.N)
        one = torch.arange(plans.problem.B, device=path.device).repeat_interleave(K * E) * plans.count
        plan = torch.arange(plans.live.numel(), device=path.device)
        place = plan // (plans.count // K) * E + plan % E  # of each plan's way and end among the paths
        for stiffness in self.stiffness:
            guide = self._guide(plans.problem, center, path, plans.R[one], stiffness * plans.unit[one])
            plans = plans.solved(self._inner(self.iterations), self.obstacle_penalty, guide, place)
        return plans

    def _settle(self, plans: Plans) -> tuple[Plans, Tensor]:
        """Plans that nothing draws any more, and whether their paths arrive and lie not too deep in obstacles."""
        if self.settle > 0:
            settled = plans.solved(self._inner(self.settle), self.hold)
            # A path that falls back into the trap, where waiting is cheaper, is none.
            keeps = (settled.arrive() | ~plans.arrive()).view(-1, 1, 1)
            X, U = torch.where(keeps, settled.X, plans.X), torch.where(keeps, settled.U, plans.U)
            plans = replace(settled, X=X, U=U)
        return plans, plans.live & plans.arrive() & (plans.depth() <= self.depth * plans.R)

    def _refine(self, plans: Plans, sound: Tensor) -> tuple[Plans, Multipliers, Tensor]:
        """The sound ones of the first few are solved to their end, and ordered by their costs there.

        Returns the plans, what each is to go on with, and their order (B, count).
        """
        everyone = torch.arange(plans.live.numel(), device=sound.device)
        duals, order = plans.duals(everyone, self.hold), (everyone % plans.count).view(-1, plans.count)
        last = min(self.finalists, plans.count)
        rows = (sound & (everyone % plans.count < last)).nonzero().flatten()
        if last == 1 or rows.numel() == 0:
            return plans, duals, order
        part, warm = plans.of(rows), take(duals, rows)
        inner = replace(self._inner(self.iterations), tolerance=0.1 * self.tolerance)
        solver = AugmentedLagrangian(
            inner,
            initial_penalty=1.0,
            max_outer_iterations=20,
            cost_tolerance=1e-3,
            grow_when_feasible=False,
            clip=True,
        )
        end = solver.solve(part, plans.U[rows], warm=warm)
        good = (end.violation <= solver.violation_tolerance) & seen.arrives(part, end.X)
        good &= seen.depth_between(part, end.X) <= BETWEEN * plans.R[rows]
        X, U, cost = plans.X.clone(), plans.U.clone(), torch.full_like(plans.unit, torch.inf)
        won = rows[good]
        X[won], U[won], cost[won] = end.X[good], end.U[good], end.cost[good]
        iterations = plans.iterations.index_add(0, rows // plans.count, end.iterations)
        put(duals, won, take(end.multipliers, good.nonzero().flatten()))
        best = cost.view(-1, plans.count)[:, :last].argsort(dim=-1, stable=True)
        order = torch.cat((best, order[:, last:]), dim=1)
        return replace(plans, X=X, U=U, iterations=iterations), duals, order

    def _inner(self, iterations: int) -> ILQR:
        return ILQR(tolerance=self.tolerance, max_iterations=iterations, damping=DAMPING, line_search=SURE)

    def _guide(self, problem: Problem, center: Tensor, way: Tensor, R: Tensor, stiffness: Tensor) -> Guide:
        """What draws to the points of the way that are to be passed; stiffness (B,) in units of q0 / (R^4 L^2)."""
        at = seen.position(problem)
        length2 = (way[:, -1] - way[:, 0]).square().sum(-1)
        spring = stiffness * R.pow(4) / length2.clamp(min=1e-12)
        if self.tube is None:
            return GuidePath(center, spring, at)
        radius = self.tube * R
        # Near its surface the tube is as stiff as a spring of 4 weight radius^2.
        weight = spring / (4.0 * radius.square()).clamp(min=1e-12)
        return GuideRegion(center, radius.unsqueeze(-1).repeat(1, problem.N + 1), weight, at)

    def _travel(self, way: Tensor, end: Tensor, N: int) -> Tensor:
        """What is followed, at every knot, (B, N+1, d): speeding up and slowing down smoothly, corners rounded."""
        share = torch.arange(N + 1, dtype=way.dtype, device=way.device) / N
        share = ((share - self.begin) / (end.unsqueeze(-1) - self.begin)).clamp(0.0, 1.0)
        share = share.square() * (3.0 - 2.0 * share)
        length = (way[:, 1:] - way[:, :-1]).square().sum(-1).sqrt().sum(-1, keepdim=True)
        center = points_along(way, share * length)
        reach = int(0.5 * self.smoothing * N)
        if reach == 0:
            return center
        padded = torch.cat((center[:, :1].expand(-1, reach, -1), center, center[:, -1:].expand(-1, reach, -1)), dim=1)
        return padded.unfold(1, 2 * reach + 1, 1).mean(-1)
