"""Solutions are saved and loaded, and the plain baselines return them too."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import torch

from tests.problems import planar_batch
from torchgco import MPPI, AugmentedLagrangian, InputError, Solution
from torchgco.baselines import Hold, IteratedMPPI


def test_save_and_load(tmp_path) -> None:
    problem, U0 = planar_batch(B=2, N=10)
    solution = AugmentedLagrangian(max_outer_iterations=2).solve(problem, U0)
    solution.save(tmp_path / "deep" / "solution.npz")
    loaded = Solution.load(tmp_path / "deep" / "solution.npz")
    for f in fields(Solution):
        if f.name not in ("multipliers", "trace", "search"):
            assert torch.equal(getattr(loaded, f.name), getattr(solution, f.name)), f.name
    assert torch.equal(loaded.multipliers.mu, solution.multipliers.mu)
    assert all(torch.equal(a, b) for a, b in zip(loaded.multipliers.lam, solution.multipliers.lam, strict=True))
    frame = loaded.to_frame()
    assert list(frame.status) == [s.name for s in solution.statuses] and frame.cost.tolist() == solution.cost.tolist()
    with pytest.raises(InputError, match="path"):
        Solution.load(tmp_path / "absent.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(InputError, match="path"):
        Solution.load(tmp_path / "other.npz")


def test_hold_and_iterated_mppi() -> None:
    problem, U0 = planar_batch(B=2, N=20, obstacles=2)
    held = Hold().solve(problem, U0)
    torch.testing.assert_close(held.X, problem.x0.unsqueeze(1).expand_as(held.X), rtol=0, atol=1e-12)
    flown = IteratedMPPI(sampler=MPPI(samples=50, covariance=25.0), iterations=5).solve(problem, U0)
    assert bool((flown.cost < held.cost).all()) and flown.iterations.tolist() == [5, 5]
