"""python -m benchmarks.families.general_peers: IPOPT from nine starts and FATROP from rest in the general families.

Every flight is a row of benchmarks/data/general_peers.csv, which `general` reads; rows that are there aren't flown
again, so that a stopped run resumes. A flight is a process of its own with a limit of processor time, and so have the
flights of a family: starts that don't fit into it are left out, for all its problems alike. Building the program isn't
counted.
"""

from __future__ import annotations

import sys
from argparse import ArgumentParser
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from signal import ITIMER_PROF
from typing import Any, Literal

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from benchmarks.families.general_problems import FAMILIES
from benchmarks.families.general_starts import (
    STARTS,
    Start,
    cost_along,
    digest,
    rollout,
    starts,
    violation_along,
)
from benchmarks.lib import DATA
from benchmarks.lib.command import parser_of
from benchmarks.lib.comparison import timed
from benchmarks.lib.kept import append, rows_of
from torchgco import InputError, Problem
from torchgco.baselines import CasADiSolver
from torchgco.baselines.casadi import PreparedCasADi
from torchgco.baselines.limited import limited

FILE = DATA / "general_peers.csv"
COLUMNS = (
    "family", "instance", "seed", "digest", "peer", "start", "status", "cost", "violation", "rolled", "seconds",
    "iterations",
)  # fmt: skip
LEFT_OUT, TIME_LIMIT, REFUSED, SOLVED = "LEFT_OUT", "TIME_LIMIT", "REFUSED", "SOLVED"
ADMITTED = 1e-4  # by how much gaps and rows along a peer's own states may be violated where it reports success
PEERS: tuple[tuple[Literal["fatrop", "ipopt"], tuple[str, ...]], ...] = (("fatrop", ("rest",)), ("ipopt", STARTS))


def main(words: Sequence[str] | None = None) -> int:
    asked = _parser().parse_args(words)
    torch.set_num_threads(1)
    for name in asked.families:
        for row in flights(name, asked.seed, asked.limit, asked.family_limit, asked.file):
            append(asked.file, COLUMNS, row)
            print(*(row.get(column, "-") for column in COLUMNS), flush=True)
    return 0


def _parser() -> ArgumentParser:
    parser = parser_of(__doc__)
    parser.add_argument("--families", nargs="+", default=list(FAMILIES), choices=list(FAMILIES), metavar="NAME")
    parser.add_argument("--seed", type=int, default=0, help="of the problems")
    parser.add_argument("--limit", type=int, default=3, metavar="SECONDS", help="per flight; more over long horizons")
    parser.add_argument("--family-limit", type=int, default=45, metavar="SECONDS", help="of the flights of a family")
    parser.add_argument("--file", type=Path, default=FILE, help="where the rows are kept")
    return parser


def known_of(name: str, seed: int, digests: Sequence[str], file: Path = FILE) -> pd.DataFrame:
    """The rows of a family's problems as they are drawn now."""
    rows = rows_of(file, COLUMNS)
    rows = rows[(rows.family == name) & (rows.seed == seed)]
    rows = rows[rows.digest == rows.instance.map(dict(enumerate(digests)))]
    return rows.astype(dict.fromkeys(("cost", "violation", "seconds"), float))


def flights(name: str, seed: int, limit: int, family_limit: int, file: Path) -> Iterator[dict[str, Any]]:
    """The rows of a family that the file lacks: FATROP, then IPOPT from one start after the other."""
    drawn = FAMILIES[name].drawn(seed)
    problem, digests = drawn.problem, digest(drawn.problem)
    kept = known_of(name, seed, digests, file)
    known = set(kept[["peer", "start", "instance"]].itertuples(index=False, name=None))
    limit, spent = limit * max(1, problem.N // 200), float(kept.seconds.sum())
    at = dict(starts(drawn, seed))
    for plugin, names in PEERS:
        lacking = {
            start: rows for start in names if (rows := [b for b in range(problem.B) if (plugin, start, b) not in known])
        }
        peer = prepared(plugin, problem) if lacking else None
        for start, rows in lacking.items():
            over = spent > family_limit
            for b in rows:
                flight = Flight(LEFT_OUT) if over else fly(peer, b, at[start], limit)
                spent += flight.seconds
                base = {"family": name, "instance": b, "seed": seed, "digest": digests[b], "peer": plugin}
                yield base | {"start": start} | flight.row()


@dataclass(frozen=True)
class Flight:
    """What a peer returned for one problem: judged along its own states, and along a rollout of its controls."""

    status: str
    cost: float = np.nan
    violation: float = np.nan  # of rows and gaps, along its own states
    rolled: float = np.nan  # of rows, along the rollout
    seconds: float = 0.0
    iterations: float = np.nan

    def row(self) -> dict[str, Any]:
        return {
            "status": self.status, "cost": f"{self.cost:.9g}", "violation": f"{self.violation:.3g}",
            "rolled": f"{self.rolled:.3g}", "seconds": f"{self.seconds:.4g}", "iterations": f"{self.iterations:.0f}",
        }  # fmt: skip


def prepared(
    plugin: Literal["fatrop", "ipopt"], problem: Problem, options: Mapping[str, Any] | None = None
) -> PreparedCasADi | None:
    """The peer with its program built; None where it refuses the problem, such as FATROP rows that join knots."""
    try:
        return CasADiSolver(plugin, max_iterations=500, tolerance=1e-6, options=options).prepare(problem)
    except InputError:
        return None


def fly(peer: PreparedCasADi | None, b: int, start: Start, limit: int) -> Flight:
    """Problem b from a start, in a process of its own."""
    if peer is None:
        return Flight(REFUSED)

    def work() -> tuple[Any, ...]:
        (v, stats), seconds = timed(lambda: _solved(peer, b, start[0][b], start[1][b]))
        return v, bool(stats["success"]), str(stats.get("return_status", "")), int(stats["iter_count"]), seconds

    try:
        v, success, said, iterations, seconds = limited(work, limit, ITIMER_PROF)
    except TimeoutError:
        return Flight(TIME_LIMIT, seconds=limit)
    except (ChildProcessError, RuntimeError) as fault:
        return Flight(str(fault).split("\n")[0])
    problem = peer.problem.take(slice(b, b + 1))
    X, U = _parts(v, problem)
    next_states = torch.stack([problem.dynamics.step(X[:, k], U[:, k]) for k in range(problem.N)], dim=1)
    gap = max(float((X[:, 1:] - next_states).abs().max()), float((X[:, 0] - problem.x0).abs().max()))
    violation = max(float(violation_along(problem, X, U)), gap)
    rolled = float(violation_along(problem, rollout(problem, U), U))
    status = SOLVED if success and violation <= ADMITTED else said if said.isidentifier() else "FAILED"
    return Flight(status, float(cost_along(problem, X, U)), violation, rolled, seconds, iterations)


def _solved(peer: PreparedCasADi, b: int, X: Tensor, U: Tensor) -> tuple[np.ndarray, dict[str, Any]]:
    """The peer's variables [x_0, u_0, ..., x_N] from states X (N+1, n) and controls U (N, m), and what it reports."""
    program = peer.program
    p = program.values(peer.problem, b)
    lower, upper = program.limits.bounds(p, program.variables.numel())
    guess = torch.cat((torch.cat((X[:-1], U), dim=-1).flatten(), X[-1])).numpy()
    lowest = np.where(program.equality, 0.0, -np.inf)
    found = peer.function(x0=guess, p=p, lbx=lower, ubx=upper, lbg=lowest, ubg=np.zeros(len(lowest)))
    return np.array(found["x"]).reshape(-1), peer.function.stats()


def _parts(v: np.ndarray, problem: Problem) -> Start:
    n = problem.n
    stages = torch.from_numpy(v[:-n]).view(1, problem.N, -1)
    return torch.cat((stages[..., :n], torch.from_numpy(v[-n:]).view(1, 1, n)), dim=1), stages[..., n:]


if __name__ == "__main__":
    sys.exit(main())
