"""Linear systems with the matrix of the KKT conditions: what kernels are asked for derivatives of solutions.

    [H  F' A'] [z]     [a]
    [F       ] [y] = - [b]        H the curvature of the Lagrangian, F the slopes of step(x, u) - x',
    [A    -D ] [v]     [c]        A those of the rows that hold: D = 0, or slack / multiplier of rows in a barrier

The matrix is symmetric: the same solve gives products with its inverse from both sides. The interior point's Riccati
recursion factors H + A'wA, w = 1 / (D + 1 / sigma), and F; steps with these factors close, round by round, what the
last one has left open: of the rows A all but a share of about 1 / sigma, as the method of multipliers does, of all else
all but rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

# sigma, as a multiple of the largest curvature: the root of rounding, which balances what each round leaves
STIFF = 1e8
# Times that curvature: the least share of what the cost lets a row give way. Where units differ, sigma is less, and the
# row 1e13 times as stiff as the cost: a thousandth of what rounding would hide.
SLIGHT = 1e-5
CLOSING_ROUNDS = 4
LEAST_PIVOT = 1e-14  # least pivot of the factors, as a share of its entry: where one is less, the minimum isn't strict


@dataclass(frozen=True)
class RightSides:
    """C right hand sides of B systems; S = n + m. R rows: constraint by constraint, and knot by knot."""

    a: Tensor  # (C, B, N+1, S): those of controls at the last knot, and of a given start, don't count
    b: Tensor  # (C, B, N, n)
    c: Tensor  # (C, B, R): those of rows that aren't active don't count


@dataclass(frozen=True)
class KktSolve:
    """Solutions of the systems at given trajectories."""

    z: Tensor  # (C, B, N+1, S)
    y: Tensor  # (C, B, N, n): of the gaps
    v: Tensor  # (C, B, R): 0 where a row isn't active
    left: Tensor  # (C, B): the largest of c + A z - D v, more than rounding where rows depend on each other
    costates: Tensor  # (B, N+1, n) that make the Lagrangian stationary in the states; those of knot 0 are 0
    definite: Tensor  # (B,) bool: the minimum is strict, H is positive definite where F z = 0 and A z = 0
