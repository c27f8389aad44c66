"""python -m benchmarks.outside.concar: a car among four hard circles, 100 problems, compared with IPOPT.

torchgco solves all problems as one batch, IPOPT one by one, both from zero controls, with one thread; `judge` judges
both. With --write the table goes into benchmarks/results/concar.md. Model, problems and solver are those of
`notebooks/own_model.ipynb`: its cells tagged `shared` are run unchanged, so that nothing is written twice.
"""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import pandas as pd
import torch
from torch import Tensor

from benchmarks.lib import DATA, ROOT
from benchmarks.lib.command import Command
from benchmarks.lib.comparison import Comparison, count, mean, median, named, timed
from torchgco import Problem, Solution, Status, judge
from torchgco.baselines import CasADiSolver

GOAL, GOAL_RADIUS = torch.ones(2, dtype=torch.float64), 0.1  # m
EXACT = 1e-6  # violation of the full radii, m
NOTABLE = 1.01  # the cost ratio beyond which one trajectory counts as cheaper than another


def own_model() -> SimpleNamespace:
    """The names that the notebook defines: Car, problem_of and solver."""
    notebook = json.loads((ROOT / "notebooks" / "own_model.ipynb").read_text())
    names: dict[str, Any] = {}
    for cell in notebook["cells"]:
        if "shared" in cell["metadata"].get("tags", ()):
            exec("".join(cell["source"]), names)
    return SimpleNamespace(**names)


def read_layouts() -> pd.DataFrame:
    """The table of layouts, one problem per row."""
    return pd.read_csv(DATA / "concar.csv")


def zero_controls(problem: Problem) -> Tensor:
    return problem.x0.new_zeros(problem.B, problem.N, problem.m)


def counted(problem: Problem, U: Tensor) -> dict[str, Tensor]:
    """Cost, violation and arrival (B,). The violation is of circles at knots 1..99, m, and of limits in their units."""
    verdict = judge(problem, U, GOAL, GOAL_RADIUS)
    return {"cost": verdict.cost, "violation": verdict.violation, "reached": verdict.reached}


COMPARISON = Comparison(counted, [
    ("solver", named("solver")),
    ("circles", lambda own, peer: "hard"),
    ("n", count),
    ("violation <= 1e-6", lambda own, peer: (own.violation <= EXACT).sum()),
    ("reached", lambda own, peer: own.reached.sum()),
    ("median objective", median("cost", 4)),
    ("ratio of medians", lambda own, peer: f"{own.cost.median() / peer.cost.median():.4f}"),
    ("median ratio", lambda own, peer: f"{(own.cost / peer.cost).median():.4f}"),
    ("seconds per problem", mean("seconds", 3)),
])  # fmt: skip


def fly(layouts: pd.DataFrame, seed: int = 0) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The flights of torchgco and IPOPT on the same problems, with `converged` by the solvers' own statuses."""
    model = own_model()
    problem = model.problem_of(layouts)
    U0 = zero_controls(problem)
    model.solver.solve(problem.take(slice(0, 1)), U0[:1], seed=seed)  # compiles
    prepared = CasADiSolver(plugin="ipopt").prepare(problem)

    def flown(solver: str, solution: Solution, seconds: float) -> pd.DataFrame:
        converged = solution.status == Status.CONVERGED
        each = seconds / problem.B
        return COMPARISON.judged(solver, problem, solution.U, solution.iterations, each, converged=converged)

    return (
        flown("`torchgco`, one batch", *timed(lambda: model.solver.solve(problem, U0, seed=seed))),
        flown("`ipopt`, one by one", *timed(lambda: prepared.solve(problem, U0))),
    )


def published(seeds: pd.Series) -> list[list[Any]]:
    """Rows for the published results of three solvers on softened circles, where they report convergence."""
    peers = pd.read_csv(DATA / "concar_peers.csv")
    peers = peers[peers["seed"].isin(seeds) & peers["converged"]]
    return [
        [f"{name}, as published", "softened", len(rows), *"--", f"{rows['objective'].median():.4f}", *"---"]
        for name, rows in peers.groupby("solver")
    ]


def compared(ours: pd.DataFrame, peer: pd.DataFrame) -> str:
    """A sentence that compares the two solvers layout by layout, as medians don't."""
    ratio = ours.cost / peer.cost
    return (
        f"Layout by layout torchgco is more than 1 % cheaper on {(ratio < 1 / NOTABLE).sum()} of {len(ratio)} and more "
        f"than 1 % more expensive on {(ratio > NOTABLE).sum()} (ratios of {ratio.min():.2f} to {ratio.max():.2f}). By "
        f"their own statuses {ours.converged.sum()} and {peer.converged.sum()} converged."
    )


def table(first: int, seed: int) -> str:
    """All solvers on the first layouts, in Markdown."""
    layouts = read_layouts().head(first)
    flights = fly(layouts, seed)
    rows = COMPARISON.rows(flights, flights[1]) + published(layouts["seed"])
    return f"{COMPARISON.table(rows)}\n\n{compared(*flights)}"


main = Command(
    __doc__, "concar", table, "seed {seed}",
    first=(100, "only the first problems, this many"), seed=(0, "of the random draws of guidance"),
)  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())
