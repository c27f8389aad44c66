"""IPOPT on the scenarios of jaxipm, stated as its scripts state them.

Rotor speeds are in rad/s, bounds are rows, and CasADi's Opti holds MX expressions, which are evaluated node by node.
"""

from __future__ import annotations

from itertools import combinations
from time import process_time
from typing import Any

import casadi as ca
import numpy as np
from torch import Tensor

from benchmarks.outside import navigation_problem as nav
from benchmarks.outside.jaxipm_problems import KEPT, NORM, RADIUS, ROTORS, STATES, Instances, Scenario, centers
from benchmarks.outside.navigation_problem import DT, FASTEST, HOVER, SLOWEST, N


class Ipopt:
    """A scenario's program, built once for all its instances.

    Args:
        tolerance: of IPOPT, `tol`.
    """

    def __init__(self, scenario: Scenario, tolerance: float) -> None:
        self.scenario, self.opti = scenario, ca.Opti()
        V = scenario.vehicles
        self.X, self.U = self.opti.variable(V * STATES, N + 1), self.opti.variable(V * ROTORS, N)
        self.x0, self.aim = self.opti.parameter(V * STATES), self.opti.parameter(V * STATES, N + 1)
        self.opti.minimize(self._cost())
        self._vehicles()
        ROWS[scenario.family](self.opti, self.X)
        quiet = {"print_time": 0, "ipopt.print_level": 0, "ipopt.sb": "yes"}
        as_published = {"ipopt.warm_start_init_point": "yes", "ipopt.max_iter": 500}
        self.opti.solver("ipopt", {**quiet, **as_published, "ipopt.tol": tolerance})

    def _cost(self) -> Any:
        cost = ca.MX(0)
        for i, weight in enumerate(self.scenario.weights * self.scenario.vehicles):
            for k in range(N + 1):
                cost += weight * (self.X[i, k] - self.aim[i, k]) ** 2
        return cost

    def _vehicles(self) -> None:
        """Starts, steps and bounds of all vehicles."""
        limits, opti = self.scenario.limits(), self.opti
        opti.subject_to(self.X[:, 0] == self.x0)
        for v in range(self.scenario.vehicles):
            X, U = self.X[v * STATES : (v + 1) * STATES, :], self.U[v * ROTORS : (v + 1) * ROTORS, :]
            for k in range(N):
                opti.subject_to(X[:, k + 1] == X[:, k] + DT * rates(X[:, k], U[:, k]))
            for k in range(N + 1):
                for i in np.isfinite(limits).nonzero()[0].tolist():
                    opti.subject_to(X[i, k] >= -limits[i])
                    opti.subject_to(X[i, k] <= limits[i])
            opti.subject_to(opti.bounded(SLOWEST, U, FASTEST))

    def solve(self, some: Instances, i: int, guess: tuple[Tensor, Tensor]) -> tuple[np.ndarray, int, bool, float]:
        """Controls (N, m) in shares of hovering speed, iterations, whether it succeeded, and processor time, s."""
        opti, (X, U) = self.opti, (part[i].numpy().T for part in guess)
        opti.set_value(self.x0, some.x0[i].numpy())
        opti.set_value(self.aim, some.aim[i].numpy().T)
        opti.set_initial(self.X, X)
        opti.set_initial(self.U, HOVER * U)
        began = process_time()
        try:
            found = opti.solve().value
        except RuntimeError:
            found = opti.debug.value
        seconds, stats = process_time() - began, opti.stats()
        return np.asarray(found(self.U)).T / HOVER, int(stats["iter_count"]), bool(stats["success"]), seconds


def rates(x: Any, w: Any) -> Any:
    """`navigation_problem.quadrotor` in CasADi, from rotor speeds w in rad/s."""
    f, spin = nav.THRUST * w**2, nav.ROTOR * (w[0] - w[1] + w[2] - w[3])
    lift, twist = (f[0] + f[1] + f[2] + f[3]) / nav.MASS, nav.TORQUE / nav.THRUST * (f[1] - f[0] + f[3] - f[2])
    s, a, b, c, p, q, r = (x[i] for i in (3, 4, 5, 6, 10, 11, 12))
    jx, jy, jz = nav.INERTIA
    drag = [-nav.DRAG / nav.MASS * ca.sign(x[i]) * x[i] ** 2 for i in (7, 8, 9)]
    return ca.vertcat(
        x[7], x[8], x[9],
        -0.5 * (a * p + b * q + c * r), 0.5 * (s * p + b * r - c * q),
        0.5 * (s * q + c * p - a * r), 0.5 * (s * r + a * q - b * p),
        drag[0] - 2 * (a * c + s * b) * lift,
        drag[1] - 2 * (b * c - s * a) * lift,
        drag[2] - (s**2 - a**2 - b**2 + c**2) * lift + nav.GRAVITY,
        ((jy - jz) * q * r - spin * q + nav.ARM * (f[0] - f[1] - f[2] + f[3])) / jx,
        ((jz - jx) * p * r + spin * p + nav.ARM * (f[0] + f[1] - f[2] - f[3])) / jy,
        ((jx - jy) * p * q + twist) / jz,
    )  # fmt: skip


def _growing(opti: Any, X: Any) -> None:
    for k in range(N):
        for (x, y), r in zip(nav.CENTERS, nav.RADII, strict=True):
            square = (r + nav.VEHICLE) ** 2 * (1 + nav.GROWTH * DT * k)
            opti.subject_to((X[0, k] - x) ** 2 + (X[1, k] - y) ** 2 >= square)


def _swinging(opti: Any, X: Any) -> None:
    for k, around in enumerate(centers(np.arange(N + 1))):
        norm = sum(X[i, k] ** 2 for i in range(3, 7))
        opti.subject_to(norm >= NORM[0])
        opti.subject_to(norm <= NORM[1])
        for x, y in around.tolist():
            opti.subject_to((X[0, k] - x) ** 2 + (X[1, k] - y) ** 2 >= RADIUS**2)


def _apart(opti: Any, X: Any) -> None:
    for a, b in combinations(range(0, X.shape[0], STATES), 2):
        for k in range(N):
            opti.subject_to(sum((X[a + i, k] - X[b + i, k]) ** 2 for i in range(3)) >= KEPT**2)


ROWS = {"navigation": _growing, "tracking": _swinging, "swap": _apart}
