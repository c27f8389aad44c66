"""python -m benchmarks.families.free_time: least times against closed forms and COPS.

Every problem is stated with `FreeTime` and solved by `gco`, without any guess but that of the time where one is named.
Beside it IPOPT through CasADi by hand: multiple shooting on equal stages with the duration as a variable, states on the
straight line to the end (COPS: COPS's own guesses), and the same guess of the time.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor

import torchgco
from benchmarks.lib.command import Command
from benchmarks.lib.page import chosen, filed, markdown, share
from torchgco import (
    ControlBounds,
    FreeTime,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Problem,
    StateBounds,
    Status,
)

D, INF = torch.float64, math.inf
EXACT = 1e-3  # share of the least time, of equal stages of which one holds the switch


@dataclass(frozen=True)
class Form:
    """A problem of free time that PyTorch and CasADi state from the same lines.

    Attributes:
        rates: x' of lists of states and controls, with the functions of a module (`torch` or `casadi`).
        start, end: of states; None in `end` is free.
        control, state: their bounds.
        times: least and most, s.
        value: what is minimised, of the last states and the duration.
        guess: states at a share of the time, and controls, of COPS.
    """

    rates: Callable[[Sequence[Any], Sequence[Any], Any], list[Any]]
    start: Sequence[float]
    end: Sequence[float | None]
    control: tuple[Sequence[float], Sequence[float]]
    state: tuple[Sequence[float], Sequence[float]] | None
    times: tuple[float, float]
    value: Callable[[Sequence[Any], Any], Any] = lambda x, T: T
    weight: float = 1.0
    guess: Callable[[float], Sequence[float]] | None = None
    U0: Sequence[float] | None = None

    def problem(self, N: int, nominal: float, x0: Tensor | None = None, guess: Tensor | None = None) -> Problem:
        """The problem with `FreeTime`; x0 (B, n) in place of the start, guess (B,) of the duration, s."""
        n, m = len(self.start), len(self.control[0])
        field = lambda x, u: torch.stack(self.rates(x.unbind(-1), u.unbind(-1), torch), -1)
        fixed = [i for i, x in enumerate(self.end) if x is not None]
        end = torch.tensor([self.end[i] for i in fixed], dtype=D)
        rows = [
            ControlBounds(*self.control),
            FunctionConstraint(lambda x: x[..., fixed] - end, "equality", knots=[-1], name="end"),
            *([] if self.state is None else [StateBounds(*self.state)]),
        ]
        last = None if self.weight > 0 else lambda x: self.value(x.unbind(-1), 0.0)
        cost = FunctionCost(lambda x, u: 0.0 * u[..., 0], last)
        least, most = (bound / nominal for bound in self.times)
        factor = None if guess is None else (guess / nominal).clamp(least, most)
        model = FunctionDynamics(field, n, m, nominal / N, "rk4")
        x0 = torch.tensor([self.start], dtype=D) if x0 is None else x0
        return Problem(model, cost, rows, x0, N, time=FreeTime(least, most, self.weight, factor))

    def by_hand(self, N: int) -> ca.Function:
        """IPOPT for this problem; variables T, x_0, u_0, x_1, ..., x_N, and x_0 as the parameter."""
        n, m = len(self.start), len(self.control[0])
        x, u, h = ca.SX.sym("x", n), ca.SX.sym("u", m), ca.SX.sym("h")
        f = lambda z: ca.vertcat(*self.rates(ca.vertsplit(z), ca.vertsplit(u), ca))
        k1 = f(x)
        k2 = f(x + h / 2 * k1)
        k3 = f(x + h / 2 * k2)
        step = ca.Function("step", [x, u, h], [x + h / 6 * (k1 + 2 * k2 + 2 * k3 + f(x + h * k3))])
        T, X, U, x0 = ca.SX.sym("T"), ca.SX.sym("X", n, N + 1), ca.SX.sym("U", m, N), ca.SX.sym("x0", n)
        rows = [X[:, 0] - x0, *(X[:, k + 1] - step(X[:, k], U[:, k], T / N) for k in range(N))]
        v = ca.vertcat(T, *(ca.vertcat(X[:, k], U[:, k]) for k in range(N)), X[:, N])
        quiet = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 3000, "tol": 1e-8}}
        value = self.value(ca.vertsplit(X[:, N]), T)
        return ca.nlpsol("solver", "ipopt", {"x": v, "p": x0, "f": value, "g": ca.vertcat(*rows)}, quiet)

    def hand_solved(
        self, solver: ca.Function, N: int, x0: np.ndarray, states: Callable[[float], Sequence[float]], T0: float
    ) -> tuple[bool, float, np.ndarray, int]:
        """Whether IPOPT succeeds, the duration, the last states, and iterations."""
        low, high = self.state or ([-INF] * len(x0), [INF] * len(x0))
        u0 = self.U0 or [0.0] * len(self.control[0])
        guess, lower, upper = [np.array([T0])], [np.array([self.times[0]])], [np.array([self.times[1]])]
        for k in range(N + 1):
            free = k == 0
            guess.append(np.asarray(states(k / N), dtype=float))
            fixed = [(-INF, INF) if e is None else (e, e) for e in self.end]
            bounds = fixed if k == N else list(zip(low, high, strict=True))
            pairs = [(-INF, INF)] * len(x0) if free else bounds
            lower.append(np.array([p[0] for p in pairs]))
            upper.append(np.array([p[1] for p in pairs]))
            if k < N:
                guess.append(np.array(u0))
                lower.append(np.array(self.control[0]))
                upper.append(np.array(self.control[1]))
        found = solver(
            x0=np.concatenate(guess), p=x0, lbx=np.concatenate(lower), ubx=np.concatenate(upper), lbg=0.0, ubg=0.0
        )
        v, stats = np.array(found["x"]).ravel(), solver.stats()
        return bool(stats["success"]), float(v[0]), v[-len(x0) :], int(stats["iter_count"])


def cart(fastest: float) -> Form:
    limits = None if fastest == INF else ([-INF, -fastest], [INF, fastest])
    return Form(lambda x, u, lib: [x[1], u[0]], [0, 0], [0, 0], ([-1], [1]), limits, (0.02, 60.0))


def least_time(x0: np.ndarray, fastest: float) -> np.ndarray:
    """The closed form: full thrust one way, then the other, with the fastest speed between where it is reached."""
    found = []
    for x, v in x0.tolist():
        side = 1.0 if x + 0.5 * v * abs(v) > 0 else -1.0
        x, v = side * x, side * v
        peak = math.sqrt(x + 0.5 * v * v)
        far = (x + 0.5 * v * v - fastest**2) / fastest if peak > fastest else 0.0
        found.append(v + 2.0 * (min(peak, fastest)) + far)
    return np.array(found)


GUESSES: dict[str, Callable[[np.ndarray], np.ndarray] | None] = {
    "none": None, "0.1": lambda drawn: 0.1 + 0.0 * drawn, "0.3": lambda drawn: 0.3 + 0.0 * drawn,
    "1": lambda drawn: 1.0 + 0.0 * drawn, "3": lambda drawn: 3.0 + 0.0 * drawn, "10": lambda drawn: 10.0 + 0.0 * drawn,
    "drawn": lambda drawn: 10.0 ** (2.0 * drawn - 1.0),
}  # fmt: skip


def carts(count: int, seed: int, N: int = 60) -> str:
    """The table of double integrators."""
    draws, rows = np.random.default_rng(seed), []
    places = np.stack((draws.uniform(-3.5, 3.5, count), draws.uniform(-1.5, 1.5, count)), -1)
    drawn = draws.uniform(0.0, 1.0, count)
    for fastest in (INF, 1.0):
        form, x0 = cart(fastest), places.copy()
        x0[:, 1] = x0[:, 1].clip(-fastest, fastest)
        best, hand = least_time(x0, fastest), form.by_hand(N)
        for name, shares in GUESSES.items():
            times = None if shares is None else shares(drawn) * best
            guess = None if times is None else torch.from_numpy(times)
            problem = form.problem(N, 3.0, torch.from_numpy(x0), guess)
            torchgco.solve(problem.take(slice(0, 2)), verbose=False)
            began = time.process_time()
            found = torchgco.solve(problem, verbose=False)
            spent = (time.process_time() - began) / count
            counts = found.iterations.numpy()
            bad = sum(status is not Status.CONVERGED for status in found.statuses)
            ours = _within(found.violation.numpy(), found.duration.numpy(), best)
            theirs = "-" if times is None else _by_ipopt(form, hand, N, x0, times, best)
            limit = "-" if fastest == INF else f"{fastest:g}"
            rows.append([limit, name, share(ours, count), bad, f"{np.median(counts):.0f} ({counts.max()})",
                         f"{1e3 * spent:.1f}", theirs])  # fmt: skip
    head = ["fastest, m/s", "guess / least time", "within 1e-3", "not CONVERGED", "iterations (most)", "ms a problem",
            "IPOPT by hand: within 1e-3; iterations; ms"]  # fmt: skip
    whole = markdown(head, rows)
    few = {"guess / least time": ("none", "drawn")}
    return filed("free_time-carts", whole, chosen(whole, [name for name in head if name != "not CONVERGED"], **few))


def _within(violation: np.ndarray, found: np.ndarray, best: np.ndarray) -> int:
    return int(((violation <= 1e-6) & (np.abs(found / best - 1.0) < EXACT)).sum())


def _by_ipopt(form: Form, hand: ca.Function, N: int, x0: np.ndarray, times: np.ndarray, best: np.ndarray) -> str:
    ends, began = [], time.process_time()
    for x, T0 in zip(x0, times, strict=True):
        ends.append(form.hand_solved(hand, N, x, lambda s, x=x: (1.0 - s) * x, float(np.clip(T0, *form.times))))
    spent = (time.process_time() - began) / len(x0)
    hits = sum(done and abs(T / t - 1.0) < EXACT for (done, T, _, _), t in zip(ends, best, strict=True))
    counts = [count for *_, count in ends]
    return f"{hits}; {np.median(counts):.0f} ({max(counts)}); {1e3 * spent:.0f}"


def _steering(x: Sequence[Any], u: Sequence[Any], lib: Any) -> list[Any]:
    return [x[2], x[3], 100 * lib.cos(u[0]), 100 * lib.sin(u[0])]


def _arm(x: Sequence[Any], u: Sequence[Any], lib: Any) -> list[Any]:
    inertia = ((5 - x[0]) ** 3 + x[0] ** 3) / 3
    return [x[3], x[4], x[5], u[0] / 5, u[1] / (inertia * lib.sin(x[2]) ** 2), u[2] / inertia]


def _rocket(x: Sequence[Any], u: Sequence[Any], lib: Any) -> list[Any]:
    drag = 310.0 * x[1] * x[1] * lib.exp(-500.0 * (x[0] - 1))
    return [x[1], (u[0] - drag) / x[2] - 1 / x[0] ** 2, -u[0] / 0.5]


def _glider(x: Sequence[Any], u: Sequence[Any], lib: Any) -> list[Any]:
    """States in units of 100 m and 10 m/s."""
    vx, vy = 10 * x[2], 10 * x[3]
    r = (x[0] - 2.5) ** 2
    w = vy - 2.5 * (1 - r) * lib.exp(-r)
    v = lib.sqrt(vx**2 + w**2)
    drag, lift = 0.5 * (0.034 + 0.069662 * u[0] ** 2) * 1.13 * 14 * v * v, 0.5 * u[0] * 1.13 * 14 * v * v
    ax, ay = (-lift * w / v - drag * vx / v) / 100, (lift * vx / v - drag * w / v) / 100 - 9.80665
    return [vx / 100, vy / 100, ax / 10, ay / 10]


PI = math.pi
# Dolan, More and Munson, "Benchmarking optimization software with COPS 3.0" (2004); of the glider the value to which
# trapezoids converge (published: 1255.05, that of 100 of them).
COPS: dict[str, tuple[Form, float, float, tuple[int, int]]] = {
    "steering": (
        Form(_steering, [0, 0, 0, 0], [None, 5, 45, 0], ([-PI / 2], [PI / 2]), None, (0.05, 10.0),
             guess=lambda s: [0, 5 * s, 45 * s, 0]), 1.0, 0.554577, (50, 200),
    ),
    "robot arm": (
        Form(_arm, [4.5, 0, PI / 4, 0, 0, 0], [4.5, 2 * PI / 3, PI / 4, 0, 0, 0], ([-1] * 3, [1] * 3),
             ([0, -PI, 0.01, -INF, -INF, -INF], [5, PI, PI - 0.01, INF, INF, INF]), (0.05, 100.0),
             guess=lambda s: [4.5, 2 * PI / 3 * s * s, PI / 4, 0, 4 * PI / 3 * s, 0]), 1.0, 9.14138, (100, 200),
    ),
    "rocket": (
        Form(_rocket, [1, 0, 1], [None, None, 0.6], ([0], [3.5]), ([1, 0, 0.6], [INF, INF, 1]), (0.001, 1.0),
             lambda x, T: -x[0], 0.0, lambda s: [1, s * (1 - s), 1 - 0.4 * s], [1.75]), 0.1, 1.01283, (100, 400),
    ),
    "glider": (
        Form(_glider, [0, 10, 1.323, -0.1288], [None, 9, 1.323, -0.1288], ([0], [1.4]),
             ([0, -INF, 0, -INF], [INF] * 4), (10.0, 300.0), lambda x, T: -x[0], 0.0,
             lambda s: [13.23 * s, 10 - s, 1.323, -0.1288], [0.7]), 100.0, 12.4803, (100, 200),
    ),
}  # fmt: skip


def cops() -> str:
    """The table of COPS."""
    rows = []
    for name, (form, nominal, known, sizes) in COPS.items():
        for N in sizes:
            problem, unit = form.problem(N, nominal), 100.0 if name == "glider" else 1.0
            torchgco.solve(problem, verbose=False)
            began = time.process_time()
            found = torchgco.solve(problem, verbose=False)
            spent = time.process_time() - began
            value = float(found.duration[0] if form.weight > 0 else found.X[0, -1, 0])
            hand = form.by_hand(N)
            began = time.process_time()
            done, T, last, count = form.hand_solved(
                hand, N, np.array(form.start, dtype=float), form.guess or (lambda s: [s]), nominal
            )
            theirs = T if form.weight > 0 else last[0]
            other = f"{unit * theirs:.6g}; {count}; {time.process_time() - began:.2f}" if done else f"failed; {count}"
            rows.append([name, N, f"{unit * known:.6g}", f"{unit * value:.6g}", f"{value / known - 1.0:+.1e}",
                         int(found.iterations[0]), f"{spent:.3f}", other])  # fmt: skip
    head = [
        "problem",
        "N",
        "known",
        "gco",
        "relative",
        "iterations",
        "s",
        "IPOPT by hand: value; iterations; s",
    ]
    return markdown(head, rows)


def text(count: int, seed: int) -> str:
    """The tables."""
    return f"{carts(count, seed)}\n\n{cops()}"


main = Command(
    __doc__, "free_time", text, "{count} drawn carts, seed {seed}", "CasADi", count=(64, "carts"), seed=(7, "of carts"),
)  # fmt: skip

if __name__ == "__main__":
    raise SystemExit(main())
