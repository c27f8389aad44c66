"""Solves of public layouts that record their search, for figures."""

from __future__ import annotations

import torch

from benchmarks.lib import DATA
from torchgco import Problem, Solution, compose
from torchgco.scenarios import Layouts


def solve(layout: int) -> tuple[Problem, Solution, Layouts]:
    """Solve one layout of `planar_trap` by `gco`, which records its search."""
    words = ["scenario=layouts", f"scenario.path={DATA / 'planar_trap.npz'}", "model=planar", "device.threads=1"]
    setup = compose([*words, "solver.local.record=true"])
    layouts = setup.layouts().take([layout])
    task = setup.task(layouts)
    solution = setup.solver.solve(task.problem, task.U0, seed=setup.seed, ids=torch.as_tensor(layouts.ids))
    return task.problem, solution, layouts
