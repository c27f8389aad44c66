"""python -m benchmarks.outside.barn: the worlds of the BARN challenge, planned from a known map.

A unicycle with the limits of the challenge's robot drives 10 m through walls and clusters of cylinders; the challenge's
score rewards short times. `gco` plans the 50 test worlds as one batch, and then the 250 others, on which no option was
chosen. With `--body disc` the robot is the disc around it, with `--body rectangle` its rectangle, covered by discs that
turn with it. The controls are driven again in steps of 1 ms, without code of the solvers. With --write the table goes
into benchmarks/results/barn.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from benchmarks.lib import DATA
from benchmarks.lib.command import Command
from benchmarks.lib.comparison import timed
from benchmarks.lib.page import markdown, share
from benchmarks.outside.barn_data import GOAL, GOAL_RADIUS, RADIUS, TEST
from torchgco import Body, ControlBounds, Goal, Problem, QuadraticCost, Spheres, StateBounds, Unicycle, judge, solve
from torchgco.obstacles.body import BoundBody
from torchgco.scenarios import Layouts

STAGES, DT = 100, 0.1  # 10 s in every world; the challenge, too, looks every 0.1 s whether a run has arrived
SPEED = 2.0  # m/s: the challenge's shortest time is the length of its path over this
BACKWARDS = -0.5  # m/s: these limits are those of the challenge's planner (base_local_planner_params.yaml)
ACCELERATION, TURN_RATE, TURN_CHANGE = 10.0, 1.57, 20.0  # m/s^2, rad/s, rad/s^2
# The rectangle around the robot's wheels: 0.262 + 2 * 0.098 m long, 0.37559 + 0.040 m wide (jackal.urdf.xacro).
HALF = np.array([0.458, 0.41559]) / 2  # m
BODY = float(np.hypot(*HALF))  # m: the disc around it
# Planned with 2 cm more: the path between two knots, 0.2 m apart, may cut a corner by 1.3 cm.
VEHICLE = BODY + 0.02  # m
RECTANGLE = Body.covering(-HALF, HALF, [2, 2])  # its discs reach 5 cm beyond the rectangle's front, 6 cm beyond sides
PART = 10  # worlds that are planned together with a body, whose rows are many: bounds the memory
# Far from the goal position costs most, so that the cost asks for speed. With less weight on the controls solves end
# far from an optimum; the turn rate has more, because no constraint limits its change.
POSITION, CONTROLS, LAST = 1.0, (1.0, 4.0), 10.0
FINE = 100  # steps of 1 ms per stage: the simulator's own


def worlds(test: bool = True, first: int | None = None) -> tuple[Layouts, pd.DataFrame]:
    """The test worlds or all others, or the first of them, and their table.

    Its column `optimal` is the challenge's shortest time, s.
    """
    table = pd.read_csv(DATA / "barn.csv")
    table = table[table["world"].isin(TEST) == test].head(first)
    layouts = Layouts.load(DATA / "barn.npz").take(table.index.to_numpy())
    return layouts, table.assign(optimal=table["path_length"] / SPEED)


def problems(layouts: Layouts, vehicle: float | Body = VEHICLE) -> Problem:
    """The planning problems: the whole map is known, and every cylinder is a disc of its own."""
    assert layouts.start is not None
    free = [torch.inf] * 3
    return Problem(
        Unicycle(dt=DT),
        QuadraticCost(Q=[POSITION, POSITION, 0, 0], R=CONTROLS, Qf=[LAST, LAST, 0, 0], x_ref=[*GOAL, 0.0, 0.0]),
        [
            Spheres(layouts.centers, layouts.radii, vehicle),
            ControlBounds([-ACCELERATION, -TURN_RATE], [ACCELERATION, TURN_RATE]),
            StateBounds([-x for x in free] + [BACKWARDS], [*free, SPEED]),
        ],
        torch.from_numpy(layouts.start),
        STAGES,
        Goal(GOAL, GOAL_RADIUS),
    )


@dataclass(frozen=True)
class Drives:
    """Controls driven in every world, arrays (B,)."""

    seconds: np.ndarray  # to the first knot within 1 m of the goal; infinite without arrival
    clearance: np.ndarray  # least distance of the disc or rectangle from a cylinder on the way, m
    turn_change: np.ndarray  # largest change of the turn rate from one stage to the next, rad/s^2
    sound: np.ndarray  # bool: arrived without contact and within all limits

    @classmethod
    def of(cls, problem: Problem, layouts: Layouts, U: Tensor, turns: bool = False) -> Drives:
        """As driven with the disc; with the rectangle where the body `turns`."""
        verdict = judge(problem, U)
        driven = [drive(x0, u) for x0, u in zip(problem.x0.numpy(), U.numpy(), strict=True)]
        near = [np.linalg.norm(path[::FINE] - GOAL, axis=1) <= GOAL_RADIUS for path in driven]
        seconds = np.array([DT * inside.argmax() if inside.any() else np.inf for inside in near])
        if turns:
            along = [headings(x0, u) for x0, u in zip(problem.x0.numpy(), U.numpy(), strict=True)]
            gaps = map(rectangle_gap, driven, along, layouts.centers)
        else:
            gaps = map(gap, driven, layouts.centers)
        clearance = np.array(list(gaps))
        change = np.abs(np.diff(U[..., 1].numpy(), axis=1, prepend=0.0)).max(axis=1) / DT
        sound = verdict.reached.numpy() & np.isfinite(seconds) & (clearance > 0) & (change <= TURN_CHANGE)
        return cls(seconds, clearance, change, sound)

    def score(self, optimal: np.ndarray) -> np.ndarray:
        """The challenge's score of every world, 0 to 0.5, for its shortest times, s (run.py, March 2026)."""
        return self.sound * optimal / np.clip(self.seconds, 2 * optimal, 8 * optimal)


def drive(x0: np.ndarray, U: np.ndarray) -> np.ndarray:
    """Positions (FINE N + 1, 2) under controls U (N, 2), in steps of 1 ms by the midpoint rule."""
    step = DT / FINE
    acceleration, turning = np.repeat(U, FINE, axis=0).T
    heading = x0[2] + np.cumsum(turning) * step - 0.5 * step * turning
    speed = x0[3] + np.cumsum(acceleration) * step - 0.5 * step * acceleration
    moves = step * speed[:, None] * np.stack((np.cos(heading), np.sin(heading)), axis=-1)
    return np.vstack((x0[:2], x0[:2] + np.cumsum(moves, axis=0)))


def gap(path: np.ndarray, centers: np.ndarray) -> float:
    """The least distance of the body's disc on a path (T, 2) from cylinders at `centers` (M, 2), m."""
    apart = np.hypot(*(path[:, None, i] - centers[~np.isnan(centers[:, 0])][:, i] for i in range(2)))
    return float(apart.min()) - RADIUS - BODY


def headings(x0: np.ndarray, U: np.ndarray) -> np.ndarray:
    """The headings (FINE N + 1,), rad, of the same drive."""
    turned = np.cumsum(np.repeat(U[:, 1], FINE)) * DT / FINE
    return x0[2] + np.append(0.0, turned)


def rectangle_gap(path: np.ndarray, along: np.ndarray, centers: np.ndarray) -> float:
    """The least distance of the rectangle on a path (T, 2) with headings (T,) from cylinders at (M, 2), m."""
    away = centers[~np.isnan(centers[:, 0])] - path[:, None]
    cos, sin = np.cos(along)[:, None], np.sin(along)[:, None]
    seen = cos * away[..., 0] + sin * away[..., 1], cos * away[..., 1] - sin * away[..., 0]
    apart = np.hypot(*(np.maximum(np.abs(part) - half, 0.0) for part, half in zip(seen, HALF, strict=True)))
    return float(apart.min()) - RADIUS


def cells(drives: Drives, optimal: np.ndarray) -> list[str]:
    """The cells of a row that tell how good the drives are; all but the first two are of successes."""
    success = f"{share(drives.sound.sum(), len(optimal))} %"
    score = f"{drives.score(optimal).mean():.3f}"
    if not drives.sound.any():
        return [success, score, *"---"]
    seconds, clearance = (z[drives.sound] for z in (drives.seconds, drives.clearance))
    ratio = seconds / optimal[drives.sound]
    return [
        success, score, f"{seconds.mean():.2f}", f"{ratio.mean():.3f}, {ratio.max():.3f}", f"{clearance.min():.3f}",
    ]  # fmt: skip


KINDS = ["test", "others"]
BODIES: dict[str, float | Body] = {"disc": VEHICLE, "rectangle": RECTANGLE}
HEAD = (
    "planner", "worlds", "success", "score", "mean time, s", "time / shortest: mean, largest", "least clearance, m",
    "seconds per world",
)  # fmt: skip
# README of Daffan/the-barn-challenge: 50 worlds, ten runs each, "Avg Success: 0.8800".
DWA = ["DWA, as published", "test", "0.88 of 500 runs", "0.169", "33.47", *"---"]


def planned(problem: Problem, seed: int) -> Tensor:
    """Controls (B, N, 2); a problem's don't depend on the others that it is planned with."""
    part = PART if any(isinstance(obstacles, BoundBody) for obstacles in problem.obstacles) else problem.B
    parts = torch.arange(problem.B).split(part)
    return torch.cat([solve(problem.take(rows), seed=seed, ids=rows).U for rows in parts])


def table(first: int | None, seed: int, body: str, kinds: list[str]) -> str:
    """The results of the solvers, in Markdown."""
    rows, notes, vehicle = [], [], BODIES[body]
    for kind in kinds:
        layouts, known = worlds(kind == "test", first)
        problem = problems(layouts, vehicle)
        solve(problem.take(slice(0, 1)))  # compiles
        U, seconds = timed(lambda p=problem: planned(p, seed))
        drives = Drives.of(problem, layouts, U, turns=isinstance(vehicle, Body))
        rows.append(["`gco`", kind, *cells(drives, known["optimal"].to_numpy()), f"{seconds / problem.B:.2f}"])
        missed = ", ".join(map(str, known["world"][~drives.sound])) or "none"
        notes.append(f"Worlds without success, {kind}: {missed}.")
    return "\n\n".join([markdown(HEAD, [*rows, DWA] if body == "disc" else rows), *notes])


main = Command(
    __doc__, "barn", table, "{body}, seed {seed}",
    mark="barn {body}", first=(None, "only the first worlds of each kind, this many"),
    seed=(0, "of the random draws of guidance"), body=("disc", "of the robot", list(BODIES)),
    kinds=(KINDS, "of worlds", KINDS),
)  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())
