"""Half-spaces at each knot: rows and derivatives against autodiff, and native kernels."""

from typing import Any

import pytest
import torch

from tests.engines import compiled, engine_of
from torchgco import ILQR, AugmentedLagrangian, ControlBounds, Problem, QuadraticCost, QuadrotorPlanning
from torchgco.base.errors import InputError
from torchgco.constraints.half_spaces import HalfSpaces, stacked
from torchgco.kernels import use_native, value
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers

B, N, R = 2, 6, 3
REST = [0.0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 9.81]


def drawn() -> tuple[Problem, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    normals = torch.randn(B, N, R, 3, generator=generator, dtype=torch.float64)
    normals /= normals.norm(dim=-1, keepdim=True)
    normals[0, 2, 1:], offsets = 0.0, 0.1 * torch.randn(B, N, R, generator=generator, dtype=torch.float64)
    offsets[0, 2, 1:] = -1.0
    goal = torch.tensor([1.0, 0.5, 0.2, *REST[3:]], dtype=torch.float64)
    cost = QuadraticCost(Q=[1.0] * 14, R=[1.0] * 4, Qf=[10.0] * 14, x_ref=goal, u_ref=[0, 0, 0, 9.81])
    x0 = torch.tensor([REST, REST], dtype=torch.float64)
    parts = [HalfSpaces(normals, offsets), ControlBounds([-5, -5, -5, 0.26], [5, 5, 5, 14.9])]
    problem = Problem(QuadrotorPlanning(dt=0.05), cost, parts, x0, N)
    X = x0.unsqueeze(1) + 0.2 * torch.randn(B, N + 1, 14, generator=generator, dtype=torch.float64)
    return problem, X, torch.randn(B, N, 4, generator=generator, dtype=torch.float64)


def test_rows_are_depths_beneath_the_planes() -> None:
    problem, X, U = drawn()
    spaces: Any = problem.constraints[0]
    for b in range(B):
        for k in range(N):
            for r in range(R):
                depth = spaces.offsets[b, k, r] - spaces.normals[b, k, r] @ X[b, k + 1, :3]
                assert spaces.value(X, U)[b, k, r] == pytest.approx(float(depth))


def test_derivatives_are_those_of_autodiff() -> None:
    problem, X, U = drawn()
    spaces: Any = problem.constraints[0]
    c = spaces.value(X, U)
    g, h = torch.randn_like(c), torch.rand_like(c)
    H = torch.zeros(B, N + 1, 19, 19, dtype=torch.float64)
    spaces.accumulate(X, U, g, h, H)
    free = X.clone().requires_grad_(True)
    (slope,) = torch.autograd.grad((g * spaces.value(free, U)).sum(), free)
    assert torch.allclose(H[..., :14, 14], slope)
    for b, k in ((0, 2), (1, 5)):
        J = torch.autograd.functional.jacobian(
            lambda p, b=b, k=k: spaces.value(_with(X, b, k, p), U)[b, k - 1], X[b, k, :3]
        )
        assert torch.allclose(H[b, k, :3, :3], J.mT @ torch.diag(h[b, k - 1]) @ J)


def _with(X: torch.Tensor, b: int, k: int, p: torch.Tensor) -> torch.Tensor:
    rows = [[X[i, j] if (i, j) != (b, k) else torch.cat((p, X[i, j, 3:])) for j in range(N + 1)] for i in range(B)]
    return torch.stack([torch.stack(row) for row in rows])


@compiled
def test_native_kernels_know_them() -> None:
    problem, X, U = drawn()
    engine = engine_of(problem)
    assert engine is not None and engine.measures
    lagrangian = Lagrangian(problem, Multipliers.zero(problem, 3.0), None, True)
    native = value(lagrangian, X, U)[1]
    use_native(False)
    try:
        eager = value(Lagrangian(problem.renewed(), Multipliers.zero(problem, 3.0), None, True), X, U)[1]
    finally:
        use_native(True)
    assert torch.allclose(native, eager, rtol=1e-12)


def test_a_solve_stays_on_the_free_side() -> None:
    problem, _, U = drawn()
    normals = torch.zeros(B, N, 1, 3, dtype=torch.float64)
    normals[..., 0] = -1.0
    wall = HalfSpaces(normals, torch.full((B, N, 1), -0.002, dtype=torch.float64))  # p_x <= 0.002
    walled = problem.started_at(problem.x0, [wall, problem.constraints[1]])
    solver = AugmentedLagrangian(ILQR(max_iterations=20), max_outer_iterations=20)
    start = torch.zeros_like(U) + torch.tensor([0, 0, 0, 9.81], dtype=torch.float64)
    X = solver.solve(walled, start).X
    assert float(X[..., 0].max()) <= 0.0031


def test_stacked_planes_are_moved_into_the_free_side() -> None:
    planes = torch.tensor([[[[1.0, 0, 0, 2.0], [0, 0, 0, 0]]]], dtype=torch.float64)
    normals, offsets = stacked(planes, torch.tensor([[[0.3]]], dtype=torch.float64))
    assert normals.shape == (1, 1, 2, 3) and offsets.tolist() == [[[2.3, -1.0]]]


def test_wrong_shapes_are_named() -> None:
    problem, _, _ = drawn()
    spaces: Any = problem.constraints[0]
    with pytest.raises(InputError, match=r"half_spaces\.offsets"):
        Problem(problem.dynamics, problem.cost, [HalfSpaces(spaces.normals, spaces.offsets[:, :-1])], problem.x0, N)
