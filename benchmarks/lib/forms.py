"""Optimal control problems that PyTorch and CasADi state from the same lines."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from torchgco import (
    ControlBounds,
    FreeTime,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Problem,
    StateBounds,
)

D, INF = torch.float64, math.inf


@dataclass(frozen=True)
class Form:
    """A problem of fixed or free time.

    Attributes:
        rates: x' of lists of states and controls, with the functions of a module (`torch` or `casadi`).
        start, end: of states; None in `end` is free.
        control, state: their bounds.
        times: least and most, s; the same for a fixed time.
        value, weight: what is minimised: a function of the last states, and the weight of the duration.
        guess: states at a share of the time.
        U0: a guess of the controls; default: 0.
        path: rows g(x) <= 0 of the states at all knots but the first.
    """

    rates: Callable[[Sequence[Any], Sequence[Any], Any], list[Any]]
    start: Sequence[float]
    end: Sequence[float | None]
    control: tuple[Sequence[float], Sequence[float]]
    state: tuple[Sequence[float], Sequence[float]] | None
    times: tuple[float, float]
    value: Callable[[Sequence[Any]], Any] | None = None
    weight: float = 1.0
    guess: Callable[[float], Sequence[float]] | None = None
    U0: Sequence[float] | None = None
    path: Callable[[Sequence[Any], Any], list[Any]] | None = None

    def problem(self, N: int, nominal: float, x0: Tensor | None = None, guess: Tensor | None = None) -> Problem:
        """The problem, of free time or fixed; x0 (B, n) in place of the start, guess (B,) of the duration, s."""
        n, m = len(self.start), len(self.control[0])
        field = lambda x, u: torch.stack(self.rates(x.unbind(-1), u.unbind(-1), torch), -1)
        fixed = [i for i, x in enumerate(self.end) if x is not None]
        end = torch.tensor([self.end[i] for i in fixed], dtype=D)
        rows = [
            *([ControlBounds(*self.control)] if np.isfinite(self.control).any() else []),
            *([FunctionConstraint(lambda x: x[..., fixed] - end, "equality", knots=[-1], name="end")] if fixed else []),
            *([] if self.state is None else [StateBounds(*self.state)]),
        ]
        if (path := self.path) is not None:
            rows.append(FunctionConstraint(lambda x: torch.stack(path(x.unbind(-1), torch), -1), name="path"))
        last = None if (value := self.value) is None else lambda x: value(x.unbind(-1))
        cost = FunctionCost(lambda x, u: 0.0 * u[..., 0], last)
        model = FunctionDynamics(field, n, m, nominal / N, "rk4")
        x0 = torch.tensor([self.start], dtype=D) if x0 is None else x0
        if self.times[0] == self.times[1]:
            return Problem(model, cost, rows, x0, N)
        least, most = (bound / nominal for bound in self.times)
        factor = None if guess is None else (guess / nominal).clamp(least, most)
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
        value = self.weight * T + (0.0 if self.value is None else self.value(ca.vertsplit(X[:, N])))
        if self.path is not None:
            rows += [row for k in range(1, N + 1) for row in self.path(ca.vertsplit(X[:, k]), ca)]
        return ca.nlpsol("solver", "ipopt", {"x": v, "p": x0, "f": value, "g": ca.vertcat(*rows)}, quiet)

    def hand_solved(
        self, solver: ca.Function, N: int, x0: np.ndarray, states: Callable[[float], Sequence[float]], T0: float
    ) -> tuple[bool, float, np.ndarray, int, float]:
        """Whether IPOPT succeeds, the duration, the last states, iterations, and what is minimised."""
        low, high = self.state or ([-INF] * len(x0), [INF] * len(x0))
        u0 = self.U0 or [0.0] * len(self.control[0])
        lowest = np.full(solver.size1_out("g"), -INF)
        lowest[: (N + 1) * len(x0)] = 0.0  # rows of steps; those of the path may be less
        guess, lower, upper = [np.array([T0])], [np.array([self.times[0]])], [np.array([self.times[1]])]
        for k in range(N + 1):
            free = k == 0
            guess.append(np.asarray(states(k / N), dtype=float))
            bounds = list(zip(low, high, strict=True))
            ends = [pair if e is None else (e, e) for e, pair in zip(self.end, bounds, strict=True)]
            pairs = [(-INF, INF)] * len(x0) if free else ends if k == N else bounds
            lower.append(np.array([p[0] for p in pairs]))
            upper.append(np.array([p[1] for p in pairs]))
            if k < N:
                guess.append(np.array(u0))
                lower.append(np.array(self.control[0]))
                upper.append(np.array(self.control[1]))
        found = solver(
            x0=np.concatenate(guess), p=x0, lbx=np.concatenate(lower), ubx=np.concatenate(upper), lbg=lowest, ubg=0.0
        )
        v, stats = np.array(found["x"]).ravel(), solver.stats()
        return bool(stats["success"]), float(v[0]), v[-len(x0) :], int(stats["iter_count"]), float(found["f"])
