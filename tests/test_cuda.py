"""A solve on a CUDA device equals that on the CPU; skipped without a device."""

import pytest
import torch

from tests.problems import planar_batch
from torchgco import GCO, ILQR, MPPI, AugmentedLagrangian, ControlBounds, QuadraticCost, Spheres
from torchgco.problem.problem import Problem

pytestmark = [pytest.mark.cuda, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]


def test_gpu_and_cpu_agree() -> None:
    problem, U0 = planar_batch(B=3, N=15, obstacles=4)
    spheres, bounds = problem.constraints
    moved = Problem(
        problem.dynamics,
        QuadraticCost([5, 5, 1e-8, 1, 1, 1e-8], [0.1, 0.1], [50, 50, 1e-8, 1, 1, 1e-8], x_ref=[1, 0.4, 0, 0, 0, 0]),
        [
            Spheres(
                torch.where(spheres.absent.unsqueeze(-1), torch.nan, spheres.centers).cuda(),
                torch.where(spheres.absent, torch.nan, spheres.inflated_radii - 0.06).cuda(),
                0.06,
            ),
            ControlBounds(bounds.lower.cuda(), bounds.upper.cuda()),
        ],
        problem.x0.cuda(),
        problem.N,
    )
    solver = AugmentedLagrangian(
        inner=ILQR(max_iterations=5), guidance=GCO(sampler=MPPI(samples=10)), max_outer_iterations=3
    )
    on_cpu, on_gpu = solver.solve(problem, U0), solver.solve(moved, U0.cuda())
    torch.testing.assert_close(on_gpu.U.cpu(), on_cpu.U, rtol=1e-6, atol=1e-6)
    assert on_gpu.status.tolist() == on_cpu.status.tolist()
