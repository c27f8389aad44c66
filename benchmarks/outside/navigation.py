"""python -m benchmarks.outside.navigation: the navigation problems of jaxipm, in problems per second, ours and IPOPT's.

Both solvers run in worker processes with one thread each, one worker, then two that share the starts. IPOPT has the
published guess and options. All results are judged by `recount`, in NumPy. With --write the table goes into
benchmarks/results/jaxipm.md.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np
import pandas as pd
import torch
from torch import Tensor

import torchgco
from benchmarks.lib import comparison as lib
from benchmarks.lib.command import Command
from benchmarks.lib.page import chosen, filed
from benchmarks.outside.navigation_problem import fan, line_guess, navigation, recount
from torchgco import Problem, Solution, presets
from torchgco.baselines import CasADiSolver

TOLERANCE = 1e-6  # the published one of IPOPT; here the largest violation of torchgco's results, too
JUDGED = 1e-4  # IPOPT's own limit on violations, m, m/s and rad/s: its states meet it, a rollout may differ slightly
REPEATS = {"local": 5}  # of the timing of a solver that takes less than a second; the median counts
IPOPT = CasADiSolver("ipopt", tolerance=TOLERANCE, options={"warm_start_init_point": "yes"})


def counted(problem: Problem, U: Tensor) -> dict[str, np.ndarray]:
    """Cost and violation (B,), by `recount`."""
    return dict(zip(("cost", "violation"), recount(problem.x0.numpy(), U.numpy()), strict=False))


def times(name: str) -> lib.Column:
    """How many times the peer's rate."""
    return lambda own, peer: f"{own[name][0] / peer[name][0]:.1f}"


COMPARISON = lib.Comparison(counted, [
    ("fan", lib.named("fan")),
    ("solver", lib.named("solver")),
    ("n", lib.count),
    ("violation <= 1e-4", lib.share_within(JUDGED, 1)),
    ("violation <= 1e-3", lib.within(1e-3)),
    ("largest violation", lib.worst("violation")),
    ("cost, share of IPOPT's: least, median, largest", lib.cost_ratios(JUDGED)),
    ("iterations, mean", lib.mean("iterations", 0)),
    ("problems per second, one core", lib.mean("alone", 0)),
    ("two cores", lib.mean("shared", 0)),
    ("times IPOPT, one core", times("alone")),
    ("two cores", times("shared")),
])  # fmt: skip
SHOWN = (
    "fan", "solver", "violation <= 1e-4", "cost, share of IPOPT's: least, median, largest",
    "problems per second, one core", "times IPOPT, one core",
)  # fmt: skip


def default(problem: Problem, ids: Tensor) -> Callable[[], Solution]:
    """The default solver with its default options; `ids` (B,) are the places of the starts in the whole fan."""
    return lambda: torchgco.solve(problem, ids=ids)


def local(problem: Problem, ids: Tensor) -> Callable[[], Solution]:
    """The default's local solver alone, AL-iLQR from hovering, to a violation of `TOLERANCE`."""
    solver = replace(presets.gco(problem).local, guidance=None, violation_tolerance=TOLERANCE)
    return lambda: torchgco.solve(problem, solver=solver, ids=ids)


def ipopt(problem: Problem, ids: Tensor) -> Callable[[], Solution]:
    """IPOPT from the published guess; its program is built here."""
    solver, guess = IPOPT.prepare(problem), line_guess(problem.x0)
    return lambda: solver.run_from(*guess)


SOLVERS = {"`torchgco.solve`, default options": default, "`torchgco`, AL-iLQR, tolerance 1e-6": local, "IPOPT": ipopt}

# In a worker: the solve that it was prepared for.
_solve: Callable[[], Solution]


def _prepare(solver: str, sector: float, count: int, rows: slice) -> None:
    global _solve
    torch.set_num_threads(1)
    ids = torch.arange(count)[rows]
    problem = navigation(fan(count, sector)[ids])
    torchgco.solve(problem.take(slice(0, 1)))  # compiles, and loads what a first solve loads
    _solve = SOLVERS[solver](problem, ids)


def _run() -> tuple[np.ndarray, np.ndarray, float]:
    solution, seconds = lib.timed(_solve)
    return solution.U.numpy(), solution.iterations.numpy(), seconds


def flown(solver: str, sector: float, count: int, workers: int, repeats: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Controls (count, N, 4) and iterations (count,) of a fan cut over workers that run at the same time.

    Also the median processor time in seconds, of the worker that takes longest.
    """
    context = multiprocessing.get_context("spawn")
    cuts = np.linspace(0, count, workers + 1).round().astype(int)
    pools = [ProcessPoolExecutor(1, mp_context=context) for _ in range(workers)]
    try:
        ready = [
            pool.submit(_prepare, solver, sector, count, slice(a, b))
            for pool, a, b in zip(pools, cuts[:-1], cuts[1:], strict=True)
        ]
        for worker in ready:
            worker.result()
        seconds = []
        for _ in range(repeats):
            parts = [running.result() for running in [pool.submit(_run) for pool in pools]]
            seconds.append(max(part[2] for part in parts))
    finally:
        for pool in pools:
            pool.shutdown()
    U, iterations = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    return U, iterations, float(np.median(seconds))


def fly(solver: str, sector: float, count: int) -> pd.DataFrame:
    """One fan by one solver, on one core and then on two; with the rates, problems per second."""
    repeats = REPEATS.get(SOLVERS[solver].__name__, 1)
    U, iterations, alone = flown(solver, sector, count, 1, repeats)
    again, _, shared = flown(solver, sector, count, 2, repeats)
    assert solver == "IPOPT" or np.array_equal(U, again)  # a result does not depend on the batch
    more = {"fan": f"{sector:.0f} degrees", "alone": count / alone, "shared": count / shared}
    problem = navigation(fan(count, sector))
    return COMPARISON.judged(solver, problem, torch.from_numpy(U), iterations, alone / count, **more)


def table(starts: int, sectors: Sequence[float]) -> str:
    """The results of all solvers on all fans, in Markdown."""
    rows = []
    for sector in sectors:
        flights = [fly(name, sector, starts) for name in SOLVERS]
        rows += COMPARISON.rows(flights, flights[-1])
    whole = COMPARISON.table(rows)
    return filed("navigation", whole, chosen(whole, SHOWN))


main = Command(
    __doc__, "jaxipm", table,
    "{starts} starts per fan", "CasADi",
    mark="navigation",
    starts=(500, "starts per fan"), sectors=([90.0, 180.0], "widths of the fans, degrees"),  # as published
)  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())
