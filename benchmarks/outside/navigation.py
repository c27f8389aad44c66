"""python -m benchmarks.outside.navigation: the navigation problems of jaxipm, in problems per second beside IPOPT.

Both solvers run in worker processes with one thread each, one worker, then two that share the starts. IPOPT has the
published guess and options. All results are judged by `recount`, in NumPy. With --write the table goes into
benchmarks/results/navigation.md.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from time import process_time

import numpy as np
import torch
from torch import Tensor

import torchgco
from benchmarks.lib import RESULTS
from benchmarks.lib.page import INTERVALS, put_table
from benchmarks.outside.navigation_problem import fan, line_guess, navigation, recount
from torchgco import Problem, Solution, presets
from torchgco.baselines import CasADiSolver
from torchgco.experiments.statistics.statistics import wilson

PAGE = RESULTS / "navigation.md"
STARTS, SECTORS = 500, (90.0, 180.0)  # the published batch, and the published widths of the fan in degrees
TOLERANCE = 1e-6  # the published one of IPOPT; here the largest violation of torchgco's results, too
JUDGED = 1e-4  # IPOPT's own limit on violations, m, m/s and rad/s: its states meet it, a rollout may differ slightly
REPEATS = {"local": 5}  # of the timing of a solver that takes less than a second; the median counts
IPOPT = CasADiSolver("ipopt", tolerance=TOLERANCE, options={"warm_start_init_point": "yes"})
HEAD = (
    "fan", "solver", "n", "violation <= 1e-4", "violation <= 1e-3", "largest violation",
    "cost, share of IPOPT's: least, median, largest", "iterations, mean", "problems per second, one core", "two cores",
    "times IPOPT, one core", "two cores",
)  # fmt: skip


def default(problem: Problem, ids: Tensor) -> Callable[[], Solution]:
    """The default solver with its default options; `ids` (B,) are the places of the starts in the whole fan."""
    return lambda: torchgco.solve(problem, ids=ids)


def local(problem: Problem, ids: Tensor) -> Callable[[], Solution]:
    """The default's local solver alone, AL-iLQR from hovering, to a violation of `TOLERANCE`."""
    solver = replace(presets.gco(problem).local, violation_tolerance=TOLERANCE)
    return lambda: torchgco.solve(problem, solver=solver, ids=ids)


def ipopt(problem: Problem, ids: Tensor) -> Callable[[], Solution]:
    """IPOPT from the published guess; its program is built here."""
    solver, guess = IPOPT.prepare(problem), line_guess(problem.x0)
    return lambda: solver.run_from(*guess)


SOLVERS = {"`torchgco.solve`, default options": default, "`torchgco`, AL-iLQR, tolerance 1e-6": local, "IPOPT": ipopt}
NAMES = list(SOLVERS)


@dataclass(frozen=True)
class Flight:
    """What one solver made of one fan, as `recount` counts."""

    cost: np.ndarray  # (B,)
    violation: np.ndarray
    iterations: np.ndarray
    rates: tuple[float, float]  # problems per second of one worker, and of two


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
    began = process_time()
    solution = _solve()
    return solution.U.numpy(), solution.iterations.numpy(), process_time() - began


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


def fly(solver: str, sector: float, count: int) -> Flight:
    """One fan by one solver, on one core and then on two."""
    repeats = REPEATS.get(SOLVERS[solver].__name__, 1)
    U, iterations, alone = flown(solver, sector, count, 1, repeats)
    again, _, shared = flown(solver, sector, count, 2, repeats)
    assert solver == "IPOPT" or np.array_equal(U, again)  # a result does not depend on the batch
    cost, violation, _ = recount(fan(count, sector).numpy(), U)
    return Flight(cost, violation, iterations, (count / alone, count / shared))


def cells(sector: float, name: str, flight: Flight, peer: Flight) -> list[str]:
    """A row of the table; costs are compared where both solve the problem."""
    n, good = len(flight.cost), flight.violation <= JUDGED
    ratio = (flight.cost / peer.cost)[good & (peer.violation <= JUDGED)]
    low, high = (100 * bound for bound in wilson(int(good.sum()), n))
    return [
        f"{sector:.0f} degrees", name, str(n), f"{good.sum()} of {n} [{low:.1f}, {high:.1f}] %",
        f"{(flight.violation <= 1e-3).sum()} of {n}", f"{flight.violation.max():.0e}",
        ", ".join(f"{x:.4f}" for x in np.quantile(ratio, (0, 0.5, 1))) if len(ratio) else "-",
        f"{flight.iterations.mean():.0f}", *(f"{rate:.0f}" for rate in flight.rates),
        *(f"{own / other:.1f}" for own, other in zip(flight.rates, peer.rates, strict=True)),
    ]  # fmt: skip


def table(count: int, sectors: Sequence[float]) -> str:
    """The results of all solvers on all fans, in Markdown."""
    rows = [list(HEAD), ["---"] * len(HEAD)]
    for sector in sectors:
        flights = {name: fly(name, sector, count) for name in NAMES}
        rows += [cells(sector, name, flight, flights["IPOPT"]) for name, flight in flights.items()]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.outside.navigation", description="Navigation of jaxipm."
    )
    parser.add_argument("--starts", type=int, default=STARTS, help="starts per fan")
    parser.add_argument("--sectors", type=float, nargs="+", default=SECTORS, help="widths of the fans, degrees")
    parser.add_argument("--write", action="store_true", help="put the table into benchmarks/results/navigation.md")
    asked = parser.parse_args(words)
    torch.set_num_threads(1)
    text = table(asked.starts, asked.sectors)
    print(text)
    if asked.write:
        how = f"{asked.starts} starts per fan, processor time without set-up, one thread per process"
        put_table(PAGE, how, text, "CasADi", INTERVALS)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
