"""The quadratic cost against its formula, its expansion against autodiff, and its errors."""

import pytest
import torch

from torchgco import Cost, FunctionDynamics, InputError, Problem, QuadraticCost
from torchgco.lagrangian.lagrangian import quadratise

n, m, N, B = 3, 2, 4, 3


def dynamics() -> FunctionDynamics:
    return FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u[..., :1]), -1), n, m, 0.1)


def problem_with(cost: Cost, batch: int = B) -> Problem:
    return Problem(dynamics(), cost, [], torch.zeros(batch, n, dtype=torch.float64), N)


def semidefinite(*shape: int, seed: int = 0) -> torch.Tensor:
    A = torch.randn(*shape, shape[-1], generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return A @ A.mT


def normal(*shape: int, seed: int = 5) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


FULL = {
    "shared": dict(Q=semidefinite(n), R=semidefinite(m, seed=1), Qf=semidefinite(n, seed=2), x_ref=normal(n)),
    "per knot": dict(
        Q=semidefinite(N, n), R=semidefinite(N, m, seed=1), Qf=semidefinite(n, seed=2), x_ref=normal(N + 1, n),
        u_ref=normal(N, m), q=normal(N, n), r=normal(N, m), qf=normal(n),
    ),
    "per problem": dict(
        Q=semidefinite(B, N, n) + 2 * torch.eye(n), R=semidefinite(B, N, m, seed=1) + 2 * torch.eye(m),
        Qf=semidefinite(B, n, seed=2), x_ref=normal(B, N + 1, n), u_ref=normal(B, N, m), q=normal(B, N, n),
        r=normal(B, N, m), qf=normal(B, n), H=0.1 * normal(B, N, m, n),
    ),
    "diagonal": dict(Q=[1, 2, 3], R=[4, 5], Qf=[6, 7, 8], x_ref=normal(B, 1, n), u_ref=0.5),
}  # fmt: skip


@pytest.mark.parametrize("kind", FULL)
def test_value_is_the_printed_formula(kind: str) -> None:
    given = FULL[kind]
    problem = problem_with(QuadraticCost(**given))
    X, U = normal(B, N + 1, n, seed=7), normal(B, N, m, seed=8)

    def part(name: str, b: int, k: int, size: int) -> torch.Tensor:
        value = torch.as_tensor(given.get(name, 0.0), dtype=torch.float64)
        matrix = name in ("Q", "R", "H")
        if matrix and value.dim() == 1:
            value = torch.diag(value)
        depth = value.dim() - (2 if matrix else 1)
        if depth >= 2:
            value = value[b, k if value.shape[1] > 1 else 0]
        elif depth == 1:
            value = value[k]
        return value.expand((m, n) if name == "H" else (size, size) if matrix else (size,))

    total = problem.cost.total(X, U)
    for b in range(B):
        value = 0.0
        for k in range(N):
            e, w = X[b, k] - part("x_ref", b, k, n), U[b, k] - part("u_ref", b, k, m)
            value += 0.5 * e @ part("Q", b, k, n) @ e + part("q", b, k, n) @ e
            value += 0.5 * w @ part("R", b, k, m) @ w + part("r", b, k, m) @ w + w @ part("H", b, k, n) @ e
        Qf = torch.as_tensor(given["Qf"], dtype=torch.float64)
        Qf = torch.diag(Qf) if Qf.dim() == 1 else Qf[b] if Qf.dim() == 3 else Qf
        qf = torch.as_tensor(given.get("qf", 0.0), dtype=torch.float64)
        qf = qf[b] if qf.dim() == 2 else qf.expand(n)
        e = X[b, N] - part("x_ref", b, N, n)
        value += 0.5 * e @ Qf @ e + qf @ e
        assert float(total[b]) == pytest.approx(float(value), rel=1e-12)


@pytest.mark.parametrize("kind", FULL)
def test_expansion_is_the_derivative(kind: str) -> None:
    problem = problem_with(QuadraticCost(**FULL[kind]))
    X, U = normal(B, N + 1, n, seed=7), normal(B, N, m, seed=8)
    H = quadratise(problem, X, U)
    expected = torch.zeros_like(H)
    Cost.expand(problem.cost, X, U, expected)  # the base class differentiates by torch.func
    torch.testing.assert_close(H, expected, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("kind", FULL)
def test_samples_have_the_cost_of_their_trajectories(kind: str) -> None:
    problem = problem_with(QuadraticCost(**FULL[kind]))
    X, U = normal(B, 6, N + 1, n, seed=7), normal(B, 6, N, m, seed=8)
    sampled = sum(problem.cost.stage(X[:, :, k], U[:, :, k], k) for k in range(N)) + problem.cost.terminal(X[:, :, N])
    for s in range(6):
        torch.testing.assert_close(sampled[:, s], problem.cost.total(X[:, s], U[:, s]))


def test_taking_problems() -> None:
    problem = problem_with(QuadraticCost(**FULL["per problem"]))
    X, U = normal(B, N + 1, n, seed=7), normal(B, N, m, seed=8)
    index = torch.tensor([2, 2, 0])
    torch.testing.assert_close(
        problem.take(index).cost.total(X[index], U[index]), problem.cost.total(X, U)[index], rtol=0, atol=0
    )


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (dict(Q=[1.0, -1.0, 1.0]), "cost.Q"),
        (dict(R=torch.tensor([[1.0, 2.0], [2.0, 1.0]], dtype=torch.float64)), "cost.R"),
        (dict(Qf=torch.tensor([[1.0, 1, 0], [0, 1, 0], [0, 0, 1]], dtype=torch.float64)), "cost.Qf"),
        (dict(H=10 * torch.ones(m, n, dtype=torch.float64)), "cost.H"),
        (dict(Q=[1.0, 1.0]), "cost.Q"),
        (dict(x_ref=torch.zeros(N, n, dtype=torch.float64)), "cost.x_ref"),
        (dict(x_ref=[float("nan"), 0, 0]), "cost.x_ref"),
        (dict(R=torch.eye(m)), "cost.R: expected dtype torch.float64 as in x0, got torch.float32"),
        (dict(Q="heavy"), "cost.Q"),
    ],
)
def test_bad_weights_are_named(change: dict, field: str) -> None:
    with pytest.raises(InputError, match=field):
        problem_with(QuadraticCost(**{**dict(Q=[1, 1, 1], R=[1, 1], Qf=[1, 1, 1]), **change}))
