"""Costs as functions see PyTorch's default precision as their process has it."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import compiled
from torchgco import FunctionCost, FunctionDynamics, Problem
from torchgco.kernels import use_native


@pytest.mark.parametrize("native", [pytest.param(True, marks=compiled), False])
def test_functions_see_the_default_precision_of_their_process(native: bool) -> None:
    """Only functions of the stage's number are called in the problem's, so that 0.3 * k is exact."""

    def stage(x: Tensor, u: Tensor) -> Tensor:
        grid = torch.tensor(16777217.0) - 16777216.0  # 0 in single precision
        return (x - grid).square().sum(-1) + u.square().sum(-1)

    model = FunctionDynamics(lambda x, u: x + u, 1, 1, 1.0, "none")
    problem = Problem(model, FunctionCost(stage), [], torch.ones(2, 1, dtype=torch.float64), 5)
    use_native(native)
    try:
        found = torchgco.solve(problem, solver="interior_point", verbose=False)
    finally:
        use_native(True)
    by_hand = stage(found.X[:, :-1], found.U).sum(-1)
    assert torch.allclose(found.cost, by_hand, rtol=1e-12, atol=0.0)
