"""python -m benchmarks.families.general: 48 families of constrained problems, compared with IPOPT from nine starts.

A solver gets the problems of a family as one batch, then one by one; a judge of its own rolls the controls out. The
peers' flights are read from benchmarks/data/general_peers.csv (`python -m benchmarks.families.general_peers` adds
those that are missing). A finished family is kept in outputs/general and not flown again at the same commit.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import pandas as pd
import torch

from benchmarks.families import general_tables
from benchmarks.families.general_peers import FILE, SOLVED, fly, known_of, prepared
from benchmarks.families.general_problems import FAMILIES, SETS
from benchmarks.families.general_problems_base import Family
from benchmarks.families.general_starts import digest, judged
from benchmarks.lib import ROOT
from benchmarks.lib.command import Command
from benchmarks.lib.comparison import timed
from benchmarks.lib.provenance import provenance
from torchgco import Problem, Solution, presets, solve
from torchgco.solvers.contracts import Solver

OUTPUTS = ROOT / "outputs" / "general"
# IPOPT stays near a result that it starts from.
STEEP = {"mu_init": 1e-6, "bound_push": 1e-6, "bound_frac": 1e-6}


def flown(family: Family, name: str, seed: int, seconds: int, restart: int) -> pd.DataFrame:
    """A row per problem of a family, by the preset of this name.

    Args:
        seconds: limit of a solve.
        restart: limit of IPOPT from each result; 0: it isn't started.
    """
    problem = family.problem(seed)
    solver = presets.named(name, problem)
    solve(problem.take(slice(0, 1)), solver=solver, max_seconds=seconds)  # compiles
    solution, took = timed(lambda: solve(problem, solver=solver, max_seconds=seconds))
    rows = pd.DataFrame({
        "family": family.name, "solver": name, "instance": range(problem.B),
        "status": [status.name for status in solution.statuses], "iterations": solution.iterations,
        **{column: value.numpy() for column, value in judged(problem, solution.U).items()},
    })  # fmt: skip
    return rows.assign(
        seconds=took / problem.B, alone=alone(problem, solver, seconds), restarted=restarts(problem, solution, restart)
    )


def alone(problem: Problem, solver: Solver, seconds: int) -> float:
    """Median processor time of the problems one by one, as far as they fit into the limit together."""
    times: list[float] = []
    for b in range(problem.B):
        if sum(times) < seconds:
            one = problem.take(slice(b, b + 1))
            times.append(timed(lambda one=one: solve(one, solver=solver, max_seconds=seconds))[1])
    return median(times)


def restarts(problem: Problem, solution: Solution, limit: int) -> list[float]:
    """The costs that IPOPT finds from each result; NaN where it finds none."""
    peer = prepared("ipopt", problem, STEEP) if limit else None
    flights = [fly(peer, b, (solution.X, solution.U), limit) for b in range(problem.B)] if peer else []
    return [one.cost if one.status == SOLVED else float("nan") for one in flights] or [float("nan")] * problem.B


def kept(family: Family, name: str, seed: int, seconds: int, restart: int, commit: str) -> pd.DataFrame:
    """The rows of a family, flown now or before at this commit."""
    file = OUTPUTS / f"{commit}-seed{seed}-restart{restart}-{seconds}s-{name}-{family.name}.csv"
    if file.is_file() and "changes" not in commit:
        return pd.read_csv(file)
    rows = flown(family, name, seed, seconds, restart)
    file.parent.mkdir(parents=True, exist_ok=True)
    rows.to_csv(file, index=False)
    good = int((rows.violation <= 1e-3).sum())
    print(f"{family.name}, {name}: {good} of {len(rows)}, {rows.seconds[0]:.3f} s", file=sys.stderr, flush=True)
    return rows


def table(
    solvers: Sequence[str], sets: Sequence[int], families: Sequence[str], seed: int, seconds: int, restart: int,
    peers: Path = FILE,
) -> str:  # fmt: skip
    """The tables of all sets and families, in Markdown."""
    asked = [FAMILIES[name] for name in families if FAMILIES[name].set in sets]
    flights, references, commit = [], [], provenance("cpu")["commit"]
    for family in asked:
        references.append(known_of(family.name, seed, digest(family.problem(seed)), peers))
        flights += [kept(family, name, seed, seconds, restart, commit) for name in solvers]
    return general_tables.text(pd.concat(flights), pd.concat(references), asked, seed)


main = Command(
    __doc__, "general", table,
    "seed {seed}, at most {seconds} s per solve", "CasADi",
    solvers=(["gco"], "presets by name"), sets=(list(SETS), "1 classics, 2 obstacles, 3 constraints, 4 scale", SETS),
    families=(list(FAMILIES), "which", FAMILIES), seed=(0, "of the problems"), seconds=(30, "limit of a solve"),
    restart=(0, "seconds of IPOPT from each result, to see whether it is a local minimum; 0: it isn't started"),
)  # fmt: skip


if __name__ == "__main__":
    torch.set_num_threads(1)
    raise SystemExit(main())
