"""Compiled kernels against eager ones, and what happens where nothing can be compiled."""

import pytest
import torch

from tests.problems import planar_batch, quadrotor_batch
from torchgco import GCO, ILQR, MPPI, AugmentedLagrangian
from torchgco.draws import DrawKey
from torchgco.kernels import compile_kernels, compiling, kernel
from torchgco.rollout import closed_loop, open_loop
from torchgco.solvers.riccati import _fused_stage, _Stage, backward

BATCHES = {"planar": planar_batch, "quadrotor": quadrotor_batch}


@pytest.fixture
def compiled():
    compile_kernels(True)
    yield
    compile_kernels(False)
    torch._dynamo.reset()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("batch", BATCHES)
def test_compiled_kernels_equal_eager_ones(batch: str, compiled) -> None:
    """Rollouts to 1e-12, sampled plans to 1e-6: what fused single-precision sums may differ by."""
    problem, U = BATCHES[batch](B=5, N=12)
    G = 0.05 * torch.randn(12, 5, problem.m, problem.n + 1, generator=torch.Generator().manual_seed(0)).double()
    alpha = torch.linspace(0.1, 1.0, 5, dtype=torch.float64)
    X = open_loop(problem.dynamics, problem.x0, U)
    key = DrawKey(0, torch.arange(5), torch.ones(5, dtype=torch.int64))
    results = []
    for on in (True, False):
        compile_kernels(on)
        rolled = closed_loop(problem.dynamics, X, U, G, alpha)
        free = open_loop(problem.dynamics, problem.x0, U), open_loop(problem.dynamics, problem.x0[:2], U[:2])
        fewer = closed_loop(problem.dynamics, X[:3], U[:3], G[:, :3], alpha[:3])
        kinds = (4, 0) if batch == "planar" else (4,)  # smooth, and white noise
        plans = [MPPI(samples=24, knots=knots, rounds=2).improve(problem, U, key)[1] for knots in kinds]
        results.append((*rolled, *fewer, *free, *plans))
    for fused, eager in zip(*results, strict=True):
        torch.testing.assert_close(fused, eager, rtol=1e-6, atol=1e-6)
    for fused, eager in zip(results[0][:6], results[1][:6], strict=True):
        torch.testing.assert_close(fused, eager, rtol=1e-12, atol=1e-12)


def test_the_fused_stage_of_the_backward_pass_equals_the_plain_one() -> None:
    """As it stands, before any compiling: in elements with mu_r, without, and where the pivots turn negative."""
    A = torch.randn(6, 9, 9, generator=torch.Generator().manual_seed(3)).double()
    Q = A @ A.mT + torch.eye(9)
    Q[5] -= 40.0 * torch.eye(9)
    mu, G = torch.tensor([0.0, 0.5, 0.0, 3.0, 0.0, 0.0]).double(), torch.empty(6, 2, 7).double()
    gains, *fused = _fused_stage(Q, mu, G)
    stage = _Stage(torch.empty(1, 6, 7, 9).double())
    stage.Q.copy_(Q)
    plain = stage.eliminate(mu, G)
    for one, other in zip((gains, *fused), (G, *plain), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)
    assert (plain[-1] > 0).tolist() == [True] * 5 + [False]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_compiled_backward_pass_equals_the_eager_one(compiled) -> None:
    draw = torch.Generator().manual_seed(1)
    for B in (5, 3):
        F = 0.3 * torch.randn(6, B, 5, 7, generator=draw).double()
        A = torch.randn(7, B, 7, 7, generator=draw).double()
        H, mu = A @ A.mT + torch.eye(7), torch.linspace(0.0, 1.0, B).double()
        compile_kernels(True)
        fused = backward(F, H, mu)
        compile_kernels(False)
        for one, other in zip(fused, backward(F, H, mu), strict=True):
            torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_compiled_solve_ends_where_the_eager_one_does(compiled) -> None:
    problem, U0 = planar_batch(B=4, N=20, obstacles=9, seed=4)
    solver = AugmentedLagrangian(
        inner=ILQR(max_iterations=8), guidance=GCO(sampler=MPPI(samples=20, knots=4)), max_outer_iterations=6, clip=True
    )
    fused = solver.solve(problem, U0)
    compile_kernels(False)
    eager = solver.solve(problem, U0)
    assert fused.statuses == eager.statuses
    torch.testing.assert_close(fused.cost, eager.cost, rtol=1e-3, atol=1e-3)


def test_kernels_run_eagerly_where_nothing_can_be_compiled(monkeypatch) -> None:
    def refuse(function, **options):
        def call(*args):
            raise torch._dynamo.exc.BackendCompilerFailed(call, RuntimeError("no C++ compiler"), None)

        return call

    monkeypatch.setattr(torch, "compile", refuse)
    compile_kernels(True)
    try:
        double = kernel(lambda x: 2 * x)
        with pytest.warns(UserWarning, match="run eagerly"):
            assert double(torch.ones(())) == 2
        assert not compiling()
    finally:
        compile_kernels(False)
