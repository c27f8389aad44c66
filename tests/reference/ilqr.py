"""Algorithm 2: iLQR on L_M with multipliers, penalties and guide held fixed."""

from dataclasses import dataclass

import numpy as np

from tests.reference.lagrangian import expansion, lagrangian
from tests.reference.problem import step_jacobians

REGULARISATION = (0.0, *(10.0**e for e in range(-6, 11)))
EPS_MIN, EPS_MAX = 1e-4, 10.0
ALPHA_MIN, PHI = 1e-4, 0.5
ZERO_DECREASE = 1e-14


@dataclass
class Backward:
    """Gains K (N, m, n), d (N, m), the two sums of the expected decrease, and the mu_r used."""

    K: np.ndarray
    d: np.ndarray
    Qu_d: float
    d_Quu_d: float
    mu_r: float

    def expected(self, alpha):
        """Predicted change of L_M for a step alpha; Eq. (45) with the factor 1/2."""
        return alpha * self.Qu_d + alpha**2 / 2 * self.d_Quu_d


@dataclass
class Iteration:
    """One pass of Algorithm 2's outer `while`: the trajectory after it. alpha = 0: no step, eps is nan."""

    X: np.ndarray
    U: np.ndarray
    cost: float
    alpha: float
    eps: float
    mu_r: float
    expected: float


@dataclass
class InnerResult:
    """X (N+1, n), U (N, m), L_M there, one record per iteration.

    status: converged, max_iterations, not_positive_definite or non_finite.
    """

    X: np.ndarray
    U: np.ndarray
    cost: float
    records: list[Iteration]
    status: str


def backward(problem, X, U, lam, mu, guide, mu_gco, mu_r):
    """Lines 4-13 with one mu_r: gains from k = N-1 to 0. LinAlgError where Quu + mu_r I is not positive."""
    N, n, m = problem.N, problem.n, problem.m
    result = Backward(np.zeros((N, m, n)), np.zeros((N, m)), 0.0, 0.0, mu_r)
    terminal = expansion(problem, N, X[N], None, lam, mu, guide, mu_gco)
    V_x, V_xx = terminal.x, terminal.xx
    for k in range(N - 1, -1, -1):
        L = expansion(problem, k, X[k], U[k], lam, mu, guide, mu_gco)
        f_x, f_u = step_jacobians(problem, X[k], U[k])
        Q_x = L.x + f_x.T @ V_x
        Q_u = L.u + f_u.T @ V_x
        Q_xx = L.xx + f_x.T @ V_xx @ f_x
        Q_ux = L.ux + f_u.T @ V_xx @ f_x
        Q_uu = L.uu + f_u.T @ V_xx @ f_u

        regular = Q_uu + mu_r * np.eye(m)
        np.linalg.cholesky(regular)  # raises LinAlgError where it is not positive definite
        d = -np.linalg.solve(regular, Q_u)
        K = -np.linalg.solve(regular, Q_ux)

        V_x = Q_x + K.T @ Q_u + Q_ux.T @ d + K.T @ Q_uu @ d
        V_xx = Q_xx + K.T @ Q_ux + Q_ux.T @ K + K.T @ Q_uu @ K
        V_xx = (V_xx + V_xx.T) / 2
        result.K[k], result.d[k] = K, d
        result.Qu_d += Q_u @ d
        result.d_Quu_d += d @ Q_uu @ d
    return result


def regularised_backward(problem, X, U, lam, mu, guide, mu_gco):
    """Lines 3-13: the first mu_r of REGULARISATION for which every stage factors, or None."""
    for mu_r in REGULARISATION:
        try:
            return backward(problem, X, U, lam, mu, guide, mu_gco, mu_r)
        except np.linalg.LinAlgError:
            continue
    return None


def forward(problem, X, U, gains, alpha):
    """Line 16: u = u_old + K (x - x_old) + alpha d, Eqs. (15) and (47). Returns new X (N+1, n), U (N, m)."""
    X_new, U_new = np.zeros_like(X), np.zeros_like(U)
    X_new[0] = X[0]
    for k in range(problem.N):
        U_new[k] = U[k] + gains.K[k] @ (X_new[k] - X[k]) + alpha * gains.d[k]
        X_new[k + 1] = problem.step(X_new[k], U_new[k])
    return X_new, U_new


def line_search(problem, X, U, J_prev, gains, lam, mu, guide, mu_gco):
    """Lines 14-24: halve alpha until eps is within its limits, or alpha < 1e-4: then step anyway."""
    alpha = 1.0
    while True:
        # A long step may overflow; nan and inf then fail the test on eps.
        with np.errstate(over="ignore", invalid="ignore"):
            X_new, U_new = forward(problem, X, U, gains, alpha)
            J_curr = lagrangian(problem, X_new, U_new, lam, mu, guide, mu_gco)
            eps = (J_curr - J_prev) / gains.expected(alpha)
        if EPS_MIN <= eps <= EPS_MAX or alpha < ALPHA_MIN:
            return Iteration(X_new, U_new, J_curr, alpha, eps, gains.mu_r, gains.expected(alpha))
        alpha = PHI * alpha


def ilqr(problem, X, U, lam, mu, guide=None, mu_gco=0.0, tolerance=1e-18, max_iterations=100):
    """Algorithm 2 from a trajectory X (N+1, n), U (N, m) that already satisfies the dynamics."""
    J_prev = lagrangian(problem, X, U, lam, mu, guide, mu_gco)
    records = []
    for _ in range(max_iterations):
        gains = regularised_backward(problem, X, U, lam, mu, guide, mu_gco)
        if gains is None:
            return InnerResult(X, U, J_prev, records, "not_positive_definite")
        if abs(gains.expected(1.0)) <= ZERO_DECREASE * max(1.0, abs(J_prev)):
            records.append(Iteration(X, U, J_prev, 0.0, np.nan, gains.mu_r, gains.expected(1.0)))
            return InnerResult(X, U, J_prev, records, "converged")

        taken = line_search(problem, X, U, J_prev, gains, lam, mu, guide, mu_gco)
        if not np.isfinite(taken.cost):
            return InnerResult(X, U, J_prev, records, "non_finite")
        records.append(taken)
        X, U = taken.X, taken.U
        if abs(taken.cost - J_prev) < tolerance:
            return InnerResult(X, U, taken.cost, records, "converged")
        J_prev = taken.cost
    return InnerResult(X, U, J_prev, records, "max_iterations")
