"""python -m benchmarks.outside.maze: ALTRO's quadrotor maze, solved without waypoints, compared with IPOPT and FATROP.

The peers start from the five published waypoints, `torchgco` from hovering. All are judged by `recount`, in NumPy, and
run in one thread. With --write the table goes into benchmarks/results/maze.md.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import process_time

import numpy as np
import torch
from torch import Tensor

import torchgco
from benchmarks.lib import RESULTS
from benchmarks.lib.page import INTERVALS, SET_UP, put_table
from benchmarks.outside.golden import IPOPT
from benchmarks.outside.maze_problem import maze, recount, starts, waypoint_guess
from torchgco import Problem, presets
from torchgco.baselines import CasADiSolver
from torchgco.experiments.statistics.statistics import wilson
from torchgco.search.restarts import Restarts

PAGE = RESULTS / "maze.md"
STARTS, FATROP_STARTS = 64, 16
TOLERANCE = 1e-6  # violation of a solved problem: m, m/s, rad/s, N
FATROP = CasADiSolver("fatrop", tolerance=1e-10)
FATROP_LIMIT = 20  # s of processor time per problem: on some FATROP does not return
HEAD = (
    "solver", "initial guess", "n", "violation <= 1e-6", "violation <= 1e-3", "median cost",
    "cost, share of IPOPT's: least, median, largest", "iterations, median", "seconds per problem",
)  # fmt: skip


def precise(problem: Problem) -> Restarts:
    """The default solver, to a violation of `TOLERANCE`."""
    solver = presets.gco(problem)
    return replace(solver, local=replace(solver.local, violation_tolerance=TOLERANCE))


@dataclass(frozen=True)
class Flight:
    """What one solver made of the starts, each (B,) and as `recount` counts; NaN where it did not return."""

    name: str
    guess: str
    cost: np.ndarray
    violation: np.ndarray
    iterations: np.ndarray
    seconds: np.ndarray  # of processor time; a batch's mean for every one of its problems

    def cells(self, peer: Flight) -> list[str]:
        """A row of the table; costs are compared where both this and `peer` are within 1e-3."""
        n = len(self.cost)
        close, ended = self.violation <= 1e-3, ~np.isnan(self.seconds)
        both = close & (peer.violation[:n] <= 1e-3)
        ratio = (self.cost / peer.cost[:n])[both]
        return [
            self.name, self.guess, str(n), _share(int((self.violation <= TOLERANCE).sum()), n), f"{close.sum()} of {n}",
            f"{np.median(self.cost[close]):.4f}" if close.any() else "-",
            ", ".join(f"{x:.4f}" for x in np.quantile(ratio, (0, 0.5, 1))) if both.any() else "-",
            f"{np.median(self.iterations[ended]):.0f}" if ended.any() else "-",
            f"{self.seconds[ended].mean():.3f}" if ended.any() else "-",
        ]  # fmt: skip


def ours(name: str, problem: Problem, solver: Restarts) -> Flight:
    """All starts as one batch, from hovering."""
    torchgco.solve(problem.take(slice(0, 1)), solver=solver, max_seconds=1e-3)  # compiles
    began = process_time()
    solution = torchgco.solve(problem, solver=solver)
    seconds = (process_time() - began) / problem.B
    return _flight(name, "hovering", problem, solution.U, solution.iterations, seconds)


def ipopt(problem: Problem) -> Flight:
    """IPOPT from the waypoints, one start after the other; building the program isn't timed."""
    solver = IPOPT.prepare(problem)
    began = process_time()
    solution = solver.run_from(*waypoint_guess(problem.x0))
    seconds = (process_time() - began) / problem.B
    return _flight("IPOPT", "waypoints", problem, solution.U, solution.iterations, seconds)


def fatrop(problem: Problem) -> Flight:
    """FATROP from the waypoints, each start in a process of its own that ends after `FATROP_LIMIT` seconds."""
    U = torch.full((problem.B, problem.N, problem.m), torch.nan, dtype=torch.float64)
    iterations, seconds = U.new_full((problem.B,), torch.nan), np.full(problem.B, np.nan)
    context = multiprocessing.get_context("fork")  # the child shares the program that was built here
    for b in range(problem.B):
        part = problem.take(slice(b, b + 1))
        prepared, guess = FATROP.prepare(part), waypoint_guess(part.x0)
        receiver, sender = context.Pipe(duplex=False)

        def solve(prepared=prepared, guess=guess, sender=sender) -> None:
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            resource.setrlimit(resource.RLIMIT_CPU, (FATROP_LIMIT, FATROP_LIMIT + 1))
            began = process_time()
            solution = prepared.run_from(*guess)
            sender.send((solution.U.numpy(), int(solution.iterations), process_time() - began))

        child = context.Process(target=solve)
        child.start()
        sender.close()
        try:
            controls, iterations[b], seconds[b] = receiver.recv()
            U[b : b + 1] = torch.from_numpy(controls)
        except EOFError:  # ended by its limit
            pass
        child.join()
    return _flight("FATROP", "waypoints", problem, U, iterations, seconds)


def _flight(
    name: str, guess: str, problem: Problem, U: Tensor, iterations: Tensor, seconds: float | np.ndarray
) -> Flight:
    cost, violation, _ = recount(problem.x0.numpy(), U.numpy())
    return Flight(name, guess, cost, violation, iterations.double().numpy(), np.broadcast_to(seconds, cost.shape))


def _share(hits: int, n: int) -> str:
    low, high = (100 * bound for bound in wilson(hits, n))
    return f"{hits} of {n} [{low:.0f}, {high:.0f}] %"


def table(count: int, seed: int, fatrop_count: int) -> str:
    """The results of all solvers, in Markdown."""
    problem = maze(starts(count, seed))
    default = ours("`torchgco.solve`, default options", problem, presets.gco(problem))
    tight = ours("the same with `violation_tolerance=1e-6`", problem, precise(problem))
    peer = ipopt(problem)
    flights = [default, tight, peer]
    note = ""
    if fatrop_count > 0:
        last = fatrop(problem.take(slice(0, fatrop_count)))
        flights.append(last)
        lost = int(np.isnan(last.seconds).sum())
        note = (
            f" FATROP did not return within {FATROP_LIMIT} s on {lost} of {fatrop_count} starts; its iterations and "
            "seconds leave these out."
        )
    known = (tight.violation <= TOLERANCE) & (peer.violation <= 1e-3)
    dearer = int((tight.cost > (1 + 1e-4) * peer.cost)[known].sum())
    rows = [list(HEAD), ["---"] * len(HEAD), *(flight.cells(peer) for flight in flights)]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows) + (
        f"\n\nOf {int(known.sum())} starts that `torchgco` (to 1e-6) and IPOPT both solve, "
        f"`torchgco` is more than 1e-4 above IPOPT's cost on {dearer}.{note}"
    )


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.outside.maze", description="ALTRO's quadrotor maze.")
    parser.add_argument("--starts", type=int, default=STARTS, help="the published start and others around it")
    parser.add_argument("--fatrop", type=int, default=FATROP_STARTS, help="of these, starts that FATROP flies")
    parser.add_argument("--seed", type=int, default=0, help="of the starts")
    parser.add_argument("--write", action="store_true", help="put the table into benchmarks/results/maze.md")
    asked = parser.parse_args(words)
    torch.set_num_threads(1)
    text = table(asked.starts, asked.seed, asked.fatrop)
    print(text)
    if asked.write:
        how = f"{asked.starts} starts, seed {asked.seed}, processor time with one thread"
        put_table(PAGE, how, text, "CasADi", SET_UP, INTERVALS)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
