"""python -m benchmarks.outside.golden: the problems of the ALTRO solver, compared with IPOPT.

torchgco solves the published start and seven drawn around it as one batch, then goes on by the interior point; IPOPT
solves them one by one from the same initial controls. Seconds are processor time with one thread. With --write the
table goes into benchmarks/results/golden.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pandas as pd
from torch import Tensor

from benchmarks.lib.command import Command
from benchmarks.lib.comparison import Comparison, cost_ratios, named, timed, within, worst
from benchmarks.lib.page import chosen, filed
from benchmarks.outside.golden_problems import GOLDEN, Golden
from torchgco import InteriorPoint, Problem, certify, solve
from torchgco.baselines import CasADiSolver
from torchgco.dynamics.rollout import open_loop
from torchgco.lagrangian.quality import violation

TOLERANCE = 1e-6
# At its own tolerance of 1e-8 and with relaxed bounds, a rollout of IPOPT's controls can miss a goal by 5e-5.
IPOPT = CasADiSolver("ipopt", tolerance=1e-10, violation_tolerance=TOLERANCE, options={"bound_relax_factor": 0.0})

# From a solution and its multipliers, to the last digits.
FINE = InteriorPoint(tolerance=1e-12, violation_tolerance=1e-9, warm_barrier=1e-8)


def counted(problem: Problem, U: Tensor) -> dict[str, Tensor]:
    """Cost, violation and KKT residual (B,) along a rollout."""
    X = open_loop(problem.dynamics, problem.x0, U)
    residual = certify(problem, X, U).kkt_residual
    return {"cost": problem.cost.total(X, U), "violation": violation(problem.constraints, X, U), "residual": residual}


def ratios(own: pd.DataFrame, peer: pd.DataFrame) -> str:
    """Of the refined costs to IPOPT's."""
    return {"default": "-", "IPOPT": "1"}.get(own.solver[0]) or cost_ratios(TOLERANCE)(own, peer)


# Cost and iterations are those of the published start, the first.
COMPARISON = Comparison(counted, [
    ("problem", named("task")),
    ("N", named("N")),
    ("solver", named("solver")),
    ("violation <= 1e-6", within(TOLERANCE)),
    ("cost", lambda own, _: f"{own.cost[0]:.6g}"),
    ("largest violation", worst("violation")),
    ("largest KKT residual", worst("residual")),
    ("iterations", named("iterations")),
    ("seconds per problem", lambda own, _: f"{own.seconds[0]:.3f}"),
    ("cost ratio: least, median, largest", ratios),
])  # fmt: skip
SHOWN = (
    "problem", "solver", "cost", "largest KKT residual", "seconds per problem", "cost ratio: least, median, largest",
)  # fmt: skip


def rows(task: Golden, starts: int, seed: int) -> list[list[Any]]:
    """The default solver as it is, and with its result refined; and IPOPT, from the same controls."""
    problem, U0 = task.batch(starts, seed)
    more = {"task": task.name, "N": problem.N}
    solve(problem.take(slice(0, 1)), max_seconds=1e-3)  # compiles
    rough, first = timed(lambda: task.solve(problem, U0))
    fine, second = timed(lambda: solve(problem, rough.U, FINE, warm=rough))
    prepared = IPOPT.prepare(problem)
    flights = [
        COMPARISON.judged("default", problem, rough.U, rough.iterations, first / starts, **more),
        COMPARISON.judged("default, refined", problem, fine.U, fine.iterations, (first + second) / starts, **more),
        COMPARISON.fly("IPOPT", problem, lambda: prepared.solve(problem, U0), **more),
    ]
    return COMPARISON.rows(flights, flights[-1])


def table(problems: Sequence[str], starts: int, seed: int) -> str:
    """The results of both solvers, in Markdown."""
    whole = COMPARISON.table([row for name in problems for row in rows(GOLDEN[name], starts, seed)])
    return filed("golden", whole, chosen(whole, SHOWN))


main = Command(
    __doc__, "golden", table, "{starts} starts, seed {seed}",
    problems=(list(GOLDEN), "which", GOLDEN), starts=(8, "starts per problem"), seed=(0, "of the starts"),
)  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())
