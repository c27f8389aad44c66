"""python -m benchmarks.outside.barn_lidar: the worlds of the BARN challenge, seen through a planar lidar while driving.

Nothing is known at first. Every 0.1 s a scan is taken among the true cylinders and marks cells of a map, and a plan to
the goal is made among the cells that are marked: the previous plan, solved on, or a new search by `gco_fast`, then by
`gco`, where that doesn't come through. It holds from the next period on. Where no plan keeps clear on the way that
braking takes, the robot brakes. The controls are driven in steps of 1 ms, as by `benchmarks.outside.barn`. With --write
the table goes into benchmarks/results/maps.md.
"""

from __future__ import annotations

import sys
import time
import warnings
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
import torch

import torchgco
from benchmarks.lib.command import Command
from benchmarks.lib.page import markdown, share
from benchmarks.outside.barn import (
    ACCELERATION,
    BACKWARDS,
    BODY,
    CONTROLS,
    DT,
    LAST,
    POSITION,
    SPEED,
    TURN_CHANGE,
    TURN_RATE,
    drive,
    gap,
    worlds,
)
from benchmarks.outside.barn_data import GOAL, GOAL_RADIUS, RADIUS
from torchgco import (
    ControlBounds,
    DistanceField,
    Field,
    Goal,
    OccupancyGrid,
    Problem,
    QuadraticCost,
    RateBounds,
    Solution,
    StateBounds,
)
from torchgco.exploration.sensing.sensors import Lidar, Motion, World

STAGES = 100  # of a plan
LIMIT = 100.0  # s, after which the challenge ends a run
# 270 degrees, as the laser of the challenge's robot; rays and noise are ours.
LASER = Lidar(range=30.0, rays=(720, 1), field_of_view=(270.0, 1.0), rate=10.0, noise=0.001)
CELL, CORNER, SHAPE = 0.03, np.array([-7.0, -1.0]), (320, 530)  # m, m, cells
FAR = 10.0  # m: returns from farther away are too sparse for a map
RETURNS = 2  # in a cell, before it counts as occupied
VEHICLE = BODY + 0.01  # m: cells reach beyond the cylinders by themselves
TURN_STEP = 0.99 * TURN_CHANGE * DT  # rad/s, from stage to stage: plans may exceed a bound by a little
AWAY = 0.002  # m by which a robot that is nearer than it should be may come nearer in a period
STOPS = 4  # stages, in which braking from 2 m/s ends


@dataclass
class Robot:
    """One robot in one world: what it has seen, where it is, and its plan."""

    world: World
    number: int
    x: np.ndarray  # (4,): position, m, heading, rad, speed, m/s
    counts: np.ndarray = field(default_factory=lambda: np.zeros(SHAPE, np.int32))
    plan: np.ndarray = field(default_factory=lambda: np.zeros((STAGES, 2)))  # controls, from the next period on
    driven: list[np.ndarray] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)  # of every period: map and plan

    def sense(self, step: int, seed: int) -> None:
        """Mark the cells of the scan's returns."""
        position = np.array([*self.x[:2], 0.0])
        half = 0.5 * self.x[2]
        attitude = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
        scan = LASER.scan(self.world, position, attitude, 0.0, (seed, self.number, step))
        ended = scan.distances <= FAR
        points = scan.origin + scan.distances[ended, None] * scan.directions[ended]
        cells = np.floor((points[:, :2] - CORNER) / CELL).astype(int)
        inside = ((cells >= 0) & (cells < SHAPE)).all(axis=1)
        np.add.at(self.counts, tuple(cells[inside].T), 1)

    def problem(self, x: np.ndarray, before: np.ndarray) -> Problem:
        """From a state (4,) to the goal among the cells marked so far, after the controls (2,) before."""
        grid = OccupancyGrid(self.counts >= RETURNS, CORNER, CELL)
        radius = min(VEHICLE, float(self.gaps(x[None, :2])[0]))
        free = [torch.inf] * 3
        return Problem(
            torchgco.Unicycle(dt=DT),
            QuadraticCost(Q=[POSITION, POSITION, 0, 0], R=CONTROLS, Qf=[LAST, LAST, 0, 0], x_ref=[*GOAL, 0.0, 0.0]),
            [
                Field(DistanceField.of(grid, refine=1), radius),
                ControlBounds([-ACCELERATION, -TURN_RATE], [ACCELERATION, TURN_RATE]),
                RateBounds([-torch.inf, -TURN_STEP], [torch.inf, TURN_STEP], previous=before),
                StateBounds([-z for z in free] + [BACKWARDS], [*free, SPEED]),
            ],
            torch.from_numpy(x)[None],
            STAGES,
            Goal(GOAL, GOAL_RADIUS),
        )

    def think(self, x: np.ndarray, before: np.ndarray, seed: int) -> np.ndarray:
        """The controls (STAGES, 2) from a state (4,) on, after the controls (2,) before."""
        problem, start = self.problem(x, before), torch.from_numpy(self.plan)[None]
        plans = []
        if self.driven:
            plans.append(torchgco.presets.al_ilqr(problem).solve(problem, start, seed=seed))
        if not (plans and arrives(plans[0]) and self.clear_until_rest(x, plans[0].U[0, 0].numpy())):
            for search in (torchgco.presets.gco_fast, torchgco.presets.gco):
                plans.append(search(problem).solve(problem, start, seed=seed))
                if arrives(plans[-1]):
                    break
        # Of plans that don't arrive, the cheaper: the robot would turn to and fro between two ways.
        for plan in sorted(plans, key=lambda plan: (not arrives(plan), not keeps_clear(plan), float(plan.cost))):
            if self.clear_until_rest(x, plan.U[0, 0].numpy()):
                return plan.U[0].numpy()
        if self.clear_until_rest(x, self.plan[0]):
            return self.plan
        return braking(x, before)

    def clear_until_rest(self, x: np.ndarray, u: np.ndarray) -> bool:
        """Whether one stage of controls u (2,) and then braking keep clear of the marked cells."""
        path = drive(x, np.vstack([u, braking(state_after(x, u), u)[:STOPS]]))[::10]
        gaps = self.gaps(path)
        return bool((gaps >= min(BODY, gaps[0] - AWAY)).all())  # a robot that is nearer already may get away

    def gaps(self, path: np.ndarray) -> np.ndarray:
        """Distances (T,), m, of positions (T, 2) from the marked cells."""
        centers = CORNER + (np.argwhere(self.counts >= RETURNS) + 0.5) * CELL
        away = np.maximum(np.abs(path[:, None] - centers) - 0.5 * CELL, 0.0)
        return np.linalg.norm(away, axis=-1).min(axis=1, initial=np.inf)

    def step(self, number: int, seed: int) -> bool:
        """One period: a scan, a plan for the next one, and a stage of the previous plan. Returns whether it goes on."""
        self.sense(number, seed)
        began = time.process_time()
        u = self.plan[0]
        coming = state_after(self.x, u)
        self.plan = np.vstack([self.plan[1:], np.zeros((1, 2))])
        self.plan = self.think(coming, u, seed)
        self.seconds.append(time.process_time() - began)
        self.driven.append(u)
        self.x = coming
        return bool(np.linalg.norm(self.x[:2] - GOAL) > GOAL_RADIUS)


def keeps_clear(plan: Solution) -> bool:
    """Whether the plan of one problem keeps clear of what is marked, and within its bounds."""
    return float(plan.violation) <= 0.05 * VEHICLE


def arrives(plan: Solution) -> bool:
    """Whether it leads to the goal, too."""
    near = torch.linalg.vector_norm(plan.X[0, -1, :2] - torch.tensor(GOAL)) <= GOAL_RADIUS
    return bool(near) and keeps_clear(plan)


def braking(x: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Controls (STAGES, 2) that stop, after the controls (2,) before, and turn as little as these allow."""
    held, v, turning = np.zeros((STAGES, 2)), x[3], before[1]
    for k in range(STAGES):
        turning -= np.clip(turning, -TURN_STEP, TURN_STEP)
        held[k] = np.clip(-v / DT, -ACCELERATION, ACCELERATION), turning
        v += DT * held[k, 0]
    return held


def state_after(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The state (4,) after a stage, by the steps of 1 ms that controls are driven in."""
    return np.array([*drive(x, u[None])[-1], x[2] + DT * u[1], x[3] + DT * u[0]])


def world_of(centers: np.ndarray) -> World:
    """The cylinders at `centers` (M, 2), m, as upright capsules for the sensor."""
    here = centers[~np.isnan(centers[:, 0])]
    boxes = np.zeros((len(here), 16))
    boxes[:, :2], boxes[:, 3:12] = here, np.eye(3).ravel()
    boxes[:, 14], boxes[:, 15] = 1.0, RADIUS
    return World(boxes, Motion.steady(np.zeros((len(here), 3))))


@dataclass(frozen=True)
class Run:
    """How one drive ended."""

    outcome: str
    seconds: float  # to the first look within 1 m of the goal
    clearance: float  # m
    turn_change: float  # rad/s^2
    period: np.ndarray  # s, of every period


def run(x0: np.ndarray, centers: np.ndarray, number: int, seed: int) -> Run:
    """Drive one world."""
    robot = Robot(world_of(centers), number, x0)
    for step in range(round(LIMIT / DT)):
        if not robot.step(step, seed):
            break
    U = np.array(robot.driven)
    clearance = gap(drive(x0, U), centers)
    arrived = bool(np.linalg.norm(robot.x[:2] - GOAL) <= GOAL_RADIUS)
    outcome = "COLLISION" if clearance <= 0 else "REACHED" if arrived else "TIMEOUT"
    change = float(np.abs(np.diff(U[:, 1], prepend=0.0)).max() / DT)
    return Run(outcome, len(U) * DT, clearance, change, np.array(robot.seconds))


def drives(first: int | None, runs: int, seed: int) -> pd.DataFrame:
    """A row per run: the test worlds, each with several draws of the lidar's noise."""
    layouts, known = worlds(True, first)
    assert layouts.start is not None
    rows = []
    for number, optimal in enumerate(known["optimal"]):
        for draw in range(runs):
            found = run(layouts.start[number], layouts.centers[number], int(layouts.ids[number]), seed + draw)
            rows.append({"world": int(layouts.ids[number]), "draw": draw, "optimal": optimal, **vars(found)})
            print(f"world {rows[-1]['world']}, {draw}: {found.outcome} in {found.seconds:.1f} s", file=sys.stderr)
    return pd.DataFrame(rows)


HEAD = (
    "sensor", "runs", "success", "COLLISION", "TIMEOUT", "score", "mean time, s", "time / shortest: mean, largest",
    "least clearance, m", "ms of a period: median, 99 %", "above 100 ms",
)  # fmt: skip


def table(first: int | None, runs: int, seed: int) -> str:
    """The results in Markdown."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", torchgco.GuidanceWarning)
        run(*_first_world(), 0, seed)  # compiles
        found = drives(first, runs, seed)
    sound = (found["outcome"] == "REACHED") & (found["turn_change"] <= TURN_CHANGE + 1e-6)
    score = sound * found["optimal"] / np.clip(found["seconds"], 2 * found["optimal"], 8 * found["optimal"])
    there, periods = found[sound], 1e3 * np.concatenate(found["period"].to_list())
    ratio = there["seconds"] / there["optimal"]
    ended = [int((found["outcome"] == name).sum()) for name in ("COLLISION", "TIMEOUT")]
    row = [
        "lidar", len(found), f"{share(sound.sum(), len(found))} %", *ended, f"{score.mean():.3f}",
        f"{there['seconds'].mean():.2f}", f"{ratio.mean():.3f}, {ratio.max():.3f}", f"{found['clearance'].min():.3f}",
        f"{np.median(periods):.0f}, {np.quantile(periods, 0.99):.0f}",
        f"{(periods > 100).sum()} of {len(periods)}",
    ]  # fmt: skip
    missed = ", ".join(f"{r.world} ({r.outcome})" for r in found[~sound].itertuples()) or "none"
    return f"{markdown(HEAD, [row])}\n\nWorlds without success: {missed}."


def _first_world() -> tuple[np.ndarray, np.ndarray]:
    layouts, _ = worlds(True, 1)
    assert layouts.start is not None
    return layouts.start[0], layouts.centers[0]


main = Command(
    __doc__, "maps", table, "seed {seed}, runs per test world: {runs}",
    mark="lidar", first=(None, "only the first worlds, this many"), runs=(1, "per world"),
    seed=(0, "of the lidar's noise, and of guidance"),
)  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())
