"""python -m benchmarks.outside.maze: ALTRO's quadrotor maze, solved without waypoints, compared with IPOPT and FATROP.

The peers start from the five published waypoints, `torchgco` from hovering. All are judged by `recount`, in NumPy, and
run in one thread. With --write the table goes into benchmarks/results/maze.md.
"""

from __future__ import annotations

from dataclasses import replace
from signal import ITIMER_PROF

import numpy as np
import pandas as pd
import torch
from torch import Tensor

import torchgco
from benchmarks.lib.command import Command
from benchmarks.lib.comparison import Comparison, cost_ratios, mean, median, named, share_within, timed
from benchmarks.outside.golden import IPOPT
from benchmarks.outside.maze_problem import drawn, maze, recount, waypoint_guess
from torchgco import Problem, presets
from torchgco.baselines import CasADiSolver
from torchgco.baselines.limited import limited
from torchgco.search.restarts import Restarts

TOLERANCE = 1e-6  # violation of a solved problem: m, m/s, rad/s, N
FATROP = CasADiSolver("fatrop", tolerance=1e-10)
FATROP_LIMIT = 20  # s of processor time per problem: on some FATROP does not return
HOVERING, WAYPOINTS = "hovering", "waypoints"  # initial guesses


def counted(problem: Problem, U: Tensor) -> dict[str, np.ndarray]:
    """Cost and violation (B,), by `recount`."""
    return dict(zip(("cost", "violation"), recount(problem.x0.numpy(), U.numpy()), strict=False))


def median_cost(own: pd.DataFrame, peer: pd.DataFrame) -> str:
    """Of the problems within 1e-3."""
    cost = own.cost[own.violation <= 1e-3]
    return f"{cost.median():.4f}" if len(cost) else "-"


COMPARISON = Comparison(counted, [
    ("solver", named("solver")),
    ("initial guess", named("guess")),
    ("violation <= 1e-6", share_within(TOLERANCE)),
    ("median cost", median_cost),
    ("cost, share of IPOPT's: least, median, largest", cost_ratios(1e-3)),
    ("iterations, median", median("iterations", 0)),
    ("seconds per problem", mean("seconds", 3)),
])  # fmt: skip


def precise(problem: Problem) -> Restarts:
    """The default solver, to a violation of `TOLERANCE`."""
    solver = presets.gco(problem)
    return replace(solver, local=replace(solver.local, violation_tolerance=TOLERANCE))


def ours(name: str, problem: Problem, solver: Restarts) -> pd.DataFrame:
    """All starts as one batch, from hovering."""
    torchgco.solve(problem.take(slice(0, 1)), solver=solver, max_seconds=1e-3)  # compiles
    return COMPARISON.fly(name, problem, lambda: torchgco.solve(problem, solver=solver), guess=HOVERING)


def ipopt(problem: Problem) -> pd.DataFrame:
    """IPOPT from the waypoints, one start after the other; building the program isn't timed."""
    solver, (X0, U0) = IPOPT.prepare(problem), waypoint_guess(problem.x0)
    return COMPARISON.fly("IPOPT", problem, lambda: solver.solve(problem, U0, X0=X0), guess=WAYPOINTS)


def alone(problem: Problem) -> pd.DataFrame:
    """FATROP from the waypoints, each start in a process of its own that ends after `FATROP_LIMIT` seconds."""
    U = torch.full((problem.B, problem.N, problem.m), torch.nan, dtype=torch.float64)
    iterations, seconds = torch.full((2, problem.B), torch.nan, dtype=torch.float64)
    for b in range(problem.B):
        one = problem.take(slice(b, b + 1))
        prepared, (X0, U0) = FATROP.prepare(one), waypoint_guess(one.x0)

        def solve(one=one, prepared=prepared, X0=X0, U0=U0) -> tuple[np.ndarray, int, float]:
            solution, took = timed(lambda: prepared.solve(one, U0, X0=X0))
            return solution.U[0].numpy(), int(solution.iterations), took

        try:
            controls, iterations[b], seconds[b] = limited(solve, FATROP_LIMIT, ITIMER_PROF)
            U[b] = torch.from_numpy(controls)
        except (TimeoutError, ChildProcessError):
            pass
    return COMPARISON.judged("FATROP", problem, U, iterations, seconds, guess=WAYPOINTS)


def table(starts: int, fatrop: int, seed: int) -> str:
    """The results of all solvers, in Markdown."""
    problem = maze(drawn(starts, seed))
    default = ours("`torchgco.solve`, default options", problem, presets.gco(problem))
    tight = ours("the same with `violation_tolerance=1e-6`", problem, precise(problem))
    peer = ipopt(problem)
    flights, note = [default, tight, peer], ""
    if fatrop > 0:
        flights.append(alone(problem.take(slice(0, fatrop))))
        note = (
            f" FATROP did not return within {FATROP_LIMIT} s on {flights[-1].seconds.isna().sum()} of {fatrop} "
            "starts; its iterations and seconds leave these out."
        )
    known = (tight.violation <= TOLERANCE) & (peer.violation <= 1e-3)
    dearer = (tight.cost > (1 + 1e-4) * peer.cost)[known].sum()
    return COMPARISON.table(COMPARISON.rows(flights, peer)) + (
        f"\n\nOf {known.sum()} starts that `torchgco` (to 1e-6) and IPOPT both solve, "
        f"`torchgco` is more than 1e-4 above IPOPT's cost on {dearer}.{note}"
    )


main = Command(
    __doc__, "maze", table, "{starts} starts, seed {seed}", "CasADi",
    starts=(64, "the published start and others around it"), fatrop=(16, "of these, starts that FATROP flies"),
    seed=(0, "of the starts"),
)  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())
