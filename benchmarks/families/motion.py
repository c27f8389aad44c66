"""python -m benchmarks.families.motion: scenes in which everything moves, by `gco` and by others.

Layouts are drawn by the scenarios of `docs/studies.md`; each has a way for a point at a stated pace. The goal is
stated, not required. All solvers start from the vehicle at rest and are judged by `torchgco.judge`. `multistart` makes
a given number of iterations for each layout instead of its own, with which it would take most of an hour.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import torch

import torchgco
from benchmarks.lib.command import Command
from benchmarks.lib.page import markdown, share
from torchgco import MultiStart, Problem, compose, presets
from torchgco.solvers.contracts import Solver

SCENES = {
    "traffic": "unicycle", "walkers": "unicycle", "sliding": "unicycle", "revolving": "unicycle",
    "conveyor": "unicycle", "swarm": "quadrotor", "forest_moving": "quadrotor",
}  # fmt: skip
NEAR = 0.02  # share of the least cost


def problem_of(scene: str, count: int, seed: int) -> Problem:
    """The layouts of a scene as the command line poses them."""
    words = [f"model={SCENES[scene]}", f"scenario={scene}", f"study.layouts={count}", f"seed={seed}"]
    return compose(words).task().problem


def solver_of(name: str, problem: Problem, budget: int) -> Solver:
    """A preset; `multistart` with so many iterations for a problem."""
    solver = getattr(presets, name)(problem)
    return replace(solver, budget=budget) if isinstance(solver, MultiStart) else solver


def text(count: int, seed: int, budget: int, solvers: Sequence[str]) -> str:
    """The table: a row for each solver of each scene."""
    rows = []
    for scene in SCENES:
        problem = problem_of(scene, count, seed)
        costs, spent = [], []
        for solver in (solver_of(name, problem, budget) for name in solvers):
            torchgco.solve(problem.take(torch.tensor([0])), solver=solver, verbose=False)  # compiles
            began = time.process_time()
            solution = torchgco.solve(problem, solver=solver, verbose=False)
            spent.append((time.process_time() - began) / count)
            verdict = torchgco.judge(problem, solution.U)
            costs.append(torch.where(verdict.reached, verdict.cost, torch.inf))
        least = torch.stack(costs).amin(0)
        for solver, cost, seconds in zip(solvers, costs, spent, strict=True):
            reached, near = torch.isfinite(cost), cost <= (1.0 + NEAR) * least
            ratio = (cost / least)[reached]
            worst = f"{float(ratio.median()):.3f} ({float(ratio.max()):.3f})" if reached.any() else "-"
            shares = (share(int(rows_of.sum()), count) for rows_of in (reached, reached & near))
            rows.append([scene, SCENES[scene], f"`{solver}`", *shares, worst, f"{seconds:.2f}"])
    head = [
        "scene",
        "model",
        "solver",
        "reached",
        "within 2 % of the least cost",
        "cost / least (most)",
        "s a layout",
    ]
    return markdown(head, rows)


main = Command(
    __doc__, "motion", text, "{count} drawn layouts a scene, seed {seed}, {budget} iterations of `multistart`",
    count=(16, "layouts of each scene"), seed=(2718, "of the layouts"),
    budget=(400, "iterations of `multistart` for a layout"),
    solvers=(("gco", "gco_fast", "multistart", "interior_point"), "presets"),
)  # fmt: skip

if __name__ == "__main__":
    raise SystemExit(main())
