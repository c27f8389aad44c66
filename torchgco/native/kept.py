"""Problems that stay packed for the interior point in C from call to call: only their numbers are written again."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.lagrangian.barrier import BarrierOptions
from torchgco.lagrangian.lagrangian import later
from torchgco.native.engine import run
from torchgco.native.interior import InteriorEngine, interior
from torchgco.native.kept_problem import KeptProblem
from torchgco.problem.problem import Problem
from torchgco.problem.scale import CostScale


class Kept(KeptProblem):
    """Kept problems for the interior point.

    Args:
        kernels: of the problems' form.
        problem: see `KeptProblem`.
        scale: of the costs.
        options: with which problems are solved.
    """

    def __init__(self, kernels: InteriorEngine, problem: Problem, scale: CostScale, options: BarrierOptions) -> None:
        super().__init__(kernels.engine, problem)
        B, N, n, m, like = problem.B, problem.N, problem.n, problem.m, problem.x0
        self.library, self.lanes = kernels.library, kernels.lanes
        self.gains = like.new_zeros(B, N, m, n + 1)
        self.status, self.iterations = torch.zeros(B, dtype=torch.int32), torch.zeros(B, dtype=torch.int64)
        self.barrier = like.new_zeros(B)
        self.packed.fill({"gains": self.gains, "status": self.status, "iterations": self.iterations})
        self.rolled = self.X.clone(), self.U.clone()  # trajectories of the controls with their feedback
        self.worst = like.new_zeros(B)
        # The same memory by NumPy, which takes a small share of PyTorch's time for a few numbers.
        self._moving = [part.numpy() for part in (self.X, self.U, *self.lam)]
        at_rows = [torch.arange(N + 1, device=like.device)[part.knots].tolist() for part in problem.constraints]
        self._knots: list[Sequence[int]] = [range(N + 1), range(N), *at_rows]
        self._later = dict[int, list[np.ndarray | None]]()
        self._rolled, self._x0 = [part.numpy() for part in self.rolled], problem.x0.numpy()
        self._flat = [part.reshape(B, -1) for part in self._rolled]
        self._gains = self.gains.numpy()
        self._feedback = self._gains[..., :-1]
        self.statuses, self.violations = self.status.numpy(), self.worst.numpy()
        self._barrier, self._iterations = self.barrier.numpy(), self.iterations.numpy()
        self._follow = self.packed.copy()
        self._follow.fill({"X": self.rolled[0], "U": self.rolled[1], "merit": self.worst})
        self.how, _ = interior(problem, self.packed, self.barrier, scale, options)

    def solve(self, rows: np.ndarray, mu: float, seconds: float) -> None:
        """Solve the problems that `rows` (B,) marks, from X, U and `lam`, in place, with `mu` as the first barrier.

        They take `seconds` at most. `rolled` then holds the rollouts that follow the solution by its
        feedback, and `worst` (B,) their violation.
        """
        B, library = self.problem.B, self.engine.library
        until = time.monotonic() + seconds
        self.how.seconds = seconds
        self._barrier[:] = mu
        self.statuses[:] = 0
        self._iterations[:] = 0
        spans = _spans(rows)
        for first, last in spans:
            self._gains[first:last] = 0.0  # of problems that a deadline leaves no time for
        for first, last in spans:
            run(self.library.tgco_interior, last - first, self.lanes, self.how, first)
            self.how.seconds = max(0.0, until - time.monotonic())
        if not math.isfinite(self._gains.sum()):
            np.nan_to_num(self._gains, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
        self._rolled[0][:], self._rolled[1][:] = self._moving[:2]
        run(library.tgco_closed_loop, B, self.lanes, self._follow)
        if self.engine.measures:
            run(library.tgco_violation, B, self.lanes, self._follow)

    def begin_with(self, other: Kept) -> None:
        """Take over the iterates of another one of the same shapes."""
        for target, its in zip(self._moving, other._moving, strict=True):
            target[:] = its

    def take_over(self, rows: Tensor, solution: Any) -> None:
        """Put the states, controls and multipliers of solutions in the places `rows` (b,)."""
        self.X[rows], self.U[rows] = solution.X, solution.U
        for lam, new in zip(self.lam, solution.multipliers.lam, strict=True):
            lam[rows] = new

    def begin_at(self, rows: Tensor, X: Tensor, U: Tensor) -> None:
        """Put trajectories in the places `rows` (b,), without multipliers."""
        self.X[rows], self.U[rows] = X, U
        for lam in self.lam:
            lam[rows] = 0.0

    @property
    def times(self) -> Tensor | None:
        """Of the knots, (B, N+1), s, where they are free; else None."""
        return None

    @property
    def multipliers(self) -> tuple[Tensor, ...]:
        """Copies of `lam`."""
        return tuple(lam.clone() for lam in self.lam)

    @property
    def finite(self) -> np.ndarray:
        """Whether all states and controls of `rolled` are, (B,)."""
        X, U = self._flat
        return np.asarray(np.isfinite(X).all(axis=1) & np.isfinite(U).all(axis=1))

    def copies(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """X (B, N+1, n) and U (B, N, m) as rolled out, gains K (B, N, m, n), status (B,) and iterations (B,)."""
        X, U = self._rolled
        parts = X.copy(), U.copy(), self._feedback.copy(), self.statuses.astype(np.int64), self._iterations.copy()
        x, u, K, status, iterations = map(torch.from_numpy, parts)
        return x, u, K, status, iterations

    def start(self) -> None:
        """Let all trajectories begin at the problem's starts."""
        self._moving[0][:, 0] = self._x0

    def shift(self, by: float) -> None:
        """Let all trajectories and multipliers begin `by` stages later, as `Solution.shifted` does.

        Part of a stage takes the straight line between what whole stages give: a guess, for the solve that follows.
        """
        whole = int(by)
        if whole:
            self._shift(whole)
        if (share := by - whole) > 0:
            now = [numbers.copy() for numbers in self._moving]
            self._shift(1)
            for numbers, before in zip(self._moving, now, strict=True):
                numbers *= share
                numbers += (1 - share) * before

    def _shift(self, by: int) -> None:
        if by not in self._later:
            self._later[by] = [_moved(knots, by) for knots in self._knots]
        for numbers, places in zip(self._moving, self._later[by], strict=True):
            if places is None:
                numbers[:, :-by], numbers[:, -by:] = numbers[:, by:], numbers[:, -1:]
            else:
                numbers[:] = numbers[:, places]


def _spans(rows: np.ndarray) -> list[tuple[int, int]]:
    """The first and the last place, plus one, of each run of rows that are marked, (B,) bool."""
    if rows.all():
        return [(0, len(rows))]
    edges = np.diff(np.pad(rows.astype(np.int8), 1)).nonzero()[0].tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def _moved(knots: Sequence[int], by: int) -> np.ndarray | None:
    """The places that numbers at these knots come from, `by` stages later; None: each from `by` places on."""
    places = np.array(later(knots, by), dtype=np.intp)
    last = len(places) - 1
    return None if by <= last and np.array_equal(places, np.minimum(np.arange(by, by + len(places)), last)) else places
