"""python -m benchmarks.families.moving: least times through lanes of moving discs, and at fixed times on a grid.

A point with bounded acceleration and speed crosses five lanes in each of which five discs move the same way, within
walls. Time and a little effort are the cost, the end at rest is required. Each layout is solved by `gco` with
`FreeTime`, and at fixed times, shares of the duration that was found, without any code of free times: stages of a model
that is so much faster or slower, among discs that are, too.
"""

from __future__ import annotations

import math
import time

import numpy as np
import torch
from torch import Tensor

import torchgco
from benchmarks.lib.command import Command
from benchmarks.lib.page import markdown, share
from torchgco import (
    ControlBounds,
    FreeTime,
    FunctionDynamics,
    Goal,
    NormBounds,
    Problem,
    QuadraticCost,
    Spheres,
    StateBounds,
    Status,
)

STAGES = 60
LANES, EACH = np.linspace(2.0, 8.0, 5), 5  # m, where the lanes are, and discs of each
WALLS, FASTEST, THRUST = 2.0, 2.5, 2.0  # m, m/s, m/s^2
END = [10.0, 0.0, 0.0, 0.0]
TIMES = 2.0, 20.0  # s
EFFORT = 0.2  # per second, of half the square of the acceleration
NOMINAL = 6.0, 12.0  # s
SHARES = 0.7, 0.76, 0.82, 0.88, 0.94, 1.0  # of the duration found, at which time is fixed
NEAR = 5e-3  # share of the cost
BALL = 0.2  # m, of the vehicle


def discs(number: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres (25, 2), radii (25,) and velocities (25, 2) of a layout."""
    rng, centers, radii, velocities = np.random.default_rng((seed, number)), [], [], []
    for lane in LANES:
        speed, side = rng.uniform(0.4, 1.2), 1.0 if rng.random() < 0.5 else -1.0
        radius, gap = rng.uniform(0.45, 0.7), rng.uniform(2.6, 3.6)
        first = rng.uniform(0.0, gap)
        for j in range(EACH):
            centers.append((lane, side * (first + gap * (j - EACH + 2))))
            radii.append(radius)
            velocities.append((0.0, side * speed))
    return np.array(centers), np.array(radii), np.array(velocities)


def problem(count: int, seed: int, nominal: float, pace: Tensor | None = None) -> Problem:
    """The layouts with a free time, or, with a pace (B,), at that multiple of the nominal time."""
    drawn = zip(*(discs(number, seed) for number in range(count)), strict=True)
    centers, radii, velocities = (torch.from_numpy(np.stack(part)) for part in drawn)
    free, dt = None, nominal / STAGES
    if pace is None:
        model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, dt, "rk4", slice(0, 2))
        free = FreeTime(TIMES[0] / nominal, TIMES[1] / nominal, weight=1.0)
    else:
        rates = lambda x, u, pace: pace * torch.cat((x[..., 2:], u), -1)
        model = FunctionDynamics(rates, 4, 2, dt, "rk4", slice(0, 2), values={"pace": pace.unsqueeze(-1)})
        velocities = pace.view(-1, 1, 1) * velocities
    far = math.inf
    parts = [
        Spheres(centers, radii, BALL, velocities),
        ControlBounds(-THRUST, THRUST),
        StateBounds([-far, -WALLS, -far, -far], [far, WALLS, far, far]),
        NormBounds(("x", [2, 3]), upper=FASTEST),
    ]
    cost = QuadraticCost([0.0] * 4, [EFFORT * dt] * 2, [0.0] * 4, x_ref=END)
    x0 = torch.zeros(count, 4, dtype=torch.float64)
    return Problem(model, cost, parts, x0, STAGES, Goal(state=END, required=True), time=free)


def fixed(count: int, seed: int, durations: Tensor) -> Tensor:
    """The least cost (B,) at fixed times, infinite where none serves, for durations (B,) that were found."""
    best = torch.full_like(durations, math.inf)
    for part in SHARES:
        pace = part * durations / NOMINAL[0]
        stated = problem(count, seed, NOMINAL[0], pace)
        found = torchgco.solve(stated, verbose=False)
        cost = part * durations + pace * found.cost
        best = torch.where(torchgco.judge(stated, found.U).reached & (cost < best), cost, best)
    return best


def text(count: int, seed: int) -> str:
    """The table."""
    rows, costs, durations = [], [], []
    for nominal in NOMINAL:
        stated = problem(count, seed, nominal)
        torchgco.solve(stated.take(slice(0, 1)), verbose=False, max_seconds=1e-3)  # compiles
        began = time.process_time()
        found = torchgco.solve(stated, verbose=False)
        spent = (time.process_time() - began) / count
        verdict = torchgco.judge(stated, found.U, times=found.t)
        costs.append(torch.where(verdict.reached, found.cost, math.inf))
        durations.append(found.duration)
        ended = sum(status is Status.CONVERGED for status in found.statuses)
        counts = found.iterations.numpy()
        rows.append([f"{nominal:g}", share(int(verdict.reached.sum()), count), ended,
                     f"{float(found.duration.median()):.2f} ({float(found.duration.max()):.2f})",
                     f"{np.median(counts):.0f} ({counts.max()})", f"{spent:.2f}"])  # fmt: skip
    grid = fixed(count, seed, durations[0])
    for row, cost, other in zip(rows, costs, reversed(costs), strict=True):
        row += [share(int((cost > (1.0 + NEAR) * rival).sum()), count) for rival in (grid, other)]
        known = torch.isfinite(grid) & torch.isfinite(cost)
        row.append(f"{float((cost / grid)[known].median()):.4f} ({float((cost / grid)[known].max()):.4f})")
    head = ["nominal time, s", "reached", "CONVERGED", "duration, s (most)", "iterations (most)", "s a layout",
            "costs over 0.5 % more than at fixed times", "than from the other nominal time",
            "cost / that at fixed times (most)"]  # fmt: skip
    return markdown(head, rows)


main = Command(
    __doc__, "free_time", text, "{count} drawn layouts, seed {seed}", mark="moving",
    count=(64, "layouts"), seed=(7, "of the layouts"),
)  # fmt: skip

if __name__ == "__main__":
    raise SystemExit(main())
