"""FATROP and IPOPT on the car of `loop`, by hand: one program for all periods, its numbers a vector."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

N, DT = 20, 0.1
Report = Callable[[], tuple[int, bool]]
CASES = (  # name, plugin, compiled, the last solution shifted by a stage
    ("fatrop", "fatrop", False, False), ("fatrop, compiled", "fatrop", True, False),
    ("fatrop, compiled, shifted", "fatrop", True, True), ("ipopt, compiled, shifted", "ipopt", True, True),
)  # fmt: skip
FLAGS = {"compiler": "shell", "jit": True, "jit_options": {"flags": ["-O3", "-march=native"], "verbose": False}}


@dataclass
class Peer:
    """A controller: control(x, x_ref, centers) gives the first controls, and what to ask for the iterations."""

    name: str
    plugin: str
    compiled: bool
    shifted: bool
    last: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def ready(cls, compiled: bool) -> Iterator[Peer]:
        """All of them, or those that aren't compiled."""
        for name, plugin, is_compiled, shifted in CASES:
            if compiled or not is_compiled:
                yield cls(name, plugin, is_compiled, shifted)

    def __post_init__(self) -> None:
        program, self.bounds, equality = _program()
        options: dict[str, Any] = {"print_time": False} | (FLAGS if self.compiled else {})
        if self.plugin == "fatrop":
            own = {"print_level": 0, "tolerance": 1e-6, "mu_init": 1e-3}
            options |= {"structure_detection": "auto", "equality": equality}
        else:
            own = {"print_level": 0, "sb": "yes", "tol": 1e-6, "mu_init": 1e-3, "warm_start_init_point": "yes"}
        options |= {f"{self.plugin}.{name}": value for name, value in own.items()}
        self.solver = ca.nlpsol("car", self.plugin, program, options)
        self.last = {"x0": np.zeros(program["x"].shape[0])}

    def __call__(self, x: np.ndarray, x_ref: np.ndarray, centers: np.ndarray) -> tuple[np.ndarray, Report]:
        found = self.solver(p=np.concatenate((x, x_ref.ravel(), centers.ravel())), **self.bounds, **self.last)
        z = np.array(found["x"]).ravel()
        start = np.concatenate((z[6:], z[-6:])) if self.shifted else z
        self.last = {"x0": start, "lam_x0": found["lam_x"], "lam_g0": found["lam_g"]}
        return z[4:6], self._report

    def _report(self) -> tuple[int, bool]:
        stats = self.solver.stats()
        return int(stats["iter_count"]), bool(stats["success"])


def _step(x: ca.SX, u: ca.SX) -> ca.SX:
    def rates(x: ca.SX) -> ca.SX:
        return ca.vertcat(x[3] * ca.cos(x[2]), x[3] * ca.sin(x[2]), x[3] * ca.tan(u[1]) / 2.5, u[0])

    a = rates(x)
    b = rates(x + DT / 2 * a)
    c = rates(x + DT / 2 * b)
    return x + DT / 6 * (a + 2 * b + 2 * c + rates(x + DT * c))


def _program() -> tuple[dict[str, ca.SX], dict[str, list[float]], list[bool]]:
    """The program, its bounds, and which of its rows are equalities, in the order of stages that FATROP detects."""
    from benchmarks.speed.loop import LOWER, QF, RADIUS, UPPER, VEHICLE, Q, R

    start, references, discs = ca.SX.sym("x0", 4), ca.SX.sym("x_ref", 4, N + 1), ca.SX.sym("centers", 2, 2)
    states = [ca.SX.sym(f"x{k}", 4) for k in range(N + 1)]
    controls = [ca.SX.sym(f"u{k}", 2) for k in range(N)]
    cost, variables, rows, kinds = ca.SX(0), [], [], []
    bounds: dict[str, list[float]] = {"lbx": [], "ubx": [], "lbg": [], "ubg": []}

    def add(row: ca.SX, lower: float, count: int) -> None:
        rows.append(row)
        kinds.extend([lower == 0.0] * count)
        bounds["lbg"] += [lower] * count
        bounds["ubg"] += [0.0] * count

    for k in range(N + 1):
        error, last = states[k] - references[:, k], k == N
        cost += 0.5 * ca.dot(ca.DM(QF if last else Q) * error, error)
        variables.append(states[k])
        bounds["lbx"] += [-np.inf] * 4
        bounds["ubx"] += [np.inf] * 4
        if not last:
            cost += 0.5 * ca.dot(ca.DM(R) * controls[k], controls[k])
            variables.append(controls[k])
            bounds["lbx"] += LOWER
            bounds["ubx"] += UPPER
            add(states[k + 1] - _step(states[k], controls[k]), 0.0, 4)
        if k == 0:
            add(states[0] - start, 0.0, 4)
        else:
            for i in range(2):
                add((RADIUS + VEHICLE) ** 2 - ca.sumsqr(states[k][:2] - discs[:, i]), -np.inf, 1)
    numbers = ca.vertcat(start, ca.vec(references), ca.vec(discs))
    return {"x": ca.vertcat(*variables), "p": numbers, "f": cost, "g": ca.vertcat(*rows)}, bounds, kinds
