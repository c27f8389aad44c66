"""Limits of time hold for every preset that repeats something."""

from __future__ import annotations

import pytest
import torch

import torchgco
from tests.problems import planar_batch


@pytest.mark.filterwarnings("ignore::torchgco.GuidanceWarning")
@pytest.mark.parametrize("name", ["al_ilqr", "mppi", "multistart", "gco", "gco_fast", "gco_max", "interior_point"])
def test_a_limit_ends_a_solve_early(name: str) -> None:
    problem, U0 = planar_batch(B=2, N=20, obstacles=2)
    whole = torchgco.solve(problem, U0, name, verbose=False)
    ended = torchgco.solve(problem, U0, name, max_seconds=1e-6, verbose=False)
    assert bool((ended.iterations < whole.iterations).all())
    assert not any(status.name in ("CONVERGED", "INFEASIBLE") for status in ended.statuses)
    assert bool(torch.isfinite(ended.U).all())
