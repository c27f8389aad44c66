"""One inner solve of every element of a batch for fixed multipliers: no outer loop around it, and no verdict."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.lagrangian import Lagrangian
from torchgco.native.dispatch import engine_of, open_loop, value
from torchgco.solvers.ilqr import ILQR
from torchgco.solvers.iteration import EagerIterations, NativeIterations
from torchgco.solvers.state import InnerState
from torchgco.status import Status
from torchgco.tree import put, take


def descend(inner: ILQR, lagrangian: Lagrangian, U: Tensor) -> InnerState:
    """Where the inner solve (Algorithm 2) of each element ends, from controls U (B, N, m).

    An element without a finite L_M stays where it starts. Tolerances and damping of `inner` are in the units of the
    problem's cost.
    """
    problem = lagrangian.problem
    X = open_loop(problem, U)
    cost, merit = value(lagrangian, X, U)
    rows = torch.arange(problem.B, device=U.device)
    none = (torch.zeros_like(rows) for _ in range(3))
    found = InnerState(rows, X, U.clone(), cost, merit.clone(), torch.zeros_like(cost), *none)
    native = engine_of(problem) is not None
    iterations = NativeIterations(inner, inner.max_iterations) if native else EagerIterations(inner)
    going = torch.isfinite(merit) & torch.isfinite(X).flatten(1).all(-1)
    running = found
    while bool(going.any()):
        if not bool(going.all()):
            stay = going.nonzero().flatten()
            running, lagrangian = take(running, stay), lagrangian.take(stay)
        end = iterations.run(running, lagrangian)
        going = ~end.ended & (end.status == Status.RUNNING)
        if running is not found:
            put(found, running.rows, running)
    return found
