"""Algorithm 1, the augmented Lagrangian method, and Algorithm 4, the same with guidance between its solves."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tests.reference.guidance import stuck_knots
from tests.reference.ilqr import Iteration, ilqr
from tests.reference.lagrangian import Guide, Multipliers, updated_multipliers
from tests.reference.problem import rollout


@dataclass(frozen=True)
class Schedule:
    """Limits and penalty growth, Tables A3 and 4. `nu` None means eta^2, as in the tables."""

    outer_iterations: int = 20
    mu0: float = 20.0
    eta: float = 2.2
    mu_gco0: float = 20.0
    nu: float | None = None
    tolerance: float = 1e-18
    max_iterations: int = 100


@dataclass
class OuterIteration:
    """One outer iteration: the inputs of its iLQR solve, and its results.

    Inputs: lam, mu, guide (None: not used), mu_gco. Results: X, U, cost (L_M), status, inner.
    J: the knots of X with two or more active spheres, from which the next guide is made.
    """

    lam: Multipliers
    mu: float
    guide: Guide | None
    mu_gco: float
    X: np.ndarray
    U: np.ndarray
    cost: float
    status: str
    inner: list[Iteration]
    J: list[int]


@dataclass
class Result:
    """The last X (N+1, n), U (N, m), the multipliers of the last solve, and a record per outer iteration."""

    X: np.ndarray
    U: np.ndarray
    lam: Multipliers
    records: list[OuterIteration]


def solve(problem, U, schedule=None, guidance: Callable | None = None, lam=None):
    """Algorithm 4; without `guidance` it is Algorithm 1. U (N, m) is the initial guess.

    `guidance(outer, X, U) -> Guide or None` is CPUF, called after outer iteration `outer` = 0, 1, ...
    The convergence test (lines 7-9) is the fixed limit: the last iteration ends before CPUF and updates.
    """
    schedule = schedule or Schedule()
    nu = schedule.eta**2 if schedule.nu is None else schedule.nu
    X = rollout(problem, U)
    lam = Multipliers.zeros(problem) if lam is None else lam.copy()
    mu, mu_gco, guide = schedule.mu0, schedule.mu_gco0, None
    records = []
    while True:
        inner = ilqr(problem, X, U, lam, mu, guide, mu_gco, schedule.tolerance, schedule.max_iterations)
        X, U = inner.X, inner.U
        J = stuck_knots(problem, X)
        records.append(OuterIteration(lam.copy(), mu, guide, mu_gco, X, U, inner.cost, inner.status, inner.records, J))
        failed = inner.status in ("not_positive_definite", "non_finite")
        if failed or len(records) >= schedule.outer_iterations:
            return Result(X, U, lam, records)
        guide = guidance(len(records) - 1, X, U) if guidance is not None else None
        lam = updated_multipliers(problem, X, U, lam, mu)
        mu = schedule.eta * mu
        mu_gco = nu * mu_gco
