"""Four problems that need different attempts, and a small solver that makes all of these attempts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tests.search.cup import controls
from tests.search.rows import restarts
from torchgco import (
    GCO,
    ILQR,
    MPPI,
    AugmentedLagrangian,
    ControlBounds,
    FunctionDynamics,
    Goal,
    PathProposals,
    Problem,
    QuadraticCost,
    Spheres,
)
from torchgco.lagrangian.lagrangian import SolveEnd
from torchgco.search import Follow
from torchgco.solvers.contracts import Call

LOCAL = AugmentedLagrangian(ILQR(tolerance=5e-6, max_iterations=20), initial_penalty=2.0, max_outer_iterations=12)
SAMPLER = MPPI(
    samples=32, covariance=None, spread=0.35, temperature=0.01, rounds=3, noise_knots=8, decay=0.93, dwell_cost=1.0,
    elite=5,
)  # fmt: skip
SAMPLING = GCO(SAMPLER, 2.0, start_from_sample=True, sample_from_rest=True)
PATHS = PathProposals(follow=(Follow(iterations=8),), max_penetration=0.5)
SOLVER = restarts(LOCAL, PATHS, SAMPLING, attempts=2)
FREE, PASSES, SHORT, CLOSED = range(4)


def gates(weight: float = 6.0) -> tuple[Problem, Tensor]:
    """Four vehicles on the line to a goal. FREE meets no obstacle. PASSES is led around a gate by a path. SHORT has the
    same gate, but its optimum ends short of the goal for this terminal weight. CLOSED is in a ring, without a path.
    """
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    centers, radii = np.full((4, 12, 2), np.nan), np.full((4, 12), np.nan)
    centers[FREE, :2] = [[5, 9], [5, 9.6]]
    centers[[PASSES, SHORT], :2] = [[5, 0.3], [5, -0.3]]
    centers[CLOSED] = 2 * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    radii[:CLOSED, :2], radii[CLOSED] = 0.5, 0.5
    weights = torch.tensor([[w, w, 0, 0] for w in (100.0, 100.0, weight, 100.0)], dtype=torch.float64)
    problem = Problem(
        FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.1, "euler", slice(0, 2)),
        QuadraticCost(Q=[0.01, 0.01, 0.1, 0.1], R=[1.0, 1.0], Qf=torch.diag_embed(weights), x_ref=[10.0, 0, 0, 0]),
        [Spheres(centers, radii, 0.1), ControlBounds([-5.0] * 2, [5.0] * 2)],
        torch.zeros(4, 4, dtype=torch.float64),
        40,
        Goal([10.0, 0.0], 0.9),
    )
    return problem, controls(problem)


@dataclass
class Solve:
    """One local solve: its call, guidance, penalty and end."""

    call: Call
    guidance: Any
    penalty: Any
    end: SolveEnd

    @property
    def rows(self) -> list[int]:
        return self.call.rows.tolist()
