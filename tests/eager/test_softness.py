"""How far rows give way where units are small, against a chain of sums whose answer is known."""

from __future__ import annotations

import pytest
import torch

from torchgco import FunctionConstraint, FunctionDynamics, Problem, QuadraticCost
from torchgco.eager.model import Model
from torchgco.eager.softness import gives_of

D, N = torch.float64, 8


@pytest.mark.parametrize(("effort", "last"), [(1e-6, 1e-9), (1e-6, 1e-2), (4.0, 0.0)])
def test_a_sum_gives_way_by_what_its_controls_cost(effort: float, last: float) -> None:
    """x' = x + u: a control moves by 1 / (effort + last), the last state by N times that, and by 1 / last at most."""
    row = FunctionConstraint(lambda x: 3.0 * x, "equality", of="x", knots=[N])
    model = FunctionDynamics(lambda x, u: x + u, 1, 1, 1.0, "none")
    problem = Problem(model, QuadraticCost([0.0], [effort], [last]), [row], torch.zeros(1, 1, dtype=D), N)
    of = Model.of(problem)
    at = of.slopes(*problem.at_rest)
    curvature = at.H.diagonal(dim1=-2, dim2=-1).abs()
    found = gives_of(of, at, curvature, torch.tensor([0.1], dtype=D), torch.ones(1, 1, dtype=torch.bool))
    moves = N / (effort + last) if last == 0.0 else min(N / (effort + last), 1.0 / last)
    assert found.item() == pytest.approx(max(1.0, 0.1 * 9.0 * moves), rel=1e-12)
