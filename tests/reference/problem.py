"""One optimal control problem: J_var, the dynamics and every scalar constraint as a row. c <= 0 is feasible.

Letters: N stages, n state, m control, M obstacles, d position dimension, k the knot. x_0 is given.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass
class ReferenceProblem:
    """min J_var(X, U) s.t. x_{k+1} = step(x_k, u_k), x_0 = x0, spheres, control bounds, user constraints.

    Shapes: Q, S (n, n) and R (m, m) symmetric; q, q_N (n), r (m), H (m, n) default to zero; x_ref (N+1, n)
    or (n); u_ref (N, m) or (m); centers, velocities (M, d); an obstacle's centre at knot k is
    center + velocity k dt; contact (M) = r_obs + r_veh; u_lower, u_upper (m) or None.
    `equalities` and `inequalities` hold pairs (knot, function of x -> (p,)) that also work for complex x.
    """

    step: Callable
    x0: np.ndarray
    N: int
    Q: np.ndarray
    R: np.ndarray
    S: np.ndarray
    x_ref: np.ndarray
    u_ref: np.ndarray
    q: np.ndarray | None = None
    r: np.ndarray | None = None
    q_N: np.ndarray | None = None
    H: np.ndarray | None = None
    position: Sequence[int] = (0, 1)
    centers: np.ndarray | None = None
    velocities: np.ndarray | None = None
    dt: float = 0.0
    contact: np.ndarray | None = None
    u_lower: np.ndarray | None = None
    u_upper: np.ndarray | None = None
    equalities: Sequence[tuple[int, Callable]] = ()
    inequalities: Sequence[tuple[int, Callable]] = ()

    def __post_init__(self):
        n, m, d = len(self.x0), len(self.R), len(self.position)
        self.x0 = np.array(self.x0, dtype=float)
        self.x_ref = np.array(np.broadcast_to(self.x_ref, (self.N + 1, n)), dtype=float)
        self.u_ref = np.array(np.broadcast_to(self.u_ref, (self.N, m)), dtype=float)
        self.position = list(self.position)
        for name, shape in dict(Q=(n, n), S=(n, n), R=(m, m), q=(n,), q_N=(n,), r=(m,), H=(m, n)).items():
            value = getattr(self, name)
            value = np.zeros(shape) if value is None else np.array(value, dtype=float)
            if value.shape != shape:
                raise ValueError(f"{name} has shape {value.shape}, expected {shape}")
            setattr(self, name, value)
        if (self.u_lower is None) != (self.u_upper is None):
            raise ValueError("give both control bounds or none; an infinite bound is allowed")
        self.centers = np.zeros((0, d)) if self.centers is None else np.array(self.centers, dtype=float)
        self.contact = np.zeros(0) if self.contact is None else np.array(self.contact, dtype=float)
        if self.velocities is None:
            self.velocities = np.zeros_like(self.centers)
        if self.centers.shape != (len(self.contact), d) or np.shape(self.velocities) != self.centers.shape:
            raise ValueError("centers and velocities must be (M, d) with M contact distances")

    @property
    def n(self):
        return len(self.x0)

    @property
    def m(self):
        return len(self.R)

    @property
    def M(self):
        return len(self.contact)

    def center(self, i, k):
        """Centre (d) of obstacle i at knot k, in metres."""
        return self.centers[i] + np.asarray(self.velocities[i]) * (k * self.dt)


def complex_jacobian(function, z):
    """Jacobian (p, len(z)) of function: (len(z),) -> (p,) by the complex step, exact to rounding."""
    z = np.asarray(z, dtype=float)
    h = 1e-30
    columns = []
    for j in range(len(z)):
        shifted = z.astype(complex)
        shifted[j] += 1j * h
        columns.append(np.imag(function(shifted)) / h)
    return np.stack(columns, axis=1)


def step_jacobians(problem, x, u):
    """f_x (n, n) and f_u (n, m) of the step at one knot."""
    f_x = complex_jacobian(lambda z: problem.step(z, u), x)
    f_u = complex_jacobian(lambda z: problem.step(x, z), u)
    return f_x, f_u


def rollout(problem, U):
    """X (N+1, n) from x0 under U (N, m): 'Predict X using U and x0'."""
    X = np.zeros((problem.N + 1, problem.n))
    X[0] = problem.x0
    for k in range(problem.N):
        X[k + 1] = problem.step(X[k], U[k])
    return X


def stage_cost(problem, k, x, u):
    """L_k(x, u), Eq. (49)."""
    e, eu = x - problem.x_ref[k], u - problem.u_ref[k]
    linear = problem.q @ e + problem.r @ eu
    return linear + 0.5 * e @ problem.Q @ e + 0.5 * eu @ problem.R @ eu + eu @ problem.H @ e


def terminal_cost(problem, x):
    """L_N(x), Eq. (48)."""
    e = x - problem.x_ref[problem.N]
    return problem.q_N @ e + 0.5 * e @ problem.S @ e


def cost(problem, X, U):
    """J_var(X, U), Eq. (14); k = 0 included."""
    J = 0.0
    for k in range(problem.N):
        J += stage_cost(problem, k, X[k], U[k])
    return J + terminal_cost(problem, X[problem.N])


@dataclass
class Row:
    """One scalar constraint at one knot, c_x (n), c_u (m). Its multiplier is `lam.block[i][j]`."""

    block: str
    i: int
    j: int
    equality: bool
    c: float
    c_x: np.ndarray
    c_u: np.ndarray


def sphere_rows(problem, k, x):
    """Eq. (52), knots 1..N: c = R^2 - |o - p|^2 in m^2; multiplier row k-1, column = obstacle."""
    rows = []
    for i in range(problem.M if k >= 1 else 0):
        offset = x[problem.position] - problem.center(i, k)
        c_x = np.zeros(problem.n)
        c_x[problem.position] = -2 * offset
        c = problem.contact[i] ** 2 - offset @ offset
        rows.append(Row("spheres", k - 1, i, False, c, c_x, np.zeros(problem.m)))
    return rows


def bound_rows(problem, k, u):
    """Knots 0..N-1: c = [u - upper, lower - u] in the control's units; multiplier row k, 2m columns."""
    rows = []
    if problem.u_lower is None or k == problem.N:
        return rows
    zero, unit = np.zeros(problem.n), np.eye(problem.m)
    for j in range(problem.m):
        rows.append(Row("bounds", k, j, False, u[j] - problem.u_upper[j], zero, unit[j]))
    for j in range(problem.m):
        rows.append(Row("bounds", k, problem.m + j, False, problem.u_lower[j] - u[j], zero, -unit[j]))
    return rows


def function_rows(problem, k, x, block):
    """User functions of the state at knot k; multiplier i is the entry in the list, j the component."""
    rows = []
    for i, (knot, function) in enumerate(getattr(problem, block)):
        if knot == k:
            values, jacobian, zero = function(x), complex_jacobian(function, x), np.zeros(problem.m)
            for j in range(len(values)):
                rows.append(Row(block, i, j, block == "equalities", values[j], jacobian[j], zero))
    return rows


def constraint_rows(problem, k, x, u):
    """All scalar constraints at knot k: spheres, bounds, equalities, inequalities. u is None at k = N."""
    rows = sphere_rows(problem, k, x) + bound_rows(problem, k, u)
    rows += function_rows(problem, k, x, "equalities")
    return rows + function_rows(problem, k, x, "inequalities")
