"""A user's own model, a Python function, solved by `torchgco.solve` without options, and by FATROP for comparison."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

import torchgco
from benchmarks.speed.bench import SEED, Bench, Took
from torchgco.baselines import CasADiSolver
from torchgco.judging.judge import Verdict, judge
from torchgco.problem.problem import Problem

SECTION = "own_model"
GOAL = (4.0, 0.0)
DISCS, RADIUS, VEHICLE = 5, 0.35, 0.2  # m
WITHIN = 0.3  # m from the goal


def unicycle(x: Tensor, u: Tensor) -> Tensor:
    """Rates of x = [px, py, heading, speed] under u = [turn rate, acceleration]."""
    return torch.stack((x[..., 3] * x[..., 2].cos(), x[..., 3] * x[..., 2].sin(), u[..., 0], u[..., 1]), dim=-1)


def problems(layouts: range, stages: int) -> Problem:
    """From rest at the origin to rest at the goal, between five discs; layout i is the same in any batch."""
    rngs = [np.random.default_rng((SEED, i)) for i in layouts]
    centers = np.stack([rng.uniform((0.8, -1.0), (3.2, 1.0), (DISCS, 2)) for rng in rngs])
    return Problem(
        dynamics=torchgco.FunctionDynamics(unicycle, 4, 2, dt=5.0 / stages, integrator="rk4", position=slice(0, 2)),
        cost=torchgco.QuadraticCost(
            Q=[1, 1, 0, 0.1], R=[0.1, 0.1], Qf=[100, 100, 0, 10], x_ref=[*GOAL, 0.0, 0.0], u_ref=[0.0, 0.0]
        ),
        constraints=[
            torchgco.Spheres(centers, [RADIUS] * DISCS, VEHICLE),
            torchgco.ControlBounds([-math.pi, -3.0], [math.pi, 3.0]),
        ],
        x0=torch.zeros(len(layouts), 4, dtype=torch.float64),
        N=stages,
    )


def run(bench: Bench) -> None:
    stages, count = bench.sizes.num_stages or 100, bench.sizes.own_layouts
    whole, alone = problems(range(count), stages), [problems(range(i, i + 1), stages) for i in range(count)]
    solved, setup = bench.timed(lambda: torchgco.solve(alone[0]), compiling=True)
    again = bench.timed(lambda: torchgco.solve(alone[0]))[1]
    bench.row(SECTION, "B = 1", "torchgco.solve", "first solve longer by", max(0.0, setup.wall - again.wall), "s, wall")
    before = _fatrop(bench, whole)
    total, U = Took(0.0, 0.0), []
    for problem in alone:
        solved, took = bench.timed(lambda p=problem: torchgco.solve(p))
        total, U = total + took, [*U, solved.U]
    _say(bench, "B = 1", "torchgco.solve", total.each(count), _judged(whole, torch.cat(U)))
    torchgco.solve(whole)
    solved, took = bench.timed(lambda: torchgco.solve(whole))
    _say(bench, f"B = {count}", "torchgco.solve", took.each(count), _judged(whole, solved.U))
    after = _fatrop(bench, whole)
    _say(bench, "one by one", "fatrop", (before[0] + after[0]).each(2), after[1])


def _fatrop(bench: Bench, problem: Problem) -> tuple[Took, Verdict]:
    prepared = CasADiSolver("fatrop").prepare(problem)
    U0 = problem.x0.new_zeros(problem.B, problem.N, problem.m)
    solution, took = bench.timed(lambda: prepared.solve(problem, U0))
    return took.each(problem.B), _judged(problem, solution.U)


def _judged(problem: Problem, U: Tensor) -> Verdict:
    return judge(problem, U, problem.x0.new_tensor(GOAL), WITHIN)


def _say(bench: Bench, case: str, solver: str, took: Took, verdict: Verdict) -> None:
    bench.times(SECTION, case, solver, took)
    bench.counts(SECTION, case, solver, verdict)
