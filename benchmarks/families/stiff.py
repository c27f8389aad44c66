"""python -m benchmarks.families.stiff: stiff models and algebraic equations by implicit steps, beside IPOPT.

The models are those that the literature tries stiff integrators on. What a plan says is compared with its controls
flown by SciPy's Radau at 1e-9. Times are processor time of one thread; IPOPT's is its own, by collocation. What a first
solve compiles is measured in a process of its own, with an empty cache folder and the default flags.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

import torchgco
from benchmarks.lib.command import Command
from benchmarks.lib.page import markdown, shown
from benchmarks.speed.first_use import started
from torchgco import ControlBounds, FunctionDynamics, InteriorPoint, Problem, QuadraticCost, Solution
from torchgco.baselines import CasADiSolver

HEAD = (
    "model", "steps", "status", "iterations", "cost said", "cost flown", "off, %", "drift", "ms", "us an iteration",
    "compiles, s", "IPOPT: iterations", "its cost", "its ms",
)  # fmt: skip
METHODS = "rk4", "implicit_euler", "radau3", "radau5"
STARTS = 32  # of which times are taken
FIRST = "from benchmarks.families.stiff import first_solve; first_solve({!r}, {!r})"


@dataclass(frozen=True)
class Case:
    """A model and its problem; `guess`: of all controls."""

    field: Callable[..., Any]
    x0: list[float]
    dt: float
    N: int
    bounds: tuple[float, float]
    cost: dict[str, list[float]]
    guess: float = 0.0
    algebraic: int = 0

    def problem(self, method: str, B: int = 1) -> Problem:
        """B starts, of which the first is the case's own, the others up to 2 % off in all that isn't 0."""
        x0 = torch.tensor([self.x0], dtype=torch.float64)
        off = torch.rand(B, len(self.x0), dtype=torch.float64, generator=torch.Generator().manual_seed(5)) - 0.5
        off[0] = 0.0
        of_model = {"n": len(self.x0), "m": 1, "dt": self.dt, "integrator": method, "algebraic": self.algebraic}
        model = FunctionDynamics(self.field, **of_model)
        starts = x0 * (1.0 + 0.04 * off)
        return Problem(model, QuadraticCost(**self.cost), [ControlBounds(*self.bounds)], starts, self.N)

    def flown(self, problem: Problem, U: Tensor) -> float:
        """The cost of a first problem's controls U (N, 1), each held for a stage, by SciPy's Radau."""
        x, total, cost = problem.x0[:1], 0.0, problem.cost.take(slice(0, 1))
        for k in range(problem.N):
            u = U[k : k + 1]
            total += float(cost.stage(x, u, k))
            rates = lambda t, z, u=u: problem.dynamics.field(torch.tensor(z)[None], u)[0].numpy()
            try:
                end = solve_ivp(rates, (0.0, self.dt), x[0].numpy(), method="Radau", rtol=1e-9, atol=1e-11)
            except ValueError:  # not finite
                return np.nan
            x = torch.tensor(end.y[:, -1])[None]
        return total + float(cost.terminal(x))

    def guess_for(self, problem: Problem) -> Tensor:
        """Of controls, (B, N, 1)."""
        return torch.full((problem.B, problem.N, 1), self.guess, dtype=torch.float64)

    def drift(self, X: Tensor) -> float:
        """By how much of its length the rod of a pendulum is longer or shorter along states X (N+1, 4), at most."""
        return float((X[:, :2].norm(dim=-1) - 1.0).abs().max()) if self.algebraic else np.nan


def van_der_pol(x: Tensor, u: Tensor, stiffness: float) -> Tensor:
    y, v = x.unbind(-1)
    return torch.stack((v, stiffness * ((1.0 - y * y) * v + u[..., 0]) - y), dim=-1)


def lagging(x: Tensor, u: Tensor, rate: float) -> Tensor:
    return torch.stack((x[..., 1], x[..., 2], rate * (u[..., 0] - x[..., 2])), dim=-1)


def robertson(x: Tensor, u: Tensor) -> Tensor:
    """Three reactions (Robertson, 1966), the second concentration times 1e4; the control heats the first."""
    a, b, c = x.unbind(-1)
    first, second, third = 0.04 * (1.0 + u[..., 0]) * a, b * c, 0.3 * b * b
    return torch.stack((second - first, 1e4 * (first - second - third), third), dim=-1)


def tank(x: Tensor, u: Tensor) -> Tensor:
    """A stirred tank that is cooled (Hicks and Ray, 1971)."""
    c, heat = x.unbind(-1)
    reaction = 300.0 * torch.exp(-5.0 / heat) * c
    cooled = 1.95e-2 * u[..., 0] * (heat - 0.38158)
    return torch.stack(((1.0 - c) / 20.0 - reaction, (0.3947 - heat) / 20.0 + reaction - cooled), dim=-1)


def rod(x: Tensor, force: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    px, py, vx, vy = x.unbind(-1)
    ax, ay = -force * px - u[..., 0] * py, -force * py + u[..., 0] * px - 9.81
    return torch.stack((vx, vy, ax, ay), -1), torch.stack((px * ax + py * ay, px * vx + py * vy), -1)


def pendulum(x: Tensor, z: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """A mass on a rod whose force is algebraic, of index 1."""
    rates, (along, _) = rod(x, z[..., 0], u)[0], rod(x, z[..., 0], u)[1].unbind(-1)
    return rates, (x[..., 2:].square().sum(-1) + along).unsqueeze(-1)


def pendulum_on_circle(x: Tensor, z: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """The same of index 2: position and velocity stay on the circle (Gear, Gupta and Leimkuhler, 1985)."""
    rates, (_, speed) = rod(x, z[..., 0], u)[0], rod(x, z[..., 0], u)[1].unbind(-1)
    push = torch.cat((z[..., 1:] * x[..., :2], torch.zeros_like(x[..., 2:])), -1)
    return rates - push, torch.stack((x[..., :2].square().sum(-1) - 1.0, speed), -1)


TO_1_2 = {"Q": [1.0, 0.0], "R": [0.1], "Qf": [10.0, 0.0], "x_ref": [1.2, 0.0]}
TO_1 = {"Q": [0.0] * 3, "R": [0.01], "Qf": [100.0, 100.0, 0.0], "x_ref": [1.0, 0.0, 0.0]}
UP = {"Q": [0.0] * 4, "R": [0.01], "Qf": [100.0, 100.0, 10.0, 10.0], "x_ref": [0.0, 1.0, 0.0, 0.0]}
MADE = {"Q": [0.0] * 3, "R": [0.01], "Qf": [0.0, 0.0, 500.0], "x_ref": [0.0, 0.0, 0.3]}
STEADY = {"Q": [10.0, 10.0], "R": [0.001], "Qf": [100.0, 100.0], "x_ref": [0.0944, 0.7766], "u_ref": [3.4]}
SWING = {"x0": [0.0, -1.0, 0.0, 0.0], "dt": 0.05, "N": 60, "bounds": (-6.0, 6.0), "cost": UP, "guess": 0.5}
CASES: dict[str, Case] = {
    **{
        f"Van der Pol, mu {stiffness:,.0f}": Case(
            lambda x, u, s=stiffness: van_der_pol(x, u, s), [2.0, 0.0], 0.05, 40, (-2.0, 2.0), TO_1_2
        )
        for stiffness in (100.0, 1000.0)
    },
    **{
        f"lag, {rate / 10:g} of a stage": Case(
            lambda x, u, r=rate: lagging(x, u, r), [0.0] * 3, 0.1, 40, (-1.0, 1.0), TO_1
        )
        for rate in (10.0, 100.0, 1000.0)
    },
    "Robertson": Case(robertson, [1.0, 0.0, 0.0], 1.0, 40, (-0.9, 5.0), MADE),
    "stirred tank": Case(tank, [0.1367, 0.7293], 0.5, 40, (0.0, 5.0), STEADY),
    "pendulum, index 1": Case(pendulum, algebraic=1, **SWING),
    "pendulum, index 2": Case(pendulum_on_circle, algebraic=2, **SWING),
}


class Timed:
    """A function of CasADi's that takes its processor time."""

    def __init__(self, function: Any) -> None:
        self._function, self.stats, self.took = function, function.stats, 0.0

    def __call__(self, **given: Any) -> Any:
        began = time.process_time()
        try:
            return self._function(**given)
        finally:
            self.took = time.process_time() - began


def milliseconds(work: Callable[[], Solution]) -> tuple[float, Solution]:
    """The least processor time of three runs, after one that compiles, and what it gives."""
    work()
    took = []
    for _ in range(3):
        began = time.process_time()
        solution = work()
        took.append(1e3 * (time.process_time() - began))
    return min(took), solution


def solved(case: Case, problem: Problem) -> Solution:
    """The case's problem, solved by the interior point from its guess, with all checks."""
    return torchgco.solve(problem, case.guess_for(problem), solver="interior_point", verbose=False)


def compiling(name: str, method: str) -> float:
    """Processor time of the compilers of a first solve, in a process and with a cache folder of its own, s."""
    with tempfile.TemporaryDirectory() as folder:
        return float(started(["-c", FIRST.format(name, method)], {"TORCHGCO_CACHE": folder, "TORCHGCO_CFLAGS": ""}))


def first_solve(name: str, method: str) -> None:
    """Solve a case, and print the processor time of the compilers that have ended, s."""
    solved(CASES[name], CASES[name].problem(method))
    took = os.times()
    print(took.children_user + took.children_system)


def row(name: str, case: Case, method: str, peer: bool) -> list[str]:
    """A case by one method."""
    problem, many = case.problem(method), case.problem(method, STARTS)
    took, solution = milliseconds(lambda: solved(case, problem))
    every, batch = milliseconds(lambda: InteriorPoint().solve(many, case.guess_for(many)))
    said, flown = float(solution.cost), np.nan
    if not case.algebraic and np.isfinite(said):
        flown = case.flown(problem, solution.U[0])
    off = f"{100 * abs(said / flown - 1):.2g}" if np.isfinite(flown) else "-"
    each = 1e3 * every / int(batch.iterations.sum())
    cells = [name, method, solution.statuses[0].name, f"{int(solution.iterations)}", f"{said:.6g}", f"{flown:.6g}", off]
    cells += [shown(case.drift(solution.X[0]), ".1e"), f"{took:.1f}", f"{each:.1f}", f"{compiling(name, method):.1f}"]
    if not peer:
        return [*cells, "-", "-", "-"]
    prepared = CasADiSolver("ipopt").prepare(problem)
    timed = Timed(prepared.function)
    found = replace(prepared, function=timed).solve(problem, case.guess_for(problem))
    theirs = 1e3 * timed.took
    return [*cells, f"{int(found.iterations)}", f"{float(found.cost):.6g}", f"{theirs:.1f}"]


def rows(names: list[str]) -> Iterator[list[str]]:
    for name in names:
        case = CASES[name]
        for method in METHODS if case.algebraic < 2 else METHODS[2:]:
            yield row(name, case, method, method != "rk4")


def table(cases: list[str]) -> str:
    """A row per case and method."""
    return markdown(HEAD, rows(cases))


main = Command(
    __doc__, "stiff", table, "{cases}", "CasADi",
    cases=(list(CASES), "which, by default all", list(CASES)),
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(main())
