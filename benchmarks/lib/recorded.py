"""Solves of public layouts that record their search, and samplers that tell of their calls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from benchmarks.lib import DATA
from torchgco import Problem, Solution, compose
from torchgco.base.draws import DrawKey
from torchgco.guidance import MPPI
from torchgco.scenarios import Layouts

Tell = Callable[[Problem, Tensor, DrawKey, Tensor], None]  # a call's arguments, and the states (B, N+1, n) of its plans


@dataclass(frozen=True)
class Told(MPPI):
    """A sampler that changes nothing, and tells of each of its calls."""

    tell: Tell = lambda *call: None

    @classmethod
    def of(cls, sampler: MPPI, tell: Tell) -> Told:
        return cls(**{option.name: getattr(sampler, option.name) for option in fields(sampler)}, tell=tell)

    def improve(self, problem: Problem, U: Tensor, key: DrawKey) -> tuple[Tensor, Tensor]:
        X, plan = super().improve(problem, U, key)
        self.tell(problem, U, key, X)
        return X, plan


def solve(layout: int) -> tuple[Problem, Solution, Layouts]:
    """Solve one layout of `planar_trap` by `gco`, which records its search."""
    words = ["scenario=layouts", f"scenario.path={DATA / 'planar_trap.npz'}", "model=planar", "device.threads=1"]
    setup = compose([*words, "solver.local.record=true"])
    layouts = setup.layouts().take([layout])
    task = setup.task(layouts)
    solution = setup.solver.solve(task.problem, task.U0, seed=setup.seed, ids=torch.as_tensor(layouts.ids))
    return task.problem, solution, layouts
