"""What sampled controls cost: thousands of rollouts side by side, components first, stage by stage.

With the components apart, every operation runs over all samples at once on memory that lies together, and what a stage
needs stays in the cache. Costs and collisions are kept apart, so that single precision loses neither.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.kernels import kernel
from torchgco.problem import Problem

COMPILED_STAGES = 5  # fused into one kernel; more compile for longer and gain little


def fly(problem: Problem, V: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Cost of the stages (B, S), touched obstacles (B, S) and last states (n, B, S) of controls V (N, m, B, S)."""
    x = problem.x0.mT.unsqueeze(-1).expand(-1, -1, V.shape[-1]).contiguous()
    cost, hits = torch.zeros_like(x[0]), torch.zeros_like(x[0])
    advance = _alike if problem.is_autonomous else _stages
    for k in range(0, problem.N, COMPILED_STAGES):
        x, cost, hits = advance(problem, x, V[k : k + COMPILED_STAGES], cost, hits, k)
    return cost, hits, x


def _stages(problem: Problem, x: Tensor, V: Tensor, cost: Tensor, hits: Tensor, first: int) -> tuple[Tensor, ...]:
    """Some stages of all samples, the first of them being stage `first`."""
    for j, u in enumerate(V.unbind(0)):
        k = first + j
        cost = cost + problem.cost.stage_rows(x, u, k)
        x = problem.dynamics.step_rows(x, u)
        for constraint in problem.geometric:
            if constraint.holds_at(k + 1):
                hits = hits + constraint.hits(x, k + 1)
    return x, cost, hits


def _alike(problem: Problem, x: Tensor, V: Tensor, cost: Tensor, hits: Tensor, first: int) -> tuple[Tensor, ...]:
    """The same where all stages are alike: one compiled kernel then serves them all."""
    return _compiled_stages(problem, x, V, cost, hits)


@kernel
def _compiled_stages(problem: Problem, x: Tensor, V: Tensor, cost: Tensor, hits: Tensor) -> tuple[Tensor, ...]:
    return _stages(problem, x, V, cost, hits, 0)
