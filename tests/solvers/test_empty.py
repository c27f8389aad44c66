"""A batch without problems has an empty solution of the right shapes, also where its parts have values of problems."""

from __future__ import annotations

import pytest
import torch

import torchgco
from torchgco import ControlBounds, FunctionConstraint, FunctionCost, FunctionDynamics, InputError, Problem

D = torch.float64


def empty() -> Problem:
    weights = {"w": torch.ones(2, dtype=D)}
    problem = Problem(
        FunctionDynamics(lambda x, u, w: torch.stack((x[..., 1], w * u[..., 0]), dim=-1), 2, 1, 0.1, values=weights),
        FunctionCost(
            lambda x, u, w: w * x.square().sum(-1) + u[..., 0].square(), lambda x: x.square().sum(-1), values=weights
        ),
        [FunctionConstraint(lambda x, w: x - w, values={"w": torch.ones(2, 1, dtype=D)}), ControlBounds(-1.0, 1.0)],
        torch.zeros(2, 2, dtype=D),
        10,
    )
    return problem.take(torch.arange(0))


@pytest.mark.parametrize(
    "solver", ["gco", "gco_max", "gco_paper", "al_ilqr", "ilqr", "mppi", "interior_point", "multistart", "hold"]
)
def test_no_problems_have_an_empty_solution(solver: str) -> None:
    problem = empty()
    found = torchgco.solve(problem, solver=solver)
    shapes = [tuple(t.shape) for t in (found.X, found.U, found.K, found.d, found.status, *found.multipliers.lam)]
    assert shapes == [(0, 11, 2), (0, 10, 1), (0, 10, 1, 2), (0, 10, 1), (0,), (0, 10, 2), (0, 10, 2)]
    assert len(found.to_frame(problem)) == len(found.worst_rows(problem)) == 0
    with pytest.raises(InputError, match="U0"):
        torchgco.solve(problem, torch.zeros(1, 10, 1, dtype=D), solver)
