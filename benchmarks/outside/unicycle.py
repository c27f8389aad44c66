"""python -m benchmarks.outside.unicycle: a user's model without tuning, compared with the best of twelve IPOPT starts.

A unicycle given as a Python function drives among discs; `torchgco.solve` runs without options. IPOPT solves every
problem from rest and from eleven random guesses, and its cheapest feasible result counts. `judge` judges both. With
--write the table goes into benchmarks/results/unicycle.md.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
import torch
from torch import Tensor

import torchgco
from benchmarks.lib.command import Command
from benchmarks.lib.comparison import Comparison, count, named
from benchmarks.lib.page import share
from torchgco.baselines import CasADiSolver
from torchgco.judging.judge import judge
from torchgco.problem.problem import Problem

STAGES, STARTS = 100, 12
VEHICLE, LIMIT = 0.15, 3.0  # m; m/s^2 and rad/s
WITHIN = 1.05  # times the best cost of IPOPT


def unicycle(x: Tensor, u: Tensor) -> Tensor:
    """Rates of x = [px, py, heading, speed] under u = [acceleration, turn rate]."""
    return torch.stack((x[..., 3] * x[..., 2].cos(), x[..., 3] * x[..., 2].sin(), u[..., 1], u[..., 0]), dim=-1)


def problems(count: int, seed: int) -> Problem:
    """From (-2, about 0) to (2, 0) m with five or six discs in the way; problem i is the same for any `count`."""
    x0, centers, radii = torch.zeros(count, 4, dtype=torch.float64), [], []
    for i in range(count):
        rng = np.random.default_rng((seed, i))
        x0[i, 0], x0[i, 1] = -2.0, rng.uniform(-0.2, 0.2)
        discs = np.c_[rng.uniform(-1.2, 1.2, 6), rng.uniform(-0.8, 0.8, 6)]
        sizes = rng.uniform(0.15, 0.35, 6)
        if i % 2:
            discs[5], sizes[5] = np.nan, np.nan
        centers.append(discs)
        radii.append(sizes)
    return Problem(
        torchgco.FunctionDynamics(unicycle, 4, 2, dt=0.05, integrator="rk4", position=slice(0, 2)),
        torchgco.QuadraticCost(Q=[1, 1, 0, 0.1], R=[0.1, 0.1], Qf=[200, 200, 1, 10], x_ref=[2.0, 0, 0, 0]),
        [
            torchgco.Spheres(np.stack(centers), np.stack(radii), VEHICLE),
            torchgco.ControlBounds([-LIMIT, -LIMIT], [LIMIT, LIMIT]),
        ],
        x0,
        STAGES,
        torchgco.Goal([2.0, 0.0], 0.3),
    )


def counted(problem: Problem, U: Tensor) -> dict[str, Tensor]:
    """Cost and violation (B,), and whether the result is feasible at full radii."""
    verdict = judge(problem, U)
    feasible = verdict.feasible
    return {"cost": verdict.cost, "violation": verdict.violation, "feasible": feasible}


def ratio(own: pd.DataFrame, peer: pd.DataFrame) -> pd.Series:
    """Costs as shares of the best start's, where both are feasible."""
    return (own.cost / peer.cost)[own.feasible & peer.feasible]


def close(own: pd.DataFrame, peer: pd.DataFrame) -> str:
    """How many are within 5 % of the best start; nothing is compared with itself."""
    return "-" if own is peer else f"{share((ratio(own, peer) <= WITHIN).sum(), peer.feasible.sum())} %"


def ratios(own: pd.DataFrame, peer: pd.DataFrame) -> str:
    return "-" if own is peer else ", ".join(f"{ratio(own, peer).quantile(q):.3f}" for q in (0.5, 0.9, 1.0))


COMPARISON = Comparison(counted, [
    ("solver", named("solver")),
    ("n", count),
    ("feasible", lambda own, _: f"{share(own.feasible.sum(), len(own))} %"),
    ("within 5 % of the best start", close),
    ("cost ratio: median, 90 %, largest", ratios),
    ("seconds", lambda own, _: f"{own.seconds[0]:.3g}"),
])  # fmt: skip


def ipopt(problem: Problem, seed: int) -> pd.DataFrame:
    """The cheapest feasible result among all starts, the first from rest, and the time of all of them."""
    solver = CasADiSolver("ipopt").prepare(problem)
    generator = torch.Generator().manual_seed(seed)
    flights = []
    for start in range(STARTS):
        U0 = problem.x0.new_zeros(problem.B, STAGES, problem.m)
        if start > 0:  # linear between ten random points in time
            knots = torch.randn(problem.B, problem.m, 10, generator=generator, dtype=torch.float64)
            U0 = torch.nn.functional.interpolate(knots, STAGES, mode="linear", align_corners=True).mT.contiguous()
        flights.append(COMPARISON.fly(f"IPOPT, {STARTS} starts", problem, lambda U=U0: solver.solve(problem, U)))
    every = pd.concat(flights)
    best = every.assign(lost=~every.feasible).sort_values(["lost", "cost"], kind="stable")
    best = best[~best.index.duplicated()].sort_index()
    return best.assign(seconds=sum(flight.seconds for flight in flights))


def table(count: int, seed: int) -> str:
    """The results of both solvers, in Markdown."""
    problem = problems(count, seed)
    torchgco.solve(problem.take(slice(0, 1)))  # compiles
    own = COMPARISON.fly("`torchgco.solve`", problem, lambda: torchgco.solve(problem))
    best = ipopt(problem, seed)
    cheaper = (ratio(own, best) < 1 / 1.01).sum()
    return COMPARISON.table(COMPARISON.rows([own, best], best)) + (
        f"\n\n`torchgco.solve` is more than 1 % cheaper than all {STARTS} starts on {cheaper} problems."
    )


main = Command(
    __doc__, "unicycle", table, "seed {seed}",
    count=(64, "problems"), seed=(0, "of problems and guesses"),
)  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())
