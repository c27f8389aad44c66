"""Results of the interior point are rollouts: along its feedback, which closes gaps, unless there are none."""

from __future__ import annotations

import pytest
import torch

from tests.problems import planar_batch
from torchgco.kernels import followed, open_loop, rolled_out
from torchgco.lagrangian.quality import violation

D = torch.float64
NOISY = 1e8  # of gains that rounding decides on, beside rows as stiff as those of a tight solution


@pytest.mark.usefixtures("native")
def test_gains_of_rounding_move_no_controls() -> None:
    problem, _ = planar_batch(B=4, obstacles=1)
    U = 0.1 * torch.randn(4, problem.N, problem.m, dtype=D, generator=torch.Generator().manual_seed(0))
    X = open_loop(problem, U)
    X[1:3, 1:] *= 1.0 + torch.finfo(D).eps  # a difference in the last bit
    X[3, 1:] += 1e-6  # gaps
    K = torch.zeros(4, problem.N, problem.m, problem.n, dtype=D)
    K[1] = NOISY
    K[2:, :, :, 0] = -0.1
    along = followed(problem, X, U, K)
    assert not torch.allclose(along[1][1], U[1], rtol=0, atol=1e-9)
    gains = torch.nn.functional.pad(K, (0, 1), value=3.0)
    x, u, worst = rolled_out(problem, X, U, gains)
    torch.testing.assert_close(worst, violation(problem.constraints, x, u), rtol=1e-9, atol=1e-12)
    assert torch.equal(u[:2], U[:2])
    assert torch.equal(x[2:], along[0][2:]) and torch.equal(u[2:], along[1][2:])
    assert not torch.equal(u[3], U[3])
    for b in range(4):  # each alone, too
        row = torch.tensor([b])
        alone = rolled_out(problem.take(row), X[row], U[row], gains[row])
        assert torch.equal(alone[0], x[row]) and torch.equal(alone[1], u[row])
