"""How missions fly in unknown space: options, what the vehicle knows, the path it seeks, the problems of a period."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
import torch
from torch import Tensor

from torchgco.base import clock
from torchgco.base.errors import InputError
from torchgco.base.options import Above, Meters, NonNegative, Seconds, Within, check_options
from torchgco.base.shapes import Dimensions
from torchgco.constraints import ControlBounds, StateBounds
from torchgco.constraints.base import Constraint
from torchgco.constraints.half_spaces import HalfSpaces, stacked
from torchgco.costs.quadratic import QuadraticCost
from torchgco.dynamics.quadrotor import Airframe, QuadrotorPlanning
from torchgco.exploration.movers import Movers, Moving, nothing
from torchgco.exploration.reference import Pace, between, motion, swings, taut
from torchgco.exploration.sensing.grid import SEEN_OCCUPIED, CellSearch, SeenMap
from torchgco.exploration.sensing.sensors import World
from torchgco.kernels import followed
from torchgco.missions.log import SeenLog
from torchgco.missions.planner import Planner
from torchgco.missions.planning_problem import airframe_of, biased, first_step, planning_state
from torchgco.obstacles.base import CONTACT_FACTOR
from torchgco.problem.problem import Problem

SensorName = Literal["full", "lidar", "depth"]
Unknown = Literal["free", "occupied"]
Speed = Annotated[float, Above(0, "m/s")]
Acceleration = Annotated[float, Above(0, "m/s^2")]
PLANES = 8  # half-spaces of a knot at most
CORRIDOR = 2.5  # m around a knot, within which cells make half-spaces
REST = {3: 0.05, 4: 0.05, 5: 0.05, 7: 0.03, 8: 0.03, 10: 0.05, 11: 0.05, 12: 0.05, 13: 0.3}  # of the last two states
FLYABLE = 0.02  # at most, by which a plan exceeds controls, misses its first step or doesn't rest, in their units
PLACES = (0, 2)  # of a form's constraints: those of positions
# Weights of a plan: positions and velocities along the reference, attitude with yaw, body rates, thrust; controls.
STATE = [4.0, 4.0, 8.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 8.0, 0.5, 0.5, 0.5, 0.1]
CONTROL = [0.5, 0.5, 0.5, 0.05]


@dataclass(frozen=True)
class Explorer:
    """Options of missions that see their world through a sensor alone.

    Args:
        resolution: side of the map's cells, m.
        region: 3 pairs [low, high], m, which the vehicle doesn't leave, and the map covers; None: the box of start and
            goal, grown by `around`.
        around: m along x and y, and along z.
        known: radius of the ball around the start that is known to be free, m.
        speed: largest speed along each axis, m/s.
        acceleration, deceleration: of the motion that plans are to follow, m/s^2.
        stages: of a plan, which is at rest after them.
        margin: m that plans keep from what isn't known to be free, beyond the vehicle's radius. A cell at least, as
            one that an obstacle fills in part may look free from afar; less is kept where there is no other way.
        movers: moving bodies are "known" with their places and velocities, "tracked" in the sensor's returns, or with
            "none" all count as at rest.
        patience: s without a way on, after which the vehicle turns to another part of the unknown.

    Raises:
        InputError: a field out of its range.
    """

    resolution: Meters = 0.2
    region: tuple[tuple[float, float], tuple[float, float], tuple[float, float]] | None = None
    around: tuple[NonNegative, NonNegative] = (12.0, 4.0)
    known: NonNegative = 0.6
    speed: Speed = 5.0
    acceleration: Acceleration = 5.0
    deceleration: Acceleration = 3.5
    stages: Annotated[int, Within(20, 400)] = 60
    margin: NonNegative = 0.2
    patience: Seconds = 1.0
    movers: Literal["none", "known", "tracked"] = "none"

    def __post_init__(self) -> None:
        check_options(self, "mission.explorer")
        object.__setattr__(self, "around", tuple(self.around))
        if self.region is not None:
            object.__setattr__(self, "region", tuple(map(tuple, self.region)))
            if any(low >= high for low, high in self.region):
                raise InputError("mission.explorer.region", "pairs [low, high], low below high", self.region)

    @property
    def pace(self) -> Pace:
        """The limits of references; some of the speed is left for what a plan deviates."""
        return Pace(0.94 * self.speed, self.acceleration, self.deceleration)

    def map_of(self, start: np.ndarray, goal: np.ndarray) -> SeenMap:
        """An empty map for a mission from start to goal (3,), m."""
        if self.region is not None:
            low, high = np.array(self.region, float).T
        else:
            more = np.array([self.around[0], self.around[0], self.around[1]])
            low, high = np.minimum(start, goal) - more, np.maximum(start, goal) + more
        shape = np.maximum(np.ceil((high - low) / self.resolution - 1e-9).astype(int), 1)
        return SeenMap(low, tuple(int(n) for n in shape), self.resolution)  # type: ignore[arg-type]


@dataclass(frozen=True)
class PlanningForm:
    """The planning problems of one control period, for C seeds of each mission: C B problems, seed by seed.

    Args:
        explorer: options.
        planner: of which estimation and first step are used.
        whole: the problems of the missions, of which model and control bounds are used; each C times.
    """

    explorer: Explorer
    planner: Planner
    whole: Problem

    def problem(
        self,
        x: Tensor,
        bias: Tensor,
        reference: Tensor,
        planes: Tensor,
        room: Tensor,
        seeds: Tensor,
        allowed: Tensor,
        region: Tensor,
    ) -> Problem:
        """The problems from plants x (B, 17).

        Args:
            bias: (B, 3), m/s^2.
            reference: states (B, N+1, 14) to follow.
            planes: (B, N, R, 4), see `SeenMap.corridor`; room (B, N), m; seeds (B, N, 3), m: where they were made.
            allowed: (B, N), m: distance that each knot keeps from what isn't known to be free.
            region: (B, 2, 3), m: the lowest and the highest point of the map, which half-spaces don't know.
        """
        whole, N = self.whole, self.explorer.stages
        x0, g = planning_state(x, self.airframe), self.airframe.gravity
        dynamics = whole.dynamics if self.planner.estimation == 0 else biased(whole.dynamics, bias)
        cost = QuadraticCost(Q=STATE, R=CONTROL, Qf=[2.0 * w for w in STATE], x_ref=reference, u_ref=[0, 0, 0, g])
        normals, offsets = stacked(planes, allowed.unsqueeze(-1))
        constraints: list[Constraint] = [
            HalfSpaces(normals, offsets),
            self._controls(),
            self._limits(seeds, room, allowed, region),
            self._rest(N),
        ]
        if self.planner.first_step:
            constraints.append(self._first_step(x, x0))
        return Problem(dynamics, cost, constraints, x0, N)

    @property
    def airframe(self) -> Airframe:
        """The vehicle."""
        return airframe_of(self.whole.dynamics)

    def _controls(self) -> ControlBounds:
        """The bounds, and yaw that costs no thrust from the second stage on; the first stage is the rotors'."""
        bounds, N = self.whole.control_bounds, self.explorer.stages
        assert bounds is not None
        lower, upper = (bound[:, :1].repeat(1, N, 1) for bound in bounds.by_knot)
        assert isinstance(self.whole.dynamics, QuadrotorPlanning)
        most = steady_yaw(self.whole.dynamics, lower)
        lower[:, 1:, 2] = torch.maximum(lower[:, 1:, 2], -most)
        upper[:, 1:, 2] = torch.minimum(upper[:, 1:, 2], most)
        return ControlBounds(lower, upper)

    def _limits(self, seeds: Tensor, room: Tensor, allowed: Tensor, region: Tensor) -> StateBounds:
        """Speeds, and positions within the map, around the seeds as far as the half-spaces hold."""
        wide = ((room - allowed) / 3**0.5).clamp(min=0.05).unsqueeze(-1)
        upper = seeds.new_full((*seeds.shape[:2], 14), torch.inf)
        lower = -upper
        low, high = region[:, :1], region[:, 1:]
        inset = torch.minimum(allowed.unsqueeze(-1), 0.5 * (high - low))
        lower[..., :3] = torch.maximum(seeds - wide, low + inset)
        upper[..., :3] = torch.minimum(seeds + wide, high - inset)
        lower[..., 3:6], upper[..., 3:6] = -self.explorer.speed, self.explorer.speed
        return StateBounds(lower, upper)

    def _first_step(self, x: Tensor, x0: Tensor) -> StateBounds:
        """`FirstStepRates` as bounds, which native kernels know."""
        model = self.whole.dynamics
        size = Dimensions(len(x0), self.explorer.stages, 14, 4, float(model.dt), model.position, x0, 1)
        asked = first_step(self.whole, x).bind(size).target
        assert asked is not None
        upper = x0.new_full((x0.shape[0], 1, 14), torch.inf)
        lower = -upper
        lower[:, 0, 10:13] = upper[:, 0, 10:13] = asked
        return StateBounds(lower, upper, knots=[1])

    def _rest(self, N: int) -> StateBounds:
        upper = torch.full((14,), torch.inf, dtype=torch.float64)
        lower = -upper
        for i, size in REST.items():
            middle = self.airframe.gravity if i == 13 else 0.0
            lower[i], upper[i] = middle - size, middle + size
        return StateBounds(lower, upper, knots=[N - 1, N])


def steady_yaw(model: QuadrotorPlanning, like: Tensor) -> Tensor:
    """The commanded yaw rate (B, 1) or (1, 1), rad/s, that half of one period's change of thrusts gives.

    A rotor's thrust falls at once, but rises slowly: a vehicle asked to yaw more loses thrust, and sinks. Yawing takes
    five times the thrust that tilting does.
    """
    airframe = model.airframe
    hover = like.new_tensor(airframe.hover_thrust)
    rise = float(model.dt) * airframe.thrust_rate(hover, like.new_tensor(airframe.rotor_speeds[1]))
    turn = 0.5 * rise * airframe.allocation(like)[2].abs().sum() / airframe.inertia[2][2]  # rad/s^2, from none
    constant = torch.as_tensor(model.rate_time_constant, dtype=like.dtype).reshape(-1, 1)
    return 0.5 * turn * constant  # half: from turning one way to turning the other


def unflyable(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """By how much plans (B, N+1, 14), (B, N, 4) break what the vehicle can do, (B,), in units of each constraint.

    Of a `PlanningForm`: bounds of the controls, rest at the end, and the first step; where it leads doesn't count.
    """
    values = [constraint.value(X, U) for i, constraint in enumerate(problem.constraints) if i not in PLACES]
    return torch.stack([value.flatten(1).amax(-1) for value in values]).amax(0).nan_to_num(nan=torch.inf)


def within_bounds(problem: Problem, X: Tensor, U: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """The rollout, X (B, N+1, n) and U (B, N, m), of feedback K around previous X and U, with controls cut off at their
    bounds: the vehicle wouldn't follow a plan that asks for more. What exceeds them by `FLYABLE` at most stays.
    """
    bounds = problem.control_bounds
    assert bounds is not None
    lower, upper = (bound.expand(*U.shape) for bound in bounds.by_knot)
    former, controls, K = X, U.clone(), K.nan_to_num(0.0, 0.0, 0.0)
    for _ in range(U.shape[1] + 1):  # once for each knot at most: what comes after one depends on it
        X, U = followed(problem, former, controls, K)
        over = (~(torch.maximum(lower - U, U - upper) <= FLYABLE)).any(-1)
        rows = over.any(-1).nonzero().flatten()
        if rows.numel() == 0:
            break
        first = over[rows].to(torch.int8).argmax(-1)
        asked, low, high = U[rows, first], lower[rows, first], upper[rows, first]
        out = ~(torch.maximum(low - asked, asked - high) <= FLYABLE)
        controls[rows, first] = torch.where(out, asked.nan_to_num().clamp(low, high), controls[rows, first])
        K[rows, first] = torch.where(out.unsqueeze(-1), 0.0, K[rows, first])
    return X, U


SEARCH_OPTIONS: dict[str, Any] = {"unseen": 1.0, "greed": 1.1, "stride": 2}
# Where no way is found, a search with less margin, then one over all cells: the share of the margin, and the stride.
CAUTION_LEVELS = (1.0, 2), (0.0, 2), (0.0, 1)
MOST_SEARCHED = 24_000  # cells that searches of a control period look at: 15 ms
SEARCHED = 2  # control periods after which a new search is due
HELD = 2.0  # s before a search with less margin, or a slow reference, ends
SPARE = 0.03  # m that a plan keeps beyond contact at least: it is tested at points, and flown with small errors
DRIFT = 0.01  # m by which a plan may come nearer while it is flown, as a vehicle isn't exactly where it should be
ARRIVES = 4.5  # cells between the end of a path and the goal, which is then joined to it
STAYED_WITHIN = 0.3  # m within which a vehicle has stayed in its place
PATH_POINTS_AHEAD = 4  # points of a path, of which the last is looked at where none is blocked
SLOW = 0.45  # factor on the speed of a slow reference; at 1 m/s^2 it still leaves a place within `patience`
PAUSE = 0.25  # s in one place after which a reference that no plan follows becomes slow, for `HELD`


@dataclass
class Scout:
    """What one vehicle knows, and where it goes.

    Args:
        goal: (3,), m; radius: of the vehicle, m; dt: control period, s; every: control periods between two scans.
        kinds: of cells that plans stay out of, as `SeenMap.gaps` takes them.
    """

    explorer: Explorer
    world: World
    seen: SeenMap
    search: CellSearch
    log: SeenLog
    goal: np.ndarray
    radius: float
    movers: Movers
    dt: float
    every: int
    kinds: int
    moving: Moving = field(default_factory=nothing)  # at this control step
    path: np.ndarray = field(default_factory=lambda: np.zeros((1, 3)))  # cells' centres, (K, 3), m
    corners: np.ndarray = field(default_factory=lambda: np.zeros((1, 3)))  # of its part that is known to be free
    waited: int = 0  # control periods near `place`
    place: np.ndarray = field(default_factory=lambda: np.full(3, np.inf))  # m
    level: int = 0  # of CAUTION_LEVELS
    since: int = 0  # control periods at this level
    slow: int = 0  # control periods for which the reference stays slow, in this place
    seconds: dict[str, float] = field(default_factory=dict)
    changed: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))
    scanned: bool = False  # in this control period
    arrives: bool = False  # whether the path leads to the goal
    age: int = 0  # control periods since the last search; 0: there was none

    @property
    def keep(self) -> float:
        """The distance, m, that plans keep from what isn't known to be free."""
        least, share = CONTACT_FACTOR * self.radius + SPARE + 2.0 * DRIFT, CAUTION_LEVELS[self.level][0]
        return share * max(least, self.radius + self.explorer.margin) + (1.0 - share) * least

    def seek(self, position: np.ndarray) -> None:
        """Find the path to the goal from a position (3,), m, and the part of it that is known to be free."""
        began = clock.seconds()
        self._search(position)
        keep = self.keep
        points = _halved(np.concatenate([position[None], self.path[1:]]))
        if np.linalg.norm(self.path[-1] - self.goal) <= ARRIVES * self.seen.resolution:
            points = np.concatenate([points, self.goal[None]])
        gaps = self.seen.gaps(points, keep + 0.05, self.kinds)
        blocked = np.flatnonzero((gaps < keep) & (np.arange(len(points)) > 3))
        free = points[: blocked[0] if len(blocked) else len(points)]
        self.corners = taut(free, lambda p: bool((self.seen.gaps(p, keep + 0.05, self.kinds)[1:] >= keep).all()))
        self._wait(position, points, gaps)
        self.seconds["search_seconds"] += clock.seconds() - began

    def _search(self, position: np.ndarray) -> None:
        """The path to the goal; where none is found, with less margin from now on, for a while.

        Scan and search take turns where there are periods without a scan: both in one would be the longest.
        """
        self.since += 1
        if self.scanned and 0 < self.age < SEARCHED and self.every > 1:
            self.age += 1
            self.path = _rest_of(self.path, position)
            return
        self.age = 1
        if self.level > 0 and self.since * self.dt >= HELD and self.search.pending is None:
            self.level, self.since = 0, 0
        left = MOST_SEARCHED
        while True:
            self.search.radius, self.search.stride = self.keep, CAUTION_LEVELS[self.level][1]
            self.search.limit = max(left, 1)
            result = self.search.path(position, self.goal)
            left -= self.search.expanded
            if result is None:
                self.path = _rest_of(self.path, position)
                return
            new, arrives = result
            self.path = self._steady(position, new) if arrives and self.arrives else new
            self.arrives = arrives
            if arrives or self.level + 1 == len(CAUTION_LEVELS):
                return
            self.level, self.since = self.level + 1, 0

    def _steady(self, position: np.ndarray, new: np.ndarray) -> np.ndarray:
        """Of two paths to the goal the one that is followed, unless it is lost, or a new one (K, 3) is cheaper."""
        former = _rest_of(self.path, position)
        gaps = self.seen.gaps(between(position, former[min(1, len(former) - 1)]), self.keep, SEEN_OCCUPIED)
        joins = bool((gaps >= gaps[0] - 0.5 * self.seen.resolution).all())
        joined = np.concatenate([position[None], former[1:]])
        costs = [self.search.cost(_halved(path)) for path in (joined, new)]
        return former if joins and costs[0] <= costs[1] else new

    def _wait(self, position: np.ndarray, points: np.ndarray, gaps: np.ndarray) -> None:
        """Count the periods in one place, and in the end look elsewhere.

        The way on may be cells that stay unknown, as no ray gets to them, or one that no plan can take.
        """
        if np.linalg.norm(position - self.place) > STAYED_WITHIN:
            self.place, self.waited, self.slow = position.copy(), 0, 0
        self.waited += self.search.pending is None
        if self.waited * self.dt >= self.explorer.patience:
            blocked = np.flatnonzero(gaps < self.keep)
            first = blocked[blocked > 0][:1]
            self.search.avoid(points[first[0] if len(first) else min(PATH_POINTS_AHEAD, len(points) - 1)], 1.0)
            self.waited = 0

    def motion(self, velocity: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities (count + 1, 3) along the free part, for plans that begin at a velocity (3,), m/s."""
        keep = self.keep
        swing = swings(self.corners, lambda p: self.seen.gaps(p, keep + 0.05, SEEN_OCCUPIED) >= keep)
        pace = self.explorer.pace.slower(SLOW if self.slow else 1.0)
        return motion(self.corners, velocity, pace, count, self.dt, swing)

    def slow_down(self, came_through: bool) -> None:
        """Make the reference of a vehicle in one place slow, where no plan comes through that follows it.

        Plans within the previous one's corridor do, but may lead nowhere: each of them may begin by hovering.
        """
        self.slow = max(0, self.slow - 1)
        if not came_through and self.slow == 0 and self.waited * self.dt >= PAUSE:
            self.slow, self.waited = round(HELD / self.dt), 0


def _halved(points: np.ndarray) -> np.ndarray:
    """The points (K, 3) of a path, and those midway between them."""
    halved = np.repeat(points, 2, axis=0)[:-1]
    halved[1::2] = 0.5 * (points[:-1] + points[1:])
    return halved


def _rest_of(path: np.ndarray, position: np.ndarray) -> np.ndarray:
    """A path (K, 3) from its point nearest to a position on, two points at least where it has them."""
    nearest = np.linalg.norm(path - position, axis=1).argmin()
    return path[min(nearest, len(path) - 2) :]
