"""The options and constants of an inner solve, as kernels in C and in PyTorch read them."""

from __future__ import annotations

from dataclasses import dataclass

from torchgco.ilqr.line_search import LineSearch

ROUNDED_OFF = 1e-14  # share of L_M: a smaller expected change is rounding error
# mu_r after a failed Cholesky (Algorithm 2, line 9): first value, growth factor, and the limit that ends a problem.
REGULARISATION_FIRST, REGULARISATION_GROWTH, REGULARISATION_MAX = 1e-6, 10.0, 1e10
# mu_r after a failed line search: first value in units of `Problem.cost_unit`, factor per failure, divisor per success.
DAMPING, DAMPING_GROWTH, DAMPING_DECAY = 0.02, 10.0, 3.0


@dataclass(frozen=True)
class Descent:
    """How an inner solve descends: the fields of `solvers.ilqr.ILQR`, which explains them."""

    line_search: LineSearch
    tolerance: float
    max_iterations: int
    as_printed: bool
