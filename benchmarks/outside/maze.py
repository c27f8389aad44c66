"""python -m benchmarks.outside.maze: ALTRO's quadrotor maze, solved without waypoints, compared with IPOPT and FATROP.

The peers start from the five published waypoints, `torchgco` from hovering. All are judged by `recount`, in NumPy, and
run in one thread. With --write the table goes into benchmarks/results/maze.md.
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
import torch
from torch import Tensor

import torchgco
from benchmarks.lib.command import one_thread, parser_of, show
from benchmarks.lib.comparison import Comparison, cost_ratios, count, mean, median, named, share_within, timed, within
from benchmarks.lib.limited import limited
from benchmarks.lib.page import INTERVALS, SET_UP
from benchmarks.outside.golden import IPOPT
from benchmarks.outside.maze_problem import maze, recount, starts, waypoint_guess
from torchgco import Problem, presets
from torchgco.baselines import CasADiSolver
from torchgco.search.restarts import Restarts

STARTS, FATROP_STARTS = 64, 16
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
    ("n", count),
    ("violation <= 1e-6", share_within(TOLERANCE)),
    ("violation <= 1e-3", within(1e-3)),
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
    solver = IPOPT.prepare(problem)
    return COMPARISON.fly("IPOPT", problem, lambda: solver.run_from(*waypoint_guess(problem.x0)), guess=WAYPOINTS)


def fatrop(problem: Problem) -> pd.DataFrame:
    """FATROP from the waypoints, each start in a process of its own that ends after `FATROP_LIMIT` seconds."""
    U = torch.full((problem.B, problem.N, problem.m), torch.nan, dtype=torch.float64)
    iterations, seconds = torch.full((2, problem.B), torch.nan, dtype=torch.float64)
    for b in range(problem.B):
        prepared, guess = FATROP.prepare(problem.take(slice(b, b + 1))), waypoint_guess(problem.x0[b : b + 1])

        def solve(prepared=prepared, guess=guess) -> tuple[np.ndarray, int, float]:
            solution, took = timed(lambda: prepared.run_from(*guess))
            return solution.U[0].numpy(), int(solution.iterations), took

        try:
            controls, iterations[b], seconds[b] = limited(solve, FATROP_LIMIT)
            U[b] = torch.from_numpy(controls)
        except (TimeoutError, RuntimeError):
            pass
    return COMPARISON.judged("FATROP", problem, U, iterations, seconds, guess=WAYPOINTS)


def table(count: int, seed: int, fatrop_count: int) -> str:
    """The results of all solvers, in Markdown."""
    problem = maze(starts(count, seed))
    default = ours("`torchgco.solve`, default options", problem, presets.gco(problem))
    tight = ours("the same with `violation_tolerance=1e-6`", problem, precise(problem))
    peer = ipopt(problem)
    flights, note = [default, tight, peer], ""
    if fatrop_count > 0:
        flights.append(fatrop(problem.take(slice(0, fatrop_count))))
        note = (
            f" FATROP did not return within {FATROP_LIMIT} s on {flights[-1].seconds.isna().sum()} of {fatrop_count} "
            "starts; its iterations and seconds leave these out."
        )
    known = (tight.violation <= TOLERANCE) & (peer.violation <= 1e-3)
    dearer = (tight.cost > (1 + 1e-4) * peer.cost)[known].sum()
    return COMPARISON.table(COMPARISON.rows(flights, peer)) + (
        f"\n\nOf {known.sum()} starts that `torchgco` (to 1e-6) and IPOPT both solve, "
        f"`torchgco` is more than 1e-4 above IPOPT's cost on {dearer}.{note}"
    )


def _parser() -> ArgumentParser:
    parser = parser_of(__doc__, "results/maze.md")
    parser.add_argument("--starts", type=int, default=STARTS, help="the published start and others around it")
    parser.add_argument("--fatrop", type=int, default=FATROP_STARTS, help="of these, starts that FATROP flies")
    parser.add_argument("--seed", type=int, default=0, help="of the starts")
    return parser


def main(words: Sequence[str] | None = None) -> int:
    asked = _parser().parse_args(words)
    one_thread()
    how = f"{asked.starts} starts, seed {asked.seed}, processor time with one thread"
    return show(asked, "maze", table(asked.starts, asked.seed, asked.fatrop), how, "CasADi", SET_UP, INTERVALS)


if __name__ == "__main__":
    raise SystemExit(main())
