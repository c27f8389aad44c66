"""python -m benchmarks.families.free_time: least times against closed forms and COPS.

Every problem is stated with `FreeTime` and solved by `gco`, without any guess but that of the time where one is named.
Beside it IPOPT through CasADi by hand: multiple shooting on equal stages with the duration as a variable, states on the
straight line to the end (COPS: COPS's own guesses), and the same guess of the time.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np
import torch

import torchgco
from benchmarks.lib.command import Command
from benchmarks.lib.forms import INF, Form
from benchmarks.lib.page import chosen, filed, markdown, share
from torchgco import Status

EXACT = 1e-3  # share of the least time, of equal stages of which one holds the switch


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
    hits = sum(done and abs(T / t - 1.0) < EXACT for (done, T, *_), t in zip(ends, best, strict=True))
    counts = [count for *_, count, _ in ends]
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
             lambda x: -x[0], 0.0, lambda s: [1, s * (1 - s), 1 - 0.4 * s], [1.75]), 0.1, 1.01283, (100, 400),
    ),
    "glider": (
        Form(_glider, [0, 10, 1.323, -0.1288], [None, 9, 1.323, -0.1288], ([0], [1.4]),
             ([0, -INF, 0, -INF], [INF] * 4), (10.0, 300.0), lambda x: -x[0], 0.0,
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
            done, T, last, count, _ = form.hand_solved(
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
