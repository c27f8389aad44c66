"""The augmented Lagrangian against plain autodiff of its definition."""

import pytest
import torch

from tests.problems import planar_batch, quadrotor_batch, random_trajectory
from torchgco.constraints import FunctionConstraint, StateBounds
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers, penalty_weights, update_and_raise_penalty
from torchgco.lagrangian.penalties import GuidePath, GuideRegion
from torchgco.problem.problem import Problem

BATCHES = {"planar": planar_batch, "quadrotor": quadrotor_batch}


def _with_more(problem: Problem) -> Problem:
    """Every kind of constraint at once: a function of x and u, an equality at one knot, state bounds."""
    limit = torch.full((problem.n,), torch.inf, dtype=torch.float64)
    limit[0] = 0.5
    more = [
        FunctionConstraint(lambda x, u: x[..., :1] * u[..., :1] - 0.02, of="xu", knots=[1, 4, 7]),
        FunctionConstraint(lambda x: x[..., :2].square() - 0.1, sense="equality", knots=[-1]),
        StateBounds(-limit, limit),
    ]
    return Problem(problem.dynamics, problem.cost, [*problem.constraints, *more], problem.x0, problem.N)


def _random_multipliers(problem: Problem, X, U, mu: float = 7.0) -> Multipliers:
    torch.manual_seed(1)
    lam = [torch.rand_like(c.value(X, U)) * (torch.rand_like(c.value(X, U)) > 0.5) for c in problem.constraints]
    return Multipliers(tuple(lam), torch.linspace(mu, 2 * mu, problem.B, dtype=torch.float64))


def _guide(X, position) -> GuideRegion:
    guide = GuideRegion.inactive(X, torch.full_like(X[:, 0, 0], 3.0), position)
    guide.radius[:, 2:6] = 0.1
    guide.center[:, 2:6] += 0.4
    return guide


@pytest.mark.parametrize("batch", BATCHES)
def test_a_path_adds_the_derivatives_of_its_springs(batch: str) -> None:
    problem = BATCHES[batch](B=3, N=9)[0]
    X, U = random_trajectory(problem)
    at = problem.dynamics.position
    guide = GuidePath(X[..., at] + torch.rand_like(X[..., at]), torch.tensor([1.0, 2.0, 3.0]).double(), at)
    multipliers = Multipliers.zero(problem, 7.0)
    with_guide, without = (Lagrangian(problem, multipliers, g, True) for g in (guide, None))
    added = (with_guide.expand(X, U) - without.expand(X, U)).transpose(0, 1)
    gradient = torch.autograd.functional.jacobian(lambda X: guide.value(X).sum(), X)
    n = problem.n
    torch.testing.assert_close(added[..., :n, n], gradient, rtol=1e-9, atol=1e-7)
    torch.testing.assert_close(added[..., n, :n], gradient, rtol=1e-9, atol=1e-7)
    flat = torch.autograd.functional.hessian(lambda x: guide.value(x.view_as(X)).sum(), X.flatten())
    exact = flat.view(*X.shape, *X.shape)
    for b, k in ((0, 0), (1, 4), (2, 9)):
        torch.testing.assert_close(added[b, k, :n, :n], exact[b, k, :, b, k], rtol=1e-9, atol=1e-7)


@pytest.mark.parametrize("phr", [False, True])
@pytest.mark.parametrize("batch", BATCHES)
def test_gradient_is_the_derivative_of_the_value(batch: str, phr: bool) -> None:
    problem = _with_more(BATCHES[batch](B=3, N=9)[0])
    X, U = random_trajectory(problem)
    lagrangian = Lagrangian(problem, _random_multipliers(problem, X, U), _guide(X, problem.dynamics.position), phr)
    X_, U_ = X.clone().requires_grad_(), U.clone().requires_grad_()
    gX, gU = torch.autograd.grad(lagrangian.value(X_, U_)[1].sum(), (X_, U_))
    H, n = lagrangian.expand(X, U).transpose(0, 1), problem.n
    torch.testing.assert_close(H[..., :n, n], gX, rtol=1e-10, atol=1e-8)
    torch.testing.assert_close(H[:, :-1, n + 1 :, n], gU, rtol=1e-10, atol=1e-8)
    torch.testing.assert_close(H, H.mT, rtol=0, atol=1e-12)


@pytest.mark.parametrize("batch", BATCHES)
def test_hessian_is_gauss_newton(batch: str) -> None:
    """J_var's Hessian plus rho c_z' c_z, from autodiff Jacobians of every row."""
    problem = _with_more(BATCHES[batch](B=2, N=9)[0])
    X, U = random_trajectory(problem)
    multipliers, n = _random_multipliers(problem, X, U), problem.n
    guide = _guide(X, problem.dynamics.position)
    H = Lagrangian(problem, multipliers, guide, False).expand(X, U).transpose(0, 1)
    plain = Problem(problem.dynamics, problem.cost, [], problem.x0, problem.N)
    expected = Lagrangian(plain, Multipliers((), multipliers.mu), None, False).expand(X, U).transpose(0, 1)
    for constraint, lam in zip(problem.constraints, multipliers.lam, strict=True):
        c = constraint.value(X, U)
        rho = penalty_weights(constraint.sense, c, lam, multipliers.mu, False)
        knots = torch.arange(problem.N + 1)[constraint.knots]
        for b in range(problem.B):
            for j, k in enumerate(knots.tolist()):
                for i in range(c.shape[-1]):
                    x, u = X.clone().requires_grad_(), U.clone().requires_grad_()
                    gx, gu = torch.autograd.grad(
                        constraint.value(x, u)[b, j, i], (x, u), allow_unused=True, materialize_grads=True
                    )
                    z = torch.zeros(H.shape[-1], dtype=torch.float64)
                    z[:n] = gx[b, k]
                    if k < problem.N:
                        z[n + 1 :] = gu[b, k]
                    expected[b, k] += rho[b, j, i] * torch.outer(z, z)
    f = (X[..., guide.position] - guide.center).square().sum(-1) - guide.radius.square()
    fx = 2 * (X[..., guide.position] - guide.center)
    at = guide.position
    expected[..., at, at] += (3.0 * (f > 0))[..., None, None] * fx.unsqueeze(-1) * fx.unsqueeze(-2)
    n_block = torch.arange(H.shape[-1]) != n
    torch.testing.assert_close(
        H[..., n_block, :][..., n_block], expected[..., n_block, :][..., n_block], rtol=1e-10, atol=1e-9
    )


def test_printed_rule_of_the_penalty() -> None:
    """rho = 0 only where an inequality has c < 0 and lam = 0 (Equation 18)."""
    c = torch.tensor([[[-1.0], [-1.0], [0.0], [2.0]]], dtype=torch.float64)
    lam = torch.tensor([[[0.0], [0.5], [0.0], [0.0]]], dtype=torch.float64)
    mu = torch.tensor([4.0], dtype=torch.float64)
    assert penalty_weights("inequality", c, lam, mu, phr=False).flatten().tolist() == [0, 4, 4, 4]
    assert penalty_weights("inequality", c, lam, mu, phr=True).flatten().tolist() == [0, 0, 4, 4]


def test_phr_value_is_continuous_where_a_row_becomes_inactive() -> None:
    problem, _ = planar_batch(B=1, N=3, obstacles=1)
    spheres, mu, lam = problem.constraints[0], 4.0, 0.6
    X = problem.x0.unsqueeze(1).repeat(1, 4, 1)
    multipliers = Multipliers(
        (torch.full((1, 3, 1), lam, dtype=torch.float64), torch.zeros(1, 3, 4, dtype=torch.float64)),
        torch.tensor([mu], dtype=torch.float64),
    )
    U = torch.zeros(1, 3, 2, dtype=torch.float64)
    # Along a ray away from the disc, c passes -lam / mu.
    R = float(spheres.inflated_radii[0, 0])
    edge = (R**2 + lam / mu) ** 0.5
    values = []
    for gap in (edge - 1e-7, edge + 1e-7):
        X[:, 1:, :2] = spheres.centers[0, 0] + torch.tensor([gap, 0.0], dtype=torch.float64)
        cost, merit = Lagrangian(problem, multipliers, None, True).value(X, U)
        values.append(float(merit - cost))
    assert values[0] == pytest.approx(values[1], abs=1e-5)
    assert values[1] == pytest.approx(-3 * lam**2 / (2 * mu))


def test_update_of_multipliers_and_penalty() -> None:
    problem, _ = planar_batch(B=2, N=5)
    X, U = random_trajectory(problem)
    multipliers = _random_multipliers(problem, X, U)
    new = update_and_raise_penalty(problem, X, U, multipliers, 3.0, mu_max=30.0)
    for constraint, lam, after in zip(problem.constraints, multipliers.lam, new.lam, strict=True):
        expected = lam + multipliers.mu.view(-1, 1, 1) * constraint.value(X, U)
        torch.testing.assert_close(after, expected.clamp(min=0.0))
    assert new.mu.tolist() == [21.0, 30.0]
