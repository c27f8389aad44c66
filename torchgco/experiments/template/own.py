"""My model, my layouts and my solver. torchgco finds them by the files in `mine`, which name them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchgco import Dynamics, Solution
from torchgco.base.draws import DrawKey, standard_normal
from torchgco.base.shapes import lead
from torchgco.base.tree import put
from torchgco.baselines.hold import rolled_out
from torchgco.lagrangian.quality import is_better
from torchgco.scenarios import Layouts, Scenario
from torchgco.solvers.contracts import Call, Solver


@dataclass(frozen=True)
class Boat(Dynamics):
    """x = [p (2, m), v (2, m/s)], u = thrust (2, m/s^2)."""

    drag: float | Tensor = 0.5  # 1/s
    dt: float = 0.1  # s
    integrator: str = "rk4"
    n, m, position = 4, 2, slice(0, 2)
    per_element = ("drag",)

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        """Time derivatives (..., n) of states (..., n) under controls (..., m)."""
        v = x[..., 2:]
        return torch.cat((v, u - lead(self.drag, v) * v), dim=-1)


@dataclass(frozen=True)
class Slalom(Scenario):
    """Discs on a line from start to goal, moved to the sides at random."""

    name: str = "slalom"
    discs: int = 3
    radius: float = 0.3  # m
    stages: int = 60

    @property
    def dimension(self) -> int:
        """Of space."""
        return 2

    def _draw_one(self, rng: np.random.Generator) -> Layouts:
        x = np.linspace(1.0, 4.0, self.discs)
        centers = np.stack((x, rng.uniform(-0.4, 0.4, self.discs)), axis=-1)
        return Layouts(centers[None], np.full((1, self.discs), self.radius), dt=0.1, stages=self.stages)


@dataclass(frozen=True)
class Shooting(Solver):
    """Random changes of the best controls so far."""

    rounds: int = 60
    spread: float = 0.3  # of a change, in the units of the controls

    def run(self, call: Call) -> Solution:
        """The best controls of all rounds."""
        best = rolled_out(call.problem, call.U0, 1e-3, self.rounds)
        for i in range(self.rounds):
            key = DrawKey(call.seed, call.ids, torch.full_like(call.ids, i))
            noise = standard_normal(key, best.U.shape[2], range(best.U.shape[1]), best.U.dtype)  # (m, B, N)
            new = rolled_out(call.problem, best.U + self.spread * noise.permute(1, 2, 0), 1e-3, self.rounds)
            rows = is_better(new.cost, new.violation, best.cost, best.violation, 1e-3).nonzero().flatten()
            put(best, rows, new.take(rows))
        return best
