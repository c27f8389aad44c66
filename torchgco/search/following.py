"""How a path is followed: from which controls, at which pace, and by which penalty the trajectory is drawn to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.options import AtLeast, Below, Count, NonNegative, Positive, check_options
from torchgco.base.shapes import check_shape, repeated, tensor
from torchgco.base.tree import take
from torchgco.constraints.gates import gates_of
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers
from torchgco.lagrangian.penalties import GuidePath, GuideRegion, Penalty
from torchgco.problem.problem import Problem
from torchgco.roadmap import geometry as seen
from torchgco.roadmap.geometry import Inflated, length, points_along
from torchgco.roadmap.roadmap import timed
from torchgco.search.candidates import Candidates, inner_solver
from torchgco.search.nearby import without_obstacles
from torchgco.solvers.ilqr import descend

OFFSET_LASTS = 0.1  # share of the horizon that an initial offset lasts
LIMITS_PENALTY = 10.0  # of limits on states, where these alone bind, in q0 / R^4
ROUNDS = 5  # of `iterations`, at most, while a candidate isn't near the goal
LEAST_SHARE = 0.05  # share of the horizon between departure and arrival
LAST_PART = 0.1  # of the distance to the goal: the last part is approached slowly
CORNER_DEPTH = 0.5  # depth in mean inflated radii; averaged corners that cut deeper into an obstacle are averaged less
DEPTH_POINTS = 64  # points of a path at which its depth is measured, about


class Free(NamedTuple):
    """The trajectories without constraints of B problems."""

    cost: Tensor  # (B,)
    share: Tensor  # (B,): of the horizon, until a tenth of the distance to the goal is left; infinite where never
    slower: Tensor  # (B,): times as long as that takes within the limits on states, at least 1
    iterations: Tensor  # (B,) int64


@dataclass(frozen=True)
class Paths:
    """Paths of B problems, K each, and the units to follow them in."""

    corners: Tensor  # (B, K, P, d), m
    classes: Tensor  # (B, K) int64: the first path of the same homotopy class
    live: Tensor  # (B, K) bool: one per homotopy class
    R: Tensor  # (B,): mean inflated radius, m
    unit: Tensor  # (B,): q0 / R^4
    obstacles: Inflated

    def joined(self, corners: Tensor, found: Tensor) -> Paths:
        """With one path more of each problem, (B, 1, P, d), as a class of its own, where it was found, (B,)."""
        own = torch.full_like(self.classes[:, :1], self.classes.shape[1])
        return replace(
            self, corners=torch.cat((self.corners, corners), dim=1), classes=torch.cat((self.classes, own), dim=1),
            live=torch.cat((self.live, found.unsqueeze(1) & self.live.any(1, keepdim=True)), dim=1),
        )  # fmt: skip

    def stretch(self) -> Tensor:
        """The length (B, K) of each path, in distances between its ends."""
        ends = self.corners[:, :, 0] - self.corners[:, :, -1]
        lengths = length(self.corners.flatten(0, 1)).view(self.corners.shape[:2])
        return lengths / ends.square().sum(-1).sqrt().clamp(min=1e-12)


@dataclass(frozen=True)
class Follow:
    """How candidates follow a path: from rest and from each initial offset, at each pace.

    Args:
        initial_offsets: offsets (m,) of the controls over the first tenth of the horizon, as shares of the range from
            rest to the control bounds; every path is tracked from rest and once from each offset. An initial turn lets
            a vehicle that turns slowly find reversing and three-point turns. `Restarts` leaves them out where they
            don't fit the number of controls.
        depart, arrive: shares of the horizon at which the vehicle leaves the start and reaches the goal. Several
            values of `arrive`: every path is tracked at each pace. Where rows limit states, all this takes as
            much longer as they make the way without obstacles.
        pace: times the time that the vehicle takes without constraints, per length of the path: no path is followed
            more slowly than this, whatever `arrive` says. None: no such limit.
        smoothing: share of the horizon over which the corners of a path are averaged, at most (see `followed`).
        tube: radius of the tube that a candidate is kept in, as a share of the mean inflated radius; None: a spring to
            the path instead. A spring takes half the iterations; a vehicle that can't move sideways ends closer to the
            path in a tube.
        stiffness: of tube or spring, one solve per value, in units of the cost of resting at the start per squared
            distance to the goal.
        obstacles: penalty of obstacles in these solves, in q0 / R^4. With 0, obstacles between the vehicle at rest and
            its path don't bar the way to it; such candidates count only as refined.
        iterations: of iLQR in each of these solves, at most; up to five times as many while a candidate
            isn't near the goal: vehicles that tilt to move leave the start in small steps.

    Raises:
        InputError: a field out of its range.
    """

    initial_offsets: tuple[tuple[float, ...], ...] = ()
    depart: float = 0.0
    arrive: float | tuple[float, ...] = 0.9
    pace: Positive | None = None
    smoothing: Annotated[float, AtLeast(0), Below(1)] = 0.08
    tube: Positive | None = 0.05
    stiffness: tuple[Positive, ...] = (20.0, 200.0)
    obstacles: NonNegative = 10.0
    iterations: Count = 20

    def __post_init__(self) -> None:
        check_options(self, "follow")
        for name in ("arrive", "stiffness", "initial_offsets"):  # lists of a configuration file equal tuples
            if isinstance(value := getattr(self, name), Sequence):
                rows = (tuple(row) if isinstance(row, list) else row for row in value)
                object.__setattr__(self, name, tuple(rows))
        if not self.paces or not all(0 <= self.depart < arrive <= 1 for arrive in self.paces):
            raise InputError("follow.depart", f"at least 0 and below arrive, {self.arrive}", self.depart)
        if not self.stiffness:
            raise InputError("follow.stiffness", "one or more numbers above 0", self.stiffness)

    def __str__(self) -> str:
        guide = "spring" if self.tube is None else "tube"
        stiffness = ", ".join(f"{value:g}" for value in self.stiffness)
        count = (1 + len(self.initial_offsets)) * len(self.paces)
        several = f", {count} candidates" if count > 1 else ""
        bare = ", without obstacles" if self.obstacles == 0 else ""
        return f"{guide} {stiffness}, {self.iterations} iterations, corners over {self.smoothing:g} N{several}{bare}"

    def fitting(self, m: int) -> Follow:
        """Without initial offsets where these have another number of controls than m."""
        return self if all(len(offset) == m for offset in self.initial_offsets) else replace(self, initial_offsets=())

    @property
    def paces(self) -> tuple[float, ...]:
        """The values of `arrive`, as a tuple."""
        return tuple(self.arrive) if isinstance(self.arrive, Sequence) else (self.arrive,)

    def starts(self, problem: Problem, rest: Tensor) -> Tensor:
        """Initial controls of the candidates of each path, (B, 1 + offsets, N, m): rest, and rest after each offset.

        Raises:
            InputError: initial offsets that don't fit the controls.
        """
        _, N, m = rest.shape
        starts = repeated(rest, 1 + len(self.initial_offsets))
        if self.initial_offsets:
            offsets = tensor(self.initial_offsets, "follow.initial_offsets", rest)
            check_shape(offsets, (len(self.initial_offsets), m), "follow.initial_offsets")
            reach = seen.control_reach(problem, rest, offsets)
            first = torch.arange(N, device=rest.device) < (OFFSET_LASTS * problem.stages).ceil().unsqueeze(-1)
            starts[:, 1:] += torch.where(first[:, None, :, None], (reach * offsets).unsqueeze(2), 0.0)
        return starts

    def track(self, candidates: Candidates, paths: Paths, free: Free | None) -> Candidates:
        """The candidates, tracked along their paths from their initial controls at their paces."""
        paces, K = len(self.paces), paths.corners.shape[1]
        arrive = paths.corners.new_tensor(self.paces).repeat(paths.corners.shape[0] * K)
        if free is not None:
            slower = free.slower.repeat_interleave(K * paces)
            arrive = torch.minimum(self.depart + (arrive - self.depart) * slower, arrive.clamp(min=1.0))
        if self.pace is not None:
            assert free is not None
            shares = ((free.share * free.slower).unsqueeze(-1) * paths.stretch()).nan_to_num(torch.inf)
            latest = self.pace * shares.flatten().repeat_interleave(paces)
            arrive = torch.minimum(arrive, latest.clamp(min=self.depart + LEAST_SHARE))
        return self.along(candidates, paths, arrive, paces)

    def along(self, candidates: Candidates, paths: Paths, arrive: Tensor, paces: int) -> Candidates:
        """The same at given paces: shares `arrive` (B * K * paces,) of the horizon, for each path one after another."""
        K = paths.corners.shape[1]
        path = paths.corners.flatten(0, 1).repeat_interleave(paces, dim=0)
        center = self._centers(path, arrive, candidates.problem, paths)
        problem = torch.arange(candidates.problem.B, device=path.device).repeat_interleave(K * paces) * candidates.count
        number = torch.arange(candidates.live.numel(), device=path.device)
        place = number // (candidates.count // K) * paces + number % paces  # of each candidate's path and pace
        at, live = candidates.problem.position, candidates.live
        for stiffness in self.stiffness:
            weight = stiffness * candidates.unit[problem]
            penalty = attraction(center, path, at, candidates.R[problem], weight, self.tube)
            for _ in range(ROUNDS):
                candidates = candidates.solved(inner_solver(self.iterations), self.obstacles, penalty, place)
                candidates = replace(candidates, live=candidates.live & ~candidates.arrive)
                if not bool(candidates.live.any()):
                    break
            candidates = replace(candidates, live=live)
        return candidates

    def _centers(self, path: Tensor, arrive: Tensor, problem: Problem, paths: Paths) -> Tensor:
        """Where the candidates are at every knot, (B K, N+1, d): along each path within the horizon of its problem.

        Where there are gates, `arrive` is a share of the stages after the last of them.
        """
        N, each = problem.N, path.shape[0] // max(1, problem.B)
        gates = gates_of(problem)
        if gates is not None:  # which say when; a pace is that of the last leg
            assert gates.places is not None
            places, stages = (part.repeat_interleave(each, dim=0) for part in (gates.places, problem.stages))
            last = places[:, -1]
            return timed(path, places, last + arrive.clamp(LEAST_SHARE, 1.0) * (stages - last), N)
        if problem.horizon is None:
            return followed(path, self.depart, arrive, self.smoothing, N, paths.obstacles, paths.R)
        center = repeated(path[:, -1], N + 1)
        for horizon in problem.stages.unique().tolist():
            rows = (problem.stages == horizon).nonzero().flatten()
            some = (rows.unsqueeze(-1) * each + torch.arange(each, device=path.device)).flatten()
            near, R = take(paths.obstacles, rows), paths.R[rows]
            along = followed(path[some], self.depart, arrive[some], self.smoothing, horizon, near, R)
            center[some, : horizon + 1] = along
            center[some, horizon + 1 :] = along[:, -1:]
        return center


def unconstrained(problem: Problem, rest: Tensor, iterations: int, unit: Tensor) -> Free:
    """The trajectories without constraints, from the controls `rest` (B, N, m); unit (B,): q0 / R^4."""
    end, _ = descend(inner_solver(iterations), plain(problem), rest)
    share, slower, made = _share(problem, end.X), torch.ones_like(end.cost), end.iterations
    bare = without_obstacles(problem) if limits_states(problem) else None
    if bare is not None:
        limits = Lagrangian(bare, Multipliers.none(bare, LIMITS_PENALTY * unit), None, True)
        limited, _ = descend(inner_solver(iterations), limits, end.U)
        slower = (_share(problem, limited.X) / share).nan_to_num(1.0).clamp(min=1.0)
        made = made + limited.iterations
    return Free(end.cost, share, slower, made)


def limits_states(problem: Problem) -> bool:
    """Whether rows besides obstacles and control bounds may limit how fast a vehicle is."""
    return any(not part.bare.says_where and part.sense == "inequality" for part in problem.constraints)


def _share(problem: Problem, X: Tensor) -> Tensor:
    """Share (B,) of the horizon until a tenth of the distance to the goal is left; infinite where never."""
    assert problem.goal is not None
    left = problem.goal.distance(X[..., problem.position])
    near = left <= LAST_PART * left[:, :1]
    share = near.to(torch.int8).argmax(-1).to(left) / problem.stages
    return torch.where(near.any(-1), share, torch.inf)


def plain(problem: Problem) -> Lagrangian:
    """The cost alone: the constraints with multipliers and penalties of zero."""
    return Lagrangian(problem, Multipliers.none(problem, torch.zeros_like(problem.x0[:, 0])), None, True)


def travel(path: Tensor, depart: float, arrive: Tensor, smoothing: float, N: int) -> Tensor:
    """Positions on paths (B, P, d) at every knot, (B, N+1, d): smooth start and stop, corners averaged.

    Args:
        depart, arrive: shares of the horizon at which the start is left and the goal is reached; arrive (B,).
        smoothing: share of the horizon over which corners are averaged.
    """
    share = torch.arange(N + 1, dtype=path.dtype, device=path.device) / N
    share = ((share - depart) / (arrive.unsqueeze(-1) - depart)).clamp(0.0, 1.0)
    share = share.square() * (3.0 - 2.0 * share)
    center = points_along(path, share * length(path).unsqueeze(-1))
    reach = int(0.5 * smoothing * N)
    if reach == 0:
        return center
    padded = torch.cat((center[:, :1].expand(-1, reach, -1), center, center[:, -1:].expand(-1, reach, -1)), dim=1)
    return padded.unfold(1, 2 * reach + 1, 1).mean(-1)


def followed(
    path: Tensor, depart: float, arrive: Tensor, smoothing: float, N: int, obstacles: Inflated, R: Tensor
) -> Tensor:
    """As `travel`, but corners are averaged less where the average would cut deep into an obstacle.

    Between the trunks of a dense wood, a path that is averaged over seconds leads through the trunks.

    Args:
        path: those of B problems one after the other, (B K, P, d).
        R: mean inflated radius (B,), m.
    """
    center, B = travel(path, depart, arrive, smoothing, N), R.shape[0]
    each, some = path.shape[0] // max(1, B), torch.arange(B, device=path.device)  # the problems with deep paths
    while some.numel() > 0 and smoothing * N >= 2.0:
        points = center.view(B, each, N + 1, -1)[some, :, :: max(1, N // DEPTH_POINTS)]
        deep = obstacles.deeper(points.flatten(1, 2), CORNER_DEPTH * R).view(*points.shape[:3]).any(-1)
        rows = (some.unsqueeze(-1) * each + torch.arange(each, device=path.device))[deep]
        if rows.numel() == 0:
            break
        smoothing *= 0.5
        center[rows] = travel(path[rows], depart, arrive[rows], smoothing, N)
        again = deep.any(-1)
        if not bool(again.all()):
            some, obstacles, R = some[again], take(obstacles, again.nonzero().flatten()), R[again]
    return center


def attraction(
    center: Tensor, path: Tensor, position: slice, R: Tensor, stiffness: Tensor, tube: float | None
) -> Penalty:
    """The penalty that attracts knots to `center` (B, N+1, d) on paths (B, P, d): a tube, or without one a spring.

    Args:
        R: mean inflated radius (B,), m.
        stiffness: (B,) in q0 / (R^4 L^2), with L the distance from start to goal.
        tube: radius as a share of R.
    """
    length2 = (path[:, -1] - path[:, 0]).square().sum(-1)
    spring = stiffness * R.pow(4) / length2.clamp(min=1e-12)
    if tube is None:
        return GuidePath(center, spring, position)
    radius = tube * R
    # Near its surface the tube is as stiff as a spring of 4 weight radius^2.
    weight = spring / (4.0 * radius.square()).clamp(min=1e-12)
    return GuideRegion(center, repeated(radius, center.shape[1]), weight, position)
