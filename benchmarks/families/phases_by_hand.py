"""A program of several phases for IPOPT, by hand with CasADi: multiple shooting in steps of rk4."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

OPTIONS = {
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-8,
    "ipopt.max_iter": 3000,
    "ipopt.bound_relax_factor": 0.0,
}


class Hand:
    """Variables, rows and a cost that phases add to.

    Attributes:
        cost: what is minimised.
    """

    def __init__(self) -> None:
        self.cost: Any = ca.SX(0)
        self._variables, self._guess, self._limits = list[Any](), list[np.ndarray](), [list[Any](), list[Any]()]
        self._rows, self._row_limits = list[Any](), [list[Any](), list[Any]()]
        self._places: dict[int, tuple[int, int]] = {}

    def variable(self, guess: Any) -> Any:
        """A column of variables."""
        guess = np.atleast_1d(np.asarray(guess, dtype=float))
        column = ca.SX.sym(f"v{len(self._variables)}", guess.size)
        first = sum(part.size for part in self._guess)
        self._places[column[0].element_hash()] = first, first + guess.size
        self._variables.append(column)
        self._guess.append(guess)
        for limits, free in zip(self._limits, (-np.inf, np.inf), strict=True):
            limits += [free] * guess.size
        return column

    def bound(self, columns: Sequence[Any], lower: Any, upper: Any) -> None:
        """Bounds of some columns of variables."""
        for column in columns:
            a, b = self._places[column[0].element_hash()]
            for limits, values, tighter in zip(self._limits, (lower, upper), (np.maximum, np.minimum), strict=True):
                limits[a:b] = tighter(limits[a:b], values).tolist()

    def rows(self, column: Any, lower: float = 0.0, upper: float = 0.0) -> None:
        """Rows between two numbers."""
        self._rows.append(column)
        for limits, value in zip(self._row_limits, (lower, upper), strict=True):
            limits += [value] * column.numel()

    def phase(
        self,
        field: Callable[[Any, Any], Any],
        X: np.ndarray,
        U: np.ndarray,
        factor: float,
        dt: float,
        limits: tuple[float, float] | None = None,
        start: Sequence[float] | None = None,
    ) -> tuple[list[Any], list[Any], Any]:
        """States and controls of a phase from its guess, and the factor by which its stages last longer than dt.

        Args:
            limits: of the factor; None: it is 1.
            start: the first state; None: it is free.
        """
        tau = 1.0 if limits is None else self.variable(factor)
        if limits is not None:
            self.bound([tau], *limits)
        states, controls = [self.variable(X[0])], []
        if start is not None:
            self.bound(states, start, start)
        for k in range(len(U)):
            controls.append(self.variable(U[k]))
            states.append(self.variable(X[k + 1]))
            self.rows(states[k + 1] - _ahead(field, states[k], controls[k], dt * tau))
        return states, controls, tau

    def solved(self) -> Solved:
        """The result."""
        program = {"x": ca.vertcat(*self._variables), "f": self.cost, "g": ca.vertcat(*self._rows)}
        solver = ca.nlpsol("phases", "ipopt", program, OPTIONS)
        lbx, ubx = self._limits
        lbg, ubg = self._row_limits
        given = {"x0": np.concatenate(self._guess), "lbx": lbx, "ubx": ubx, "lbg": lbg, "ubg": ubg}
        return Solved(solver, given)


class Solved:
    """IPOPT's result, and its least processor time of three runs, ms."""

    def __init__(self, solver: Any, given: dict[str, Any]) -> None:
        took = []
        for _ in range(3):
            began = time.process_time()
            found = solver(**given)
            took.append(1e3 * (time.process_time() - began))
        self.cost, self.milliseconds = float(found["f"]), min(took)
        self.iterations, self.status = int(solver.stats()["iter_count"]), str(solver.stats()["return_status"])
        self.variables = np.asarray(found["x"]).reshape(-1)


def _ahead(field: Callable[[Any, Any], Any], x: Any, u: Any, h: Any) -> Any:
    """A step of rk4."""
    a = field(x, u)
    b = field(x + 0.5 * h * a, u)
    c = field(x + 0.5 * h * b, u)
    d = field(x + h * c, u)
    return x + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
