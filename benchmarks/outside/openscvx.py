"""python -m benchmarks.outside.openscvx: three published examples of OpenSCvx, beside it.

OpenSCvx runs in its own environment: OPENSCVX_PYTHON is its Python, OPENSCVX its checkout at commit 815902c. Both
solvers' controls are judged here, by functions of NumPy: what rows and bounds are violated by at 1,000 instants of each
interval, from its node on by 1,000 steps of rk4, and by SciPy's DOP853 from the start on, at instants that are drawn.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

import torchgco
from benchmarks.lib.command import Command
from benchmarks.lib.page import markdown
from benchmarks.outside import openscvx_peer
from benchmarks.outside.openscvx_problems import EXAMPLES, WINDOW, Example
from torchgco import Problem, Solution

INSTANTS = 1000  # of each interval
ROUNDS = 5
ENOUGH = 1e-6  # what is left of violations, at which no further round is made
HEAD = (
    "example", "solver", "intervals", "time, s", "ended", "iterations", "violated", "by DOP853", "gates missed by, m",
    "end missed by, m", "ms", "compile, s",
)  # fmt: skip
NEEDS = "set OPENSCVX_PYTHON to a Python with OpenSCvx, and OPENSCVX to its checkout, whose examples it runs"


@dataclass(frozen=True)
class Flight:
    """Nodes, and what happens between them.

    Args:
        x: states at the nodes, (K+1, n).
        u: controls at both ends of each interval, between which they are linear, (2, K, m).
        seconds: the pace there, in seconds per interval, (2, K).
    """

    x: np.ndarray
    u: np.ndarray
    seconds: np.ndarray

    @classmethod
    def held(cls, x: np.ndarray, u: np.ndarray, t: np.ndarray) -> Flight:
        """Controls u (K, m) that are held between times t (K+1,)."""
        return cls(x, np.stack((u, u)), np.stack((np.diff(t), np.diff(t))))

    @classmethod
    def linear(cls, x: np.ndarray, u: np.ndarray, rate: np.ndarray) -> Flight:
        """Controls u (K+1, m), and durations of all of it at the pace of each node, (K+1,).

        As OpenSCvx's `discretization.py` and `propagation.py` have it, that reach the next node's after K / (K+1) of
        the interval, and go on.
        """
        K, ends = len(x) - 1, []
        for z in (u, rate / (len(x) - 1)):
            ends.append(np.stack((z[:-1], z[:-1] + (K + 1) / K * z[1:] - (K + 1) / K * z[:-1])))
        return cls(x, *ends)

    @property
    def duration(self) -> float:
        return float(self.seconds.mean(0).sum())

    def rates(self, example: Example, share: Any, x: np.ndarray, i: Any = slice(None)) -> np.ndarray:
        """The derivatives of states (..., n) by the share of the interval, at shares of intervals i."""
        u = self.u[0, i] + share * (self.u[1, i] - self.u[0, i])
        pace = self.seconds[0, i] + share * (self.seconds[1, i] - self.seconds[0, i])
        return np.asarray(np.asarray(pace)[..., None] * example.field(x, u))


def dense(example: Example, flight: Flight) -> float:
    """The largest violation at `INSTANTS` of each interval, from its node on."""
    x, h, worst = flight.x[:-1], 1.0 / INSTANTS, worst_of(example, flight.x)
    for k in range(INSTANTS):
        s = k * h
        a = flight.rates(example, s, x)
        b = flight.rates(example, s + 0.5 * h, x + 0.5 * h * a)
        c = flight.rates(example, s + 0.5 * h, x + 0.5 * h * b)
        x = x + h / 6.0 * (a + 2.0 * b + 2.0 * c + flight.rates(example, s + h, x + h * c))
        worst = max(worst, worst_of(example, x))
    return worst


def worst_of(example: Example, x: np.ndarray) -> float:
    return max(0.0, *(float(values.max()) for values in example.rows(x).values()))


def independent(example: Example, flight: Flight, seed: int = 0) -> tuple[float, float, float]:
    """The same of one flight from the start on, at drawn instants; by how much it misses the gates, and the end, m."""
    draws, x, worst, gates = np.random.default_rng(seed), flight.x[0], 0.0, 0.0
    count = len(flight.x) - 1
    knots = {2 * (i + 1) * count // example.intervals: center for i, center in enumerate(example.gates)}
    for i in range(count):
        rates = lambda s, z, i=i: flight.rates(example, s, z, i)
        shares = np.append(np.sort(draws.uniform(0.0, 1.0, INSTANTS)), 1.0)
        way = solve_ivp(rates, (0.0, 1.0), x, "DOP853", shares, rtol=1e-10, atol=1e-12).y.T
        x, worst = way[-1], max(worst, worst_of(example, way))
        if i + 1 in knots:
            gates = max(gates, float((np.abs(x[:3] - knots[i + 1]) - WINDOW).max()))
    return worst, gates, float(np.linalg.norm(x[: len(example.goal)] - example.goal))


def cells(example: Example, flight: Flight) -> list[str]:
    """What a row says of a flight."""
    worst, gates, end = independent(example, flight)
    missed = f"{gates:.1e}" if len(example.gates) else "-"
    return [f"{dense(example, flight):.1e}", f"{worst:.1e}", missed, f"{end:.1e}"]


def flown(solution: Solution) -> Flight:
    assert solution.times is not None
    return Flight.held(*(z[0].numpy() for z in (solution.X, solution.U, solution.times)))


def ours(name: str) -> Iterator[list[str]]:
    """Rows at knots alone, at three points of each stage, too, and tightened until `ENOUGH` is left."""
    example, X0 = EXAMPLES[name], EXAMPLES[name].states()
    for words, between in (("knots alone", False), ("three points", True)):
        problem = example.problem(between)
        solution, compiled, took = timed(problem, X0=X0)
        yield row(name, f"torchgco, {words}", solution, 1e3 * took, compiled)
    left, rounds = dense(example, flown(solution)), 0
    while left > ENOUGH and rounds < ROUNDS:
        problem, rounds = torchgco.tightened(problem, solution), rounds + 1
        solution, more, again = timed(problem, warm=solution, X0=solution.X)
        compiled, took, left = compiled + more, took + again, dense(example, flown(solution))
        yield row(name, f"torchgco, tightened {rounds} times", solution, 1e3 * took, compiled)


def timed(problem: Problem, **begin: Any) -> tuple[Solution, float, float]:
    """A solution, and processor time of the first solve beyond that of a later one, and of this, s."""
    took = []
    for _ in range(3):
        began = time.process_time() + os.times().children_user
        solution = torchgco.solve(problem, solver="interior_point", verbose=False, **begin)
        took.append(time.process_time() + os.times().children_user - began)
    return solution, took[0] - min(took[1:]), min(took[1:])


def row(name: str, solver: str, solution: Solution, ms: float, compiled: float) -> list[str]:
    ended = solution.statuses[0].name
    head = [name, solver, f"{solution.U.shape[1]}", f"{float(solution.duration[0]):.4f}", ended]
    return [
        *head,
        f"{int(solution.iterations[0])}",
        *cells(EXAMPLES[name], flown(solution)),
        f"{ms:.0f}",
        f"{compiled:.0f}",
    ]


def peers(name: str, found: Mapping[str, np.ndarray]) -> Iterator[list[str]]:
    """OpenSCvx as published, and with larger weights of the time."""
    for factor in openscvx_peer.WEIGHTS:
        part = {
            key: found[f"{name}/{factor:g}/{key}"] for key in ("x", "u", "rate", "seconds", "converged", "iterations")
        }
        flight = Flight.linear(part["x"], part["u"], part["rate"])
        words = "as published" if factor == 1.0 else f"time counts {factor:g} times as much"
        ended = "converged" if part["converged"] else "after its most iterations"
        compiled = found.get(f"{name}/compile")
        yield [
            name, f"OpenSCvx, {words}", f"{len(flight.x) - 1}", f"{flight.duration:.4f}", ended,
            f"{int(part['iterations'])}",
            *cells(EXAMPLES[name], flight), f"{1e3 * float(part['seconds']):.0f}",
            "as above" if compiled is None else f"{float(compiled):.0f}",
        ]  # fmt: skip


def peers_flights() -> dict[str, np.ndarray]:
    """What OpenSCvx found, in its own process.

    Raises:
        SystemExit: it isn't there.
    """
    python, checkout = os.environ.get("OPENSCVX_PYTHON"), os.environ.get("OPENSCVX")
    if not python or not checkout or not Path(python).exists() or not Path(checkout, "examples").is_dir():
        raise SystemExit(f"OpenSCvx isn't here: {NEEDS}")
    quiet = {"XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1", "OMP_NUM_THREADS": "1"}
    own = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    with tempfile.TemporaryDirectory() as folder:
        output = str(Path(folder, "found.npz"))
        words = [python, str(Path(openscvx_peer.__file__)), checkout, output]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL, env=own | quiet)
        return dict(np.load(output))


def table() -> str:
    found = peers_flights()
    rows = [row for name in EXAMPLES for source in (peers(name, found), ours(name)) for row in source]
    return markdown(HEAD, rows)


main = Command(__doc__, "openscvx", table, "three published examples of OpenSCvx 815902c")

if __name__ == "__main__":
    sys.exit(main())
