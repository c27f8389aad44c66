"""The planner of missions that see their world through a sensor: map, path, corridor, plan, and the safe plan it keeps.

In every control period the map takes what the sensor has seen, a search over its cells finds the cheapest path to the
goal through all that isn't known to be occupied, and plans follow the part of this path that is known to be free. Every
plan comes to rest within it. Where no new plan does, the previous one is flown on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base import clock
from torchgco.base.errors import InputError
from torchgco.exploration.evading import evaded
from torchgco.exploration.explorer import (
    CORRIDOR,
    DRIFT,
    FLYABLE,
    PLANES,
    SEARCH_OPTIONS,
    SPARE,
    STATE,
    Explorer,
    PlanningForm,
    Scout,
    Unknown,
    unflyable,
)
from torchgco.exploration.movers import Known, Movers, Tracks, Unaware
from torchgco.exploration.safety import AT_REST, braking, ends_at_rest, former_plans
from torchgco.exploration.sensing.grid import NOT_FREE, SEEN_OCCUPIED, CellSearch
from torchgco.exploration.sensing.sensors import Sensor, World
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers
from torchgco.missions.log import TIMED_PARTS, SeenLog
from torchgco.missions.planner import MissionPlan, Planner
from torchgco.missions.planning_problem import EARLY, airframe_of
from torchgco.obstacles.base import CONTACT_FACTOR
from torchgco.problem.problem import Problem
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.ending import optimality

OUTER = 12  # outer iterations of a plan at most
LOCAL: dict[str, Any] = {"initial_penalty": 1.0, "penalty_growth": 3.0, "violation_tolerance": 5e-3}
MAP_ERROR = 0.01  # m of distance that sensed maps and plans between their knots may err by
BETTER = 2 * MAP_ERROR  # m of distance gained that an unsafe plan needs to replace another unsafe one
ESCAPE_ACCELERATION = 1.0  # m/s^2 with which a vehicle gets out of a margin that it has entered
NEARLY = 0.2  # largest excess over the actuators' limits of a plan that replaces an unsafe one
SLOWER = 0.5  # m/s by which an unsafe plan has to end slower than the one that is kept
WAITS = 5  # knots before the first that is blocked
MOST_MOVING = 4  # moving bodies that a knot keeps away from
CLEAR_AFTER = 1.0  # s after a plan's end in which its place stays clear: about what it takes to get away from there
TESTED_POINTS = 4  # points tested per step of a plan
OVER = 0.2  # m/s by which a plan may exceed the speed


class Exploration:
    """The scouts and the planning problems of missions in lockstep."""

    def __init__(
        self,
        explorer: Explorer,
        planner: Planner,
        sensor: Sensor,
        unknown: Unknown,
        problem: Problem,
        seed: int,
        ids: Tensor,
    ) -> None:
        self.explorer, self.planner, self.sensor, self.seed = explorer, planner, sensor, seed
        self.kinds = NOT_FREE if unknown == "occupied" else SEEN_OCCUPIED  # of cells, which plans stay out of
        self.dt = float(problem.dynamics.dt)
        self.every = max(1, round(1.0 / (sensor.rate * self.dt)))  # control periods between two scans
        self.ids = ids.tolist()
        local = planner.solver.in_closed_loop(OUTER)[1]
        if not isinstance(local, AugmentedLagrangian):
            raise InputError("solver", "gco, al_ilqr or another around AL-iLQR, for a sensor", type(local).__name__)
        self.local = replace(local, guidance=None, max_outer_iterations=OUTER, **LOCAL)
        assert problem.goal is not None
        radius = torch.stack([part.vehicle_radius for part in problem.obstacles]).amax(0) if problem.obstacles else None
        self.radius = torch.full_like(problem.x0[:, 0], 0.3) if radius is None else radius
        self.whole = problem
        self.scouts = [self._scout(b) for b in range(problem.B)]

    def _scout(self, b: int) -> Scout:
        start, goal = self.whole.x0[b, :3].numpy(), self.whole.goal.position[b].numpy()  # type: ignore[union-attr]
        seen, radius = self.explorer.map_of(start, goal), float(self.radius[b])
        size = seen.resolution
        search = CellSearch(seen, radius + self.explorer.margin, near=4 * size, leave=4 * size, **SEARCH_OPTIONS)
        log = SeenLog(seen.corner, seen.shape, seen.resolution)
        world = World.of(self.whole, b)
        scout = Scout(
            self.explorer, world, seen, search, log, goal, radius, self._movers(world), self.dt, self.every, self.kinds
        )
        scout.changed = seen.clear(start, self.explorer.known)
        return scout

    def _movers(self, world: World) -> Movers:
        """What a vehicle of this world learns of moving bodies."""
        if self.explorer.movers == "known":
            return Known(world)
        return Unaware() if self.explorer.movers == "none" else Tracks(self.sensor.pitch)

    @property
    def knots(self) -> int:
        """Of a plan, N+1."""
        return self.explorer.stages + 1

    @property
    def seen(self) -> list[SeenLog]:
        """What each vehicle sees."""
        return [scout.log for scout in self.scouts]

    def take(self, index: Tensor) -> None:
        """Keep the missions in `index`."""
        self.scouts = [self.scouts[b] for b in index.tolist()]
        self.ids = [self.ids[b] for b in index.tolist()]
        self.whole, self.radius = self.whole.take(index), self.radius[index]

    def sense(self, step: int, x: Tensor, measured: Tensor) -> None:
        """Scan at a control step from plants x (B, 17), and put that into the maps where the vehicles believe to be."""
        for b, scout in enumerate(self.scouts):
            took, scout.scanned = [0.0, 0.0], step % self.every == 0
            if scout.scanned:
                key = (self.seed, self.ids[b], step)
                scan = self.sensor.scan(scout.world, x[b, :3].numpy(), x[b, 6:10].numpy(), step * self.dt, key)
                scan = scan.seen_from(x[b, 6:10].numpy(), measured[b, :3].numpy(), measured[b, 6:10].numpy())
                began = clock.seconds()
                keep = scout.movers.observe(scan, scout.seen, step * self.dt)
                scan = scan if keep.all() else scan.take(keep)
                changed = scout.seen.add(scan, self.sensor.range, 3.0 * self.sensor.noise)
                scout.movers.note(scout.seen, changed)
                scout.changed = np.concatenate([scout.changed, changed])
                mapped = clock.seconds()
                scout.seen.remeasure(scout.changed)
                took = [mapped - began, clock.seconds() - mapped]
            scout.log.changes.append((scout.changed, scout.seen.state.reshape(-1)[scout.changed]))
            scout.changed = scout.changed[:0]
            scout.seconds = dict(zip(TIMED_PARTS, (*took, 0.0), strict=True))

    def plan(
        self, step: int, x: Tensor, before: MissionPlan | None, measured: Tensor | None = None
    ) -> tuple[MissionPlan, float]:
        """Plans from plants measured at x (B, 17), and the seconds that they took, those of the maps among them."""
        began, t = clock.seconds(), step * self.dt
        sensed = sum(sum(scout.seconds.values()) for scout in self.scouts)
        bias = self.planner.estimated(x, before, self.dt)
        for scout in self.scouts:
            scout.moving = scout.movers.now(t)
        self.seek(x)
        reference = self._evading(self._reference(x))
        rest = x[:, None, :3].expand(-1, self.explorer.stages, -1)
        former = None if before is None else before.moved_to(t)
        if former is not None and before is not None:
            clear, brakes = self._clear_part(former.X[:, 1:, :3]), braking(x, self.explorer, self.dt)
            rest = torch.where(ends_at_rest(before.X).view(-1, 1, 1), clear, brakes)
        seeds = [rest, reference[:, 1:, :3]]
        problem = self._problem(x, bias, reference, seeds)
        kept = former_plans(problem, former, t).take(slice(0, len(self.scouts)))
        plan = self._chosen(problem, kept, len(seeds))
        for b, scout in enumerate(self.scouts):
            scout.log.safe.append(plan.X[b, :, :3].numpy().copy())
        return replace(plan, measured=x, bias=bias), clock.seconds() - began + sensed

    def parts(self) -> dict[str, Tensor]:
        """Seconds of the last period by part, (B,)."""
        return {name: torch.tensor([s.seconds[name] for s in self.scouts], dtype=torch.float64) for name in TIMED_PARTS}

    def seek(self, x: Tensor) -> None:
        """Find paths of vehicles measured at x (B, 17) to their goals, and the parts that are known to be free."""
        for b, scout in enumerate(self.scouts):
            scout.seek(x[b, :3].numpy())

    def _reference(self, x: Tensor) -> Tensor:
        """States (B, N+1, 14) that the plans are to follow."""
        N, reference = self.explorer.stages, x.new_zeros(x.shape[0], self.explorer.stages + 1, 14)
        reference[..., 6], reference[..., 13] = 1.0, airframe_of(self.whole.dynamics).gravity
        for b, scout in enumerate(self.scouts):
            p, v = scout.motion(x[b, 3:6].numpy(), N)
            reference[b, :, :3], reference[b, :, 3:6] = torch.from_numpy(p), torch.from_numpy(v)
        return reference

    def _evading(self, reference: Tensor) -> Tensor:
        """The states (B, N+1, 14) with ways around moving bodies."""
        for b, scout in enumerate(self.scouts):
            p, keep = reference[b, :, :3].numpy(), scout.keep
            horizon = self.explorer.stages * self.dt
            around = horizon * self.explorer.speed
            scout.moving = scout.moving.within(p[0] - around, p[0] + around, horizon + CLEAR_AFTER).clear_of(p[0], keep)
            if len(scout.moving.radii):
                static = lambda q, scout=scout, keep=keep: scout.seen.gaps(q, keep + 0.3, self.kinds)
                v, pace = reference[b, 0, 3:6].numpy(), self.explorer.pace
                way = evaded(p, v, STATE[:3], scout.moving, static, keep, self.dt, CLEAR_AFTER, pace)
                if way is not p:
                    reference[b, :, :3] = torch.from_numpy(way)
                    reference[b, :, 3:6] = torch.from_numpy(np.gradient(way, self.dt, axis=0))
        return reference

    def _problem(self, x: Tensor, bias: Tensor, reference: Tensor, seeds: Sequence[Tensor]) -> Problem:
        """The planning problems, seed by seed."""
        C, N = len(seeds), self.explorer.stages
        planes, room, allowed, inside, regions = [], [], [], [], []
        for seed in seeds:
            for b, scout in enumerate(self.scouts):
                began, keep = clock.seconds(), scout.keep
                knots = np.clip(seed[b].numpy(), *scout.seen.box(keep))
                close, far = scout.seen.corridor(knots, CORRIDOR, PLANES, self.kinds)
                if self.explorer.movers != "none":
                    times = self.dt * np.arange(1, N + 1)
                    close = np.concatenate([close, scout.moving.planes(knots, times, MOST_MOVING, CLEAR_AFTER)], axis=1)
                gap = float(scout.seen.gaps(x[b : b + 1, :3].numpy(), keep, self.kinds)[0])
                late = self.dt * (np.arange(1, N + 1) - EARLY).clip(0)
                near = max(gap - MAP_ERROR, CONTACT_FACTOR * scout.radius) + 0.5 * ESCAPE_ACCELERATION * late**2
                new = (
                    (planes, close),
                    (room, far),
                    (inside, knots),
                    (allowed, near.clip(max=keep)),
                    (regions, self._region(scout, x[b].numpy())),
                )
                for parts, array in new:
                    parts.append(array)
                scout.seconds["field_seconds"] += clock.seconds() - began
        form = PlanningForm(self.explorer, self.planner, self.whole.take(torch.arange(self.whole.B).repeat(C)))
        stack = [torch.from_numpy(np.stack(arrays)) for arrays in (planes, room, inside, allowed, regions)]
        return form.problem(x.repeat(C, 1), bias.repeat(C, 1), reference.repeat(C, 1, 1), *stack)

    def _region(self, scout: Scout, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The lowest and the highest point (3,), m, for plans: the map's, and around a vehicle that has left it."""
        low, high = scout.seen.box(0.0)
        out = (x[:3] < low) | (x[:3] > high)
        return np.where(out, np.minimum(low, x[:3] - 1.0), low), np.where(out, np.maximum(high, x[:3] + 1.0), high)

    def _clear_part(self, former: Tensor) -> Tensor:
        """Positions (B, N, 3) of previous plans; where one has become blocked, it waits some knots before that."""
        former = former.clone()
        for b, scout in enumerate(self.scouts):
            least = CONTACT_FACTOR * scout.radius + SPARE
            blocked = np.flatnonzero(scout.seen.gaps(former[b].numpy(), least + MAP_ERROR, self.kinds) < least)
            if len(blocked):
                knot = max(0, int(blocked[0]) - WAITS)
                former[b, knot:] = former[b, knot].clone()
        return former

    def _chosen(self, problem: Problem, kept: MissionPlan, count: int) -> MissionPlan:
        """Of the new plans, `count` for each mission, the cheapest that is safe, or else the one that is kept.

        Where that isn't safe either, as cells have turned out to be occupied, the one that keeps the most distance.
        """
        B = len(self.scouts)
        U = kept.U
        hover = problem.cost.rest_controls(torch.zeros_like(U.repeat(count, 1, 1)))[:B]
        U = torch.where(ends_at_rest(kept.X).view(-1, 1, 1), U, hover)  # one that doesn't end at rest is no start
        solution = self.local.solve(problem, U.repeat(count, 1, 1), seed=self.seed)
        # Gains of the cost alone: with penalties of constraints they are as stiff as walls, and rollouts may diverge.
        bare = Lagrangian(problem, Multipliers.zero(problem, 0.0), None, True)
        K = optimality(bare, solution.X, solution.U).gains[..., :-1]
        excess = unflyable(problem, solution.X, solution.U)
        best = [self._best(solution.X[b::B], solution.cost[b::B], excess[b::B], kept.X[b], b) for b in range(B)]
        for b, scout in enumerate(self.scouts):
            last = B * (count - 1) + b  # the plan that follows the reference
            came_through = float(excess[last]) <= FLYABLE and self.spare(solution.X[last].numpy(), b) >= 0
            scout.slow_down(came_through)
        rows = torch.tensor([b + B * (choice or 0) for b, choice in enumerate(best)])
        stay = torch.tensor([b for b, choice in enumerate(best) if choice is None], dtype=torch.int64)
        plan = MissionPlan.of_solution(solution.take(rows), problem.take(rows), 0.0)
        plan = replace(plan, K=K[rows], start=kept.start, multipliers=kept.multipliers, penalty=kept.penalty)
        plan.put(stay, kept.take(stay))
        return plan

    def _best(self, X: Tensor, cost: Tensor, excess: Tensor, kept: Tensor, b: int) -> int | None:
        """Which of some plans (C, N+1, 14) of mission b is flown; None: the kept one (N+1, 14).

        excess (C,): by how much each asks for more than the vehicle can do, which would fall out of such a plan.
        """
        order = [int(c) for c in cost.argsort() if bool(torch.isfinite(cost[c]) & (excess[c] <= NEARLY))]
        spare = {c: self.spare(X[c].numpy(), b) for c in order}
        kept_spare = self.spare(kept.numpy(), b, 3.0 * AT_REST)
        asked = min(max(kept_spare, 0.0), DRIFT)
        safe = next((c for c in order if excess[c] <= FLYABLE and spare[c] >= asked), None)
        if safe is not None or kept_spare >= 0 or not order:
            return safe
        # The kept one was safe when it was made: a cell that an obstacle fills in part has turned out to be occupied.
        most = min(order, key=lambda c: (spare[c] < 0, float(excess[c]) if spare[c] >= 0 else -spare[c]))
        if spare[most] >= 0 or spare[most] > kept_spare + BETTER:
            return most
        if kept_spare == -np.inf:  # none stops as it should: better a plan that nearly does than one that doesn't
            ends = X[:, -1, 3:6].norm(dim=-1)
            slowest = min(order, key=lambda c: float(ends[c]))
            return slowest if float(ends[slowest]) + SLOWER < float(kept[-1, 3:6].norm()) else None
        return None

    def spare(self, X: np.ndarray, b: int, rest: float = 0.7 * AT_REST) -> float:
        """The least distance, m, of a plan (N+1, 14) from what isn't known to be free, beyond what is asked for.

        Minus infinity for a plan that isn't at rest in the end, up to `rest`, m/s, or is too fast. A vehicle that is
        too near already is asked to go no nearer, and to get away.
        """
        scout, least = self.scouts[b], CONTACT_FACTOR * self.scouts[b].radius + SPARE
        if not np.isfinite(X).all() or np.abs(X[-1, 3:6]).max() > rest:
            return -np.inf
        if np.abs(X[:, 3:6]).max() > max(self.explorer.speed + OVER, np.abs(X[0, 3:6]).max()):
            return -np.inf
        p = X[:, :3]
        share = np.arange(TESTED_POINTS)[:, None] / TESTED_POINTS
        points = np.concatenate([(p[:-1, None] + share * np.diff(p, axis=0)[:, None]).reshape(-1, 3), p[-1:]])
        gaps = scout.seen.gaps(points, least + 2.0 * DRIFT, self.kinds)
        gaps = np.minimum(gaps, scout.moving.gaps(points, self.dt / TESTED_POINTS * np.arange(len(points))))
        if len(scout.moving.radii):
            late = self.dt * (len(p) - 1) + np.linspace(0.0, CLEAR_AFTER, TESTED_POINTS)
            gaps[-1] = min(gaps[-1], scout.moving.gaps(np.repeat(p[-1:], TESTED_POINTS, axis=0), late).min())
        low, high = scout.seen.box(0.0)
        gaps = gaps - np.linalg.norm(points - points.clip(low, high), axis=1)  # how far outside of the map
        near = gaps[0] - least
        asked = np.zeros(len(gaps))
        if near < 0:
            asked[: TESTED_POINTS * EARLY] = near - BETTER
        return float((gaps - least - asked).min())
