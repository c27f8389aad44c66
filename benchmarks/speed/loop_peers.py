"""FATROP and IPOPT in a receding horizon, by hand: one program for all periods, its numbers a vector."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

Report = Callable[[], tuple[int, bool]]
CASES = (  # name, plugin, compiled, the last solution shifted by a stage
    ("fatrop", "fatrop", False, False), ("fatrop, compiled", "fatrop", True, False),
    ("fatrop, compiled, shifted", "fatrop", True, True), ("ipopt, compiled, shifted", "ipopt", True, True),
)  # fmt: skip


@dataclass(frozen=True)
class ByHand:
    """What is controlled: RK4 steps of `rates`, quadratic costs, bounds, discs in the plane of the first two states."""

    rates: Callable[[ca.SX, ca.SX], ca.SX]
    N: int
    dt: float  # s
    Q: list[float]
    R: list[float]
    QF: list[float]
    lower: list[float]  # of controls
    upper: list[float]
    limits: list[float]  # of states, both ways, from the second knot on
    optimisation: str = "-O3"  # of the compiler
    reach: list[float] = field(default_factory=list)  # least distances from the discs' centres, m


@dataclass
class Peer:
    """A controller: control(x, x_ref, centers) gives the first controls, and what to ask for the iterations."""

    name: str
    plugin: str
    compiled: bool
    shifted: bool
    plant: ByHand
    last: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def ready(cls, plant: ByHand, compiled: bool, plugins: tuple[str, ...] = ("fatrop", "ipopt")) -> Iterator[Peer]:
        """All of them, or those that aren't compiled."""
        for name, plugin, is_compiled, shifted in CASES:
            if plugin in plugins and (compiled or not is_compiled):
                yield cls(name, plugin, is_compiled, shifted, plant)

    def __post_init__(self) -> None:
        program, self.bounds, equality = _program(self.plant)
        flags = {"flags": [self.plant.optimisation, "-march=native"], "verbose": False}
        jit = {"compiler": "shell", "jit": True, "jit_options": flags}
        options: dict[str, Any] = {"print_time": False} | (jit if self.compiled else {})
        if self.plugin == "fatrop":
            own = {"print_level": 0, "tolerance": 1e-6, "mu_init": 1e-3}
            options |= {"structure_detection": "auto", "equality": equality}
        else:
            own = {"print_level": 0, "sb": "yes", "tol": 1e-6, "mu_init": 1e-3, "warm_start_init_point": "yes"}
        options |= {f"{self.plugin}.{name}": value for name, value in own.items()}
        self.solver = ca.nlpsol("loop", self.plugin, program, options)
        self.last = {"x0": np.zeros(program["x"].shape[0])}

    def __call__(self, x: np.ndarray, x_ref: np.ndarray, centers: np.ndarray) -> tuple[np.ndarray, Report]:
        found = self.solver(p=np.concatenate((x, x_ref.ravel(), centers.ravel())), **self.bounds, **self.last)
        z, n, m = np.array(found["x"]).ravel(), len(self.plant.Q), len(self.plant.R)
        start = np.concatenate((z[n + m :], z[-n - m :])) if self.shifted else z
        self.last = {"x0": start, "lam_x0": found["lam_x"], "lam_g0": found["lam_g"]}
        return z[n : n + m], self._report

    def _report(self) -> tuple[int, bool]:
        stats = self.solver.stats()
        return int(stats["iter_count"]), bool(stats["success"])


def _step(x: ca.SX, u: ca.SX, plant: ByHand) -> ca.SX:
    a = plant.rates(x, u)
    b = plant.rates(x + plant.dt / 2 * a, u)
    c = plant.rates(x + plant.dt / 2 * b, u)
    return x + plant.dt / 6 * (a + 2 * b + 2 * c + plant.rates(x + plant.dt * c, u))


def _program(plant: ByHand) -> tuple[dict[str, ca.SX], dict[str, list[float]], list[bool]]:
    """The program, its bounds, and which of its rows are equalities, in the order of stages that FATROP detects."""
    n, m, N = len(plant.Q), len(plant.R), plant.N
    start, references = ca.SX.sym("x0", n), ca.SX.sym("x_ref", n, N + 1)
    discs = ca.SX.sym("centers", 2, len(plant.reach))
    states = [ca.SX.sym(f"x{k}", n) for k in range(N + 1)]
    controls = [ca.SX.sym(f"u{k}", m) for k in range(N)]
    cost, variables, rows, kinds = ca.SX(0), [], [], []
    bounds: dict[str, list[float]] = {"lbx": [], "ubx": [], "lbg": [], "ubg": []}

    def add(row: ca.SX, lower: float, count: int) -> None:
        rows.append(row)
        kinds.extend([lower == 0.0] * count)
        bounds["lbg"] += [lower] * count
        bounds["ubg"] += [0.0] * count

    for k in range(N + 1):
        error, last = states[k] - references[:, k], k == N
        cost += 0.5 * ca.dot(ca.DM(plant.QF if last else plant.Q) * error, error)
        variables.append(states[k])
        bounds["lbx"] += [-limit if k else -np.inf for limit in plant.limits]
        bounds["ubx"] += [limit if k else np.inf for limit in plant.limits]
        if not last:
            cost += 0.5 * ca.dot(ca.DM(plant.R) * controls[k], controls[k])
            variables.append(controls[k])
            bounds["lbx"] += plant.lower
            bounds["ubx"] += plant.upper
            add(states[k + 1] - _step(states[k], controls[k], plant), 0.0, n)
        if k == 0:
            add(states[0] - start, 0.0, n)
        else:
            for i, reach in enumerate(plant.reach):
                add(reach**2 - ca.sumsqr(states[k][:2] - discs[:, i]), -np.inf, 1)
    numbers = ca.vertcat(start, ca.vec(references), ca.vec(discs))
    return {"x": ca.vertcat(*variables), "p": numbers, "f": cost, "g": ca.vertcat(*rows)}, bounds, kinds
