"""ALTRO's quadrotor maze as a torchgco problem: between two walls with doors and round a middle wall.

The numbers (maze, start, goal, times, weights, bounds, waypoints) are those of Altro.jl (problems/quadrotor_maze.jl,
commit 4864df2). Its vehicle, `Quadrotor2` of an early TrajectoryOptimization.jl, has the equations and parameters of
RobotZoo.jl (src/quadrotor.jl, commit a3abc6e). Steps are RK4.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchgco import ControlBounds, FunctionConstraint, FunctionDynamics, Problem, QuadraticCost, Spheres, StateBounds

N, DT = 100, 0.05
MASS, GRAVITY, ARM, TORQUE = 0.5, 9.81, 0.175, 0.0245  # kg, m/s^2, m, m (yaw torque per thrust)
INERTIA = (0.0023, 0.0023, 0.004)  # kg m^2
HOVER = MASS * GRAVITY / 4  # N per rotor
START, GOAL = (0.0, -15.0, 1.0), (0.0, 15.0, 1.0)  # m; level and at rest
SPREAD = (0.5, 0.5, 0.2, 0, 0, 0, 0, 0.5, 0.5, 0.5, 0.1, 0.1, 0.1)  # standard deviations of the drawn starts
WAYPOINTS = ((2.0, -7.0, 1.0), (5.0, -5.0, 1.0), (7.0, 0.0, 1.0), (5.0, 5.0, 1.0), (2.0, 7.0, 1.0))  # m
Q = (1e-3,) * 3 + (1e-2,) * 4 + (1e-3,) * 6  # times DT
R = 1e-4  # times DT
CYLINDER, VEHICLE = 1.2, 1.0  # radii, m
THRUST, SPEED = 50.0, 30.0  # N per rotor; m/s, upper bound of each component
LOWER, UPPER = (-25.0, -np.inf, 0.0), (25.0, np.inf, 20.0)  # of the position, m
FIXED = (0, 1, 2, 7, 8, 9, 10, 11, 12)  # the states that the goal fixes: all but the quaternion


def cylinders() -> np.ndarray:
    """Axes (47, 2) of the upright cylinders, m: two walls with a door, a middle wall, and two long sides."""
    walls = [(x, y) for y in (-10.0, 10.0) for ends in ((-10, -3), (3, 10)) for x in np.linspace(*ends, 5)]
    middle = [(x, 0.0) for x in np.linspace(-3, 3, 7)]
    sides = [(x, y) for x in (-10.0, 10.0) for y in np.linspace(-10 + 2 * CYLINDER, 10 - 2 * CYLINDER, 10)]
    return np.array(walls + middle + sides)


def quadrotor(x: Tensor, u: Tensor) -> Tensor:
    """Rates of x = [p (m), quaternion (w, x, y, z), v (m/s), body rates (rad/s)] under the thrusts u (4, N).

    As in the source, the quaternion isn't normalised: its length drifts by the error of the integrator alone.
    """
    w, a, b, c = x[..., 3], x[..., 4], x[..., 5], x[..., 6]
    vx, vy, vz, p, q, r = x[..., 7], x[..., 8], x[..., 9], x[..., 10], x[..., 11], x[..., 12]
    lift = u.sum(-1) / MASS
    jx, jy, jz = INERTIA
    return torch.stack(
        (
            vx, vy, vz,
            -0.5 * (a * p + b * q + c * r), 0.5 * (w * p + b * r - c * q),
            0.5 * (w * q + c * p - a * r), 0.5 * (w * r + a * q - b * p),
            2 * (a * c + w * b) * lift, 2 * (b * c - w * a) * lift,
            (w * w - a * a - b * b + c * c) * lift - GRAVITY,
            (ARM * (u[..., 1] - u[..., 3]) - (jz - jy) * q * r) / jx,
            (ARM * (u[..., 2] - u[..., 0]) - (jx - jz) * p * r) / jy,
            (TORQUE * (u[..., 0] - u[..., 1] + u[..., 2] - u[..., 3]) - (jy - jx) * p * q) / jz,
        ),
        dim=-1,
    )  # fmt: skip


def rest(p: Sequence[float]) -> list[float]:
    """The state (13,) at p, level and at rest."""
    return [*p, 1.0] + [0.0] * 9


def drawn(count: int, seed: int) -> Tensor:
    """The published start and count - 1 drawn around it, (count, 13): normal, by `SPREAD`."""
    x0 = torch.tensor([rest(START)], dtype=torch.float64).repeat(count, 1)
    draws = torch.randn(count - 1, 13, generator=torch.Generator().manual_seed(seed), dtype=x0.dtype)
    x0[1:] += torch.tensor(SPREAD, dtype=x0.dtype) * draws
    return x0


def maze(x0: Tensor) -> Problem:
    """The maze from starts x0 (B, 13).

    The cost is the published one apart from a constant: u' R u / 2 is written around the thrusts of hovering, so that
    these count as rest. The position is the one in the plane: there a cylinder of infinite height is a disc.
    """
    goal, fixed = x0.new_tensor(rest(GOAL)), list(FIXED)
    weights, effort = [q * DT for q in Q], R * DT
    lower, upper = [*LOWER] + [-np.inf] * 10, [*UPPER] + [np.inf] * 4 + [SPEED] * 3 + [np.inf] * 3
    return Problem(
        FunctionDynamics(quadrotor, 13, 4, DT, "rk4", position=slice(0, 2)),
        QuadraticCost(weights, [effort] * 4, weights, x_ref=goal, u_ref=[HOVER] * 4, r=[effort * HOVER] * 4),
        [
            Spheres(cylinders(), [CYLINDER] * 47, VEHICLE),
            ControlBounds([0.0] * 4, [THRUST] * 4),
            StateBounds(lower, upper, knots=slice(1, N)),
            FunctionConstraint(lambda x: x[..., fixed] - goal[fixed], "equality", knots=[N], name="goal"),
        ],
        x0,
        N,
    )


def waypoint_guess(x0: Tensor) -> tuple[Tensor, Tensor]:
    """States (B, N+1, 13) along the published waypoints at equal times, level and at rest; and hovering thrusts."""
    points = torch.tensor([rest(p) for p in (*WAYPOINTS, GOAL)], dtype=x0.dtype)
    corners = torch.cat((x0.unsqueeze(1), points.expand(x0.shape[0], -1, -1)), dim=1)  # (B, 7, 13)
    at = torch.linspace(0, corners.shape[1] - 1, N + 1, dtype=x0.dtype)
    before = at.floor().long().clamp(max=corners.shape[1] - 2)
    share = (at - before).view(1, -1, 1)
    X0 = (1 - share) * corners[:, before] + share * corners[:, before + 1]
    return X0, x0.new_full((x0.shape[0], N, 4), HOVER)


def recount(x0: np.ndarray, U: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Published cost (B,), largest violation (B,) and states (B, N+1, 13) of controls U (B, N, 4), rolled out in NumPy.

    No code is shared with the problem or the solvers. The violation is in m, m/s, rad/s and N.
    """

    def rates(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        q, v, w = x[:, 3:7], x[:, 7:10], x[:, 10:13]
        s, e = q[:, :1], q[:, 1:]
        up = np.array([[0.0, 0.0, 1.0]])
        lift = (s**2 - (e**2).sum(-1, keepdims=True)) * up + 2 * e * e[:, 2:] + 2 * s * np.cross(e, up)
        dq = 0.5 * np.c_[-(e * w).sum(-1), s * w + np.cross(e, w)]
        dv = lift * u.sum(-1, keepdims=True) / MASS - GRAVITY * up
        turn = ARM * np.c_[u[:, 1] - u[:, 3], u[:, 2] - u[:, 0], TORQUE / ARM * (u @ [1, -1, 1, -1])]
        return np.c_[v, dq, dv, (turn - np.cross(w, w * INERTIA)) / INERTIA]

    goal, X = np.array(rest(GOAL)), [x0]
    for k in range(N):
        x, u = X[-1], U[:, k]
        a = rates(x, u)
        b = rates(x + DT / 2 * a, u)
        c = rates(x + DT / 2 * b, u)
        X.append(x + DT / 6 * (a + 2 * b + 2 * c + rates(x + DT * c, u)))
    X = np.stack(X, axis=1)
    cost = 0.5 * DT * ((X - goal) ** 2 @ Q).sum(-1) + 0.5 * DT * R * (U**2).sum((1, 2))
    apart = np.linalg.norm(X[:, :-1, None, :2] - cylinders(), axis=-1)
    inner = X[:, 1:-1]
    worst = [
        (CYLINDER + VEHICLE - apart).max((1, 2)),
        np.maximum(-U, U - THRUST).max((1, 2)),
        np.maximum(LOWER - inner[..., :3], inner[..., :3] - UPPER).max((1, 2)),
        (inner[..., 7:10] - SPEED).max((1, 2)),
        np.abs(X[:, -1] - goal)[:, FIXED].max(-1),
    ]
    return cost, np.maximum(0.0, np.max(worst, axis=0)), X
