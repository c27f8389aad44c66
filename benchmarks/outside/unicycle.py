"""python -m benchmarks.outside.unicycle: a user's model without tuning, compared with the best of twelve IPOPT starts.

A unicycle given as a Python function drives among discs; `torchgco.solve` runs without options. IPOPT solves every
problem from rest and from eleven random guesses, and its cheapest feasible result counts. `judge` judges both. With
--write the table goes into benchmarks/results/unicycle.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from time import perf_counter

import numpy as np
import torch
from torch import Tensor

import torchgco
from benchmarks.lib import RESULTS
from benchmarks.lib.page import INTERVALS, put_table
from torchgco.baselines import CasADiSolver
from torchgco.experiments.statistics.statistics import wilson
from torchgco.judging.judge import Verdict, judge
from torchgco.problem.problem import Problem

PAGE = RESULTS / "unicycle.md"
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


def ipopt(problem: Problem, seed: int) -> Tensor:
    """The least cost (B,) of a feasible result among all starts; infinite where there is none."""
    solver = CasADiSolver("ipopt").prepare(problem)
    generator = torch.Generator().manual_seed(seed)
    best = torch.full_like(problem.x0[:, 0], torch.inf)
    for start in range(STARTS):
        U0 = problem.x0.new_zeros(problem.B, STAGES, problem.m)
        if start > 0:  # linear between ten random points in time
            knots = torch.randn(problem.B, problem.m, 10, generator=generator, dtype=torch.float64)
            U0 = torch.nn.functional.interpolate(knots, STAGES, mode="linear", align_corners=True).mT.contiguous()
        verdict = judge(problem, solver.solve(problem, U0).U)
        best = torch.where(sound(verdict), torch.minimum(best, verdict.cost), best)
    return best


def sound(verdict: Verdict) -> Tensor:
    """Feasible at full radii, (B,)."""
    return verdict.feasible & (verdict.violation <= 1e-3)


def table(problem: Problem, seed: int) -> str:
    """The results of both solvers, in Markdown."""
    torchgco.solve(problem.take(slice(0, 1)))  # compiles
    began = perf_counter()
    solution = torchgco.solve(problem)
    seconds = (perf_counter() - began) / problem.B
    verdict = judge(problem, solution.U)
    began = perf_counter()
    best = ipopt(problem, seed)
    peer = (perf_counter() - began) / problem.B
    known, fits = torch.isfinite(best), sound(verdict)
    ratio = (verdict.cost / best)[known & fits]
    close = int((ratio <= WITHIN).sum())
    lines = [
        ["solver", "n", "feasible", "within 5 % of the best start", "cost ratio: median, 90 %, largest", "seconds"],
        ["---"] * 6,
        [
            "`torchgco.solve`", str(problem.B), _share(int(fits.sum()), problem.B), _share(close, int(known.sum())),
            ", ".join(f"{float(ratio.quantile(q)):.3f}" for q in (0.5, 0.9, 1.0)), f"{seconds:.3f}",
        ],
        [f"IPOPT, {STARTS} starts", str(problem.B), _share(int(known.sum()), problem.B), "-", "-", f"{peer:.2f}"],
    ]  # fmt: skip
    cheaper = int((ratio < 1 / 1.01).sum())
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + (
        f"\n\n`torchgco.solve` is more than 1 % cheaper than all {STARTS} starts on {cheaper} problems."
    )


def _share(hits: int, n: int) -> str:
    low, high = (100 * bound for bound in wilson(hits, n))
    return f"{hits} of {n} [{low:.0f}, {high:.0f}] %"


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.outside.unicycle", description="A user's model, untuned."
    )
    parser.add_argument("--count", type=int, default=64, help="problems")
    parser.add_argument("--seed", type=int, default=0, help="of problems and guesses")
    parser.add_argument("--write", action="store_true", help="put the table into benchmarks/results/unicycle.md")
    asked = parser.parse_args(words)
    torch.set_num_threads(1)
    text = table(problems(asked.count, asked.seed), asked.seed)
    print(text)
    if asked.write:
        put_table(PAGE, f"seed {asked.seed}, one thread on one core", text, INTERVALS)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
