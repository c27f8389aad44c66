"""python -m benchmarks.outside.golden: the problems of the ALTRO solver, compared with IPOPT.

torchgco solves the published start and seven drawn around it as one batch, then polishes; IPOPT solves them one by one
from the same initial controls. Seconds are processor time with one thread. With --write the table goes into
benchmarks/results/golden.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from time import process_time

import torch

from benchmarks.lib import RESULTS
from benchmarks.lib.page import SET_UP, put_table
from benchmarks.outside.golden_problems import GOLDEN, Golden
from torchgco import Certificate, Polish, Problem, Solution, certify, solve
from torchgco.baselines import CasADiSolver

PAGE = RESULTS / "golden.md"
STARTS = 8
# At its own tolerance of 1e-8 and with relaxed bounds, a rollout of IPOPT's controls can miss a goal by 5e-5.
IPOPT = CasADiSolver("ipopt", tolerance=1e-10, violation_tolerance=1e-6, options={"bound_relax_factor": 0.0})
HEAD = (
    "problem", "N", "solver", "violation <= 1e-6", "cost", "largest violation", "largest KKT residual", "iterations",
    "seconds per problem", "cost ratio: least, median, largest",
)  # fmt: skip


@dataclass(frozen=True)
class Flight:
    """Trajectories of one solver, and the processor time in seconds per problem."""

    solution: Solution
    certificate: Certificate
    seconds: float

    @classmethod
    def timed(cls, problem: Problem, solution: Solution, began: float) -> Flight:
        seconds = (process_time() - began) / problem.B
        return cls(solution, certify(problem, solution.X, solution.U), seconds)

    def cells(self) -> list[str]:
        """The columns from `violation <= 1e-6` to the seconds; cost and iterations are those of the first problem."""
        violation = self.solution.violation
        return [
            f"{int((violation <= 1e-6).sum())} of {len(violation)}", f"{float(self.solution.cost[0]):.6g}",
            f"{float(violation.max()):.0e}", f"{float(self.certificate.kkt_residual.max()):.0e}",
            str(int(self.solution.iterations[0])), f"{self.seconds:.3f}",
        ]  # fmt: skip


def ours(task: Golden, problem: Problem) -> tuple[Flight, Flight]:
    """The default solver as it is, and with its result polished."""
    U0 = task.U0.expand(problem.B, *task.U0.shape).clone()
    solve(problem.take(slice(0, 1)), max_seconds=1e-3)  # compiles
    began = process_time()
    rough = Flight.timed(problem, task.solve(problem, U0), began)
    began = process_time() - rough.seconds * problem.B
    return rough, Flight.timed(problem, Polish().refine(problem, rough.solution), began)


def ipopt(task: Golden, problem: Problem) -> Flight:
    """IPOPT from the task's initial controls; building the program isn't timed."""
    solver = IPOPT.prepare(problem)
    began = process_time()
    solution = solver.solve(problem, task.U0.expand(problem.B, *task.U0.shape).clone())
    return Flight.timed(problem, solution, began)


def rows(task: Golden, starts: int, seed: int) -> list[list[str]]:
    """Three rows of the table."""
    problem, _ = task.batch(starts, seed)
    rough, polished = ours(task, problem)
    peer = ipopt(task, problem)
    ratio = (polished.solution.cost / peer.solution.cost)[peer.solution.violation <= 1e-6]
    share = ", ".join(f"{float(ratio.quantile(q)):.4f}" for q in (0.0, 0.5, 1.0)) if len(ratio) else "-"
    return [
        [task.name, str(problem.N), "default", *rough.cells(), "-"],
        [task.name, str(problem.N), "default, polished", *polished.cells(), share],
        [task.name, str(problem.N), "IPOPT", *peer.cells(), "1"],
    ]


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.outside.golden", description="Problems of the ALTRO solver."
    )
    parser.add_argument("--problems", nargs="+", choices=GOLDEN, default=list(GOLDEN), metavar="NAME", help="which")
    parser.add_argument("--starts", type=int, default=STARTS, help="starts per problem")
    parser.add_argument("--seed", type=int, default=0, help="of the starts")
    parser.add_argument("--write", action="store_true", help="put the table into benchmarks/results/golden.md")
    asked = parser.parse_args(words)
    torch.set_num_threads(1)
    lines = [list(HEAD), ["---"] * len(HEAD)]
    for name in asked.problems:
        lines += rows(GOLDEN[name], asked.starts, asked.seed)
    text = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    print(text)
    if asked.write:
        put_table(PAGE, f"{asked.starts} starts, seed {asked.seed}, processor time with one thread", text, SET_UP)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
