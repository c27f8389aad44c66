"""iLQR: exact optima, statuses, regularisation, and the line search."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from tests.problems import planar_batch
from tests.solvers.problems import linear_problem, zeros
from torchgco import ILQR, AugmentedLagrangian, Cost, FunctionConstraint, LineSearch, Problem, Solution, Status
from torchgco.ilqr import line_search
from torchgco.ilqr import step as iteration
from torchgco.ilqr.riccati import backward


def test_lqr_is_solved_in_one_step() -> None:
    """Linear dynamics and quadratic cost: the optimum of one dense least-squares problem."""
    problem = linear_problem()
    solution = ILQR(tolerance=1e-12).solve(problem, zeros(problem))
    A, b = np.array([[1, 0.2], [0, 1]]), np.array([[0], [0.2]])
    Q, R, Qf = np.diag([1, 0.1]), 0.1 * np.eye(1), np.diag([5.0, 1])
    powers = [np.linalg.matrix_power(A, k) for k in range(9)]
    free = np.concatenate(powers)  # X = free x0 + forced U
    forced = np.zeros((18, 8))
    for k in range(1, 9):
        for j in range(k):
            forced[2 * k : 2 * k + 2, j : j + 1] = powers[k - 1 - j] @ b
    W = np.kron(np.eye(9), Q)
    W[-2:, -2:] = Qf
    for i in range(2):
        U = -np.linalg.solve(forced.T @ W @ forced + np.kron(np.eye(8), R), forced.T @ W @ free @ problem.x0[i].numpy())
        np.testing.assert_allclose(solution.U[i, :, 0], U, rtol=1e-10, atol=1e-12)
    assert solution.statuses == [Status.CONVERGED] * 2
    assert solution.iterations.tolist() == [2, 2]  # one step, and one iteration that finds no decrease
    # The returned gains belong to the optimum, where the feed-forward is zero.
    torch.testing.assert_close(solution.d, torch.zeros_like(solution.d), rtol=0, atol=1e-10)


def test_backward_pass_satisfies_the_general_recursion() -> None:
    """With mu_r > 0, V of the homogeneous form is Vxx = Qxx + K'Qux + Qxu K + K'Quu K, and so on (Equations 43, 44)."""
    torch.manual_seed(0)
    n, m, N, B = 3, 2, 1, 2
    F = torch.zeros(N, B, n + 1, n + 1 + m, dtype=torch.float64)
    F[..., :n, :] = torch.randn(N, B, n, n + 1 + m, dtype=torch.float64)
    F[..., n, n] = 1.0
    A = torch.randn(N + 1, B, n + 1 + m, n + 1 + m, dtype=torch.float64)
    H = A @ A.mT
    mu = torch.tensor([0.0, 0.7], dtype=torch.float64)
    step = backward(F, H, mu)
    Q = H[0] + F[0].mT @ H[1, :, : n + 1, : n + 1] @ F[0]
    u, z = slice(n + 1, None), slice(0, n + 1)
    regular = Q[:, u, u] + mu.view(-1, 1, 1) * torch.eye(m)
    G = -torch.linalg.solve(regular, Q[:, u, z])
    torch.testing.assert_close(step.gains[0], G)
    d = G[..., n : n + 1]
    torch.testing.assert_close(step.linear, (Q[:, u, n : n + 1] * d).sum((1, 2)))
    torch.testing.assert_close(step.quadratic, (d * (Q[:, u, u] @ d)).sum((1, 2)))


@dataclass(frozen=True)
class Saddle(Cost):
    """A cost that is concave in u: the backward pass needs regularisation, or fails."""

    concavity: float

    def stage(self, x, u, k):
        return x.square().sum(-1) - 0.5 * self.concavity * (1 - torch.exp(-u.square().sum(-1)))

    def terminal(self, x):
        return x.square().sum(-1)


def saddle(concavity: float) -> Problem:
    flat = linear_problem()
    return Problem(flat.dynamics, Saddle(concavity), [], flat.x0, flat.N)


def test_regularisation_rises_until_the_pass_succeeds() -> None:
    problem = saddle(1.0)
    solver = AugmentedLagrangian(inner=ILQR(max_iterations=3), max_outer_iterations=1, record=True)
    solution = solver.solve(problem, zeros(problem))
    assert solution.trace is not None and float(solution.trace.regularisation.max()) > 0.1
    assert bool(torch.isfinite(solution.cost).all())


def test_statuses(monkeypatch) -> None:
    problem, U0 = planar_batch(B=2, N=20)
    free = replace(problem, constraints=[])
    assert ILQR(max_iterations=1).solve(free, U0).statuses == [Status.MAX_ITERATIONS] * 2
    with monkeypatch.context() as patch:
        patch.setattr(LineSearch, "ratio_min", 5.0)
        stubborn = ILQR().solve(free, U0)
    assert stubborn.statuses == [Status.LINE_SEARCH_FAILED] * 2
    assert torch.equal(stubborn.U, U0)
    impossible = FunctionConstraint(lambda x: x[..., :1].square() + 1.0, sense="equality", knots=[-1])
    walled = linear_problem(constraints=[impossible])
    cut = AugmentedLagrangian(max_outer_iterations=2)
    assert cut.solve(walled, zeros(walled)).statuses == [Status.MAX_ITERATIONS] * 2
    monkeypatch.setattr(iteration, "REGULARISATION_MAX", 1e-4)
    hopeless = ILQR().solve(saddle(1.0), zeros(saddle(1.0)))
    assert hopeless.statuses == [Status.NOT_POSITIVE_DEFINITE] * 2
    assert all(status.sentence for status in Status)


def steep() -> Problem:
    """A step that overshoots: full Gauss-Newton steps on a strongly curved constraint are refused."""
    curved = FunctionConstraint(lambda x: (8 * x[..., :1]).sin() - 0.5 * x[..., 1:].square(), sense="equality")
    return linear_problem(constraints=[curved])


def steep_run(monkeypatch, as_printed: bool = False, smallest: float = 1e-4, back: int | None = None) -> Solution:
    monkeypatch.setattr(LineSearch, "ratio_min", 0.95)
    monkeypatch.setattr(LineSearch, "smallest", smallest)
    inner = ILQR(as_printed, max_iterations=25, tolerance=1e-6, line_search=LineSearch(back))
    return AugmentedLagrangian(inner=inner, max_outer_iterations=3, record=True).solve(steep(), zeros(steep()))


def test_the_smallest_step_is_accepted_as_printed_and_refused_otherwise(monkeypatch) -> None:
    short, printed = steep_run(monkeypatch, smallest=0.4), steep_run(monkeypatch, True, smallest=0.4)
    assert set(short.trace.alpha) <= {1.0, 0.5, 0.0} and (short.trace.alpha == 0).any()
    assert set(printed.trace.alpha) <= {1.0, 0.5, 0.25} and (printed.trace.alpha == 0.25).any()
    assert ((steep_run(monkeypatch).trace.alpha > 0) & (steep_run(monkeypatch).trace.alpha < 0.5)).any()


def test_a_failed_search_raises_the_regularisation_and_L_M_never_rises(monkeypatch) -> None:
    damped, printed = steep_run(monkeypatch, smallest=0.4), steep_run(monkeypatch, True, smallest=0.4)
    assert float(damped.trace.regularisation.max()) > 0.0 and float(printed.trace.regularisation.max()) == 0.0
    assert (damped.trace.groupby(["element", "outer"]).merit.diff().dropna() <= 1e-12).all()


def test_a_search_starts_a_little_above_the_last_accepted_rung(monkeypatch) -> None:
    plain, kept = steep_run(monkeypatch), steep_run(monkeypatch, back=1)
    grown = {}
    for name, run in (("plain", plain), ("kept", kept)):
        alpha = run.trace[run.trace.alpha > 0].groupby(["element", "outer"]).alpha
        grown[name] = (alpha.shift(-1) / run.trace.alpha).max()
    assert grown["plain"] > 2.0 and grown["kept"] <= 2.0
    assert bool((kept.violation <= 2.0 * plain.violation + 1e-6).all())


@pytest.mark.slow
@pytest.mark.parametrize("native", ["eager"], indirect=True)
def test_parallel_and_sequential_line_searches_agree(native: bool, monkeypatch) -> None:
    many = steep_run(monkeypatch)
    monkeypatch.setattr(line_search, "PARALLEL", 1)
    monkeypatch.setattr(line_search, "SIDE_BY_SIDE", 1)
    one = steep_run(monkeypatch)
    torch.testing.assert_close(one.U, many.U, rtol=1e-9, atol=1e-9)
    assert one.iterations.tolist() == many.iterations.tolist()
