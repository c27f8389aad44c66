"""States between the knots: those that the model's own integrator leads to within a stage."""

from __future__ import annotations

from torch import Tensor

from torchgco.dynamics.base import Dynamics
from torchgco.dynamics.integrators import INTEGRATORS


def between(dynamics: Dynamics, X: Tensor, U: Tensor, k: Tensor, h: Tensor, lengths: Tensor) -> Tensor:
    """The states (B, T, n) at times h (T,), s, after the knots k (T,), on trajectories X (B, N+1, n), U (B, N, m).

    A model that integrates a derivative is integrated over h in place of its time step: after a whole stage the state
    is that of the next knot, to rounding. Models with a step alone have the straight line between two knots.

    Args:
        k: stages, int64 within 0..N-1.
        lengths: of these stages, (T,), s.
    """
    x, u = X[:, k], U[:, k]
    model = dynamics.at(k)
    if not model.is_integrated:
        return x + (h / lengths).unsqueeze(-1) * (X[:, k + 1] - x)
    # The field times h, over a unit of time: integrators take one time step for all states.
    return INTEGRATORS[model.integrator](lambda z: h.unsqueeze(-1) * model.field(z, u), x, 1.0)
