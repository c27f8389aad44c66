"""python -m benchmarks.outside.concar: a car among four hard circles, 100 problems, compared with IPOPT.

torchgco solves all problems as one batch, IPOPT one by one, both from zero controls, with one thread; `judge` judges
both. With --write the table goes into benchmarks/results/concar.md. Model, problems and solver are those of
`notebooks/own_model.ipynb`: its cells tagged `shared` are run unchanged, so that nothing is written twice.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from types import SimpleNamespace
from typing import Any

import pandas as pd
import torch
from torch import Tensor

from benchmarks.lib import DATA, RESULTS, ROOT
from benchmarks.lib.page import SET_UP, put_table
from torchgco import Problem, Solution, Status, judge
from torchgco.baselines import CasADiSolver

PAGE = RESULTS / "concar.md"
GOAL, GOAL_RADIUS = torch.ones(2, dtype=torch.float64), 0.1  # m
FEASIBLE, EXACT = 1e-3, 1e-6  # violation of the full radii, m
NOTABLE = 1.01  # the cost ratio beyond which one trajectory counts as cheaper than another
HEAD = (
    "solver", "circles", "n", "feasible", "violation <= 1e-6", "reached", "median objective", "ratio of medians",
    "median ratio", "seconds per problem",
)  # fmt: skip


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


@dataclass(frozen=True)
class Flight:
    """Results of a solver on the problems, from the judge."""

    name: str
    cost: Tensor  # (B,)
    violation: Tensor  # (B,), m: circles at knots 1..99 and, in their own units, control limits
    reached: Tensor  # (B,) bool
    converged: int  # number, by the solver's own status
    seconds: float  # per problem

    @classmethod
    def judged(cls, name: str, problem: Problem, solution: Solution, seconds: float) -> Flight:
        verdict = judge(problem, solution.U, GOAL, GOAL_RADIUS)
        converged = int((solution.status == Status.CONVERGED).sum())
        return cls(name, verdict.cost, verdict.violation, verdict.reached, converged, seconds / problem.B)

    def cells(self, other: Flight) -> list[str]:
        """A row of the table; ratios are to `other`."""
        ratio = float((self.cost / other.cost).quantile(0.5))
        of_medians = median(self.cost) / median(other.cost)
        counts = ((self.violation <= FEASIBLE), (self.violation <= EXACT), self.reached)
        return [
            self.name, "hard", str(len(self.cost)), *(str(int(count.sum())) for count in counts),
            f"{median(self.cost):.4f}", f"{of_medians:.4f}", f"{ratio:.4f}", f"{self.seconds:.3f}",
        ]  # fmt: skip


def fly(layouts: pd.DataFrame, seed: int = 0) -> tuple[Flight, Flight]:
    """torchgco and IPOPT on the same problems."""
    model = own_model()
    problem = model.problem_of(layouts)
    U0 = zero_controls(problem)
    began = perf_counter()
    solution = model.solver.solve(problem, U0, seed=seed)
    ours = Flight.judged("`torchgco`, one batch", problem, solution, perf_counter() - began)
    prepared = CasADiSolver(plugin="ipopt").prepare(problem)  # not timed, as in `benchmarks.speed`
    began = perf_counter()
    solution = prepared.solve(problem, U0)
    return ours, Flight.judged("`ipopt`, one by one", problem, solution, perf_counter() - began)


def published(seeds: pd.Series) -> list[list[str]]:
    """Rows for the published results of three solvers on softened circles, where they report convergence."""
    peers = pd.read_csv(DATA / "concar_peers.csv")
    peers = peers[peers["seed"].isin(seeds) & peers["converged"]]
    dash = "-"
    return [
        [f"{name}, as published", "softened", str(len(rows)), dash, dash, dash, f"{rows['objective'].median():.4f}"]
        + [dash] * 3
        for name, rows in peers.groupby("solver")
    ]


def compared(ours: Flight, peer: Flight) -> str:
    """A sentence that compares the two solvers layout by layout, as medians don't."""
    ratio = ours.cost / peer.cost
    return (
        f"Layout by layout torchgco is more than 1 % cheaper on {int((ratio < 1 / NOTABLE).sum())} of {len(ratio)} and "
        f"more than 1 % more expensive on {int((ratio > NOTABLE).sum())} (ratios of {float(ratio.min()):.2f} to "
        f"{float(ratio.max()):.2f}). By their own statuses {ours.converged} and {peer.converged} converged."
    )


def median(values: Tensor) -> float:
    return float(values.quantile(0.5))


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.outside.concar", description="A car among four hard circles."
    )
    parser.add_argument("--first", type=int, default=100, help="only the first problems, this many")
    parser.add_argument("--seed", type=int, default=0, help="of the random draws of guidance")
    parser.add_argument("--write", action="store_true", help="put the table into benchmarks/results/concar.md")
    asked = parser.parse_args(words)
    torch.set_num_threads(1)
    layouts = read_layouts().head(asked.first)
    ours, peer = fly(layouts, asked.seed)
    lines = [list(HEAD), ["---"] * len(HEAD), ours.cells(peer), peer.cells(peer), *published(layouts["seed"])]
    text = "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n\n" + compared(ours, peer)
    print(text)
    if asked.write:
        put_table(PAGE, f"seed {asked.seed}, one thread on one core", text, SET_UP)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
