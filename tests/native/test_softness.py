"""How far rows of equalities give way where units are small, against a chain of sums whose answer is known."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from torchgco import FunctionConstraint, FunctionDynamics, InteriorPoint, Problem, QuadraticCost
from torchgco.kernels import interior_of
from torchgco.problem.scale import CostScale

D, N = torch.float64, 8
DELTA, SHARE = 1e-3, 0.1  # delta_c, and its share of what the cost lets a row give way


@pytest.mark.parametrize(("effort", "last"), [(1e-6, 1e-9), (1e-6, 1e-2), (4.0, 0.0)])
def test_a_sum_gives_way_by_what_its_controls_cost(effort: float, last: float) -> None:
    """x' = x + u, and 3 x = 3 at the end: a control moves by 1 / (effort + last), the last state by N times that, and
    by 1 / last at most. One step minimises the cost beside (3 x - 3)^2 / (2 delta_c gives).
    """
    row = FunctionConstraint(lambda x: 3.0 * x - 3.0, "equality", of="x", knots=[N])
    model = FunctionDynamics(lambda x, u: x + u, 1, 1, 1.0, "none")
    problem = Problem(model, QuadraticCost([0.0], [effort], [last]), [row], torch.zeros(1, 1, dtype=D), N)
    how = replace(
        InteriorPoint().options(False), max_iter=1, nlp_scaling_obj_target_gradient=math.inf, softest=DELTA,
        jacobian_regularization_value=DELTA, slight=SHARE,
    )  # fmt: skip
    one, (X, U) = torch.ones(1, dtype=D), problem.at_rest
    X, U = X.clone(), U.clone()
    interior_of(problem).solve(
        problem, X, U, (torch.zeros(1, 1, 1, dtype=D),), 0.1 * one, CostScale(one, 0 * one, one), how
    )
    moves = N / (effort + last) if last == 0.0 else min(N / (effort + last), 1.0 / last)
    gives = max(1.0, SHARE * 9.0 * moves)
    assert X[0, N].item() == pytest.approx(1.0 / (1.0 + DELTA * gives * (effort / N + last) / 9.0), rel=1e-9)
