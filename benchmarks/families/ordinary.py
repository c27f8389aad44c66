"""python -m benchmarks.families.ordinary: ordinary constrained problems by default options, and without the finish.

Twelve families, eight problems per seed. Feasible: every constraint within 1e-3 along PyTorch's own rollout of the
returned controls. With --write the table goes into benchmarks/results/ordinary.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median

import torch

from benchmarks.families.ordinary_problems import FAMILIES
from benchmarks.lib.command import Command
from benchmarks.lib.comparison import timed
from benchmarks.lib.page import INTERVALS, SET_UP, interval, markdown
from torchgco import Problem, presets, solve
from torchgco.lagrangian.rollout import open_loop
from torchgco.search import Finish

ADMITTED = 1e-3
HEAD = ("family", "n", "cut off by limits", "default", "ms per problem, cut off", "ms per problem, default")


@dataclass(frozen=True)
class Batch:
    """How many problems of a batch are feasible, and the processor time per problem in seconds."""

    feasible: int
    seconds: float


def flown(problem: Problem, finished: bool) -> Batch:
    """One batch by the default solver, or by the same without its finish."""
    solver = presets.gco(problem)
    solver = replace(solver, passes=tuple(one for one in solver.passes if finished or not isinstance(one, Finish)))
    solve(problem.take(slice(0, 1)), solver=solver, max_seconds=1e-2)  # compiles
    solution, seconds = timed(lambda: solve(problem, solver=solver))
    X = open_loop(problem.dynamics, problem.x0, solution.U)
    worst = torch.stack([part.worst(X, solution.U) for part in problem.constraints]).amax(0)
    return Batch(int((worst <= ADMITTED).sum()), seconds / problem.B)


def row(name: str, seeds: Sequence[int]) -> list[str]:
    problems = [FAMILIES[name](seed) for seed in seeds]
    cut, whole = ([flown(problem, finished) for problem in problems] for finished in (False, True))
    counts = [str(sum(batch.feasible for batch in batches)) for batches in (cut, whole)]
    times = [f"{1e3 * median(batch.seconds for batch in batches):.1f}" for batches in (cut, whole)]
    return [name, str(sum(problem.B for problem in problems)), *counts, *times]


def table(families: Sequence[str], seeds: Sequence[int]) -> str:
    """A row per family and one of all, in Markdown."""
    rows = [row(name, seeds) for name in families]
    n, *counts = (sum(int(cells[i]) for cells in rows) for i in (1, 2, 3))
    return markdown(HEAD, [*rows, ["all", n, *(f"{count} {interval(count, n)}" for count in counts), "", ""]])


main = Command(
    __doc__, "ordinary", table,
    "eight problems per family and seed, seeds {seeds}, processor time with one thread, median over seeds",
    INTERVALS, SET_UP, families=(list(FAMILIES), "which", FAMILIES), seeds=([7, 21, 100], "of the draws"),
)  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())
