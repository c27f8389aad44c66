"""iLQR, the local solver (Algorithm 2)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.constraints.guides import Guide
from torchgco.errors import InputError
from torchgco.lagrangian import VIOLATION_TOLERANCE, Multipliers
from torchgco.native.engine import Options
from torchgco.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers.batch import Loop
from torchgco.solvers.line_search import LineSearch
from torchgco.solvers.state import Callback, InnerEnd
from torchgco.status import Status


@dataclass(frozen=True)
class ILQR:
    """Iterative LQR: expansions, backward pass, line search, until L_M no longer falls.

    Alone it leaves constraints out (`penalty` = 0) or holds them by a fixed quadratic penalty; inside
    `AugmentedLagrangian` it is the inner solver.

    Args:
        tolerance: share of L_M. The solve ends where a full step changed L_M by less and the quadratic model expects
            no more than that from the step.
        absolute_tolerance: ends the solve where |L_M - L_M,prev| is below it, in units of cost (as printed), or of
            `Problem.cost_unit` where `normalise`; 0: never.
        normalise: work in units of `Problem.cost_unit`, so that scaling all weights changes no iterate: penalties and
            regularisation are then relative to the cost. False as printed.
        max_iterations: inner limit.
        line_search: how step lengths are chosen.
        regularisation_first, regularisation_growth, regularisation_max: mu_r after a failed Cholesky: its first
            value, its growth, and where the element gives up.
        damping: mu_r after a failed line search, ten times more after the next, a third after a success; the inner
            solve ends where even regularisation_max didn't help. 0: it ends with the first failure.
        penalty: weight of constraint violations when used alone.

    Raises:
        InputError: a field out of its range.
    """

    tolerance: float = 1e-6
    absolute_tolerance: float = 0.0
    normalise: bool = True
    max_iterations: int = 50
    line_search: LineSearch = LineSearch()
    regularisation_first: float = 1e-6
    regularisation_growth: float = 10.0
    regularisation_max: float = 1e10
    damping: float = 0.0
    penalty: float = 0.0

    def __post_init__(self) -> None:
        for name in ("tolerance", "absolute_tolerance"):
            if not getattr(self, name) >= 0:
                raise InputError(f"ilqr.{name}", "at least 0", getattr(self, name))
        if self.max_iterations < 1:
            raise InputError("ilqr.max_iterations", "at least 1", self.max_iterations)
        if not 0 < self.regularisation_first <= self.regularisation_max:
            raise InputError("ilqr.regularisation_first", "positive, below its maximum", self.regularisation_first)
        if not self.regularisation_growth > 1:
            raise InputError("ilqr.regularisation_growth", "above 1", self.regularisation_growth)
        if not self.damping >= 0:
            raise InputError("ilqr.damping", "at least 0", self.damping)
        if not self.penalty >= 0:
            raise InputError("ilqr.penalty", "at least 0", self.penalty)

    def options(self, rounding: float, lost_beyond: float) -> Options:
        """The same for native kernels; `rounding` is the share of L_M below which an expected change means
        nothing, `lost_beyond` how many times L_M the shortest step makes of it where rollouts diverge."""
        search = self.line_search
        return Options(
            tuple(search.ladder), -1 if search.back is None else search.back, self.max_iterations,
            search.accept_last, self.tolerance, self.absolute_tolerance, search.ratio_min, search.ratio_max,
            search.smallest, self.regularisation_first, self.regularisation_growth, self.regularisation_max,
            self.damping, rounding, lost_beyond,
        )  # fmt: skip

    def solve(
        self,
        problem: Problem,
        U0: Tensor,
        seed: int = 0,
        ids: Tensor | None = None,
        warm: Multipliers | None = None,
        callback: Callback | None = None,
        guide: Guide | None = None,
    ) -> Solution:
        """One inner solve of every problem, from U0 (B, N, m); `violation` tells what the constraints say of it.

        `warm` multipliers are held fixed, with their own penalties, and so is the region that `guide` draws to. `seed`
        is unused: nothing here is random.
        """
        return Loop(_OneInnerSolve(self, self.penalty), problem, U0, seed, ids, warm, callback, guide).run()


@dataclass(frozen=True)
class _OneInnerSolve:
    """The outer loop that isn't one: it ends with the first inner solve, and says how that ended."""

    inner: ILQR
    initial_penalty: float
    guidance: None = None
    penalty_growth: float = 1.0
    penalty_max: float = math.inf
    grow_when_feasible: bool = True
    violation_tolerance: float = VIOLATION_TOLERANCE
    hold_factor: float = 1.0
    attempts: int = 1
    arrival: float | None = None
    thorough: bool = False
    clip: bool = False
    slots: None = None
    record: bool = False

    def verdict(self, inner: InnerEnd) -> Tensor:
        return torch.where(inner.refused, int(Status.LINE_SEARCH_FAILED), int(Status.MAX_ITERATIONS))
