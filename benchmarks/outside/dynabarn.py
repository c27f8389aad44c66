"""python -m benchmarks.outside.dynabarn: the 60 worlds of the BARN challenge in which cylinders move (DynaBARN).

The challenge's robot crosses a yard of 20 m, walled on three sides, in which 5 to 24 cylinders of 0.5 m radius move;
their motion is known here. A cylinder crosses the yard on a curve and then begins again. When the robot begins is
drawn. The controls are driven again in steps of 1 ms among the cylinders as the challenge's simulator moves them,
without code of the solvers. With --write the table goes into benchmarks/results/dynabarn.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch import Tensor

from benchmarks.lib import DATA
from benchmarks.lib.command import Command
from benchmarks.lib.comparison import timed
from benchmarks.lib.page import markdown, share
from benchmarks.outside.barn import (
    ACCELERATION,
    BACKWARDS,
    BODY,
    CONTROLS,
    DT,
    FINE,
    LAST,
    POSITION,
    SPEED,
    TURN_CHANGE,
    TURN_RATE,
    VEHICLE,
    drive,
)  # fmt: skip
from benchmarks.outside.barn_data import GOAL_RADIUS
from benchmarks.outside.dynabarn_data import RADIUS, WORLDS
from torchgco import (
    Boxes,
    ControlBounds,
    Goal,
    Moved,
    Problem,
    QuadraticCost,
    RateBounds,
    StateBounds,
    Unicycle,
    judge,
    solve,
)

STAGES = 200  # of 0.1 s: twice the time that the straight way takes
START, GOAL = (11.0, 0.0, np.pi, 0.0), (-9.0, 0.0)  # m, rad, m/s; run.py there, seen from the world
SHORTEST = 20.0 / SPEED  # s; run.py takes -31 m for the length of the way here, so its score can't be given
WALLS = np.array([[-10.0, 0.0], [0.0, 10.0], [0.0, -10.0]])  # m; and half their sizes
HALVES = np.array([[0.25, 10.0], [10.0, 0.25], [10.0, 0.25]])
BEGINS = 60.0  # s: within so much time after the simulator's start the robot begins
OUTSIDE = 30.0  # m beyond the border: there a cylinder waits that isn't in the yard
KINDS = {"easy": range(20), "medium": range(20, 40), "hard": range(40, 60)}  # speeds up to 1, 1.5 and 2 m/s


@cache
def data() -> tuple[np.ndarray, np.ndarray]:
    """Rows of time and place of every cylinder (469, K, 3), NaN behind the last, and cylinders of the worlds, -1."""
    with np.load(DATA / "dynabarn.npz") as file:
        return file["rows"], file["cylinders"]


@dataclass(frozen=True)
class Motion:
    """One cylinder's way through the yard, after which it begins again."""

    t: np.ndarray  # (K,), s, from 0 on
    p: np.ndarray  # (K, 2), m

    @property
    def seconds(self) -> float:
        return float(self.t[-1])

    def within(self, t: np.ndarray) -> np.ndarray:
        """Places (T, 2) at times (T,) of one crossing, 0 to `seconds`.

        Between two rows Gazebo moves on a cubic whose slopes, per row and not per second, are half the way from the row
        before to the row behind (common/Animation.cc and the spline of its mathematics).
        """
        slopes = 0.5 * np.diff(np.vstack((self.p[:1], self.p)), axis=0)
        slopes += 0.5 * np.diff(np.vstack((self.p, self.p[-1:])), axis=0)
        i = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2)
        s = ((t - self.t[i]) / (self.t[i + 1] - self.t[i]))[:, None]
        start = (1 + 2 * s) * (1 - s) ** 2 * self.p[i] + s * (1 - s) ** 2 * slopes[i]
        return start + s * s * (3 - 2 * s) * self.p[i + 1] + s * s * (s - 1) * slopes[i + 1]

    def at(self, t: np.ndarray) -> np.ndarray:
        """Places (T, 2) at times (T,) since the simulator's start; at the end it jumps back to the first."""
        return self.within(np.mod(t, self.seconds))

    def crossings(self, t: np.ndarray) -> list[tuple[np.ndarray, float]]:
        """Places (T, 2) at times (T,), once for every crossing, and how far it gets from the lines between them, m.

        Before and after the crossing it is beyond the border where it was. Where rows follow each other within tenths
        of a second, Gazebo's cubic dashes to and fro by up to a metre.
        """
        known = []
        for lap in range(int(t[0] // self.seconds), int(t[-1] // self.seconds) + 1):
            since = t - lap * self.seconds
            near = (since > -DT) & (since < self.seconds + DT)  # stages within which it begins or ends count whole
            away = np.where(since[:, None] < 0, beyond(self.p[0]), beyond(self.p[-1]))
            places = np.where(near[:, None], self.within(np.clip(since, 0, self.seconds)), away)
            stages = near[:-1] & near[1:]
            share = np.linspace(0.0, 1.0, FINE, endpoint=False)[:, None]
            fine = self.within(np.clip(since[:-1][stages] + DT * share, 0, self.seconds).ravel())
            lines = places[:-1][stages] + share[..., None] * np.diff(places, axis=0)[stages]
            known.append((places, np.linalg.norm(fine - lines.reshape(-1, 2), axis=1).max(initial=0.0)))
        return known


def beyond(p: np.ndarray) -> np.ndarray:
    """Where a cylinder waits whose way begins or ends at a place at the border: beyond the wall there.

    On the open side, before which the robot starts, it waits beyond the nearer corner, straight along the border.
    """
    is_open = p[0] > 10.0 - 0.1
    side = np.array([False, True]) if is_open else np.abs(p) > np.abs(p).max() - 0.1
    return p + OUTSIDE * np.where(p < 0, -1.0, 1.0) * side


def motions(world: int) -> list[Motion]:
    """The cylinders of a world, 0 to 59."""
    rows, cylinders = data()
    known = [rows[i] for i in cylinders[world] if i >= 0]
    return [Motion(row[:, 0], row[:, 1:]) for row in (row[~np.isnan(row[:, 0])] for row in known)]


def begins(world: int, runs: int, seed: int) -> np.ndarray:
    """When the robot begins in each run, s after the simulator's start; a world's don't depend on the others."""
    return np.random.default_rng([seed, world]).uniform(0.0, BEGINS, runs)


def problem(cases: list[tuple[int, float]]) -> Problem:
    """The planning problems of pairs of a world and the second at which the robot begins."""
    t = DT * np.arange(STAGES + 1)
    tracks = [[p for one in motions(world) for p in one.crossings(begin + t)] for world, begin in cases]
    places = np.full((len(cases), STAGES + 1, max(map(len, tracks)), 2), np.nan)
    radii = np.full((len(cases), places.shape[2]), np.nan)
    for b, world in enumerate(tracks):
        places[b, :, : len(world)] = np.stack([track for track, _ in world], axis=1)
        radii[b, : len(world)] = [RADIUS + strays for _, strays in world]
    free = [torch.inf] * 3
    return Problem(
        Unicycle(dt=DT),
        QuadraticCost(Q=[POSITION, POSITION, 0, 0], R=CONTROLS, Qf=[LAST, LAST, 0, 0], x_ref=[*GOAL, 0.0, 0.0]),
        [
            Moved(places, radii, VEHICLE),
            Boxes(WALLS, HALVES, vehicle_radius=VEHICLE),
            ControlBounds([-ACCELERATION, -TURN_RATE], [ACCELERATION, TURN_RATE]),
            RateBounds([-torch.inf, -TURN_CHANGE * DT], [torch.inf, TURN_CHANGE * DT], previous=[0.0, 0.0]),
            StateBounds([-x for x in free] + [BACKWARDS], [*free, SPEED]),
        ],
        torch.tensor(START, dtype=torch.float64).expand(len(cases), -1),
        STAGES,
        Goal(GOAL, GOAL_RADIUS),
    )


@dataclass(frozen=True)
class Drive:
    """One run as driven: until it arrives, as the challenge counts, and until the last stage."""

    seconds: float  # until it is within 1 m of the goal, looked at every 0.1 s; infinite if never
    clearance: float  # least distance of the robot's disc from cylinders and walls until then, m
    afterwards: float  # and until the last stage
    turn_change: float  # largest change of the turn rate, rad/s^2

    @property
    def arrived(self) -> bool:
        return np.isfinite(self.seconds) and self.clearance > 0 and self.turn_change <= TURN_CHANGE

    @classmethod
    def of(cls, world: int, begin: float, U: np.ndarray) -> Drive:
        path = drive(np.array(START), U)
        t = begin + DT / FINE * np.arange(len(path))
        apart = np.min([np.linalg.norm(path - one.at(t), axis=1) for one in motions(world)], axis=0) - RADIUS
        for center, half in zip(WALLS, HALVES, strict=True):
            apart = np.minimum(apart, np.linalg.norm(np.maximum(np.abs(path - center) - half, 0.0), axis=1))
        near = np.linalg.norm(path[::FINE] - GOAL, axis=1) <= GOAL_RADIUS
        last = int(near.argmax()) if near.any() else len(near) - 1
        change = np.abs(np.diff(U[: max(last, 1), 1], prepend=0.0)).max() / DT
        clearance = float(apart[: last * FINE + 1].min()) - BODY
        return cls(DT * last if near.any() else np.inf, clearance, float(apart.min()) - BODY, float(change))


def planned(cases: list[tuple[int, float]], solver: str, seed: int) -> tuple[list[Drive], np.ndarray]:
    """As driven, and whether the judge calls the whole plan sound and arrived (B,)."""
    posed = problem(cases)
    U: Tensor = solve(posed, solver=solver, seed=seed, verbose=False).U
    drives = [Drive.of(world, begin, u) for (world, begin), u in zip(cases, U.numpy(), strict=True)]
    return drives, judge(posed, U).reached.numpy()


HEAD = (
    "worlds", "planner", "arrived", "also sound until 20 s", "mean time, s", "time / shortest: mean, largest",
    "least clearance, m", "s a run",
)  # fmt: skip


def row(kind: str, solver: str, drives: list[Drive], whole: np.ndarray, seconds: float) -> list[str]:
    """What the runs of a kind of world came to."""
    successes = [one for one in drives if one.arrived]
    cells = [kind, f"`{solver}`", share(len(successes), len(drives)), share(int(whole.sum()), len(drives))]
    if not successes:
        return [*cells, *"---", f"{seconds / len(drives):.2f}"]
    times = np.array([one.seconds for one in successes])
    least = min(one.clearance for one in successes)
    ratios = f"{times.mean() / SHORTEST:.3f}, {times.max() / SHORTEST:.3f}"
    return [*cells, f"{times.mean():.2f}", ratios, f"{least:.3f}", f"{seconds / len(drives):.2f}"]


def table(runs: int, seed: int, solvers: list[str], first: int) -> str:
    """The results of the solvers by kind of world, in Markdown."""
    rows, missed = [], []
    for solver in solvers:
        planned([(0, 0.0)], solver, seed)  # compiles
        for kind, worlds in KINDS.items():
            cases = [(world, float(begin)) for world in worlds[:first] for begin in begins(world, runs, seed)]
            (drives, whole), seconds = timed(lambda c=cases, s=solver: planned(c, s, seed))
            rows.append(row(kind, solver, drives, whole, seconds))
            if solver == solvers[0]:
                missed += [
                    f"{world + 300} at {begin:.1f} s"
                    for (world, begin), one in zip(cases, drives, strict=True)
                    if not one.arrived
                ]
    return f"{markdown(HEAD, rows)}\n\nNot arrived with `{solvers[0]}`: {', '.join(missed) or 'none'}."


main = Command(
    __doc__, "dynabarn", table, "{runs} runs in each world, seed {seed}",
    runs=(10, "in each world"), seed=(0, "of the times at which the robot begins, and of guidance"),
    solvers=(["gco", "gco_fast", "multistart", "interior_point"], "one or more"),
    first=(len(WORLDS), "worlds of each kind"),
)  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())
