"""Problems among obstacles that move as a lattice in space and time sees them: its size, speeds, and what they cost."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchgco.base.autodiff import gradients_at_once
from torchgco.base.draws import uniform
from torchgco.base.shapes import repeated
from torchgco.constraints.base import ADMITTED, Constraint
from torchgco.constraints.gates import gates_of
from torchgco.costs.quadratic import QuadraticInFreeTime
from torchgco.lagrangian.quality import goal_tolerance, ranks_arrival
from torchgco.obstacles.base import Obstacles
from torchgco.problem.problem import Problem
from torchgco.roadmap.lattice import Array
from torchgco.roadmap.timed import FAR, TimedLattice, TimedScene, field_of
from torchgco.search.reach import WIDE, bounds_at_inner_knots, push_of
from torchgco.search.steering import SAME_MODEL, SEED, alike, heading_and_speed

SAMPLES = 16  # states and controls at which the equations are looked at


@dataclass(frozen=True, eq=False)
class Velocity:
    """Which states say how fast the position moves, of a batch of one.

    Args:
        places: in the state, of the velocity along each axis, or of heading and speed; empty: neither.
        by_heading: which of the two.
    """

    problem: Problem
    places: tuple[int, ...]
    by_heading: bool

    @classmethod
    def of(cls, problem: Problem) -> Velocity:
        """Read from the equations at samples of states and controls."""
        model, at = problem.dynamics, problem.position
        none = cls(problem, (), False)
        if model.at(0) is not model or not model.stretches:
            return none
        low, high = (part[0] for part in bounds_at_inner_knots(problem))
        bounded = torch.isfinite(low) & torch.isfinite(high)
        low, high = torch.where(bounded, low, -WIDE), torch.where(bounded, high, WIDE)
        z = low + uniform(SEED, (1, SAMPLES, problem.n + problem.m), low) * (high - low)
        x, u = z[..., : problem.n], z[..., problem.n :]
        rates = model.field(x, u)[0, :, at]
        rows = [torch.cat(_slopes(model, x, u, i), dim=-1)[0] for i in range(at.start, at.stop)]
        slopes = torch.stack(rows, dim=-2)  # (SAMPLES, d, n + m)
        if not bool(torch.isfinite(slopes).all() & torch.isfinite(rates).all()):
            return none
        if rates.shape[1] == 2 and (found := heading_and_speed(x[0], rates, slopes)) is not None:
            return cls(problem, found, True)
        depends = (slopes.abs() > SAME_MODEL).any(0)
        places = tuple(int(row.nonzero()[0]) for row in depends if int(row.sum()) == 1)
        if len(places) < len(depends) or max(places) >= problem.n or not alike(rates, x[0][:, list(places)]):
            return none
        return cls(problem, places, False)

    def states(self, v: Array, p: Tensor | None = None) -> Tensor:
        """States (M, n) that move at velocities v (M, d), m/s, at the start; or at places p (M, d) one after another.

        What moves along its heading keeps that of the place before where it rests.
        """
        x = repeated(self.problem.x0, len(v))[0]
        if p is not None:
            x[:, self.problem.position] = p
        if self.by_heading:
            heading, speed = self.places
            x[:, speed] = x.new_tensor(np.hypot(v[:, 0], v[:, 1]))
            x[:, heading] = x.new_tensor(_headings(v, float(self.problem.x0[0, heading]), p is not None))
        elif self.places:
            x[:, list(self.places)] = x.new_tensor(v)
        return x

    @cached_property
    def start(self) -> Array:
        """The velocity (d,) at the start, m/s."""
        x, at = self.problem.x0, self.problem.position
        if not self.places:
            return np.zeros(at.stop - at.start)
        if not self.by_heading:
            return x[0, list(self.places)].double().cpu().numpy()
        heading, speed = (float(x[0, i]) for i in self.places)
        return speed * np.array([np.cos(heading), np.sin(heading)])

    def admitted(self, v: Array) -> NDArray[np.bool_]:
        """Which velocities v (M, d) the constraints on states admit at some knot, (M,) bool."""
        if not any(map(_limits_speed, self.problem.constraints)):
            return np.ones(len(v), dtype=bool)
        rest = self.problem.take(torch.zeros(len(v) + 1, dtype=torch.int64, device=self.problem.x0.device))
        X = repeated(self.states(np.vstack((v, np.zeros_like(v[:1])))), rest.N + 1)
        U = rest.cost.rest_controls(X.new_zeros(rest.B, rest.N, rest.m))
        good = torch.ones(len(v), dtype=torch.bool, device=X.device)
        for part in rest.constraints:
            if _limits_speed(part):
                worst = part.violation(X, U)
                least = worst.flatten(2).amax(-1).amin(-1) if worst.numel() > 0 else X.new_zeros(rest.B)
                good &= least[:-1] <= least[-1] + ADMITTED
        return good.cpu().numpy()

    def cost_of(self, v: Array, stages: float) -> tuple[Array, Array]:
        """What moving at v (M, d) for so many stages costs more than resting, and moving so at the end, (M,) each."""
        both = self.states(np.vstack((v, np.zeros_like(v[:1])))).unsqueeze(0)
        cost, u = self.problem.cost, self._rest(both.shape[1])
        along, last = cost.stage(both, u, 0)[0], cost.terminal(both)[0]
        moving, ending = ((part[:-1] - part[-1]).double().cpu().numpy() for part in (along, last))
        return stages * moving, ending

    def cost_of_change(self, a: float, stages: float) -> Array:
        """What an acceleration a, m/s^2, along each axis costs over so many stages, (d,).

        NaN where no control accelerates at once.
        """
        at, model = self.problem.position, self.problem.dynamics
        unknown = np.full(at.stop - at.start, np.nan)
        if not self.places:
            return unknown
        x, u = self.problem.x0.unsqueeze(1), self._rest(1)
        states = self.places[1:] if self.by_heading else self.places
        B = torch.stack([_slopes(model, x, u, i)[1][0, 0] for i in states])  # (c, m)
        more = torch.linalg.pinv(B).T * a  # controls of each, (c, m)
        does = (more @ B.T - a * torch.eye(len(states)).to(B)).abs().amax(-1) <= 1e-6 * a
        here = repeated(x[:, 0], len(states))
        cost = self.problem.cost.stage(here, u + more, 0) - self.problem.cost.stage(
            here, u.expand(-1, len(states), -1), 0
        )
        found = torch.where(does, stages * cost[0], torch.nan).double().cpu().numpy()
        return np.broadcast_to(found, unknown.shape).copy()

    def _rest(self, count: int) -> Tensor:
        return self.problem.at_rest[1][:, :1].expand(-1, count, -1)


def _slopes(model, x: Tensor, u: Tensor, i: int) -> tuple[Tensor, Tensor]:
    """The derivatives (1, S, n) and (1, S, m) of the rate of state i."""
    fx, fu = gradients_at_once(lambda x, u: model.field(x, u)[..., i], x, u)
    return fx, fu


def _limits_speed(part: Constraint) -> bool:
    """Whether a constraint's rows are of states, and say more than where to be."""
    return (
        not part.geometric
        and not part.joins_knots
        and not part.is_goal
        and getattr(part, "of", "x") == "x"
        and (part.sense == "inequality")
    )


def _headings(v: Array, first: float, in_turn: bool) -> Array:
    """Directions (M,), rad, of velocities v (M, d), `first` where there is none; of places in turn without jumps, and
    that of the place before."""
    moves, ways = np.hypot(v[:, 0], v[:, 1]) > SAME_MODEL, np.arctan2(v[:, 1], v[:, 0])
    if not in_turn:
        return np.where(moves, ways, first)
    last = np.maximum.accumulate(np.where(moves, np.arange(len(v)), -1))
    return np.unwrap(np.append(first, np.where(last >= 0, ways[last], first)))[1:]


STATES = 2**24  # of a lattice, at most: 128 MiB
MOVES = 256  # of a lattice, at most, before the constraints are asked: two sweeps look at each of them everywhere
COARSER = 1.1  # times as wide cells, until there are so few
PUSH_SHARE = 0.5  # share of the strongest acceleration by which the lattice changes its velocity at most
ROOM = 0.1  # share of a cell's side that ways keep clear, as distances are interpolated between cells
HALF = (
    0.5  # share of the distance that the lattice extends beyond start, goal and the way without obstacles: there stay
)
# ways up to sqrt(2) times as long; at first
AROUND = 3.0  # sizes of the largest obstacle, at most
FASTER = 1.25  # times as fast as without obstacles, at most
SIDEWAYS = 0.5  # share of that speed by which in space the velocity along an axis may leave its range there
THIN = 0.25  # share of the smallest obstacle's size that a cell of a vehicle without a radius measures


class Sizes(NamedTuple):
    """What the lattice of a problem follows from."""

    spacing: float  # m
    push: float  # by which the lattice changes its velocity at most, m/s^2
    duration: float  # s
    low: Array  # (d,), m
    high: Array
    slowest: Array  # (d,), m/s
    fastest: Array


def can_search(problem: Problem) -> bool:
    """Whether there are obstacles that move, in two or three dimensions, and all of them have distances."""
    at = problem.dynamics.position
    if at is None or at.stop - at.start not in (2, 3) or not any(part.moving for part in problem.obstacles):
        return False
    return all(type(part.inscribed).signed_distance is not Obstacles.signed_distance for part in problem.obstacles)


def _with_distances(problem: Problem) -> list[Any]:
    """The obstacles and the maps of a batch of one; of a body those of the ball about the position that it holds."""
    parts = (part.inscribed if isinstance(part, Obstacles) else part for part in problem.geometric)
    return [part for part in parts if hasattr(part, "signed_distance")]


class Span(NamedTuple):
    """The times of one problem."""

    step: float  # of the trajectory without obstacles, s
    earliest: float  # at which it may end, s
    latest: float
    second: float = 0.0  # what a second costs
    push: float = PUSH_SHARE

    @classmethod
    def of(cls, problem: Problem) -> Span:
        """That of a batch of one whose time isn't free."""
        dt, stages = float(problem.dynamics.dt), int(problem.stages[0])
        return cls(dt, stages * dt, stages * dt)


def scene_in_time(problem: Problem, free: Tensor, finer: float = 1.0, span: Span | None = None) -> TimedScene:
    """The scene of a batch of one.

    Args:
        free: states (N+1, n) of the trajectory without obstacles.
        finer: share of the usual spacing.
        span: when ways may end; None: that of the problem.
    """
    span = span or Span.of(problem)
    velocity, start = Velocity.of(problem), problem.x0[0, problem.position].double().cpu().numpy()
    lattice = _lattice(_sizes(problem, free, finer, span), start, velocity)
    stages = lattice.tau / float(problem.dynamics.dt)
    move, last = velocity.cost_of(lattice.velocities, stages)
    fast = ~velocity.admitted(lattice.velocities)
    cell_cost, end_cost, bend = _cell_costs(problem, lattice, stages, span)
    change = np.zeros(3)
    unit = lattice.spacing / lattice.tau
    own = velocity.cost_of_change(unit / lattice.tau, stages)
    # Without a control that accelerates at once: as much as being a cell away from where one wants to be.
    change[: lattice.d] = np.where(np.isfinite(own), own, bend)
    if not change.any() and not move.any():  # the way alone counts
        move = (lattice.velocities**2).sum(1) * lattice.tau
    return TimedScene(
        lattice, field_of(_with_distances(problem), lattice), cell_cost, end_cost,
        _costs(np.where(fast, FAR, move)), _costs(last), _costs(change), lattice.cell(start),
        lattice.move(velocity.start), ROOM * lattice.spacing,
    )  # fmt: skip


def among(scene: TimedScene, problem: Problem) -> TimedScene:
    """A scene with the obstacles of another batch of one, which differs in these alone."""
    return replace(scene, field=field_of(_with_distances(problem), scene.lattice))


def _costs(values: Array) -> Tensor:
    """Costs for C: those that aren't finite are `FAR`."""
    return torch.from_numpy(np.nan_to_num(values, nan=FAR, posinf=FAR, neginf=FAR)).float().contiguous()


def _sizes(problem: Problem, free: Tensor, finer: float, span: Span) -> Sizes:
    at, d = problem.position, problem.position.stop - problem.position.start
    radius = max((float(part.vehicle_radius.max()) for part in problem.obstacles), default=0.0)
    margins = [float(part.margins[~part.absent].min()) for part in problem.obstacles if not bool(part.absent.all())]
    spacing = finer * (radius if radius > 0.0 else THIN * min(margins))
    p = free[:, at].double().cpu().numpy()
    v = np.diff(p, axis=0)[: int(problem.stages[0])] / span.step
    push = float(push_of(problem)[0])
    if not np.isfinite(push) or push <= 0.0:
        push = float(np.abs(np.diff(v, axis=0)).max(initial=0.0)) / span.step or 1.0
    ends = [problem.x0[:, at].double().cpu().numpy(), p]
    if problem.goal is not None:
        ends.append(problem.goal.position.double().cpu().numpy())
    gates = gates_of(problem)
    if gates is not None:
        ends.append(gates.centers[0].double().cpu().numpy())
    points = np.concatenate(ends)
    beyond = HALF * float(np.linalg.norm(np.ptp(points, axis=0)))
    if finer == 1.0 or d == 3:  # in space so many cells would be coarse
        beyond = min(beyond, AROUND * (_largest(problem) + radius))
    low, high = (part[0, at].double().cpu().numpy() for part in bounds_at_inner_knots(problem))
    speed = FASTER * np.linalg.norm(v, axis=1).max(initial=0.0)
    slowest, fastest = np.full(d, -speed), np.full(d, speed)
    if d == 3 and len(v) > 0:
        slowest, fastest = v.min(0) - SIDEWAYS * speed, v.max(0) + SIDEWAYS * speed
    low, high = np.maximum(low, points.min(0) - beyond), np.minimum(high, points.max(0) + beyond)
    return Sizes(spacing, span.push * push, span.latest, low, high, slowest, fastest)


def _largest(problem: Problem) -> float:
    """Half the length of the largest obstacle of a batch of one, m."""
    found = 0.0
    for part in problem.obstacles:
        shapes = part.inscribed.shapes(0)
        if shapes is None:
            found = max(found, float(part.margins.amax()))
        elif len(shapes.radius) > 0:
            found = max(found, float((np.linalg.norm(shapes.half, axis=1) + shapes.radius).max()))
    return found


def _lattice(sizes: Sizes, start: Array, velocity: Velocity) -> TimedLattice:
    """As fine as the sizes say, or as memory and moves allow; with the moves that the constraints admit."""
    spacing = sizes.spacing
    while True:
        lattice = _of_spacing(sizes, start, spacing)
        # What the constraints admit of so few moves is soon known; it may leave fewer.
        if lattice is not None and (lattice := _admitted(lattice, velocity)).states <= STATES:
            return lattice
        spacing *= COARSER


def _of_spacing(sizes: Sizes, start: Array, spacing: float) -> TimedLattice | None:
    """The lattice with cells of a width, m; None where it has too many moves, or cells and layers."""
    layers = max(2.0, np.rint(sizes.duration / np.sqrt(spacing / sizes.push)))
    tau = sizes.duration / layers
    before, behind = (
        np.floor(np.maximum(part, 0.0) / spacing + 1e-9) for part in (start - sizes.low, sizes.high - start)
    )
    unit = spacing / tau
    least = np.minimum(np.floor(sizes.slowest / unit + 0.5), -1.0)
    most = np.maximum(np.ceil(sizes.fastest / unit - 0.5), 1.0)
    counts = before + behind + 1.0
    if (most - least + 1.0).prod() > MOVES or (layers + 1.0) * counts.prod() > STATES:
        return None
    whole = [part.astype(np.int64) for part in (counts, least, most)]
    return TimedLattice(start - spacing * before, whole[0], spacing, tau, int(layers), whole[1], whole[2])


def _admitted(lattice: TimedLattice, velocity: Velocity) -> TimedLattice:
    """The same lattice without moves along an axis that the constraints admit nowhere."""
    v = lattice.velocities
    some = np.rint(v[velocity.admitted(v)] * (lattice.tau / lattice.spacing)).astype(np.int64)
    some = np.concatenate((some, np.zeros((1, lattice.d), np.int64)))  # to rest
    return replace(lattice, least=some.min(0), most=some.max(0))


def _cell_costs(problem: Problem, lattice: TimedLattice, stages: float, span: Span) -> tuple[Tensor, Tensor, Array]:
    """What being at a cell at a layer costs, (layers, cells), ending there at one of the last ones, (some, cells), and
    being a cell away from the best one, by axis (d,)."""
    dt = float(problem.dynamics.dt)
    x = repeated(problem.x0, lattice.cells)
    points = x.new_tensor(lattice.points)
    x[..., problem.position] = points
    u = problem.at_rest[1][:, :1].expand(-1, lattice.cells, -1)
    last = int(problem.stages[0]) - 1
    found = torch.empty(lattice.layers, lattice.cells, dtype=torch.float64)
    for layer in range(lattice.layers):
        k = min(last, round(layer * lattice.tau / dt))
        found[layer] = stages * (_stage_cost(problem, x, u, k, layer * lattice.tau) + span.second * dt).double().cpu()
        for part in problem.geometric:
            if not hasattr(part, "signed_distance") and k > 0 and part.holds_at(k):
                found[layer][(part.at(x, k)[0] > 0).any(-1).cpu()] = FAR
    bend = _bend(found[0], lattice)
    earliest = min(lattice.layers, int(np.ceil(span.earliest / lattice.tau - 1e-9)))
    ends = [_end_cost(problem, x, layer * lattice.tau) for layer in range(earliest, lattice.layers + 1)]
    end = torch.stack(ends).double().cpu()
    _bar(problem, lattice, points, found, end)
    found, end = (part.nan_to_num(FAR, FAR, FAR).clamp(max=FAR).float() for part in (found, end))
    return found, end, bend


def _stage_cost(problem: Problem, x: Tensor, u: Tensor, k: int, t: float) -> Tensor:
    """What a stage in states x (1, M, n) costs, (M,): stage k, with references of a time."""
    if problem.time is None or k == 0 or not isinstance(problem.cost, QuadraticInFreeTime):
        return problem.cost.stage(x, u, k)[0]
    return problem.cost.stage_at(x, u, k, torch.full_like(x[..., 0], t / (k * float(problem.dynamics.dt))))[0]


def _end_cost(problem: Problem, x: Tensor, t: float) -> Tensor:
    """What ending in states x (1, M, n) at a time costs, (M,)."""
    if problem.time is None or not isinstance(problem.cost, QuadraticInFreeTime):
        return problem.cost.terminal(x)[0]
    return problem.cost.terminal_at(x, torch.full_like(x[..., 0], t / (problem.N * float(problem.dynamics.dt))))[0]


def _bend(cost: Tensor, lattice: TimedLattice) -> Array:
    """Half the mean second difference of a layer's costs along each axis, (d,)."""
    grid, found = cost.numpy().reshape(lattice.counts), np.zeros(lattice.d)
    for a in range(lattice.d):
        if lattice.counts[a] > 2:
            found[a] = max(0.0, 0.5 * float(np.diff(grid, 2, axis=a).mean()))
    return found


def _bar(problem: Problem, lattice: TimedLattice, points: Tensor, cost: Tensor, end: Tensor) -> None:
    """Bar all cells but those at a goal that counts, at the end, and at gates, at their times; in place."""
    half = 0.5 * lattice.spacing * np.sqrt(lattice.d)  # the farthest that a place may be from a cell
    if problem.goal is not None and ranks_arrival(problem):
        near = goal_tolerance(problem)
        assert near is not None
        away = problem.goal.distance(points.unsqueeze(0))[0]
        end[:, (away > max(float(near[0]), half)).cpu()] = FAR
    gates = gates_of(problem)
    if gates is not None and gates.places is not None:
        dt = float(problem.dynamics.dt)
        for center, size, place in zip(gates.centers[0], gates.sizes[0], gates.places[0], strict=True):
            layer = min(lattice.layers, max(1, round(float(place) * dt / lattice.tau)))
            away = (points - center).norm(dim=-1)
            late = abs(float(place) * dt - layer * lattice.tau)
            reach = max(float(size), half) + late * float(np.abs(lattice.velocities).max())
            (end[-1] if layer == lattice.layers else cost[layer])[(away > reach).cpu()] = FAR
