"""The augmented Lagrangian L_M = J_var + J_con + J_gco at fixed multipliers, and the multiplier update."""

from copy import deepcopy
from dataclasses import dataclass

import numpy as np

from tests.reference.problem import constraint_rows, cost


@dataclass
class Multipliers:
    """lambda: spheres (N, M) for knots 1..N, bounds (N, 2m), and one array (p,) for each user function."""

    spheres: np.ndarray
    bounds: np.ndarray
    equalities: list[np.ndarray]
    inequalities: list[np.ndarray]

    @classmethod
    def zeros(cls, problem):
        """The paper's start, lambda = 0."""
        columns = 0 if problem.u_lower is None else 2 * problem.m
        functions = {}
        for block in ("equalities", "inequalities"):
            functions[block] = [np.zeros(len(g(problem.x0))) for _, g in getattr(problem, block)]
        return cls(np.zeros((problem.N, problem.M)), np.zeros((problem.N, columns)), **functions)

    def of(self, row):
        """The multiplier of one constraint row."""
        return getattr(self, row.block)[row.i][row.j]

    def copy(self):
        return deepcopy(self)


@dataclass
class Guide:
    """The guidance region: p (N+1, d) and r (N+1) in metres; the vehicle should be within r[k] of p[k]."""

    p: np.ndarray
    r: np.ndarray


def penalty_weight(row, lam, mu):
    """rho of Eq. (20): 0 for a satisfied inequality without multiplier, else mu."""
    if not row.equality and row.c < 0 and lam == 0:
        return 0.0
    return mu


def guide_value(problem, k, x, guide):
    """f_k = |p - p_guide|^2 - r_guide^2 in m^2, Eq. (62), and its gradient (n)."""
    offset = x[problem.position] - guide.p[k]
    f_x = np.zeros(problem.n)
    f_x[problem.position] = 2 * offset
    return offset @ offset - guide.r[k] ** 2, f_x


def guide_acts(problem, k, guide):
    """Whether guidance acts at knot k: neither at the given x_0 nor at the terminal knot."""
    return guide is not None and 1 <= k <= problem.N - 1


def lagrangian(problem, X, U, lam, mu, guide=None, mu_gco=0.0):
    """L_M(X, U), Eqs. (18), (19) and (63)-(65)."""
    J = cost(problem, X, U)
    for k in range(problem.N + 1):
        for row in constraint_rows(problem, k, X[k], U[k] if k < problem.N else None):
            rho = penalty_weight(row, lam.of(row), mu)
            if rho == 0 and lam.of(row) == 0:  # not 0 * c: c is -inf at an infinite bound
                continue
            J += lam.of(row) * row.c + rho / 2 * row.c**2
        if guide_acts(problem, k, guide):
            f, _ = guide_value(problem, k, X[k], guide)
            if f > 0:
                J += mu_gco / 2 * f**2
    return J


@dataclass
class Expansion:
    """Derivatives of one knot's terms: x (n), u (m), xx (n, n), ux (m, n), uu (m, m); no controls at N."""

    x: np.ndarray
    xx: np.ndarray
    u: np.ndarray | None = None
    ux: np.ndarray | None = None
    uu: np.ndarray | None = None


def cost_expansion(problem, k, x, u):
    """L_x, L_u, L_xx, L_ux, L_uu of Eqs. (48) and (49)."""
    e = x - problem.x_ref[k]
    if k == problem.N:
        return Expansion(problem.q_N + problem.S @ e, problem.S.copy())
    eu = u - problem.u_ref[k]
    L_x = problem.q + problem.Q @ e + problem.H.T @ eu
    L_u = problem.r + problem.R @ eu + problem.H @ e
    return Expansion(L_x, problem.Q.copy(), L_u, problem.H.copy(), problem.R.copy())


def expansion(problem, k, x, u, lam, mu, guide=None, mu_gco=0.0):
    """Knot k's terms of Eqs. (31)-(37) without V: cost, Gauss-Newton constraint terms, guide."""
    L = cost_expansion(problem, k, x, u)
    for row in constraint_rows(problem, k, x, u):
        rho = penalty_weight(row, lam.of(row), mu)
        if rho == 0 and lam.of(row) == 0:
            continue
        force = lam.of(row) + rho * row.c
        L.x += row.c_x * force
        L.xx += rho * np.outer(row.c_x, row.c_x)
        if k < problem.N:
            L.u += row.c_u * force
            L.ux += rho * np.outer(row.c_u, row.c_x)
            L.uu += rho * np.outer(row.c_u, row.c_u)
    if guide_acts(problem, k, guide):
        f, f_x = guide_value(problem, k, x, guide)
        if f > 0:
            L.x += mu_gco * f * f_x
            L.xx += mu_gco * np.outer(f_x, f_x)
    return L


def updated_multipliers(problem, X, U, lam, mu):
    """Eq. (21): lambda + mu c for equalities, max(0, lambda + mu c) for inequalities; a copy."""
    new = lam.copy()
    for k in range(problem.N + 1):
        for row in constraint_rows(problem, k, X[k], U[k] if k < problem.N else None):
            value = lam.of(row) + mu * row.c
            getattr(new, row.block)[row.i][row.j] = value if row.equality else max(0.0, value)
    return new
