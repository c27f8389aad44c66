"""The tracking problem of Table 5 as a dense nonlinear program, solved by SciPy's SLSQP for one state.

Variables are the thrusts at knots 1..N: rates follow from them by Euler steps, and rotor speeds by solving the Euler
step of the thrusts. Sums and limits of the thrusts are then linear.
"""

import numpy as np
from scipy.optimize import minimize

from tests.reference import models

SCALE = 1e4  # of the cost, for the tolerance of SLSQP


def rollout(x0, U, dt, parameters):
    """States (N+1, 7) = [w, F] from x0 (7) under rotor speeds U (N, 4), rpm; complex where an argument is."""
    step = models.euler(lambda x, u: models.rotor_field(x, u, parameters), dt)
    X = [x0]
    for u in U:
        X.append(step(X[-1], u))
    return np.array(X)


def cost(X, U, rates, parameters, effort=1e-2):
    """1/2 of the weighted squares: rates by 1, thrusts and speeds from hover by b^2 and effort b^2; rates (N+1, 3)."""
    b, hover = parameters.b, parameters.mass * parameters.gravity / 4
    J = 0.0
    for k in range(len(X)):
        w, F = X[k][:3], X[k][3:]
        J = J + 0.5 * ((w - rates[k]) ** 2).sum() + 0.5 * b**2 * ((F - hover) ** 2).sum()
        if k < len(U):
            J = J + 0.5 * effort * b**2 * ((U[k] - parameters.hover_rpm) ** 2).sum()
    return J


def solve(x0, rates, acceleration, dt, parameters=None, commands=False, effort=1e-2):
    """Optimal states (N+1, 7) and rotor speeds (N, 4), for references rates (N+1, 3), acceleration (N,) at 1..N.

    With `commands`, rotor speeds are those that hold thrusts within their limits.
    """
    parameters = parameters or models.QuadrotorParameters()
    N = len(acceleration)

    def trajectory(z):
        """States and rotor speeds for thrusts z (4 N,) at knots 1..N."""
        F, w, U = z.reshape(N, 4), x0[:3], []
        X = [x0.astype(z.dtype)]
        for k in range(N):
            before = X[k][3:]
            w = w + dt * models.angular_acceleration(w, before, parameters)
            root = np.sqrt(before)
            U.append((root + (F[k] - before) / dt * parameters.T_r / (2 * root)) / np.sqrt(parameters.b))
            X.append(np.concatenate([w, F[k]]))
        return np.array(X), np.array(U)

    def objective(z):
        return SCALE * cost(*trajectory(z), rates, parameters, effort)

    def gradient(z):
        return np.array([objective(z + 1e-30j * unit).imag / 1e-30 for unit in np.eye(len(z))])

    def room(z):
        """How far rotor speeds are from the lowest and the highest, as shares of the latter."""
        lowest, highest = (np.sqrt(limit / parameters.b) for limit in (parameters.f_min, parameters.f_max))
        U = trajectory(z)[1].ravel()
        return np.concatenate([U - lowest, highest - U]) / highest

    def room_gradient(z):
        return np.array([room(z + 1e-30j * unit).imag / 1e-30 for unit in np.eye(len(z))]).T

    sums = np.kron(np.eye(N), np.ones(4))
    constraints = [{"type": "eq", "fun": lambda z: sums @ z - parameters.mass * acceleration, "jac": lambda z: sums}]
    if commands:
        constraints.append({"type": "ineq", "fun": room, "jac": room_gradient})
    found = minimize(
        objective,
        np.repeat(parameters.mass * acceleration / 4, 4),
        jac=gradient,
        bounds=[(parameters.f_min, parameters.f_max)] * (4 * N),
        constraints=constraints,
        method="SLSQP",
        options={"ftol": 1e-9, "maxiter": 200},
    )
    assert found.success, found.message
    return trajectory(found.x)
